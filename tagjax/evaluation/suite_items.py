"""The recordings of suites by name and split; missing ones are simulated first."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from ..core.camera import working_stride
from ..core.progress import OnProgress, unobserved
from ..core.settings import ConfigError, from_mapping
from ..metrics.recordings import ScoreSettings
from ..recording import Recording
from ..recording.store import open_recording
from ..sim.suites import PLANAR, SPLITS, Item, Suite, make_items
from ..tagattention.tracer_settings import settled
from ..tracing.clips import ClipSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteSelection:
    """Recordings of one split of some suites; `suites` holds each one's settings by name, as in the files of conf/suite."""

    lines_allowed: ClassVar[bool] = False
    """Whether suites of lines of reads, without pictures, may be selected."""

    suites: Mapping[str, Mapping[str, Any]]
    recordings_dir: str = "recordings"
    split: str = "test"
    max_recordings: int | None = None  # of each variant; all if None
    smoke: bool = False
    workers: int = 1

    def __post_init__(self) -> None:
        if not self.suites:
            raise ConfigError("suites is empty; expected names of suites, for example suites=[single_static,multi_4].")
        if self.split not in SPLITS:
            raise ConfigError(f"split is {self.split!r}; expected one of {', '.join(SPLITS)}.")
        if self.max_recordings is not None and self.max_recordings < 1:
            raise ConfigError(
                f"max_recordings is {self.max_recordings}; expected at least 1 recording of each variant."
            )
        if self.workers < 1:
            raise ConfigError(f"workers is {self.workers}; expected at least 1 process.")

    def all_items(self, report: OnProgress = unobserved) -> dict[str, list[Item]]:
        """The items of every suite by its name: see `items`."""
        return {name: self.items(name, report) for name in self.suites}

    def items(self, name: str, report: OnProgress = unobserved) -> list[Item]:
        """A suite's items, simulated where they are missing. Raises `ConfigError` where it has none, or no pictures."""
        suite = from_mapping(Suite, self.suites[name], where=f"suite {name}")
        suite = suite.smoke() if self.smoke else suite
        if suite.story == PLANAR and not self.lines_allowed:
            raise ConfigError(f"{suite.name} has lines of reads and no pictures; choose another suite.")
        items = make_items(
            suite,
            Path(self.recordings_dir),
            splits=(self.split,),
            max_per_variant=self.max_recordings,
            workers=self.workers,
            on_progress=report,
        )
        if not items:
            raise ConfigError(f"{suite.name} has no {self.split} recording; choose another split, or raise its counts.")
        return items

    def open(self, item: Item) -> Recording:
        """The recording of an item."""
        return open_recording(item.path(Path(self.recordings_dir)))


def result_key(item: Item, tracer: Mapping[str, Any], clips: ClipSettings, scores: ScoreSettings) -> str:
    """A hash, 64 hexadecimal digits, of all settings that determine a tracer's result on a recording.

    `tracer` are settings as under conf/tracer. How many other recordings the suite has does not matter.
    """
    width = item.suite.capture.intrinsics().width
    parts = [
        {**item.suite.as_dict(), "counts": None},
        item.name,
        settled(tracer, width),
        dataclasses.asdict(dataclasses.replace(clips, stride=working_stride(width, clips.stride))),
        dataclasses.asdict(scores),
    ]
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()
