"""Recordings and traces for figures: a recording is opened, and a tracer run over it, once for all figures of a run folder."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from ...core.progress import OnProgress, unobserved
from ...core.settings import ConfigError, from_mapping
from ...metrics.locking import first_motion
from ...metrics.recordings import Picture, evaluate_recording
from ...metrics.tags import FrameScores
from ...recording import Recording
from ...recording.store import open_recording
from ...report.paper.curves import NUM_FRAMES
from ...sim.suites import PLANAR, Item, Suite, make_items
from ...tagattention.tracer_settings import make_tracer, tracer_clips
from ...tracing.clips import ClipSettings, clip_loader
from ...tracing.tracer import AbstractTracer
from ..suite_items import result_key
from .settings import PaperConfig
from .traced import Traced, read_traced, write_traced

T = TypeVar("T")


def items_by_variant(items: Sequence[Item]) -> dict[tuple[str, str], list[Item]]:
    """The recordings by the names of suite and variant, in the order of the first of each."""
    groups: dict[tuple[str, str], list[Item]] = {}
    for item in items:
        groups.setdefault((item.suite.name, item.variant.name), []).append(item)
    return groups


class MissingRecordingsError(ConfigError):
    """A figure has no recording, and missing ones are not simulated."""


@dataclasses.dataclass(frozen=True)
class System:
    """A tracer as a figure runs it: settings as under conf/tracer, and changes to its clips."""

    name: str  # as the figure's legend has it
    settings: Mapping[str, Any]
    clips: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def clip_settings(self) -> ClipSettings:
        """The clips of the tracer's configuration with the changes."""
        return dataclasses.replace(tracer_clips(self.settings), **self.clips)


