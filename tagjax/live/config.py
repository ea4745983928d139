"""Settings of a stream, and what it traces: a stored recording that is replayed, or running sensors."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np

from ..core.camera import Intrinsics
from ..core.settings import ConfigError
from ..recording import Recording
from ..recording.capture.settings import CameraKind, ReaderKind, SensorConfig, SensorSettings
from ..recording.store import open_recording
from ..tracing.clips import choose_antennas, selected_tags
from ..tracing.replay import Replay, ReplaySettings
from .event_log import EventSettings
from .page import PageSettings
from .sensors import SensorStream


@dataclasses.dataclass(frozen=True, kw_only=True)
class StreamConfig(SensorSettings):
    """What is traced, and the tracer (settings as under conf/tracer, or learned weights).

    Without camera and reader `recording` is replayed. Raises `ConfigError` for settings that do not fit together.
    """

    tracer: Mapping[str, Any]
    weights: str | None = None
    flow: str = "dis_live"
    stride: int | None = None  # None: that of the tracer's settings, or else of the picture's width
    num_places: int = 4  # for tags, before more are made
    antennas: tuple[int, ...] | Literal["all"] = "all"  # ports whose reads are used
    replay: ReplaySettings = dataclasses.field(default_factory=ReplaySettings)
    camera: CameraKind | None = None
    reader: ReaderKind | None = None
    record: str | None = None  # a new recording of what the sensors give
    reads_wait_s: float = 0.02  # of a frame, for reads that are under way
    events: EventSettings = dataclasses.field(default_factory=EventSettings)
    page: PageSettings = dataclasses.field(default_factory=PageSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.camera is None) != (self.reader is None):
            raise ConfigError(
                f"camera is {self.camera}, reader is {self.reader}; expected both, or neither and recording=<a recording>."
            )
        if self.camera is None and self.recording is None:
            raise ConfigError(
                "found no recording, camera or reader; expected recording=<a recording>, or camera=... reader=..."
            )
        if self.camera is None and self.record is not None:
            raise ConfigError(
                f"record is {self.record} without a camera and a reader; expected both. Nothing is new here."
            )
        if not 0 <= self.reads_wait_s <= 1:
            raise ConfigError(f"reads_wait_s is {self.reads_wait_s}; expected 0 to 1 s.")
        self.sensors()

    def sensors(self) -> SensorConfig | None:
        """The sensors that are used; None where a recording is replayed."""
        if self.camera is None:
            return None
        return SensorConfig(**{field.name: getattr(self, field.name) for field in dataclasses.fields(SensorConfig)})


@dataclasses.dataclass(frozen=True)
class Source:
    """What is traced. `start` begins to give frames; before, the tracer is made ready."""

    name: str
    intrinsics: Intrinsics
    depth_kind: str
    antennas_m: np.ndarray  # (num_antennas, 3)
    antennas: tuple[int, ...]  # whose reads are used, counted from 1
    num_frames: int  # that it will give; 0: it does not end by itself
    start: Callable[[], Replay | SensorStream]


def open_source(config: StreamConfig, stack: contextlib.ExitStack) -> Source:
    """Open the recording or the sensors; the stack closes them.

    Raises `RecordingError`, `CameraError`, `ReaderError` or `ConfigError` for what cannot be used.
    """
    sensors = config.sensors()
    if sensors is None:
        recording = open_recording(config.recording or "")

        def start() -> Replay:
            return stack.enter_context(contextlib.closing(Replay(recording, config.replay)))

        return Source(
            recording.name,
            recording.intrinsics,
            recording.depth_kind,
            recording.antennas_m,
            _antennas(config, recording),
            recording.num_frames * config.replay.loops,
            start,
        )
    stream = SensorStream(sensors, record=config.record, reads_wait_s=config.reads_wait_s)
    stack.callback(stream.close)
    video = stream.open()

    def begin() -> SensorStream:
        stream.start()
        return stream

    played = stream.sensors.played
    antennas = _antennas(config, None if config.address is not None else played)
    num_frames = played.num_frames if played is not None and config.camera == "playback" else 0
    return Source(
        stream.name, video.intrinsics, video.depth_kind, stream.sensors.antennas_m, antennas, num_frames, begin
    )


def _antennas(config: StreamConfig, played: Recording | None) -> tuple[int, ...]:
    if played is not None:
        return choose_antennas(played, selected_tags(played, None), config.antennas)
    return config.inventory.antennas if config.antennas == "all" else config.antennas
