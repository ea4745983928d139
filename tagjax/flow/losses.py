"""Losses of optical flow without labels, and the loss of a student network against a teacher's flow.

Multi-level census loss and forward-backward occlusion after UnFlow (Meister et al., AAAI 2018); full-image warping and
sequence loss after SMURF (Stone et al., CVPR 2021). Functions take one pair; `jax.vmap` for batches. Masks carry no
gradient: otherwise the network could lower its loss by declaring pixels occluded.
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
from .loss_terms import charbonnier, crop_margin_px, inside, masked_mean, occluded, smoothness, ssim_distance
from .network import Levels

Photometric = Literal["census", "photometric", "ssim"]


@dataclasses.dataclass(frozen=True)
class FlowLossSettings:
    """Weights and switches of the loss; steps count updates of the network. Raises `ValueError` for impossible values."""

    data: Photometric = "census"
    census_radius: int = 3  # pixels, at the full resolution; one less at each coarser level, down to 1
    census_stride: int = 3  # every n-th neighbour within the radius is compared
    level_weights: tuple[float, ...] = (1.0, 0.5, 0.4, 0.3, 0.2)  # finest first; coarser levels have weight 0
    sequence_decay: float = 0.0  # weight per update of a recurrent network, instead of level_weights; 0: off
    robustness: float = 0.4  # exponent of the generalised Charbonnier function of the data term
    smooth_first: float = 1.0
    smooth_second: float = 0.0
    edge_weight: float = 50.0  # factor of the mean absolute colour difference (0 to 1) of neighbours
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
        if self.self_supervision_border_px < 1:
            raise ValueError(f"self_supervision_border_px is {self.self_supervision_border_px}; expected at least 1.")
        census_offsets(self.census_radius, self.census_stride)


def data_distance(
    first: Float[Array, "height width"],
    second: Float[Array, "height width"],
    settings: FlowLossSettings,
    level: int,
) -> Float[Array, "height width"]:
    """Photometric distance of two aligned grey images, pixel by pixel, before the robust function."""
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
    return masked_mean(charbonnier(data_distance(first, warped, settings, level), settings.robustness), visible)


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

    `second` may extend beyond `first` (`data_term`) by a multiple of the coarsest level's stride. Smoothness applies to
    the last level before the learned upsampling, which follows the image's edges by itself. Raises `ValueError` for a
    margin that is no such multiple.
    """
    height = first.shape[0]
    margin = crop_margin_px(first.shape, second.shape)
    data, first_order, second_order = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    occluded_fraction = jnp.zeros(())
    pairs = list(zip(forward[::-1], backward[::-1], strict=True))
    for level, (flow, back) in enumerate(pairs[: len(settings.level_weights)]):
        factor = height // flow.shape[0]
        if margin % factor:
            raise ValueError(f"The margin around the crop is {margin} pixels; expected a multiple of {factor}.")
        here, there = (shrink(image, factor) if factor > 1 else image for image in (first, second))
        visible = visible_mask(flow, back, occlusion_weight, settings, margin // factor)
        if level == 0:
            occluded_fraction = 1 - jnp.mean(visible)
        term = data_term(flow, to_grey(here), to_grey(there), visible, settings, level)
        data = data + settings.level_weights[level] * term
        if level == min(1, len(pairs) - 1):
            first_order = smoothness(flow, here, settings.edge_weight, 1)
            second_order = smoothness(flow, here, settings.edge_weight, 2)
    return {
        "data": data,
        "smooth_first": first_order,
        "smooth_second": second_order,
        "occluded_fraction": occluded_fraction,
    }


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
    return total + settings.self_supervision * terms.get("self_supervision", jnp.zeros(()))