class Sources:
    """Finds the recordings of suites, simulates missing ones, and traces them; results are kept in `folder`/traces.

    `report` is called with what is being done; `on_progress` counts recordings that are simulated.
    """

    def __init__(
        self,
        config: PaperConfig,
        folder: Path,
        report: Callable[[str], None] = lambda _: None,
        on_progress: OnProgress = unobserved,
    ):
        self.config, self.folder, self.report, self._on_progress = config, folder, report, on_progress
        self._tracers: dict[str, AbstractTracer] = {}
        self._made: dict[tuple[str, ...], Any] = {}

    def suite(self, name: str) -> Suite:
        """A suite as the settings change it. Raises `ConfigError` for one without pictures."""
        suite = from_mapping(Suite, self.config.suites[name], where=f"suite {name}")
        if suite.story == PLANAR:
            raise ConfigError(f"{name} has lines of reads and no pictures; choose another suite.")
        suite = suite.smoke() if self.config.smoke else suite
        if self.config.width is None or self.config.smoke:
            return suite
        width = min(self.config.width, suite.capture.width or self.config.width)
        return dataclasses.replace(suite, capture=dataclasses.replace(suite.capture, width=width))

    def items(self, name: str, variants: Sequence[str] | None = None, *, one: bool = False) -> list[Item]:
        """The recordings of some variants (all if None), in the order of variants, splits and numbers.

        `one` takes the first of each variant. Raises `MissingRecordingsError` where a variant has none.
        """
        config, suite = self.config, self.suite(name)
        wanted = [variant.name for variant in suite.variants] if variants is None else list(variants)
        if unknown := set(wanted) - {variant.name for variant in suite.variants}:
            raise ConfigError(f"{name} has no variant {', '.join(sorted(unknown))}.")
        kept = tuple(variant for variant in suite.variants if variant.name in wanted)
        folder = Path(config.recordings_dir)
        splits = ("test",) if config.smoke else config.splits
        limit = 1 if one else config.max_recordings
        if config.simulates():
            found = make_items(
                suite,
                folder,
                splits=self._splits_with(suite, splits)[: 1 if one else None],
                max_per_variant=limit,
                workers=config.workers,
                on_progress=self._on_progress,
            )
        else:
            found = [item for item in suite.items() if item.split in splits and item.path(folder).exists()]
        found = [item for item in found if item.variant in kept and item.path(folder).exists()]
        order = {variant: place for place, variant in enumerate(wanted)}
        found.sort(key=lambda item: (order[item.variant.name], splits.index(item.split), item.number))
        chosen: list[Item] = []
        for variant in wanted:
            own = [item for item in found if item.variant.name == variant]
            if not own:
                raise MissingRecordingsError(
                    f"{name}, variant {variant}: found no recording of {', '.join(splits)} in {folder}; expected at least one. "
                    "Set simulate=true to simulate it, or splits= to others."
                )
            by_split = [[item for item in own if item.split == split][:limit] for split in splits]
            own = [item for items in by_split for item in items]
            chosen += own[:1] if one else own
        return chosen

    @staticmethod
    def _splits_with(suite: Suite, splits: Sequence[str]) -> tuple[str, ...]:
        """The splits of which the suite has recordings."""
        return tuple(split for split in splits if getattr(suite.counts, split)) or tuple(splits)

    def once(self, key: tuple[str, ...], make: Callable[[], T]) -> T:
        """What `make` returns, made once for all figures."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def recording(self, item: Item) -> Recording:
        """The recording, opened."""
        return open_recording(item.path(Path(self.config.recordings_dir)))

    def system(self, name: str) -> System:
        """`tagattention` or `published`, as configured."""
        return System(name, self.config.tracers[name])

    def tracer(self, system: System) -> AbstractTracer:
        """The system's tracer, made once: what was compiled for it then serves every recording."""
        key = json.dumps(system.settings, sort_keys=True, default=str)
        if key not in self._tracers:
            self._tracers[key] = make_tracer(system.settings)
        return self._tracers[key]

    def scores(self, system: System, item: Item) -> dict[str, FrameScores]:
        """Every labelled tag's scores at every frame, by EPC."""
        return self.traced(system, item, pictures=False).frames

    def traced(self, system: System, item: Item, *, pictures: bool = True, whole: bool = False) -> Traced:
        """The scores of a recording, and with `pictures` the output at every frame. Traced unless `folder` has it all.

        The trace ends `NUM_FRAMES` after the last tag's first motion, or with `whole` at the recording's end.
        """
        recording, tracer, clips = self.recording(item), self.tracer(system), system.clip_settings()
        last = recording.num_frames if whole else last_frame(recording)
        path = self.folder / "traces" / f"{item.name}-{last}-{self._key(system, item)}.npz"
        known = read_traced(path, pictures=pictures)
        if known is not None:
            return known
        self.report(f"{item.name}, {system.name}")
        kept: list[Picture] = []
        result = evaluate_recording(
            tracer,
            recording,
            clip_loader(clips),
            stride=clips.stride,
            settings=dataclasses.replace(self.config.scores.supported_by(tracer), num_pictures=1),
            frames=(0, last),
            on_picture=kept.append,
        )
        traced = Traced(result.frames, kept)
        write_traced(path, traced)
        return traced

    def _key(self, system: System, item: Item) -> str:
        """A hash of all that determines the result."""
        return result_key(item, system.settings, system.clip_settings(), self.config.scores)[:16]


def last_frame(recording: Recording) -> int:
    """The frame after the last one that the figures show: `NUM_FRAMES` after the last first motion, or the end."""
    truth, time_s = recording.truth, recording.frame_time_s()
    begins = [] if truth is None else [first_motion(truth, epc, time_s) for epc in truth.tag_to_label]
    known = [begin for begin in begins if begin is not None]
    return min(max(known) + NUM_FRAMES + 1, recording.num_frames) if known else recording.num_frames


def described(items: Sequence[Item]) -> str:
    """The recordings of a figure in words: `single_static: 10 recordings (train, validation)`."""
    suites = dict.fromkeys(item.suite.name for item in items)
    parts = []
    for suite in suites:
        own = {item.name: item for item in items if item.suite.name == suite}.values()
        splits = ", ".join(dict.fromkeys(item.split for item in own))
        parts.append(f"`{suite}`, {len(own)} recording{'s' if len(own) > 1 else ''} ({splits})")
    return "; ".join(parts)
