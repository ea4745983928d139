"""Disparity of a rectified pair by OpenCV's semi-global matching, checked from right to left and smoothed; metric depth."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16

from ..core.camera import Intrinsics
from ..core.settings import ConfigError
from .smoothing import smooth_disparity

MAX_DISPARITIES = 1024
"""Largest number of disparities that are searched: more would take minutes a picture."""

_SCALE = 16  # OpenCV's disparities have 4 fractional bits
_STEP = 16  # the number of disparities is a multiple of it
_MAX_MM = 65535
_EDGE_PX = 1.5  # larger steps of disparity are edges of objects
_LIKE_COLOUR = 12.0  # levels by which the same surface may differ
_SLOPE = np.array([[-0.5, 0.0, 0.5]], np.float32)  # grey values a pixel, along a row
_NOISE = np.float32(4.0)  # of the slope, squared: without it, windows without texture would follow the noise


@dataclasses.dataclass(frozen=True)
class MatchSettings:
    """Settings of the matching. Depth outside of `near_m` to `far_m` is not found.

    `smoothness` 1 stands for OpenCV's usual penalties, 8 and 32 a pixel of a block and a channel, for disparities that differ
    by one pixel and by more (Hirschmueller, PAMI 2008). Matches are kept where the disparity found from the right picture
    differs by at most `max_difference_px`.
    """

    near_m: float = 0.6
    far_m: float = 8.0
    block_px: int = 3  # odd
    smoothness: float = 1.0
    uniqueness_percent: int = 5  # by which the best match must be better than the second
    max_difference_px: float = 1.0
    min_patch_px: int = 60  # smaller patches of similar disparity are taken for errors, at a width of 512 pixels
    border_px: int = (
        9  # radius within which borders of near objects are compared with what has their colour; 0: they are not
    )
    smoothing: float = 200.0  # strength of the smoothing within edges of the picture, as of `smooth_disparity`; 0: none

    def __post_init__(self) -> None:
        if not 0.05 <= self.near_m < self.far_m <= 1000:
            raise ConfigError(
                f"near_m is {self.near_m}, far_m {self.far_m}; expected 0.05 m or more, and a far_m above near_m, at most 1000 m."
            )
        if self.block_px % 2 == 0 or not 1 <= self.block_px <= 31:
            raise ConfigError(f"block_px is {self.block_px}; expected an odd number of pixels from 1 to 31.")
        if not self.smoothness > 0 or not self.max_difference_px > 0:
            raise ConfigError(
                f"smoothness is {self.smoothness}, max_difference_px {self.max_difference_px}; expected values above 0."
            )
        if not 0 <= self.smoothing <= 1e5:
            raise ConfigError(f"smoothing is {self.smoothing}; expected 0 (none) to 100000.")
        if not 0 <= self.uniqueness_percent < 100 or self.min_patch_px < 0 or not 0 <= self.border_px <= 50:
            raise ConfigError(
                f"uniqueness_percent is {self.uniqueness_percent}, min_patch_px {self.min_patch_px}, border_px {self.border_px}; expected "
                "0 to 99, 0 or more, and 0 to 50."
            )

    def search_px(self, focal_px: float, baseline_m: float) -> tuple[int, int]:
        """Smallest disparity that is searched, and the number of them (a multiple of 16).

        Raises `ConfigError` for a depth range that no pair of this size can cover.
        """
        first = math.floor(focal_px * baseline_m / self.far_m)
        last = math.ceil(focal_px * baseline_m / self.near_m) + 1
        count = _STEP * math.ceil((last - first + 1) / _STEP)
        if count > MAX_DISPARITIES:
            raise ConfigError(
                f"near_m is {self.near_m}: objects there have {last} pixels of disparity; expected at most {MAX_DISPARITIES}. Choose "
                "a larger near_m, or smaller pictures."
            )
        return first, count


def disparity_of_pair(
    left: UInt8[np.ndarray, "height width 3"],
    right: UInt8[np.ndarray, "height width 3"],
    focal_px: float,
    baseline_m: float,
    settings: MatchSettings,
) -> Float[np.ndarray, "height width"]:
    """Disparity of each pixel of the left picture in pixels, float32: it is that far to the left in the right one.

    0 where none is found: hidden from one camera, without texture, in a small patch, or outside of the depth range. Pairs are
    rectified, so that matches lie in one row. Raises `ValueError` for pictures of two sizes or no baseline.
    """
    if left.shape != right.shape:
        raise ValueError(f"pictures of {left.shape} and {right.shape}; expected one size.")
    if not baseline_m > 0:
        raise ValueError(f"baseline_m is {baseline_m}; expected a right camera that is to the right of the left one.")
    first, count = settings.search_px(focal_px, baseline_m)
    from_left = _matched(left, right, first, count, settings)
    mirrored = _matched(right[:, ::-1], left[:, ::-1], first, count, settings)
    found = _agreeing(from_left, mirrored[:, ::-1], settings.max_difference_px)
    patch_px = round(settings.min_patch_px * (left.shape[1] / 512) ** 2)
    found = _without_small_patches(found, patch_px)
    if settings.border_px:
        found = _without_widened_borders(left, found, settings.border_px)
    found, texture = _refined(left, right, found, settings.block_px + 2)
    return smooth_disparity(found, texture, left, settings.smoothing) if settings.smoothing > 0 else found


def depth_of_disparity(
    disparity_px: Float[np.ndarray, "height width"], focal_px: float, baseline_m: float, settings: MatchSettings
) -> UInt16[np.ndarray, "height width"]:
    """z = f B / d in whole millimetres; 0 where the disparity is 0 or the depth out of range."""
    with np.errstate(divide="ignore"):
        depth_m = np.where(disparity_px > 0, np.float32(focal_px * baseline_m) / disparity_px, 0)
    within = (depth_m >= settings.near_m) & (depth_m <= settings.far_m)
    return np.where(within, np.minimum(np.rint(1000 * depth_m), _MAX_MM), 0).astype(np.uint16)


def depth_of_pair(
    left: UInt8[np.ndarray, "height width 3"],
    right: UInt8[np.ndarray, "height width 3"],
    camera: Intrinsics,
    baseline_m: float,
    settings: MatchSettings,
) -> UInt16[np.ndarray, "height width"]:
    """Depth of the left picture of a rectified pair, uint16 millimetres, 0 = missing. Errors as of `disparity_of_pair`."""
    disparity_px = disparity_of_pair(left, right, camera.fx_px, baseline_m, settings)
    return depth_of_disparity(disparity_px, camera.fx_px, baseline_m, settings)


@functools.lru_cache(maxsize=4)
def _matcher(first: int, count: int, settings: MatchSettings) -> cv2.StereoSGBM:
    weight = settings.smoothness * 3 * settings.block_px**2
    return cv2.StereoSGBM.create(
        minDisparity=first,
        numDisparities=count,
        blockSize=settings.block_px,
        P1=round(8 * weight),
        P2=round(32 * weight),
        disp12MaxDiff=-1,  # checked here from both pictures, which is stricter
        preFilterCap=63,
        uniquenessRatio=settings.uniqueness_percent,
        speckleWindowSize=0,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,  # as accurate here as five directions, and faster
    )


def _matched(
    one: np.ndarray, other: np.ndarray, first: int, count: int, settings: MatchSettings
) -> Float[np.ndarray, "height width"]:
    """Disparity of `one`, NaN where there is none. The border is widened: OpenCV gives its first `count` columns none."""
    margin = first + count
    wide = [cv2.copyMakeBorder(image, 0, 0, margin, 0, cv2.BORDER_REPLICATE) for image in (one, other)]
    raw = _matcher(first, count, settings).compute(*wide)[:, margin:]
    return np.where(raw >= first * _SCALE, raw / np.float32(_SCALE), np.float32(np.nan))


def _agreeing(from_left: np.ndarray, from_right: np.ndarray, max_difference_px: float) -> np.ndarray:
    """The disparities that the right picture confirms at the place to which they point; 0 elsewhere."""
    width = from_left.shape[1]
    column = np.arange(width) - from_left
    inside = np.isfinite(column) & (column > -0.5)
    at = np.clip(np.rint(np.where(inside, column, 0)), 0, width - 1).astype(np.intp)
    back = np.take_along_axis(from_right, at, axis=1)
    kept = inside & (np.abs(back - from_left) <= max_difference_px) & (from_left > 0)
    return np.where(kept, from_left, 0).astype(np.float32)


def _without_widened_borders(
    left: np.ndarray, disparity_px: np.ndarray, radius_px: int
) -> Float[np.ndarray, "height width"]:
    """Disparities without the seam of background that blocks of a near object's edge take for the object; 0 there.

    A pixel beside something farther away keeps its disparity if, of the pixels around it that have its colour, those of its own
    disparity outweigh those that are farther away (the vote of a bilateral filter).
    """
    height, width = disparity_px.shape
    known = np.where(disparity_px > 0, disparity_px, np.float32(np.inf))
    lowest = cv2.erode(known, np.ones((2 * radius_px + 1,) * 2, np.uint8))
    row, column = np.nonzero((disparity_px > 0) & (disparity_px - lowest > _EDGE_PX))
    own, colour = disparity_px[row, column], left[row, column].astype(np.float32)
    same, farther = np.zeros(len(row), np.float32), np.zeros(len(row), np.float32)
    reach = range(-radius_px, radius_px + 1, max(1, radius_px // 3))
    for down, across in itertools.product(reach, reach):
        at = np.clip(row + down, 0, height - 1), np.clip(column + across, 0, width - 1)
        other = disparity_px[at]
        differs = left[at].astype(np.float32) - colour
        alike = np.exp(np.einsum("nc,nc->n", differs, differs) * np.float32(-0.5 / _LIKE_COLOUR**2)) * (other > 0)
        same += alike * (np.abs(other - own) <= 1)
        farther += alike * (own - other > _EDGE_PX)
    out = disparity_px.copy()
    drop = farther > same
    out[row[drop], column[drop]] = 0
    return out


def _refined(
    left: np.ndarray, right: np.ndarray, disparity_px: np.ndarray, window_px: int
) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Disparities to a fraction of a pixel, and the texture that they rest on, by two Gauss-Newton steps on the grey values of a window (Lucas and Kanade, 1981).

    Semi-global matching interpolates costs of whole pixels, which draws disparities towards whole pixels, by 0.1 px or so: a
    distance that changes evenly would seem to change in steps. Every pixel of the window is compared at its own disparity, and
    means are subtracted, so that neither depth edges nor a difference in exposure moves the result. Windows without texture
    keep what they have. The texture is the window's mean square of the slope, (grey levels a pixel)^2, 0 without a disparity.
    """
    one, other = (
        cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (left, right)
    )
    slope = cv2.filter2D(other, -1, _SLOPE, borderType=cv2.BORDER_REPLICATE)
    known = (disparity_px > 0).astype(np.float32)
    count = np.maximum(_box(known, window_px), np.float32(1e-3))
    grid = np.indices(disparity_px.shape, np.float32)
    y, x = grid[0], grid[1]
    found, square = disparity_px.copy(), np.zeros_like(disparity_px)
    for _ in range(2):
        seen = cv2.remap(other, x - found, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        along = cv2.remap(slope, x - found, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) * known
        error = (one - seen) * known
        mean_error, mean_slope = _box(error, window_px) / count, _box(along, window_px) / count
        both = _box(error * along, window_px) / count - mean_error * mean_slope
        square = _box(along * along, window_px) / count - mean_slope * mean_slope
        found = found - np.clip(both / (square + _NOISE), -0.5, 0.5) * known
    return np.clip(found, disparity_px - 1, disparity_px + 1) * known, np.maximum(square, 0) * known


def _box(image: np.ndarray, side_px: int) -> np.ndarray:
    """Mean of each pixel's square window."""
    return cv2.blur(image, (side_px, side_px), borderType=cv2.BORDER_CONSTANT)


def _without_small_patches(disparity_px: np.ndarray, patch_px: int) -> np.ndarray:
    """Disparities outside of patches (neighbours differ by at most a pixel) of `patch_px` or fewer pixels; 0 there."""
    if patch_px == 0:
        return disparity_px
    whole = np.rint(disparity_px * _SCALE).astype(np.int16)
    cv2.filterSpeckles(whole, 0, patch_px, _SCALE)
    return np.where(whole > 0, disparity_px, np.float32(0))
