"""The systems that are compared, each with what it needs of a recording's site: a calibrated camera, a tag grid."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ...baselines._interface import host_trace
from ...baselines.goller import Calibration, GollerSettings, GollerTracer, calibrate
from ...baselines.tagview import TagviewSettings, TagviewTracer
from ...baselines.tagvision import TagVision, TagVisionSettings
from ...config import ClipSettings, ConfigError
from ...data.store import open_recording
from ...recording import Recording, RecordingError
from ...sim.suites import Item
from ...tracer import Trace
from ...training.run import make_tracer
from ...training.sources import clip_loader
from ..evaluate import ScoreSettings, trace_recording
from ..tagvision import CalibrationSettings, calibrated, table_truth

Traces = Iterator[tuple[int, Trace]]

NAMES = ("tagattention", "tagattention_paper", "tagvision", "tagview", "goller")
"""TagAttention with what is learnable, to the letter of its paper, and its three forerunners."""


@dataclasses.dataclass(frozen=True)
class SystemSettings:
    """The settings of every system. The two TagAttentions are tracers by `_target_`, with the clips they see."""

    tagattention: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    tagattention_paper: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    clips: ClipSettings = dataclasses.field(default_factory=ClipSettings)
    tagvision: TagVisionSettings = dataclasses.field(default_factory=TagVisionSettings)
    tagvision_calibration: CalibrationSettings = dataclasses.field(default_factory=CalibrationSettings)
    tagview: TagviewSettings = dataclasses.field(default_factory=TagviewSettings)
    goller: GollerSettings = dataclasses.field(default_factory=GollerSettings)
    goller_grid: str | None = None  # recording of a tag at the places of a grid, which calibrates its antennas


class Systems:
    """Makes each system's traces of a recording; what cannot be applied raises `RecordingError` with the reason."""

    def __init__(self, settings: SystemSettings, scores: ScoreSettings):
        self.settings, self.scores = settings, scores
        self._calibration: Calibration | None = None
        self._tracers = {name: make_tracer(getattr(settings, name)) for name in NAMES[:2]}

    def stride(self, name: str) -> int:
        """Every how many pixels a system's masks have one."""
        return self.settings.clips.stride if name in self._tracers else 1

    def traces(self, name: str, item: Item, recording: Recording, epcs: list[str]) -> Traces:
        """Frame numbers and traces. Raises `RecordingError` or `ValueError` where the method cannot apply."""
        if name in self._tracers:
            return self._device(name, recording, epcs)
        make: dict[str, Callable[[], Any]] = {
            "tagvision": lambda: self._tagvision(item, recording),
            "tagview": lambda: TagviewTracer(self.settings.tagview),
            "goller": lambda: self._goller(recording),
        }
        if name not in make:
            raise ConfigError(f"Unknown system {name!r}; expected some of {', '.join(NAMES)}.")
        tracer = make[name]()
        reason = tracer.inapplicable(recording)
        if reason is not None:
            raise RecordingError(reason)
        return host_trace(tracer, recording, epcs=epcs)

    def _device(self, name: str, recording: Recording, epcs: list[str]) -> Traces:
        clips = self.settings.clips
        if name == "tagattention_paper":
            clips = dataclasses.replace(clips, estimator="paper")
        return trace_recording(self._tracers[name], recording, clip_loader(clips), epcs=epcs, settings=self.scores)

    def _tagvision(self, item: Item, recording: Recording) -> TagVision:
        if item.suite.story != "tabletop":
            raise RecordingError("no calibrated plane: things do not move on one")
        truth = table_truth(item, recording)
        camera = calibrated(truth.camera, truth.area_m, self.settings.tagvision_calibration)
        return TagVision(camera, self.settings.tagvision)

    def _goller(self, recording: Recording) -> GollerTracer:
        if len(recording.antennas_m) < 2:
            raise RecordingError("location by proximity needs several antennas")
        if self._calibration is None:
            if self.settings.goller_grid is None:
                raise RecordingError("antennas not calibrated: name a grid's recording in systems.goller_grid")
            self._calibration = calibrate(open_recording(Path(self.settings.goller_grid)))
        return GollerTracer(self._calibration, self.settings.goller).at(recording)
