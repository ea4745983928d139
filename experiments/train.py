"""Train a tracer on unlabelled recordings and evaluate it on validation recordings.

python -m experiments.train
python -m experiments.train 'data.recordings=[a.zarr,b.zarr]' 'data.validation=[c.zarr]' loop.num_steps=200
python -m experiments.train suite=multi_4                             # on its train split, simulated where missing
python -m experiments.train -m optimizer.learning_rate=0.01,0.03 hydra/launcher=joblib
python -m experiments.train -m hparams_search=optuna                  # a killed search resumes when started again
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import resumable_command
from .errors import errors_in_one_line
from .hparams_search import sweep_score
from .run_folder import check_configuration, keep_configuration
from .suites import suite_recordings


@resumable_command
def main(values: dict[str, Any], folder: Path) -> float | None:
    from tagjax.core.settings import from_mapping
    from tagjax.training.config import TrainConfig
    from tagjax.training.loop import DivergedError
    from tagjax.training.run import run_training

    suite, recordings_dir = values.pop("suite", None), values.pop("recordings_dir")
    data = values["data"]
    given = data["recordings"] or data["validation"] or data["virtual_tag"]["tracks"] is not None
    if suite is not None and not given:
        progress = values["loop"]["progress"]
        data["recordings"] = suite_recordings(suite, "train", recordings_dir, progress=progress)
        data["validation"] = suite_recordings(suite, "validation", recordings_dir, progress=progress)
    config = from_mapping(TrainConfig, values)
    check_configuration(folder, values)
    with errors_in_one_line("train", DivergedError):
        score = run_training(config, folder, on_start=lambda: keep_configuration(folder, values))
    print(f"run folder: {folder}")
    return sweep_score(score)


if __name__ == "__main__":
    main()
