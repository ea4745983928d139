"""Make a table from its recipe: measure it, write its JSON, and write it into its pages. Simulating needs the sim extra."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...core.progress import OnProgress, unobserved
from .markdown import write_pages
from .measure import Inputs, measure
from .recipe import Recipe
from .table import begin, filled, read_table, scores_by_recording, table_path, write_table


def make_table(
    recipe: Recipe,
    root: Path,
    *,
    suites: Mapping[str, Mapping[str, Any]],
    tracers: Mapping[str, Mapping[str, Any]],
    recordings: Path,
    finished: Path,
    workers: int = 1,
    confirm: int | None = None,
    on_progress: OnProgress = unobserved,
) -> dict[str, Any]:
    """Measure a table, write it to docs/tables below `root` and into its pages, and return it.

    `suites` and `tracers` are the settings that the recipe names (`Recipe.suites`, `Recipe.tracers`). The
    recordings of suites are in the folder `recordings`; missing ones are simulated by `workers` processes. Scores of each
    traced recording are stored in `finished`, so that the next call resumes after an interruption. `confirm` brings the
    table that there is up to date: see `measure`.
    """
    begun, path = begin(recipe, root), table_path(root, recipe.name)
    inputs = Inputs(suites, tracers, recordings, finished, begun["depends"], workers, begun["revision"]["commit"])
    before = {} if confirm is None else scores_by_recording(read_table(path))
    scores = measure(recipe, inputs, before=before, confirm=confirm, on_progress=on_progress)
    table = filled(begun, recipe, scores)
    write_table(path, table)
    write_pages(recipe, root)
    return table
