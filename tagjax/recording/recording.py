"""Recordings: RGB-D video and tag reads, with optional ground truth; on the host, opened lazily.

All arrays are NumPy arrays or lazily read Zarr arrays; none is on a device. Times are int64 nanoseconds of the host
clock. `Recording.check` checks what every later stage relies on.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from ..core.camera import Intrinsics
from ..core.errors import RecordingError, RecordingWarning
from ..core.types import LazyArray
from .checks import check_geometry, check_names, check_second, check_time_of_reads, check_truth
from .reads import TagReads

MAX_RANGE_M = 30.0
"""A median depth above this is taken for a wrong unit: no RGB-D camera of this kind measures so far."""


MIN_BASELINE_M, MAX_BASELINE_M = 0.005, 2.0
"""Distances between two cameras that a recording may have."""


@dataclasses.dataclass(frozen=True)
class SecondCamera:
    """Pictures of a colour camera beside the first, at the same times. The pair is rectified: the second camera has the
    first one's intrinsics and orientation, and is `baseline_m` to its right.
    """

    colour: LazyArray  # (num_frames, height, width, 3) uint8 RGB
    baseline_m: float


@dataclasses.dataclass(frozen=True)
class Truth:
    """Ground truth. Every part is optional; lazily read arrays are read when indexed."""

    labels: LazyArray | None = (
        None  # (num_frames, height, width) uint8: 0 background, 255 ignore, else the object's label
    )
    tag_to_label: Mapping[str, int] = dataclasses.field(default_factory=dict)
    boxes_px: np.ndarray | None = None  # (num_frames, num_labels, 4) float32 x0 y0 x1 y1 inclusive; NaN = not visible
    tag_range_m: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)  # EPC: (num_frames,), NaN unknown
    tag_position_m: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)  # EPC: (num_frames, 3) camera
    visible: Mapping[int, np.ndarray] = dataclasses.field(default_factory=dict)  # label: (num_frames,) bool
    flow_px: LazyArray | None = None  # (num_frames, height, width, 2) flow from frame t to t + 1; last one NaN
    occluded: LazyArray | None = None  # (num_frames, height, width) bool: that flow's target is occluded
    backward_flow_px: LazyArray | None = None  # (num_frames, height, width, 2) from frame t to t - 1; first one NaN
    backward_occluded: LazyArray | None = None  # (num_frames, height, width) bool: that flow's target is occluded
    line_of_sight: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)  # EPC: (num_frames,)
    # fraction of the field that reaches the first antenna on the direct path: 1 free, 0 blocked
    carrier_box_px: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)  # EPC: (num_frames, 4)
    # x0 y0 x1 y1 (inclusive) around the person who holds the tagged object, and all that the person holds; NaN = not visible

    IGNORE = 255


@dataclasses.dataclass(frozen=True)
class ClockPiece:
    """A piece of a table without a jump of a clock: host = reader + offset + drift * (reader - reference)."""

    reference_ns: int  # reader's clock
    num_reads: int
    offset_s: float
    offset_interval_s: tuple[float, float]  # 95 %; a single value where the piece has few reads
    drift_ppm: float  # 0 where the piece is too short to measure it
    drift_interval_ppm: tuple[float, float] | None  # 95 %; None where it was not measured


@dataclasses.dataclass(frozen=True)
class ClockAudit:
    """How the reader's clock relates to the host's, piece by piece in order of arrival."""

    pieces: tuple[ClockPiece, ...]
    residual_ms: float  # spread of the smallest delays of arrival, of the piece where it is largest
    num_reads: int
    num_set_aside: int  # reads whose reader time fits no piece
    reader_epoch: str  # "unix", or "1970" or "2000" for a reader clock that was never set
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Recording:
    """One RGB-D video with its tag reads.

    `depth` holds millimetres as uint16, or metres as float32; 0 (or NaN) = missing. It is z-depth or range to the
    camera, as `depth_kind` says, in the view of the colour camera whose `intrinsics` these are. `antennas_m` are
    antenna positions in the camera frame (x right, y down, z forward), row i for antenna i + 1.
    """

    colour: LazyArray  # (num_frames, height, width, 3) uint8 RGB
    depth: LazyArray  # (num_frames, height, width)
    time_ns: np.ndarray  # (num_frames,) int64 host clock
    intrinsics: Intrinsics
    reads: TagReads
    antennas_m: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((1, 3)))  # (num_antennas, 3)
    depth_kind: Literal["depth", "range"] = "depth"
    truth: Truth | None = None
    clock: ClockAudit | None = None
    name: str = "recording"
    source: str = ""  # data and settings that it was made from
    store: Any = None  # the open Zarr group, for a stored recording
    second: SecondCamera | None = None  # another colour camera, where the recording has one
    reversed_from: Recording | None = None  # the original of a time-reversed recording

    @property
    def num_frames(self) -> int:
        return len(self.time_ns)

    @property
    def image_shape(self) -> tuple[int, int]:
        return (self.intrinsics.height, self.intrinsics.width)

    @property
    def frame_rate_hz(self) -> float:
        """Median frame rate; NaN for a single frame."""
        return float(1e9 / np.median(np.diff(self.time_ns))) if self.num_frames > 1 else float("nan")

    def frame_time_s(self) -> np.ndarray:
        """Frame times in seconds from the first frame, float64."""
        return (self.time_ns - self.time_ns[0]) * 1e-9

    def depth_metres(self, frames: int | slice) -> np.ndarray:
        """Raw depth values (z or range, as `depth_kind` says) in metres, float32, 0 where missing."""
        raw = np.asarray(self.depth[frames])
        metres = raw.astype(np.float32) * np.float32(1e-3 if raw.dtype.kind in "ui" else 1.0)
        return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0))

    def resolve_epcs(self, epcs: Sequence[str] | None) -> list[str]:
        """The given EPCs, or all EPCs that were read if None. Raises `RecordingError` for an EPC that was never read."""
        if epcs is None:
            return self.reads.epcs
        for epc in epcs:
            self.reads.select(epc)
        return list(epcs)

    def with_reads(self, reads: TagReads, truth: Truth | None = None) -> Recording:
        """The same video with other reads (and, if given, other truth)."""
        return dataclasses.replace(self, reads=reads, truth=self.truth if truth is None else truth)

    def check(self, *, depth: bool = True) -> None:
        """Raise `RecordingError` for a recording that later stages cannot process; warn of one that is unusual.

        Reads metadata and three depth frames only, so that it is cheap for a remote recording; depth is not checked
        unless `depth`. A recording without any depth gives a warning: TagAttention needs depth, the baselines do not.
        """
        num_frames, shape = self.num_frames, self.image_shape
        if num_frames == 0:
            raise RecordingError(f"{self.name}: no frames; expected at least one.")
        check_names(self)
        self.intrinsics.check()
        if self.colour.shape != (num_frames, *shape, 3) or self.colour.dtype != np.uint8:
            raise RecordingError(
                f"{self.name}: colour is {self.colour.dtype} of shape {self.colour.shape}; expected uint8 of shape "
                f"{(num_frames, *shape, 3)} (frames, height, width, RGB) from times and intrinsics."
            )
        if depth and self.depth.shape != (num_frames, *shape):
            raise RecordingError(
                f"{self.name}: depth has shape {self.depth.shape}; expected {(num_frames, *shape)}, registered to colour. "
                "Use geometry.register_depth for a depth camera beside the colour camera."
            )
        if depth and np.dtype(self.depth.dtype) not in (np.dtype(np.uint16), np.dtype(np.float32)):
            raise RecordingError(f"{self.name}: depth is {self.depth.dtype}; expected uint16 mm or float32 m.")
        if np.dtype(self.time_ns.dtype) != np.int64 or self.time_ns.ndim != 1:
            raise RecordingError(
                f"{self.name}: time_ns is {self.time_ns.dtype} of shape {self.time_ns.shape}; expected int64 nanoseconds, one "
                "for each frame."
            )
        steps = np.diff(self.time_ns)
        if np.any(steps <= 0):
            first = int(np.argmax(steps <= 0)) + 1
            raise RecordingError(
                f"{self.name}: frame {first} is stamped {int(-steps[first - 1]) / 1e6:.3f} ms before or at frame {first - 1}; "
                "expected strictly increasing times. Drop or re-stamp the frame."
            )
        check_geometry(self)
        check_second(self, MIN_BASELINE_M, MAX_BASELINE_M)
        if self.truth is not None:
            check_truth(self.truth, self.name, num_frames, shape)
        if depth:
            self._check_depth_values()
        self.reads.check()
        if self.reads.num_reads:
            highest = int(self.reads.antenna.max())
            if highest > len(self.antennas_m):
                raise RecordingError(
                    f"{self.name}: reads of antenna {highest}, but antennas_m has {len(self.antennas_m)} positions. Give the position of every antenna."
                )
            check_time_of_reads(self)

    def check_has_depth(self) -> None:
        """Raise `RecordingError` if none of the frames that `check` samples has any depth."""
        sampled, values = self._sampled_depth()
        if not np.any(values > 0):
            raise RecordingError(
                f"{self.name}: frames {sampled} have no depth at all; TagAttention needs depth. Was it exported?"
            )

    def _sampled_depth(self) -> tuple[list[int], np.ndarray]:
        sampled = sorted({0, self.num_frames // 2, self.num_frames - 1})
        return sampled, np.stack([self.depth_metres(frame) for frame in sampled])

    def _check_depth_values(self) -> None:
        sampled, values = self._sampled_depth()
        measured = values[values > 0]
        if measured.size == 0:
            warnings.warn(
                f"{self.name}: frames {sampled} have no depth at all: only systems that need no depth can trace here, not "
                "TagAttention. Was it exported?",
                RecordingWarning,
                stacklevel=4,
            )
            return
        if np.median(measured) > MAX_RANGE_M or np.median(measured) < 0.05:
            raise RecordingError(
                f"{self.name}: median depth {np.median(measured):.4g} m; expected 0.05 to {MAX_RANGE_M:g}. Wrong unit? uint16 "
                "is read as millimetres, float32 as metres (TUM's PNG files hold 1/5000 m)."
            )
        for frame, image in zip(sampled, values, strict=True):
            if not np.any(image > 0):
                warnings.warn(
                    f"{self.name}: frame {frame} has no depth; the tracer propagates its state over it.",
                    RecordingWarning,
                    stacklevel=4,
                )
