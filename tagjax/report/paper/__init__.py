"""The papers' figures, drawn from arrays. Each module draws one kind; `tagjax.evaluation.paper` has the table of all."""
