"""A pair of colour cameras, and the file that describes it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np

from ..core.camera import Intrinsics, check_rotation
from ..core.errors import RecordingError
from ..core.files import write_atomic
from ..core.json_text import parse_json
from ..core.settings import ConfigError, from_mapping
from ..recording.recording import MAX_BASELINE_M, MIN_BASELINE_M

FORMAT = "tagjax-stereo"

EXAMPLE = (
    '{"left": {"fx_px": 615.0, "fy_px": 615.0, "cx_px": 319.5, "cy_px": 239.5, "width": 640, "height": 480}, '
    '"translation_m": [-0.12, 0.0, 0.0]}'
)
"""The smallest camera file: a rectified pair 12 cm apart."""

_MAX_BYTES = 1_000_000
_MAX_SKEW = 1e-3  # of a rotation matrix from an orthogonal one


@dataclasses.dataclass(frozen=True)
class StereoRig:
    """Two cameras side by side: X_right = rotation X_left + translation_m, so that translation_m[0] is minus the baseline.

    Left and right as seen from behind the cameras. Intrinsics may have lens distortion.
    """

    left: Intrinsics
    right: Intrinsics
    rotation: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))  # (3, 3)
    translation_m: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))  # (3,)

    @property
    def baseline_m(self) -> float:
        """Distance between the cameras."""
        return float(np.linalg.norm(self.translation_m))

    def check(self, where: str) -> None:
        """Raise `RecordingError`, which names `where` the values come from, for cameras that are no stereo pair."""
        for side, camera in (("left", self.left), ("right", self.right)):
            try:
                camera.check()
            except RecordingError as error:
                raise RecordingError(f"{where}: {side}: {error}") from error
        sizes = [(camera.width, camera.height) for camera in (self.left, self.right)]
        if sizes[0] != sizes[1]:
            raise RecordingError(
                f"{where}: the left camera has {sizes[0][0]} x {sizes[0][1]} pixels, the right one {sizes[1][0]} x {sizes[1][1]}; "
                "expected one size. Use one resolution for both, and calibrate at it."
            )
        check_rotation(self.rotation, where, "X_right = rotation X_left + translation_m", max_skew=_MAX_SKEW)
        shift = np.asarray(self.translation_m, float)
        if shift.shape != (3,) or not np.isfinite(shift).all():
            raise RecordingError(f"{where}: translation_m is {shift.tolist()}; expected 3 finite numbers in metres.")
        self._check_baseline(where)

    def _check_baseline(self, where: str) -> None:
        if not MIN_BASELINE_M <= self.baseline_m <= MAX_BASELINE_M:
            raise RecordingError(
                f"{where}: the cameras are {self.baseline_m:.4g} m apart; expected {MIN_BASELINE_M:g} to {MAX_BASELINE_M:g} m. "
                "Millimetres must be converted; without a distance there is no depth."
            )
        # The right camera's centre in the left camera's frame.
        centre = -np.asarray(self.rotation, float).T @ np.asarray(self.translation_m, float)
        if np.abs(centre[0]) < np.linalg.norm(centre[1:]):
            raise RecordingError(
                f"{where}: the right camera is at {np.round(centre, 4).tolist()} m in the left camera's frame; expected most of it "
                "along x (right). Cameras above each other must be turned, and their pictures with them."
            )
        if centre[0] < 0:
            raise RecordingError(
                f"{where}: the right camera is {-centre[0]:.4g} m to the left of the left one; expected it to the right: left and "
                "right are swapped. Exchange them, or the sign of translation_m."
            )


@dataclasses.dataclass(frozen=True)
class StereoFile:
    """Content of a camera file. The right camera is like the left one where it is not given."""

    left: Intrinsics
    translation_m: tuple[float, float, float]  # X_right = rotation X_left + translation_m
    right: Intrinsics | None = None
    rotation: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )
    format: str = FORMAT
    reprojection_px: float | None = None  # of the calibration
    row_difference_px: float | None = None  # between the same corner in both rectified pictures
    num_views: int | None = None

    def rig(self, where: str) -> StereoRig:
        """The cameras, checked. Raises `RecordingError`, which names `where` they come from."""
        rig = StereoRig(
            self.left, self.right or self.left, np.array(self.rotation, float), np.array(self.translation_m, float)
        )
        rig.check(where)
        return rig


def read_rig(path: str | Path) -> StereoRig:
    """The pair of a camera file. Raises `RecordingError` for a file that cannot be read or describes no pair."""
    path = Path(path)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise RecordingError(f"{path}: {path.stat().st_size} bytes; expected a camera file of some lines.")
        values = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(
            f"{path}: no readable camera file ({error}). Make one with experiments.calibrate_stereo, or write: {EXAMPLE}"
        ) from error
    try:
        if not isinstance(values, dict):
            raise ConfigError("no keys and values.")
        file = from_mapping(StereoFile, values)
    except (ConfigError, TypeError) as error:
        raise RecordingError(f"{path}: {error} A camera file of a pair is, for example: {EXAMPLE}") from error
    if file.format != FORMAT:
        raise RecordingError(f"{path}: format is {file.format!r}; expected {FORMAT!r}.")
    return file.rig(str(path))


def write_rig(rig: StereoRig, path: str | Path, **about: float | int) -> None:
    """Write the camera file of a pair as JSON; `about` are further fields of `StereoFile`."""
    values = {
        "format": FORMAT,
        "left": dataclasses.asdict(rig.left),
        "right": dataclasses.asdict(rig.right),
        "rotation": np.asarray(rig.rotation, float).tolist(),
        "translation_m": np.asarray(rig.translation_m, float).tolist(),
        **about,
    }
    write_atomic(path, json.dumps(values, indent=1, allow_nan=False) + "\n")
