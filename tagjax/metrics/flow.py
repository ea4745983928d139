"""Scores of optical flow: end-point error against truth, and the photometric error of the second picture warped to the first.

Host-side NumPy; sums over pixels accumulate as state -> merge -> result, so that pairs are scored one by one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from ..flow.images import to_float
from .mean import MaskedMean

OUTLIERS_PX = (1, 3, 5)
"""Thresholds of the end-point error, pixels, above which the fraction of pixels is counted."""

FL_PX, FL_FRACTION = 3.0, 0.05
"""An outlier of KITTI 2015 (Menze and Geiger, CVPR 2015): an error above this, and above this fraction of the true length."""


def endpoint_error(
    flow_px: Float[np.ndarray, "_ _ 2"], truth_px: Float[np.ndarray, "height width 2"]
) -> Float[np.ndarray, "height width"]:
    """Length of the difference of two flows, pixels; NaN where the truth is not finite.

    Raises `ValueError` for two sizes, and for a flow that is not finite where the truth is.
    """
    if flow_px.shape != truth_px.shape:
        raise ValueError(f"A flow of shape {flow_px.shape} against a truth of {truth_px.shape}; expected one shape.")
    known = np.all(np.isfinite(truth_px), axis=-1)
    bad = int(np.sum(known & ~np.all(np.isfinite(flow_px), axis=-1)))
    if bad:
        raise ValueError(f"The flow of {bad} pixels is not finite; expected a finite flow at every pixel.")
    gap = np.where(known[..., None], flow_px, 0).astype(np.float64) - np.where(known[..., None], truth_px, 0)
    return np.where(known, np.linalg.norm(gap, axis=-1), np.nan)


def warped_error(
    first: Shaped[np.ndarray, "height width 3"],
    second: Shaped[np.ndarray, "height width 3"],
    flow_px: Float[np.ndarray, "height width 2"],
) -> tuple[Float[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
    """Mean over colours of |first(x) - second(x + flow)|, levels of 255, and where the target is in the picture.

    Pictures are uint8, or floats from 0 to 1. Needs no truth. It is a proxy: where the light changes or pixels are
    occluded, the more accurate of two flows may have the larger error.
    """
    height, width = first.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    u, v = x + flow_px[..., 0].astype(np.float32), y + flow_px[..., 1].astype(np.float32)
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    moved = cv2.remap(to_float(second), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.mean(np.abs(255.0 * (to_float(first) - moved)), axis=-1, dtype=np.float64)), inside


@dataclasses.dataclass(frozen=True)
class FlowScores:
    """Accumulated scores of any number of pairs."""

    means: Mapping[str, MaskedMean] = dataclasses.field(default_factory=dict)

    @classmethod
    def of_truth(
        cls,
        flow_px: Float[np.ndarray, "_ _ 2"],
        truth_px: Float[np.ndarray, "height width 2"],
        occluded: Bool[np.ndarray, "height width"] | None = None,
        *,
        moving_px: float = 0.5,
    ) -> FlowScores:
        """The state of one pair: errors of all pixels, visible and occluded ones, moving and static ones; outliers.

        A pixel moves if its true flow is longer than `moving_px`. Pixels of unknown flow (NaN) count nowhere. Errors as
        of `endpoint_error`.
        """
        error = endpoint_error(flow_px, truth_px)
        known = np.isfinite(error)
        length = np.linalg.norm(np.where(known[..., None], truth_px, 0), axis=-1)
        moving = length > moving_px
        parts = {"epe_px": known, "epe_moving_px": known & moving, "epe_still_px": known & ~moving}
        if occluded is not None:
            parts |= {"epe_visible_px": known & ~occluded, "epe_hidden_px": known & occluded}
        means = {name: MaskedMean.of(error, part) for name, part in parts.items()}
        for limit in OUTLIERS_PX:
            means[f"above_{limit}px"] = MaskedMean.of(np.asarray(error > limit, np.float64), known)
        outlier = (error > FL_PX) & (error > FL_FRACTION * length)
        return cls({**means, "fl": MaskedMean.of(outlier.astype(np.float64), known)})

    @classmethod
    def of_pictures(
        cls,
        first: Shaped[np.ndarray, "height width 3"],
        second: Shaped[np.ndarray, "height width 3"],
        flow_px: Float[np.ndarray, "height width 2"],
    ) -> FlowScores:
        """The state of one pair without truth: `warped_error` over targets in the picture, and their fraction."""
        error, inside = warped_error(first, second, flow_px)
        everywhere = np.ones_like(inside)
        return cls(
            {
                "warped_levels": MaskedMean.of(error, inside),
                "inside": MaskedMean.of(inside.astype(np.float64), everywhere),
            }
        )

    def merge(self, other: FlowScores) -> FlowScores:
        names = {**self.means, **other.means}
        none = MaskedMean()
        return FlowScores({name: self.means.get(name, none).merge(other.means.get(name, none)) for name in names})

    def result(self) -> dict[str, float | int | None]:
        """Named means, None where no pixel counts, and the number of pixels of known flow."""
        numbers: dict[str, float | int | None] = {
            name: mean.result() if mean.count else None for name, mean in self.means.items()
        }
        return {**numbers, "num_pixels": self.means["epe_px"].count if "epe_px" in self.means else 0}
