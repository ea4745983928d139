"""Checks and conversion of the input images of a flow."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Shaped, UInt8

_RULE = "expected a grey or RGB image: (height, width), or (height, width, 1, 3 or 4), uint8, uint16, or floats 0 to 1"


def check_images(
    first: Any, second: Any
) -> tuple[Shaped[np.ndarray, "height width 3"], Shaped[np.ndarray, "height width 3"]]:
    """Both images as RGB of one size and dtype: uint8 if both are, else float32 from 0 to 1.

    Grey becomes RGB, an alpha channel is removed, uint16 is divided by 65535. Raises `ValueError` for anything that is
    no image, for floats that are not finite or outside 0 to 1, and for two sizes.
    """
    if first is None or second is None:
        raise ValueError("One image is missing; a flow needs two of the same size.")
    images = [_colour(image, name) for image, name in ((first, "The first"), (second, "The second"))]
    one, other = (image.shape for image in images)
    if one != other:
        raise ValueError(
            f"The images have {one[1]} x {one[0]} and {other[1]} x {other[0]} pixels; a flow needs equal sizes. Crop or "
            "resize them."
        )
    if images[0].dtype != images[1].dtype:
        images = [to_float(image) for image in images]
    return images[0], images[1]


def _colour(given: Any, name: str) -> np.ndarray:
    try:
        image: np.ndarray = np.asarray(given)
    except ValueError:  # lists of different lengths
        image = np.asarray(None)
    flat = image.ndim == 2
    if image.dtype == object or not (flat or (image.ndim == 3 and image.shape[2] in (1, 3, 4))):
        hint = ""
        if image.ndim == 3 and image.shape[0] in (1, 3, 4):
            hint = " Channels come last: transpose(1, 2, 0)."
        if image.ndim == 4:
            hint = " Give one image at a time."
        raise ValueError(f"{name} image is {image.dtype} of shape {image.shape}; {_RULE}.{hint}")
    if min(image.shape[:2]) < 1:
        raise ValueError(f"{name} image is empty (shape {image.shape}); {_RULE}.")
    image = image[..., None] if flat else image[..., :3]
    if image.dtype == np.uint16:
        image = image.astype(np.float32) / np.float32(65535)
    elif image.dtype.kind == "f":
        image = _unit(image, name)
    elif image.dtype != np.uint8:
        raise ValueError(f"{name} image is {image.dtype}; {_RULE}. Convert it first.")
    return np.broadcast_to(image, (*image.shape[:2], 3)) if image.shape[2] == 1 else image


def _unit(image: np.ndarray, name: str) -> np.ndarray:
    """Floats, checked to be finite and from 0 to 1; rounding errors beyond are clipped."""
    bad = image.size - int(np.sum(np.isfinite(image)))
    if bad:
        raise ValueError(f"{name} image holds {bad} values that are not finite; replace them first.")
    low, high = float(image.min()), float(image.max())
    if low < -1e-3 or high > 1 + 1e-3:
        raise ValueError(
            f"{name} image is {image.dtype} from {low:.4g} to {high:.4g}; expected floats from 0 to 1. Divide levels of "
            "255 by 255, or give uint8."
        )
    return np.clip(image.astype(np.float32), 0, 1)


def to_float(image: Shaped[np.ndarray, "height width channel"]) -> Float[np.ndarray, "height width channel"]:
    """uint8 levels as float32 from 0 to 1; floats unchanged."""
    return image.astype(np.float32) / np.float32(255) if image.dtype == np.uint8 else image


def to_uint8(image: Shaped[np.ndarray, "height width channel"]) -> UInt8[np.ndarray, "height width channel"]:
    """Floats from 0 to 1 as uint8 levels; uint8 unchanged."""
    return image if image.dtype == np.uint8 else np.rint(255 * image).astype(np.uint8)
