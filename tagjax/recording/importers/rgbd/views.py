"""Pictures of a rig as the frames of a recording: without lens distortion, depth in the view of the colour camera."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt8

from ....core.camera import Intrinsics
from ....core.errors import RecordingError
from ....core.geometry import range_to_depth, register_depth, undistorted_positions
from .source import Picture, Rig

_MAX_MM = 65535.0
_MILLIMETRE = 0.001


class Views:
    """Frames of one rig. Maps of the lenses are made once.

    Depth becomes uint16 millimetres if it is stored as integer millimetres, else float32 metres, so that no precision is
    lost; missing depth (0, not finite) is 0. Colour is interpolated bilinearly, depth takes the nearest pixel. Depth that is
    registered here has a coarser picture than colour enlarged first, so that no holes open between its pixels. Raises
    `RecordingError` for pictures of another size than the cameras'.
    """

    def __init__(self, rig: Rig):
        self.rig = rig
        self.intrinsics = dataclasses.replace(rig.colour, distortion=())
        # Depth that is registered here is converted to z first.
        self.depth_kind: Literal["depth", "range"] = "depth" if rig.depth is not None else rig.depth_kind
        self._colour_maps = _lens_maps(rig.colour)
        self._depth_maps = self._colour_maps if rig.depth is None else _lens_maps(rig.depth)

    def depth_dtype(self, stored: np.dtype) -> np.dtype:
        """Type of the recording's depth for pictures that are stored as `stored`."""
        whole = stored.kind in "ui" and math.isclose(self.rig.depth_unit_m, _MILLIMETRE, rel_tol=1e-6)
        return np.dtype(np.uint16 if whole else np.float32)

    def colour(self, picture: Picture) -> UInt8[np.ndarray, "height width 3"]:
        """The colour frame of a picture."""
        image = picture.decode()
        _check_size(picture, image, self.rig.colour)
        if self._colour_maps is None:
            return image
        return cv2.remap(image, *self._colour_maps, cv2.INTER_LINEAR)

    def depth(self, picture: Picture) -> Shaped[np.ndarray, "height width"]:
        """The depth frame of a picture, in the view of the colour camera."""
        raw = picture.decode()
        _check_size(picture, raw, self.rig.depth or self.rig.colour)
        dtype = self.depth_dtype(raw.dtype)
        if self._depth_maps is not None:
            raw = cv2.remap(raw, *self._depth_maps, cv2.INTER_NEAREST)
        if self.rig.depth is None:
            return raw if raw.dtype == dtype == np.uint16 else _metres(raw, self.rig.depth_unit_m)
        return _stored(self._registered(_metres(raw, self.rig.depth_unit_m), self.rig.depth), dtype)

    def _registered(
        self, depth_m: Float[np.ndarray, "depth_height depth_width"], lens: Intrinsics
    ) -> Float[np.ndarray, "height width"]:
        camera = dataclasses.replace(lens, distortion=())
        if self.rig.depth_kind == "range":
            depth_m = range_to_depth(depth_m, camera)
        # A pixel of depth must not cover more than one of colour.
        times = math.ceil(max(self.intrinsics.fx_px / camera.fx_px, self.intrinsics.fy_px / camera.fy_px) - 0.05)
        if times > 1:
            depth_m, camera = depth_m.repeat(times, axis=0).repeat(times, axis=1), _enlarged(camera, times)
        return register_depth(depth_m, camera, self.intrinsics, self.rig.rotation, self.rig.translation_m)


def _enlarged(camera: Intrinsics, times: int) -> Intrinsics:
    """Intrinsics of a picture whose every pixel was repeated; centres are at integers in both."""
    return dataclasses.replace(
        camera,
        fx_px=camera.fx_px * times,
        fy_px=camera.fy_px * times,
        cx_px=(camera.cx_px + 0.5) * times - 0.5,
        cy_px=(camera.cy_px + 0.5) * times - 0.5,
        width=camera.width * times,
        height=camera.height * times,
    )


def _lens_maps(camera: Intrinsics) -> tuple[np.ndarray, np.ndarray] | None:
    """Maps for `cv2.remap`, x and y of the distorted picture; None for a lens without distortion."""
    if not any(camera.distortion):
        return None
    try:
        positions = undistorted_positions(camera).astype(np.float32)
    except ValueError as error:
        raise RecordingError(str(error)) from error
    return np.ascontiguousarray(positions[..., 0]), np.ascontiguousarray(positions[..., 1])


def _check_size(picture: Picture, image: np.ndarray, camera: Intrinsics) -> None:
    expected = (camera.height, camera.width)
    if image.shape[:2] != expected:
        raise RecordingError(
            f"{picture.where}: {picture.stream} of {image.shape[1]} x {image.shape[0]} pixels; expected {camera.width} x "
            f"{camera.height} as in the camera's intrinsics. Give the intrinsics of this resolution; all pictures must have one size."
        )
    wrong = image.ndim != (3 if picture.stream == "colour" else 2)
    if wrong or (image.dtype != np.uint8 if picture.stream == "colour" else image.dtype not in (np.uint16, np.float32)):
        kind = (
            "uint8 of 3 channels" if picture.stream == "colour" else "16-bit integers or 32-bit floats of one channel"
        )
        raise RecordingError(
            f"{picture.where}: {picture.stream} is {image.dtype} of shape {image.shape}; expected {kind}. Convert it."
        )


def _metres(raw: np.ndarray, unit_m: float) -> np.ndarray:
    """Depth in metres, float32, 0 where missing."""
    metres = raw.astype(np.float32)
    if raw.dtype.kind in "ui":
        metres *= np.float32(unit_m)
    metres[~(np.isfinite(metres) & (metres > 0))] = 0
    return metres


def _stored(depth_m: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if dtype == np.float32:
        return depth_m.astype(np.float32)
    millimetres = np.rint(depth_m * np.float32(1000))
    return np.where(millimetres <= _MAX_MM, millimetres, 0).astype(np.uint16)
