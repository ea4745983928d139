"""Losses of optical flow without labels, and the loss of a student network against a teacher's flow.

Multi-level census loss, forward-backward occlusion and consistency, and second-order smoothness after UnFlow (Meister
et al., AAAI 2018); full-image warping and sequence loss after SMURF (Stone et al., CVPR 2021). Functions take one pair;
`jax.vmap` for batches. Masks carry no gradient: otherwise the network could lower its loss by declaring pixels occluded.

Against UnFlow's published code: the data term and the consistency are means over the visible pixels, there sums over them
divided by the number of all pixels, which is less by the visible fraction; a greater occlusion does not lower the loss
here. Second differences are means over the pixels that have both neighbours, there divided by the number of all pixels.
The two directions are averaged, there added, so that the whole loss is half as large. Pixels that leave the picture are left
out and count as occluded; there the border of the picture does, a tenth of its shorter side, wherever its pixels move.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.numerics import safe_sqrt
from ..image.census import census_distance, census_offsets, to_grey
from ..image.warp import gather
from ._layers import enlarge_flow, shrink
from .loss_terms import (
    charbonnier,
    consistency_term,
    crop_margin_px,
    generalised_charbonnier,
    inside,
    masked_mean,
    occluded,
    second_order_term,
    smoothness,
    ssim_distance,
)
from .network import Levels

Photometric = Literal["census", "photometric", "ssim"]

_OF_LEVELS = ("consistency", "occlusion_penalty", "smooth_levels")
"""UnFlow's terms, each named as its weight; computed only where that is above 0."""


@dataclasses.dataclass(frozen=True)
class FlowLossSettings:
    """Weights and switches of the loss; steps count updates of the network. Raises `ValueError` for impossible values."""

    data: Photometric = "census"
    census_radius: int = 3  # pixels, at the full resolution; one less at each coarser level, down to 1
    census_stride: int = 3  # every n-th neighbour within the radius is compared
    level_weights: tuple[float, ...] = (1.0, 0.5, 0.4, 0.3, 0.2)  # finest first; coarser levels have weight 0
    sequence_decay: float = 0.0  # weight per update of a recurrent network, instead of level_weights; 0: off
    robust_function: Literal["uflow", "unflow"] = "uflow"  # (|x| + 0.01)^r; or (x^2 + 0.001^2)^r, of the summed census
    robustness: float = 0.4  # the exponent r of the data term
    smooth_first: float = 1.0
    smooth_second: float = 0.0
    edge_weight: float = 50.0  # factor of the mean absolute colour difference (0 to 1) of neighbours
    smooth_levels: float = 0.0  # second differences in four directions, at every level, without edge weights (UnFlow)
    consistency: float = 0.0  # forward-backward error of visible pixels, at every level (UnFlow)
    occlusion_penalty: float = 0.0  # of each occluded pixel (UnFlow): part of the reported loss, without any gradient
    occlusion: bool = True
    occlusion_after: int = 500  # steps before which no pixel counts as occluded: an untrained network would occlude all
    occlusion_fraction: float = 0.01  # tolerance, as a fraction of the squared lengths of the two flows
    occlusion_px2: float = 0.5  # tolerance added to it
    self_supervision: float = 0.0
    self_supervision_after: int = 3000
    self_supervision_ramp: int = 1000
    self_supervision_border_px: int = 16  # cropped from the student's images, at each side

    def __post_init__(self) -> None:
        if not self.level_weights or min(self.level_weights) < 0 or max(self.level_weights) <= 0:
            raise ValueError(f"level_weights are {self.level_weights}; at least one positive and none negative.")
        if not 0 < self.robustness <= 1:
            raise ValueError(f"robustness is {self.robustness}; expected an exponent above 0 and at most 1.")
        if not 0 <= self.sequence_decay <= 1:
            raise ValueError(f"sequence_decay is {self.sequence_decay}; expected 0 (none) to 1.")
        for name in _OF_LEVELS:
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a weight of 0 or more.")
            if getattr(self, name) > 0 and self.sequence_decay > 0:
                raise ValueError(
                    f"{name} is {getattr(self, name)} and sequence_decay is {self.sequence_decay}; {name} is a term of a "
                    "pyramid's levels, which a recurrent network has not: set one of the two to 0."
                )
        if self.self_supervision_border_px < 1:
            raise ValueError(f"self_supervision_border_px is {self.self_supervision_border_px}; expected at least 1.")
        census_offsets(self.census_radius, self.census_stride)


