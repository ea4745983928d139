"""What every format of an RGB-D recording gives: its cameras and its pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from ....core.camera import Intrinsics, check_rotation
from ....core.errors import RecordingError

MAX_UNIT_M = 0.1
"""Largest unit of depth that a camera file may state: a larger one is a mistake."""

_MAX_SKEW = 0.02  # of a rotation matrix from an orthogonal one
_MAX_BASELINE_M = 2.0


@dataclasses.dataclass(frozen=True)
class Rig:
    """The cameras of a recording. X_colour = rotation X_depth + translation_m, in metres.

    `depth` is None where depth is registered to colour already, pixel by pixel. Intrinsics may have lens distortion. Depth
    of type float32 is in metres; integers are multiples of `depth_unit_m`.
    """

    colour: Intrinsics
    depth: Intrinsics | None = None
    rotation: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))  # (3, 3)
    translation_m: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))  # (3,)
    depth_unit_m: float = 0.001
    depth_kind: Literal["depth", "range"] = "depth"

    def check(self, where: str) -> None:
        """Raise `RecordingError`, which names `where` the values come from, for cameras that cannot be."""
        for name, camera in (("colour", self.colour), ("depth", self.depth)):
            try:
                if camera is not None:
                    camera.check()
            except RecordingError as error:
                raise RecordingError(f"{where}: {name}: {error}") from error
        if not 0 < self.depth_unit_m <= MAX_UNIT_M:
            raise RecordingError(
                f"{where}: depth_unit_m is {self.depth_unit_m!r}; expected the metres of one unit of depth, above 0 and at most "
                f"{MAX_UNIT_M:g} (0.001 for millimetres)."
            )
        check_rotation(self.rotation, where, "X_colour = rotation X_depth + translation_m", max_skew=_MAX_SKEW)
        translation = np.asarray(self.translation_m, float)
        if translation.shape != (3,) or not np.linalg.norm(translation) <= _MAX_BASELINE_M:
            raise RecordingError(
                f"{where}: translation_m is {translation.tolist()}; expected 3 numbers in metres, at most {_MAX_BASELINE_M:g} m "
                "long. Millimetres must be converted."
            )


@dataclasses.dataclass(frozen=True)
class Picture:
    """One picture as it is stored, decoded on request.

    `decode` returns colour as uint8 RGB (height, width, 3), or depth as integers or float32 (height, width). It raises
    `RecordingError` for damaged data.
    """

    stream: Literal["colour", "depth"]
    time_ns: int
    where: str  # file, or topic and number: for messages
    decode: Callable[[], np.ndarray]


@dataclasses.dataclass(frozen=True)
class RgbdSource:
    """An opened recording of some format.

    `pictures()` yields all pictures in the order in which they are stored: each stream by itself in order of time, the two
    roughly interleaved. It holds no more of the recording in memory than a few pictures, and may be called again.
    """

    name: str
    description: str
    rig: Rig
    pictures: Callable[[], Iterator[Picture]]
    max_gap_s: float = 0.02  # between the times of a colour picture and its depth
    start_ns: int | None = None  # time of the first frame, to which all times are moved; None: they stay as they are

    def lines(self) -> list[str]:
        """A description of the cameras for a report, line by line."""
        rig = self.rig
        lines = [self.description, f"colour camera: {_described(rig.colour)}"]
        if rig.depth is None:
            lines.append("depth: registered to colour")
        else:
            shift_mm = ", ".join(f"{1000 * value:.1f}" for value in rig.translation_m)
            lines.append(f"depth camera: {_described(rig.depth)}; {shift_mm} mm from the colour camera; is registered")
        lines.append(f"unit of integer depth: {1000 * rig.depth_unit_m:g} mm")
        return lines


def _described(camera: Intrinsics) -> str:
    lens = "lens distortion is undone" if any(camera.distortion) else "no lens distortion"
    return (
        f"{camera.width} x {camera.height}, f {camera.fx_px:.1f} {camera.fy_px:.1f} px, centre {camera.cx_px:.1f} "
        f"{camera.cy_px:.1f} px, {lens}"
    )
