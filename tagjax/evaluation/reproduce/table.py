"""A table as data: its cells from the scores of recordings, and its JSON file."""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.machine import machine
from ...core.results import write_json
from ...metrics.interval import LEVEL, NUM_RESAMPLES, SEED, ratio_estimate
from .provenance import dependencies, revision
from .recipe import COUNTS, Column, Job, Recipe, Row, TableRecipe
from .scores import RecordingScores

FORMAT, VERSION = "tagjax-table", 1


def command(name: str) -> str:
    """The command that makes a table."""
    return f"python -m experiments.reproduce table={name}"


def table_path(root: Path, name: str) -> Path:
    """The path of a table's JSON."""
    return root / "docs" / "tables" / f"{name}.json"


def begin(recipe: TableRecipe, root: Path) -> dict[str, Any]:
    """The metadata of a table before it is measured: name, command, revision, date, machine, and files it depends on."""
    files = dependencies(root, recipe.depends)
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": recipe.name,
        "title": recipe.title,
        "command": command(recipe.name),
        "revision": revision(root, files),
        "date_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "interval": {"level": LEVEL, "num_resamples": NUM_RESAMPLES, "seed": SEED, "method": "percentile bootstrap"},
        "depends": files,
    }


def filled(begun: Mapping[str, Any], recipe: Recipe, scores: Mapping[Job, Sequence[RecordingScores]]) -> dict[str, Any]:
    """The whole table as plain values: its metadata from `begin`, columns, rows with their cells, and scores by recording."""
    columns = [
        {"name": name, "heading": column.heading, "measures": list(column.measures), "interval": column.interval}
        for name, column in recipe.columns.items()
    ]
    rows = [
        {
            "label": row.label,
            "kind": row.kind,
            "cells": {name: _cell(recipe, row, name, column, scores) for name, column in recipe.columns.items()},
        }
        for row in recipe.rows
    ]
    by_job = {job.name: [dataclasses.asdict(one) for one in results] for job, results in scores.items()}
    return {**begun, "columns": columns, "rows": rows, "recordings": by_job}


def scores_by_recording(table: Mapping[str, Any] | None) -> dict[str, list[RecordingScores]]:
    """The scores of each recording by the name of its job; none where there is no table."""
    if table is None:
        return {}
    commit = table["revision"]["commit"]
    return {
        job: [RecordingScores.from_json(one, commit) for one in scores] for job, scores in table["recordings"].items()
    }


def _cell(
    recipe: Recipe, row: Row, name: str, column: Column, scores: Mapping[Job, Sequence[RecordingScores]]
) -> dict[str, Any] | None:
    """One cell: recorded, or with its values, intervals and counts; None where it is empty."""
    if name in row.recorded:
        return {"kind": "recorded", **dataclasses.asdict(row.recorded[name])}
    job = recipe.job(row, name)
    if job is None:
        return None
    results = scores[job]
    values = {measure: _estimate(measure, results) for measure in column.measures if measure not in COUNTS}
    return {
        "kind": "score",
        "job": job.name,
        "values": values,
        "num_recordings": len(results),
        "num_tags": sum(one.num_tags for one in results),
        "num_frames": sum(one.num_frames for one in results),
    }


def _estimate(measure: str, scores: Sequence[RecordingScores]) -> dict[str, Any]:
    """A measure's mean with its interval."""
    sums = [one.sums.get(measure, (0.0, 0)) for one in scores]
    totals, counts = np.array([one[0] for one in sums], np.float64), np.array([one[1] for one in sums], np.int64)
    return dataclasses.asdict(ratio_estimate(totals, counts))


def write_table(path: Path, table: Mapping[str, Any]) -> None:
    """Write a table atomically."""
    write_json(path, table)


def read_table(path: Path) -> dict[str, Any] | None:
    """A table of `write_table`; None if it has not been made. Raises `ValueError` for a file that is something else."""
    if not path.exists():
        return None
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not JSON ({error}); make the table again, or restore the file.") from error
    if not isinstance(table, dict) or table.get("format") != FORMAT or table.get("version") != VERSION:
        raise ValueError(f"{path}: found no {FORMAT} of version {VERSION}; make the table again, or restore the file.")
    return table
