"""Losses of optical flow without labels: census, occlusion, smoothness, and a teacher's word on what is hidden.

Multi-level census and forward-backward occlusion after UnFlow (Meister et al., AAAI 2018); edge-aware smoothness and
self-supervision after UFlow (Jonschkowski et al., ECCV 2020); the picture beyond a crop and sequences of estimates after
SMURF (Stone et al., CVPR 2021). Functions take one pair; `jax.vmap` for batches. Masks carry no gradient: none could
tell the network to hide what it does not explain.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core.numerics import safe_sqrt
from ..image.census import census_distance, census_offsets, to_grey
from ..image.warp import gather, pixel_grid
from ._layers import enlarge_flow, shrink
from .network import Levels

Photometric = Literal["census", "photometric", "ssim"]


@dataclasses.dataclass(frozen=True)
class FlowLossSettings:
    """Weights and switches of the loss; steps count updates of the network."""

    data: Photometric = "census"
    census_radius: int = 3  # pixels, at the full resolution; one less at each rougher level, down to 1
    census_stride: int = 3  # of the neighbours within the radius every n-th is compared
    level_weights: tuple[float, ...] = (1.0, 0.5, 0.4, 0.3, 0.2)  # finest first; rougher levels beyond have none
    sequence_decay: float = 0.0  # per update of a recurrent network, which takes the place of level_weights; 0 for none
    robustness: float = 0.4  # exponent of the generalised Charbonnier function of the data term
    smooth_first: float = 1.0
    smooth_second: float = 0.0
    edge_weight: float = 50.0  # of the mean absolute colour difference (0 to 1) between neighbours
    occlusion: bool = True
    occlusion_after: int = 500  # steps before which nothing counts as hidden: from scratch, everything would be
    occlusion_fraction: float = 0.01  # of the squared lengths
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
        if not 0 <= self.sequence_decay <= 1:
            raise ValueError(f"sequence_decay is {self.sequence_decay}; expected 0 (none) to 1.")
        if self.self_supervision_border_px < 1:
            raise ValueError(f"self_supervision_border_px is {self.self_supervision_border_px}; expected at least 1.")
        census_offsets(self.census_radius, self.census_stride)


def charbonnier(x: Float[Array, "*shape"], exponent: float, epsilon: float = 0.01) -> Float[Array, "*shape"]:
    """Robust penalty (|x| + epsilon)^exponent, after DDFlow and UFlow. Gradient 0 at 0."""
    magnitude = x * jax.lax.stop_gradient(jnp.sign(x))  # JAX's own |x| has gradient 1 at 0
    return (magnitude + epsilon) ** exponent


def masked_mean(values: Float[Array, "height width"], mask: Float[Array, "height width"]) -> Float[Array, ""]:
    """Mean over the mask; 0 where the mask is empty."""
    return jnp.sum(values * mask) / (jnp.sum(mask) + 1e-6)


def inside(flow_px: Float[Array, "height width 2"], margin_px: int = 0) -> Bool[Array, "height width"]:
    """Where the flow stays within the picture, or within `margin_px` around it."""
    height, width, _ = flow_px.shape
    x, y = pixel_grid(height, width, flow_px.dtype)
    u, v = x + flow_px[..., 0] + margin_px, y + flow_px[..., 1] + margin_px
    return (u >= 0) & (u <= width - 1 + 2 * margin_px) & (v >= 0) & (v <= height - 1 + 2 * margin_px)


def margin_of(crop: tuple[int, ...], whole: tuple[int, ...]) -> int:
    """Pixels by which a whole picture reaches beyond a crop of it, alike at every side; from their shapes."""
    margin = (whole[0] - crop[0]) // 2
    if margin < 0 or whole[:2] != (crop[0] + 2 * margin, crop[1] + 2 * margin):
        raise ValueError(f"A picture of {whole[:2]} pixels does not reach equally far beyond a crop of {crop[:2]}.")
    return margin


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
    second: Float[Array, "rows columns"],
    visible: Float[Array, "height width"],
    settings: FlowLossSettings,
    level: int = 0,
) -> Float[Array, ""]:
    """Mean robust distance of the first picture and the second, brought onto it, over what is visible.

    The second may reach beyond the first, alike at every side, so that what leaves a crop still teaches (SMURF's
    full-image warping, Section 3.3). The gradient reaches the flow only, not the pictures.
    """
    margin = margin_of(first.shape, second.shape)
    outer = jnp.pad(flow_px, ((margin, margin), (margin, margin), (0, 0)))
    warped = gather(jax.lax.stop_gradient(second)[..., None], outer)[0][..., 0]
    # Outside, the first picture stands in, so that the neighbours of such pixels see no edge.
    height, width = first.shape
    warped = jnp.where(inside(flow_px, margin), warped[margin : margin + height, margin : margin + width], first)
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
    known = (~teacher_hidden[cut, cut] & student_hidden).astype(student_px.dtype)
    gap = student_px - jax.lax.stop_gradient(teacher_px[cut, cut])
    return jnp.sum(jnp.sum(safe_sqrt(gap * gap + 1e-6), axis=-1) * known) / known.size


def shown(
    flow_px: Float[Array, "height width 2"],
    back_px: Float[Array, "height width 2"],
    hide: Float[Array, ""],
    settings: FlowLossSettings,
    margin_px: int = 0,
) -> Float[Array, "height width"]:
    """1 where the second picture shows what the first does, 0 where not: it left, or (times `hide`) is occluded.

    What leaves a crop for the margin around it has no way back to check, and counts as shown.
    """
    visible = inside(flow_px, margin_px).astype(flow_px.dtype)
    if settings.occlusion:
        hidden = occluded(flow_px, back_px, settings.occlusion_fraction, settings.occlusion_px2)
        if margin_px:
            hidden = hidden & inside(flow_px)
        visible = visible * (1 - hide * hidden.astype(flow_px.dtype))
    return jax.lax.stop_gradient(visible)


def level_terms(
    forward: Levels,
    backward: Levels,
    first: Float[Array, "height width 3"],
    second: Float[Array, "rows columns 3"],
    hide: Float[Array, ""],
    settings: FlowLossSettings,
) -> dict[str, Float[Array, ""]]:
    """Data term and smoothness summed over levels, of one direction; `hide` 1 leaves out what is occluded, 0 not.

    `second` may reach beyond `first` (`data_term`) by a multiple of the roughest level's stride. Smoothness is asked of
    the last level before the learned upsampling, which follows the picture's edges by itself.
    """
    height = first.shape[0]
    margin = margin_of(first.shape, second.shape)
    data, first_order, second_order = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    hidden_share = jnp.zeros(())
    ways = list(zip(forward[::-1], backward[::-1], strict=True))
    for level, (flow, back) in enumerate(ways[: len(settings.level_weights)]):
        factor = height // flow.shape[0]
        if margin % factor:
            raise ValueError(f"A margin of {margin} pixels around the crop; it must be a multiple of {factor}.")
        here, there = (shrink(image, factor) if factor > 1 else image for image in (first, second))
        visible = shown(flow, back, hide, settings, margin // factor)
        if level == 0:
            hidden_share = 1 - jnp.mean(visible)
        term = data_term(flow, to_grey(here), to_grey(there), visible, settings, level)
        data = data + settings.level_weights[level] * term
        if level == min(1, len(ways) - 1):
            first_order = smoothness(flow, here, settings.edge_weight, 1)
            second_order = smoothness(flow, here, settings.edge_weight, 2)
    return {"data": data, "smooth_first": first_order, "smooth_second": second_order, "hidden_share": hidden_share}


def sequence_terms(
    forward: Levels,
    backward: Levels,
    first: Float[Array, "height width 3"],
    second: Float[Array, "rows columns 3"],
    hide: Float[Array, ""],
    settings: FlowLossSettings,
) -> dict[str, Float[Array, ""]]:
    """`level_terms` of a recurrent network: sum over its updates of decay^(last - i) times each one's (SMURF, Eq. 1).

    The estimates before the last have one size, and each is enlarged to the picture's; the last estimate is the last
    update enlarged by the network itself, and adds nothing. What is hidden is decided by the last update. Smoothness is
    asked of each at its own size.
    """
    if len({flow.shape for flow in forward[:-1]}) != 1:
        raise ValueError(
            f"Estimates of shapes {[flow.shape for flow in forward[:-1]]}; a sequence has one shape before the last. "
            "Set sequence_decay to 0 for a pyramid."
        )
    flows = jnp.stack(forward[:-1])
    factor = first.shape[0] // flows.shape[1]
    margin, rough = margin_of(first.shape, second.shape), shrink(first, factor)
    grey_here, grey_there = to_grey(first), to_grey(second)
    visible = shown(enlarge_flow(forward[-2], factor), enlarge_flow(backward[-2], factor), hide, settings, margin)

    @jax.checkpoint
    def terms(flow: Array) -> tuple[Array, Array, Array]:
        fine = enlarge_flow(flow, factor)
        seen = jax.lax.stop_gradient(inside(fine, margin).astype(fine.dtype) * visible)
        data = data_term(fine, grey_here, grey_there, seen, settings)
        return data, smoothness(flow, rough, settings.edge_weight, 1), smoothness(flow, rough, settings.edge_weight, 2)

    weights = settings.sequence_decay ** jnp.arange(len(flows) - 1, -1, -1, dtype=flows.dtype)
    data, first_order, second_order = (jnp.sum(weights * each) for each in jax.lax.map(terms, flows))
    return {
        "data": data,
        "smooth_first": first_order,
        "smooth_second": second_order,
        "hidden_share": 1 - jnp.mean(visible),
    }


def imitation_term(
    levels: Levels, teacher_px: Float[Array, "height width 2"], settings: FlowLossSettings
) -> Float[Array, ""]:
    """How far all estimates of a student are from a teacher's flow: robust end-point errors, weighted by level.

    Errors are in pixels of the picture at every level, against the teacher's mean over its pixels. Where the teacher's
    flow is NaN nothing is asked. No gradient to the teacher.
    """
    height = teacher_px.shape[0]
    known = jnp.all(jnp.isfinite(teacher_px), axis=-1, keepdims=True).astype(teacher_px.dtype)
    target = jax.lax.stop_gradient(jnp.where(known > 0, teacher_px, 0.0))
    total = jnp.zeros(())
    # As many as have a weight: rougher ones than that are left to themselves.
    for flow, weight in zip(levels[::-1], settings.level_weights, strict=False):
        factor = height // flow.shape[0]
        share = shrink(known, factor)
        gap = factor * flow - shrink(known * target, factor) / jnp.maximum(share, 1e-6)
        error = safe_sqrt(jnp.sum(gap * gap, axis=-1) + 1e-4)
        total = total + weight * jnp.mean(share[..., 0] * charbonnier(error, settings.robustness))
    return total


def weighted(terms: dict[str, Float[Array, ""]], settings: FlowLossSettings) -> Float[Array, ""]:
    """The loss of the terms."""
    total = terms["data"] + settings.smooth_first * terms["smooth_first"]
    total = total + settings.smooth_second * terms["smooth_second"]
    return total + settings.self_supervision * terms.get("teaching", jnp.zeros(()))
