"""The compared systems, each with the calibration that it needs: of a camera, or of antennas by a tag grid."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ...baselines import host_trace
from ...baselines.blobs import BlobSettings, BlobTracer
from ...baselines.goller import Calibration, GollerSettings, GollerTracer, load_calibration
from ...baselines.goller.calibration import calibrate
from ...baselines.tagview import TagviewSettings, TagviewTracer
from ...baselines.tagvision import PlaneCamera, TagVisionSettings, TagVisionTracer
from ...baselines.tagvision.experiment.simulated_calibration import CalibrationSettings, simulate_calibration
from ...baselines.tagvision.experiment.table_truth import table_truth
from ...core.settings import ConfigError
from ...metrics.recordings import ScoreSettings
from ...recording import Recording, RecordingError
from ...recording.store import open_recording
from ...sim.suites import Item
from ...tagattention.tracer_settings import make_tracer, tracer_clips
from ...tracing.clips import clip_loader
from ...tracing.recordings import trace_recording
from ...tracing.tracer import AbstractTracer, Trace

Traces = Iterator[tuple[int, Trace]]

NAMES = ("tagattention", "tagattention_published", "blobs", "tagvision", "tagview", "goller")
"""TagAttention as it is learned here and as published, moving blobs without pixel fusion, and the three systems before it."""

TABLE = "tabletop"
"""The story of objects that move on a table below the camera."""


@dataclasses.dataclass(frozen=True)
class SystemSettings:
    """The settings of every system."""

    tagattention: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # as under conf/tracer
    tagattention_published: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    blobs: BlobSettings = dataclasses.field(default_factory=BlobSettings)
    tagvision: TagVisionSettings = dataclasses.field(default_factory=TagVisionSettings)
    tagvision_calibration: CalibrationSettings = dataclasses.field(default_factory=CalibrationSettings)
    tagview: TagviewSettings = dataclasses.field(default_factory=TagviewSettings)
    goller: GollerSettings = dataclasses.field(default_factory=GollerSettings)
    goller_calibration: str | None = None  # calibration.json of experiments.goller, with fitted widths and rates
    goller_grid: str | None = None  # otherwise: recording of a tag grid, from which only the antennas are calibrated


class Systems:
    """Computes each system's traces of a recording.

    Raises `ConfigError` where `goller_calibration` is not a calibration.
    """

    def __init__(self, settings: SystemSettings, scores: ScoreSettings):
        self.settings, self.scores = settings, scores
        self._calibration: Calibration | None = None
        if settings.goller_calibration is not None:
            try:
                self._calibration = load_calibration(Path(settings.goller_calibration))
            except ValueError as error:
                raise ConfigError(f"systems.goller_calibration: {error}") from error
        self._tracers: dict[str, AbstractTracer] = {}

    def settings_label(self, name: str) -> str | None:
        """The settings that a system uses, as tables show it; None for a system with one setting only."""
        if name == "goller":
            return "starting widths" if self.settings.goller_calibration is None else "fitted widths"
        return None

    def stride(self, name: str) -> int | None:
        """The stride in pixels of a system's masks; None for that of the picture's width."""
        settings = self._device_settings(name)
        return 1 if settings is None else tracer_clips(settings).stride

    def traces(self, name: str, item: Item, recording: Recording, epcs: list[str]) -> Traces:
        """Frame numbers and traces. Raises `RecordingError` or `ValueError` where the method cannot apply."""
        settings = self._device_settings(name)
        if settings is not None:
            return self._device(name, settings, recording, epcs)
        make: dict[str, Callable[[], Any]] = {
            "blobs": lambda: BlobTracer(self.settings.blobs),
            "tagvision": lambda: self._tagvision(item, recording),
            "tagview": lambda: self._tagview(item, recording),
            "goller": lambda: self._goller(recording),
        }
        if name not in make:
            raise ConfigError(f"found system {name!r}; expected one of {', '.join(NAMES)}.")
        tracer = make[name]()
        reason = tracer.inapplicable(recording)
        if reason is not None:
            raise RecordingError(reason)
        return host_trace(tracer, recording, epcs=epcs)

    def _device_settings(self, name: str) -> Mapping[str, Any] | None:
        """The tracer's settings of a system that runs compiled, on clips; None for the others."""
        compiled = {
            "tagattention": self.settings.tagattention,
            "tagattention_published": self.settings.tagattention_published,
        }
        return compiled.get(name)

    def _device(self, name: str, settings: Mapping[str, Any], recording: Recording, epcs: list[str]) -> Traces:
        if name not in self._tracers:
            self._tracers[name] = make_tracer(settings)
        tracer, clips = self._tracers[name], tracer_clips(settings)
        return trace_recording(
            tracer, recording, clip_loader(clips), epcs=epcs, settings=self.scores.supported_by(tracer)
        )

    def _plane(self, item: Item, recording: Recording) -> PlaneCamera:
        """The simulated calibration of the camera over the table, which both TagVision and Tagview use."""
        truth = table_truth(item, recording)
        return simulate_calibration(truth.camera, truth.area_m, self.settings.tagvision_calibration)

    def _tagvision(self, item: Item, recording: Recording) -> TagVisionTracer:
        if item.suite.story != TABLE:
            raise RecordingError("no calibrated plane: the objects do not move on one plane")
        return TagVisionTracer(self._plane(item, recording), self.settings.tagvision)

    def _tagview(self, item: Item, recording: Recording) -> TagviewTracer:
        settings = self.settings.tagview
        if item.suite.story != TABLE:
            raise RecordingError("the camera does not look straight down on a plane on which the objects move")
        if settings.height_m is None:
            height_m = float(self._plane(item, recording).position_m[2]) - self.settings.tagvision.height_m
            settings = dataclasses.replace(settings, height_m=height_m)
        return TagviewTracer(settings)

    def _goller(self, recording: Recording) -> GollerTracer:
        if len(recording.antennas_m) < 2:
            raise RecordingError("location by proximity needs several antennas")
        if self._calibration is None:
            grid = self.settings.goller_grid
            if grid is None or not Path(grid).exists():
                raise RecordingError(
                    f"antennas not calibrated: found no recording of a tag grid at systems.goller_grid={grid}; "
                    "`python -m experiments.simulate suite=shop_grid` makes one"
                )
            self._calibration = calibrate(open_recording(Path(grid)))
        return GollerTracer(self._calibration, self.settings.goller).install(recording)