def data_distance(
    first: Float[Array, "height width"],
    second: Float[Array, "height width"],
    settings: FlowLossSettings,
    level: int,
) -> Float[Array, "height width"]:
    """Photometric distance of two aligned grey images, pixel by pixel, before the robust function.

    The census is its mean over the neighbours times 48, the number at radius 3 (UFlow), or times their own number (UnFlow).
    """
    if settings.data == "census":
        radius = max(1, settings.census_radius - level)
        neighbours = 48 if settings.robust_function == "uflow" else (2 * radius + 1) ** 2 - 1
        offsets = census_offsets(radius, settings.census_stride if radius > 1 else 1)
        return neighbours * census_distance(first, second, offsets)
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
    """Mean robust distance of the first image and the second, warped onto it, over the visible pixels.

    The second image may extend beyond the first, equally at every side, so that motion out of the crop still gives a
    gradient (SMURF's full-image warping, Section 3.3). The gradient reaches the flow only, not the images.
    """
    margin = crop_margin_px(first.shape, second.shape)
    outer = jnp.pad(flow_px, ((margin, margin), (margin, margin), (0, 0)))
    warped = gather(jax.lax.stop_gradient(second)[..., None], outer)[0][..., 0]
    # Outside, the first image is inserted, so that the census of neighbouring pixels has no false edge.
    height, width = first.shape
    warped = jnp.where(inside(flow_px, margin), warped[margin : margin + height, margin : margin + width], first)
    penalty = charbonnier if settings.robust_function == "uflow" else generalised_charbonnier
    return masked_mean(penalty(data_distance(first, warped, settings, level), settings.robustness), visible)


def visible_mask(
    flow_px: Float[Array, "height width 2"],
    back_px: Float[Array, "height width 2"],
    occlusion_weight: Float[Array, ""],
    settings: FlowLossSettings,
    margin_px: int = 0,
) -> Float[Array, "height width"]:
    """1 where a pixel is visible in the second image, 0 where it left the image, 1 - `occlusion_weight` where it is
    occluded.

    A pixel that leaves the crop for the margin around it has no backward flow to compare with, and counts as visible.
    """
    visible = inside(flow_px, margin_px).astype(flow_px.dtype)
    if settings.occlusion:
        is_occluded = occluded(flow_px, back_px, settings.occlusion_fraction, settings.occlusion_px2)
        if margin_px:
            is_occluded = is_occluded & inside(flow_px)
        visible = visible * (1 - occlusion_weight * is_occluded.astype(flow_px.dtype))
    return jax.lax.stop_gradient(visible)


