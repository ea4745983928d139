"""Random augmentation of image pairs: crop, rotation, scale and mirroring alike for both images; light and noise."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8


@dataclasses.dataclass(frozen=True)
class AugmentationSettings:
    """How a pair is cropped from two images, and how the network's input differs from what the loss compares.

    The geometry is the same for both images of a pair; brightness and noise differ a little between them. Raises
    `ValueError` for sizes, ranges and probabilities that are not possible.
    """

    height: int = 128
    width: int = 160
    margin_px: int = 0  # at each side of the crop, for the loss only (SMURF's full-image warping)
    scale: tuple[float, float] = (0.7, 1.4)  # log-uniform; an image that is too small is enlarged to fit
    rotation_deg: float = 10.0  # uniform, up to this much either way
    gaps: tuple[int, ...] = (1, 2, 4)  # frames between the images of a pair
    gain: float = 0.25  # of both images, relative
    gamma: float = 0.25  # of both images, logarithm of the exponent
    tint: float = 0.1  # gain of each colour channel, relative
    gain_difference: float = 0.05  # between the two images, relative
    noise: float = 0.02  # highest standard deviation, of values from 0 to 1
    grey_probability: float = 0.1  # of grey pairs
    transpose_probability: float = 0.0  # of exchanging rows and columns
    negative_probability: float = 0.0  # of inverting the brightness
    recolour_probability: float = 0.0  # of permuting the colour channels

    def __post_init__(self) -> None:
        low, high = self.scale
        if self.margin_px < 0:
            raise ValueError(f"margin_px is {self.margin_px}; expected 0 or more.")
        if not 0 < low <= high:
            raise ValueError(f"scale is {self.scale}; expected two positive numbers, the smaller first.")
        if not self.gaps or min(self.gaps) < 1:
            raise ValueError(f"gaps are {self.gaps}; expected frame distances of at least 1.")
        if min(self.height, self.width) < 32:
            raise ValueError(f"Crops of {self.height} x {self.width} are too small; use at least 32 x 32.")
        for name in ("grey_probability", "transpose_probability", "negative_probability", "recolour_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a probability from 0 to 1.")


def augment(
    pair: UInt8[np.ndarray, "2 _ _ 3"],
    rng: np.random.Generator,
    settings: AugmentationSettings,
    flow_px: Float32[np.ndarray, "_ _ 2"] | None = None,
) -> dict[str, np.ndarray]:
    """A random crop of a pair, uint8: `clean`, for the loss, and `augmented`, for the network, with other light and
    noise.

    `clean` extends `margin_px` further than `augmented` at each side. With the pair's flow, first to second in pixels,
    the result holds the flow between the cropped images, `flow_px`, NaN where the crop extends beyond the image;
    without it the order of the two images is random.
    """
    margin = settings.margin_px
    size = settings.height + 2 * margin, settings.width + 2 * margin
    matrix, scale = _crop_geometry(pair.shape[1:3], rng, settings, size)
    order = rng.permutation(2) if flow_px is None else np.arange(2)
    clean = np.stack([_crop(image, matrix, size, scale) for image in pair[order]])
    inner = slice(margin, margin + settings.height), slice(margin, margin + settings.width)
    found = {"clean": clean, "augmented": _change_light(clean[:, *inner].astype(np.float32) / 255, rng, settings)}
    if flow_px is not None:
        found["flow_px"] = _crop_flow(flow_px, matrix, size)[inner]
    return found


def _change_light(
    images: Float32[np.ndarray, "2 height width 3"], rng: np.random.Generator, settings: AugmentationSettings
) -> UInt8[np.ndarray, "2 height width 3"]:
    """The pair with other brightness, colour and noise. Values from 0 to 1."""
    images = images ** np.float32(np.exp(rng.uniform(-settings.gamma, settings.gamma)))
    difference = rng.uniform(-settings.gain_difference, settings.gain_difference, (2, 1, 1, 1))
    tint = rng.uniform(-settings.tint, settings.tint, (1, 1, 1, 3))
    images = images * (1 + rng.uniform(-settings.gain, settings.gain) + difference + tint).astype(np.float32)
    if rng.uniform() < settings.grey_probability:
        images = np.repeat(np.mean(images, axis=-1, keepdims=True), 3, axis=-1)
    if _happens(rng, settings.negative_probability):
        images = 1 - images
    if _happens(rng, settings.recolour_probability):
        images = images[..., rng.permutation(3)]
    noise = rng.standard_normal(images.shape, np.float32) * np.float32(settings.noise * rng.uniform() ** 2)
    return np.clip(np.rint(255 * (images + noise)), 0, 255).astype(np.uint8)


def _crop_geometry(
    image_shape: tuple[int, ...], rng: np.random.Generator, settings: AugmentationSettings, size: tuple[int, int]
) -> tuple[Float[np.ndarray, "2 3"], float]:
    """The affine map from pixels (x, y, 1) of a random crop of (rows, columns) `size` to the image's pixels; and its
    scale.
    """
    (height, width), (rows, columns) = image_shape, size
    low, high = settings.scale
    scale = np.exp(rng.uniform(np.log(low), np.log(high)))
    scale = max(scale, rows / height, columns / width)
    angle_rad = np.deg2rad(rng.uniform(-settings.rotation_deg, settings.rotation_deg))
    # The range of the crop's centre for which a crop without rotation lies within the image.
    room = np.array([width - columns / scale, height - rows / scale])
    centre = np.array([(width - 1) / 2, (height - 1) / 2]) + (rng.uniform(size=2) - 0.5) * room
    mirror = rng.choice([-1.0, 1.0], 2)
    cosine, sine = np.cos(angle_rad) / scale, np.sin(angle_rad) / scale
    linear = np.array([[cosine, -sine], [sine, cosine]]) * mirror
    if _happens(rng, settings.transpose_probability):
        linear = linear[:, ::-1]
    corner = centre - linear @ np.array([(columns - 1) / 2, (rows - 1) / 2])
    return np.concatenate([linear, corner[:, None]], axis=1), float(scale)


def _happens(rng: np.random.Generator, probability: float) -> bool:
    """Draws no number if the probability is 0, so that such settings give the same pairs as before the option existed."""
    return probability > 0 and rng.uniform() < probability


_WARP_FLAGS = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


def _crop(image: np.ndarray, matrix: np.ndarray, size: tuple[int, int], scale: float) -> np.ndarray:
    """The crop of (rows, columns) `size`; beyond the image it is mirrored."""
    # Shrinking skips pixels: blur against aliasing.
    sigma = 0.5 * (1 / scale - 1)
    smooth = cv2.GaussianBlur(image, (0, 0), sigma) if sigma > 0.1 else np.ascontiguousarray(image)
    return cv2.warpAffine(smooth, matrix, size[::-1], flags=_WARP_FLAGS, borderMode=cv2.BORDER_REFLECT_101)


def _crop_flow(
    flow_px: Float32[np.ndarray, "_ _ 2"], matrix: Float[np.ndarray, "2 3"], size: tuple[int, int]
) -> Float32[np.ndarray, "rows columns 2"]:
    """The same crop of a flow field, in pixels of the crop; NaN beyond the image."""
    crop = cv2.warpAffine(
        np.ascontiguousarray(flow_px),
        matrix,
        size[::-1],
        flags=_WARP_FLAGS,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(np.nan, np.nan),
    )
    return (crop @ np.linalg.inv(matrix[:, :2]).T).astype(np.float32)
