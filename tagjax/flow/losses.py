"""Losses of optical flow without labels: census, occlusion, smoothness, and a teacher's word on what is hidden.

Multi-level census and forward-backward occlusion after UnFlow (Meister et al., AAAI 2018); edge-aware smoothness and
self-supervision after UFlow (Jonschkowski et al., ECCV 2020). Functions take one pair; `jax.vmap` for batches. Masks
carry no gradient: none could tell the network to hide what it does not explain.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._numerics import safe_sqrt
from ..image.census import census_distance, census_offsets, to_grey
from ..image.warp import gather, pixel_grid
from ._layers import shrink
from .network import Levels

Photometric = Literal["census", "photometric", "ssim"]


@dataclasses.dataclass(frozen=True)
class FlowLossSettings:
    """Weights and switches of the loss; steps count updates of the network."""

    data: Photometric = "census"
    census_radius: int = 3  # pixels, at the full resolution; one less at each rougher level, down to 1
    census_stride: int = 3  # of the neighbours within the radius every n-th is compared
    level_weights: tuple[float, ...] = (1.0, 0.5, 0.4, 0.3, 0.2)  # finest first; rougher levels beyond have none
    robustness: float = 0.4  # exponent of the generalised Charbonnier function of the data term
    smooth_first: float = 1.0
    smooth_second: float = 0.0
    edge_weight: float = 50.0  # of the mean absolute colour difference (0 to 1) between neighbours
    occlusion: bool = True
    occlusion_after: int = 500  # steps before which nothing counts as hidden: from scratch, everything would be
    occlusion_share: float = 0.01  # of the squared lengths
    occlusion_px2: float = 0.5
    self_supervision: float = 0.0
    self_supervision_after: int = 3000
    self_supervision_ramp: int = 1000
    self_supervision_border_px: int = 16  # what the student does not see, at each side

    def __post_init__(self) -> None:
        if not self.level_weights or min(self.level_weights) < 0 or max(self.level_weights) <= 0:
            raise ValueError(f"level_weights are {self.level_weights}; at least one positive and none negative.")
        if not 0 < self.robustness <= 1:
            raise ValueError(f"robustness is {self.robustness}; expected an exponent above 0 and at most 1.")
        census_offsets(self.census_radius, self.census_stride)


def charbonnier(x: Float[Array, "*shape"], exponent: float, epsilon: float = 0.01) -> Float[Array, "*shape"]:
    """Robust penalty (|x| + epsilon)^exponent, after DDFlow and UFlow. Gradient 0 at 0."""
    return (jnp.abs(x) + epsilon) ** exponent


def masked_mean(values: Float[Array, "height width"], mask: Float[Array, "height width"]) -> Float[Array, ""]:
    """Mean over the mask; 0 where the mask is empty."""
    return jnp.sum(values * mask) / (jnp.sum(mask) + 1e-6)


def inside(flow_px: Float[Array, "height width 2"]) -> Bool[Array, "height width"]:
    """Where the flow stays within the picture."""
    height, width, _ = flow_px.shape
    x, y = pixel_grid(height, width)
    u, v = x + flow_px[..., 0], y + flow_px[..., 1]
    return (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)


def inconsistency(
    flow_px: Float[Array, "height width 2"], back_px: Float[Array, "height width 2"]
) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
    """|f + b(x + f)|^2 and |f|^2 + |b(x + f)|^2, pixels^2: how far there and back is from where it began."""
    back, _ = gather(back_px, flow_px)
    gap = flow_px + back
    return jnp.sum(gap * gap, axis=-1), jnp.sum(flow_px * flow_px + back * back, axis=-1)


def occluded(
    flow_px: Float[Array, "height width 2"],
    back_px: Float[Array, "height width 2"],
    share: float = 0.01,
    floor_px2: float = 0.5,
) -> Bool[Array, "height width"]:
    """Where the way back does not lead back: |f + b|^2 >= share (|f|^2 + |b|^2) + floor (Sundaram et al., ECCV 2010)."""
    gap, length = inconsistency(flow_px, back_px)
    return gap >= share * length + floor_px2


def ssim_distance(
    first: Float[Array, "height width"], second: Float[Array, "height width"]
) -> Float[Array, "height width"]:
    """(1 - SSIM) / 2 over windows of 3 x 3 pixels (Wang et al., 2004): 0 alike to 1; edge pixels repeat."""

    def mean(image: Array) -> Array:
        padded = jnp.pad(image, 1, mode="edge")
        height, width = image.shape
        return sum((padded[i : i + height, j : j + width] for i in range(3) for j in range(3)), jnp.zeros(())) / 9

    one, other = mean(first), mean(second)
    variance_one, variance_other = mean(first * first) - one * one, mean(second * second) - other * other
    covariance = mean(first * second) - one * other
    light, contrast = 0.01**2, 0.03**2
    likeness = (2 * one * other + light) * (2 * covariance + contrast)
    return 0.5 * (1 - likeness / ((one**2 + other**2 + light) * (variance_one + variance_other + contrast)))


def data_distance(
    first: Float[Array, "height width"],
    second: Float[Array, "height width"],
    settings: FlowLossSettings,
    level: int,
) -> Float[Array, "height width"]:
    """How unlike two aligned grey pictures are, pixel by pixel, before the robust function."""
    if settings.data == "census":
        radius = max(1, settings.census_radius - level)
        return 48 * census_distance(first, second, census_offsets(radius, settings.census_stride if radius > 1 else 1))
    if settings.data == "ssim":
        return ssim_distance(first, second)
    return first - second


def data_term(
    flow_px: Float[Array, "height width 2"],
    first: Float[Array, "height width"],
    second: Float[Array, "height width"],
    visible: Float[Array, "height width"],
    settings: FlowLossSettings,
    level: int = 0,
) -> Float[Array, ""]:
    """Mean robust distance of the first picture and the second, brought onto it, over what is visible.

    The gradient reaches the flow only, not the pictures.
    """
    warped, _ = gather(jax.lax.stop_gradient(second)[..., None], flow_px)
    # Outside, the first picture stands in, so that the neighbours of such pixels see no edge.
    warped = jnp.where(inside(flow_px), warped[..., 0], first)
    return masked_mean(charbonnier(data_distance(first, warped, settings, level), settings.robustness), visible)


def smoothness(
    flow_px: Float[Array, "height width 2"], image: Float[Array, "height width 3"], edge_weight: float, order: int
) -> Float[Array, ""]:
    """Mean over both axes of exp(-w |dI|) sqrt(|d^n f|^2 + 0.001^2), n = `order` 1 or 2 (UFlow, Eq. 5).

    dI is the mean over colours of the difference across the n + 1 pixels that the flow's difference takes in.
    """
    total = jnp.zeros(())
    for axis in (0, 1):
        change = jnp.diff(flow_px, n=order, axis=axis)
        first = jax.lax.slice_in_dim(image, 0, image.shape[axis] - order, axis=axis)
        last = jax.lax.slice_in_dim(image, order, image.shape[axis], axis=axis)
        weight = jnp.exp(-edge_weight * jnp.mean(jnp.abs(last - first), axis=-1))
        total = total + jnp.mean(weight * jnp.sum(safe_sqrt(change * change + 1e-6), axis=-1))
    return total / 2


def teaching_term(
    student_px: Float[Array, "rows columns 2"],
    teacher_px: Float[Array, "height width 2"],
    student_hidden: Bool[Array, "rows columns"],
    teacher_hidden: Bool[Array, "height width"],
    border_px: int,
) -> Float[Array, ""]:
    """What a student that sees less should learn of one that sees all, where only the teacher is sure (UFlow, Eq. 6).

    The student's picture is the teacher's without `border_px` at each side. No gradient to the teacher.
    """
    cut = slice(border_px, -border_px)
    known = (~teacher_hidden[cut, cut] & student_hidden).astype(jnp.float32)
    gap = student_px - jax.lax.stop_gradient(teacher_px[cut, cut])
    return jnp.sum(jnp.sum(safe_sqrt(gap * gap + 1e-6), axis=-1) * known) / known.size


def level_terms(
    forward: Levels,
    backward: Levels,
    first: Float[Array, "height width 3"],
    second: Float[Array, "height width 3"],
    hide: Float[Array, ""],
    settings: FlowLossSettings,
) -> dict[str, Float[Array, ""]]:
    """Data term and smoothness summed over levels, of one direction; `hide` 1 leaves out what is occluded, 0 not.

    Smoothness is asked of the last level before the learned upsampling, which follows the picture's edges by itself.
    """
    height = first.shape[0]
    data, first_order, second_order = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    hidden_share = jnp.zeros(())
    ways = list(zip(forward[::-1], backward[::-1], strict=True))
    for level, (flow, back) in enumerate(ways[: len(settings.level_weights)]):
        factor = height // flow.shape[0]
        here, there = (shrink(image, factor) if factor > 1 else image for image in (first, second))
        visible = inside(flow).astype(jnp.float32)
        if settings.occlusion:
            hidden = occluded(flow, back, settings.occlusion_share, settings.occlusion_px2).astype(jnp.float32)
            visible = visible * (1 - hide * hidden)
        visible = jax.lax.stop_gradient(visible)
        if level == 0:
            hidden_share = 1 - jnp.mean(visible)
        term = data_term(flow, to_grey(here), to_grey(there), visible, settings, level)
        data = data + settings.level_weights[level] * term
        if level == min(1, len(ways) - 1):
            first_order = smoothness(flow, here, settings.edge_weight, 1)
            second_order = smoothness(flow, here, settings.edge_weight, 2)
    return {"data": data, "smooth_first": first_order, "smooth_second": second_order, "hidden_share": hidden_share}


def weighted(terms: dict[str, Float[Array, ""]], settings: FlowLossSettings) -> Float[Array, ""]:
    """The loss of the terms."""
    total = terms["data"] + settings.smooth_first * terms["smooth_first"]
    total = total + settings.smooth_second * terms["smooth_second"]
    return total + settings.self_supervision * terms.get("teaching", jnp.zeros(()))


def mean_terms(parts: Sequence[dict[str, Float[Array, ""]]]) -> dict[str, Float[Array, ""]]:
    """Term by term, the mean of several."""
    return {name: sum((part[name] for part in parts), jnp.zeros(())) / len(parts) for name in parts[0]}