def level_terms(
    forward: Levels,
    backward: Levels,
    first: Float[Array, "height width 3"],
    second: Float[Array, "rows columns 3"],
    occlusion_weight: Float[Array, ""],
    settings: FlowLossSettings,
) -> dict[str, Float[Array, ""]]:
    """Data term and smoothness of one direction, summed over levels; with `occlusion_weight` 1 occluded pixels are left
    out.

    `second` may extend beyond `first` (`data_term`) by a multiple of the coarsest level's stride. Edge-aware smoothness
    applies to the last level before the learned upsampling, which follows the image's edges by itself; UnFlow's terms, of
    those that have a weight, to every level. Raises `ValueError` for a margin that is no such multiple.
    """
    height = first.shape[0]
    margin = crop_margin_px(first.shape, second.shape)
    data, first_order, second_order = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    occluded_fraction = jnp.zeros(())
    of_levels = {name: jnp.zeros(()) for name in _OF_LEVELS if getattr(settings, name) > 0}
    pairs = list(zip(forward[::-1], backward[::-1], strict=True))
    for level, (flow, back) in enumerate(pairs[: len(settings.level_weights)]):
        factor = height // flow.shape[0]
        if margin % factor:
            raise ValueError(f"The margin around the crop is {margin} pixels; expected a multiple of {factor}.")
        here, there = (shrink(image, factor) if factor > 1 else image for image in (first, second))
        visible = visible_mask(flow, back, occlusion_weight, settings, margin // factor)
        if level == 0:
            occluded_fraction = 1 - jnp.mean(visible)
        weight = settings.level_weights[level]
        if weight > 0:
            data = data + weight * data_term(flow, to_grey(here), to_grey(there), visible, settings, level)
            for name in of_levels:
                of_levels[name] = of_levels[name] + weight * _term_of_level(name, flow, back, visible)
        if level == min(1, len(pairs) - 1):
            first_order = smoothness(flow, here, settings.edge_weight, 1)
            second_order = smoothness(flow, here, settings.edge_weight, 2)
    return {
        "data": data,
        "smooth_first": first_order,
        "smooth_second": second_order,
        "occluded_fraction": occluded_fraction,
        **of_levels,
    }


def _term_of_level(
    name: str,
    flow_px: Float[Array, "height width 2"],
    back_px: Float[Array, "height width 2"],
    visible: Float[Array, "height width"],
) -> Float[Array, ""]:
    """One of UnFlow's terms. The penalty is the fraction of pixels that are not visible, which has no gradient."""
    if name == "consistency":
        return consistency_term(flow_px, back_px, visible)
    return second_order_term(flow_px) if name == "smooth_levels" else 1 - jnp.mean(visible)


def sequence_terms(
    forward: Levels,
    backward: Levels,
    first: Float[Array, "height width 3"],
    second: Float[Array, "rows columns 3"],
    occlusion_weight: Float[Array, ""],
    settings: FlowLossSettings,
) -> dict[str, Float[Array, ""]]:
    """`level_terms` of a recurrent network: sum over its updates i of decay^(last - i) times the terms (SMURF, Eq. 1).

    The estimates before the last have one size, and each is enlarged to the image size; the last estimate is the last
    update enlarged by the network itself, and adds nothing. Occlusion follows from the last update. Smoothness applies
    to each update at its own size. Raises `ValueError` for estimates of several sizes.
    """
    if len({flow.shape for flow in forward[:-1]}) != 1:
        raise ValueError(
            f"Estimates of shapes {[flow.shape for flow in forward[:-1]]}; expected one shape before the last. "
            "Set sequence_decay to 0 for a pyramid."
        )
    flows = jnp.stack(forward[:-1])
    factor = first.shape[0] // flows.shape[1]
    margin, coarse = crop_margin_px(first.shape, second.shape), shrink(first, factor)
    grey_here, grey_there = to_grey(first), to_grey(second)
    visible = visible_mask(
        enlarge_flow(forward[-2], factor), enlarge_flow(backward[-2], factor), occlusion_weight, settings, margin
    )

    @jax.checkpoint
    def terms(flow: Array) -> tuple[Array, Array, Array]:
        fine = enlarge_flow(flow, factor)
        mask = jax.lax.stop_gradient(inside(fine, margin).astype(fine.dtype) * visible)
        data = data_term(fine, grey_here, grey_there, mask, settings)
        return (
            data,
            smoothness(flow, coarse, settings.edge_weight, 1),
            smoothness(flow, coarse, settings.edge_weight, 2),
        )

    weights = settings.sequence_decay ** jnp.arange(len(flows) - 1, -1, -1, dtype=flows.dtype)
    data, first_order, second_order = (jnp.sum(weights * each) for each in jax.lax.map(terms, flows))
    return {
        "data": data,
        "smooth_first": first_order,
        "smooth_second": second_order,
        "occluded_fraction": 1 - jnp.mean(visible),
    }


def distillation_term(
    levels: Levels, teacher_px: Float[Array, "height width 2"], settings: FlowLossSettings
) -> Float[Array, ""]:
    """Robust end-point error of all estimates of a student against a teacher's flow, weighted by level.

    Errors are in pixels of the image at every level, against the mean of the teacher's flow over each pixel of the
    level. Pixels at which the teacher's flow is NaN are left out. The teacher gets no gradient.
    """
    height = teacher_px.shape[0]
    known = jnp.all(jnp.isfinite(teacher_px), axis=-1, keepdims=True).astype(teacher_px.dtype)
    target = jax.lax.stop_gradient(jnp.where(known > 0, teacher_px, 0.0))
    total = jnp.zeros(())
    # Levels beyond the weights are left out.
    for flow, weight in zip(levels[::-1], settings.level_weights, strict=False):
        factor = height // flow.shape[0]
        known_fraction = shrink(known, factor)
        gap = factor * flow - shrink(known * target, factor) / jnp.maximum(known_fraction, 1e-6)
        error = safe_sqrt(jnp.sum(gap * gap, axis=-1) + 1e-4)
        total = total + weight * jnp.mean(known_fraction[..., 0] * charbonnier(error, settings.robustness))
    return total


def total_loss(terms: dict[str, Float[Array, ""]], settings: FlowLossSettings) -> Float[Array, ""]:
    """The weighted sum of the terms, with the weights of the settings."""
    total = terms["data"] + settings.smooth_first * terms["smooth_first"]
    total = total + settings.smooth_second * terms["smooth_second"]
    for name in _OF_LEVELS:
        if name in terms:
            total = total + getattr(settings, name) * terms[name]
    return total + settings.self_supervision * terms.get("self_supervision", jnp.zeros(()))
