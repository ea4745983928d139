"""Pictures that a flow is asked of: what is accepted, what is refused and why, and how it is brought to one form."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Shaped, UInt8

_RULE = (
    "expected a grey or RGB picture: (height, width), or (height, width, 1, 3 or 4), uint8, uint16, or floats 0 to 1"
)


def check_images(
    first: Any, second: Any
) -> tuple[Shaped[np.ndarray, "height width 3"], Shaped[np.ndarray, "height width 3"]]:
    """Both pictures as RGB of one size and kind: uint8 if both are, else float32 from 0 to 1.

    Grey becomes RGB, an alpha channel is left out, uint16 is divided by its largest value. Raises `ValueError` for
    anything that is no picture, for floats that are not finite or beyond 0 to 1, and for two sizes.
    """
    if first is None or second is None:
        raise ValueError("One picture is missing; a flow needs two, of one camera and one size.")
    pictures = [_colour(picture, name) for picture, name in ((first, "The first"), (second, "The second"))]
    one, other = (picture.shape for picture in pictures)
    if one != other:
        raise ValueError(
            f"The pictures have {one[1]} x {one[0]} and {other[1]} x {other[0]} pixels; a flow needs one size. Crop or "
            "resize them alike."
        )
    if pictures[0].dtype != pictures[1].dtype:
        pictures = [to_float(picture) for picture in pictures]
    return pictures[0], pictures[1]


def _colour(given: Any, name: str) -> np.ndarray:
    try:
        picture: np.ndarray = np.asarray(given)
    except ValueError:  # lists of unlike lengths
        picture = np.asarray(None)
    flat = picture.ndim == 2
    if picture.dtype == object or not (flat or (picture.ndim == 3 and picture.shape[2] in (1, 3, 4))):
        hint = ""
        if picture.ndim == 3 and picture.shape[0] in (1, 3, 4):
            hint = " Channels come last: transpose(1, 2, 0)."
        if picture.ndim == 4:
            hint = " Give one picture at a time."
        raise ValueError(f"{name} picture is {picture.dtype} of shape {picture.shape}; {_RULE}.{hint}")
    if min(picture.shape[:2]) < 1:
        raise ValueError(f"{name} picture is empty (shape {picture.shape}); {_RULE}.")
    picture = picture[..., None] if flat else picture[..., :3]
    if picture.dtype == np.uint16:
        picture = picture.astype(np.float32) / np.float32(65535)
    elif picture.dtype.kind == "f":
        picture = _unit(picture, name)
    elif picture.dtype != np.uint8:
        raise ValueError(f"{name} picture is {picture.dtype}; {_RULE}. Convert it first.")
    return np.broadcast_to(picture, (*picture.shape[:2], 3)) if picture.shape[2] == 1 else picture


def _unit(picture: np.ndarray, name: str) -> np.ndarray:
    """Floats, checked to be finite and from 0 to 1; what rounding put beyond is cut."""
    bad = picture.size - int(np.sum(np.isfinite(picture)))
    if bad:
        raise ValueError(f"{name} picture holds {bad} values that are not finite; fill them before asking for a flow.")
    low, high = float(picture.min()), float(picture.max())
    if low < -1e-3 or high > 1 + 1e-3:
        raise ValueError(
            f"{name} picture is {picture.dtype} from {low:.4g} to {high:.4g}; floats count from 0 to 1. Divide levels of "
            "255 by 255, or give uint8."
        )
    return np.clip(picture.astype(np.float32), 0, 1)


def to_float(picture: Shaped[np.ndarray, "height width channel"]) -> Float[np.ndarray, "height width channel"]:
    """uint8 levels as float32 from 0 to 1; such floats as they are."""
    return picture.astype(np.float32) / np.float32(255) if picture.dtype == np.uint8 else picture


def to_uint8(picture: Shaped[np.ndarray, "height width channel"]) -> UInt8[np.ndarray, "height width channel"]:
    """Floats from 0 to 1 as uint8 levels; such levels as they are."""
    return picture if picture.dtype == np.uint8 else np.rint(255 * picture).astype(np.uint8)
