"""The recipe of a table: its rows and columns, what is measured for each cell, and the files that determine the values.

A recipe is plain settings (conf/table/<name>.yaml). Nothing in it is executed: what can be measured is a score of a suite
(`kind: score`), and what cannot be measured from a simulated suite is written by hand with its source (`kind: recorded`).
What other commands measure has a recipe of its own kind (`CommandRecipe`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any, Literal

from ...core.settings import ConfigError, changed
from ...metrics.recordings import ScoreSettings
from ...tracing.clips import ClipSettings

Kind = Literal["score", "recorded"]

Split = Literal["train", "validation", "test"]

COUNTS = ("num_recordings", "num_tags", "num_frames")
"""Measures that count the items over which a cell's scores are averaged."""

SCORES = (
    *("iou", "cle_px", "mask_j", "identification", "success", "locked", "p_fa"),
    *("clear_iou", "clear_identification", "carrier_iou"),
)
"""Means that a column can show: scores of `tagjax.metrics.tags.Scores`, and `locked` (of all tags)."""

MEASURES = (*SCORES, *COUNTS)
"""All that a column can show."""


@dataclasses.dataclass(frozen=True)
class System:
    """A tracer with its settings for the measurement.

    `clips` overrides the clip settings of the weights or of the tracer, `scores` those of the protocol.
    """

    tracer: str  # the name of its settings in conf/tracer, or `blobs` (conf/system)
    weights: str | None = None  # learned parameters: `default`, a name, or a file
    clips: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    scores: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        changed(ClipSettings(), self.clips, where="clips")
        changed(ScoreSettings(), self.scores, where="scores")


@dataclasses.dataclass(frozen=True)
class Protocol:
    """Which frames of a recording are traced (all if None), and which are scored; `scores` overrides `ScoreSettings`."""

    frames: tuple[int, int] | None = None
    scores: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        changed(ScoreSettings(), self.scores, where="scores")
        if self.frames is not None and not 0 <= self.frames[0] < self.frames[1]:
            raise ConfigError(f"frames is {list(self.frames)}; expected [from, to] with 0 <= from < to.")


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A value written by hand, with the command, revision and date of its measurement, or its source in a paper."""

    text: str
    command: str | None = None
    revision: str | None = None
    date: str | None = None
    paper: str | None = None  # "Fig. 10"

    def __post_init__(self) -> None:
        measured = [self.command, self.revision, self.date]
        if None in measured if self.paper is None else any(measured):
            raise ConfigError(
                f"{self.text!r}: found command {self.command}, revision {self.revision}, date {self.date}, paper {self.paper}; "
                "expected the first three (a value measured here), or paper alone (a value from a paper)."
            )


@dataclasses.dataclass(frozen=True)
class Column:
    """A column: its heading, and the measures that it shows."""

    heading: str
    measures: tuple[str, ...] = ()  # none: a column of recorded values
    interval: bool = False  # whether the first measure is followed by its 95 % interval

    def __post_init__(self) -> None:
        if unknown := [name for name in self.measures if name not in MEASURES]:
            raise ConfigError(f"found measure {', '.join(unknown)}; expected some of {', '.join(MEASURES)}.")


@dataclasses.dataclass(frozen=True)
class Row:
    """A row: a suite's recordings, scored, or values recorded by hand; `recorded` is by the name of the column."""

    label: str
    kind: Kind = "score"
    suite: str | None = None
    split: Split = "test"
    seeds: tuple[int, ...] | None = None  # the suite's recordings with all of these seeds; the suite's own seed if None
    protocol: str | None = None
    system: str | Mapping[str, str] | None = None  # for all columns, or by the name of the column
    recorded: Mapping[str, Recorded] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.kind == "score" and (self.suite is None or self.protocol is None):
            raise ConfigError(f"row {self.label!r}: found no suite or no protocol; a score needs both.")
        if self.kind == "recorded" and (self.suite or self.protocol or self.system or not self.recorded):
            raise ConfigError(f"row {self.label!r}: kind is recorded; expected only recorded values, without a suite.")


@dataclasses.dataclass(frozen=True)
class Job:
    """The measurement of a cell's scores: every recording of a suite's split, under a protocol, by a system."""

    suite: str
    split: str
    seeds: tuple[int, ...] | None
    protocol: str
    system: str

    @property
    def name(self) -> str:
        """A readable name, also used in the JSON."""
        seeds = "" if self.seeds is None else f"/seeds {', '.join(map(str, self.seeds))}"
        return f"{self.suite}/{self.split}{seeds}/{self.protocol}/{self.system}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class TableRecipe:
    """What every recipe of a table has."""

    name: str
    title: str
    pages: tuple[str, ...]  # files that hold the markers `<!-- table: name -->` and `<!-- /table -->`
    columns: Mapping[str, Any]
    rows: tuple[Any, ...]
    depends: tuple[str, ...]  # patterns of files (`tagjax/radio/**/*.py`); the table is stale once one of them changes

    def __post_init__(self) -> None:
        for name in ("pages", "columns", "rows", "depends"):
            if not getattr(self, name):
                raise ConfigError(f"{name} is empty; expected at least one.")
        for path in (*self.pages, *self.depends):
            if PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts:
                raise ConfigError(f"found {path!r}; expected a path within the repository, from its root.")

    @staticmethod
    def _check(where: str, found: Any, known: Mapping[str, Any]) -> None:
        if unknown := [str(name) for name in found if name not in known]:
            raise ConfigError(f"{where}: found {', '.join(unknown)}; expected some of {', '.join(known) or 'none'}.")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recipe(TableRecipe):
    """Everything that determines a table of scores, except for the files in `depends`."""

    columns: Mapping[str, Column]
    rows: tuple[Row, ...]
    systems: Mapping[str, System] = dataclasses.field(default_factory=dict)
    protocols: Mapping[str, Protocol] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        for row in self.rows:
            self._check(f"row {row.label!r}: recorded", row.recorded, self.columns)
            if row.kind == "score":
                self._check(f"row {row.label!r}: protocol", [row.protocol], self.protocols)
                by_column = row.system if isinstance(row.system, Mapping) else {}
                self._check(f"row {row.label!r}: system", by_column, self.columns)
                systems = by_column.values() if by_column else [row.system] if row.system else []
                self._check(f"row {row.label!r}: system", systems, self.systems)

    def job(self, row: Row, column: str) -> Job | None:
        """The measurement for the cell of a row and a column; None for a recorded or an empty cell."""
        system = row.system.get(column) if isinstance(row.system, Mapping) else row.system
        if row.suite is None or row.protocol is None or system is None or column in row.recorded:
            return None
        if not self.columns[column].measures:
            return None
        return Job(row.suite, row.split, row.seeds, row.protocol, system)

    def jobs(self) -> list[Job]:
        """All measurements without duplicates, in the order of the table."""
        jobs = [self.job(row, column) for row in self.rows for column in self.columns]
        return list(dict.fromkeys(job for job in jobs if job is not None))

    def suites(self) -> list[str]:
        """Names of the suites of all measurements."""
        return list(dict.fromkeys(job.suite for job in self.jobs()))

    def tracers(self) -> list[str]:
        """Names of the tracers' settings of all measurements."""
        return list(dict.fromkeys(self.systems[job.system].tracer for job in self.jobs()))
