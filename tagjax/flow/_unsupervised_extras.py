"""Unsupervised losses for what a level by itself cannot tell: range maps, the picture beyond a crop, and sequences.

After Wang et al. (CVPR 2018) and SMURF (Stone et al., CVPR 2021). Functions take one pair, as those of `losses`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..image.census import to_grey
from ..image.warp import gather, gather_taps, pixel_grid
from ._layers import enlarge_flow, shrink
from .losses import FlowLossSettings, charbonnier, data_distance, data_term, inside, masked_mean, occluded, smoothness
from .network import Levels


def range_map(back_px: Float[Array, "height width 2"]) -> Float[Array, "height width"]:
    """How many pixels of the second picture the backward flow brings to each pixel of the first (Wang et al., Eq. 2).

    Bilinear weights summed: the transpose of sampling the first picture by that flow. 0 where nothing arrives.
    """
    height, width, _ = back_px.shape

    def sampled(image: Array) -> Array:
        values, weight = gather_taps(image, back_px)
        return jnp.sum(values * weight[..., None], axis=0)

    blank = jnp.zeros((height, width, 1), back_px.dtype)
    (mass,) = jax.linear_transpose(sampled, blank)(jnp.ones_like(blank))
    return mass[..., 0]


def visible_by_range(back_px: Float[Array, "height width 2"]) -> Float[Array, "height width"]:
    """Share of each pixel that the second picture shows, 0 hidden to 1: the range map, cut at 1. No gradient.

    Unlike the check there and back, it needs no forward flow and hides little before anything is learnt.
    """
    return jax.lax.stop_gradient(jnp.clip(range_map(back_px), 0.0, 1.0))


def gather_beyond(
    whole: Float[Array, "rows columns channel"], flow_px: Float[Array, "height width 2"], corner_px: Float[Array, " 2"]
) -> tuple[Float[Array, "height width channel"], Bool[Array, "height width"]]:
    """A whole picture sampled by the flow of a crop of it, whose upper left pixel is at `corner_px` (x, y).

    Returns the samples and where they lie within the whole picture.
    """
    height, width, _ = flow_px.shape
    rows, columns, _ = whole.shape
    moved = flow_px + corner_px.reshape(1, 1, 2)
    samples, _ = gather(whole, jnp.pad(moved, ((0, rows - height), (0, columns - width), (0, 0))))
    x, y = pixel_grid(height, width, flow_px.dtype)
    u, v = x + moved[..., 0], y + moved[..., 1]
    return samples[:height, :width], (u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1)


def data_term_beyond(
    flow_px: Float[Array, "height width 2"],
    first: Float[Array, "height width"],
    whole: Float[Array, "rows columns"],
    corner_px: Float[Array, " 2"],
    visible: Float[Array, "height width"],
    settings: FlowLossSettings,
    level: int = 0,
) -> Float[Array, ""]:
    """`data_term` of a flow estimated on crops, held against the second picture before the cut (SMURF, Section 3.3).

    So what moves out of the crop still teaches. At a level of 1/n, `corner_px` is the corner's position over n.
    """
    warped, within = gather_beyond(jax.lax.stop_gradient(whole)[..., None], flow_px, corner_px)
    warped = jnp.where(within, warped[..., 0], first)
    distance = charbonnier(data_distance(first, warped, settings, level), settings.robustness)
    return masked_mean(distance, visible * within.astype(visible.dtype))


def sequence_terms(
    forward: Levels,
    backward: Levels,
    first: Float[Array, "height width 3"],
    second: Float[Array, "height width 3"],
    hide: Float[Array, ""],
    settings: FlowLossSettings,
    decay: float = 0.8,
    factor: int = 1,
) -> dict[str, Float[Array, ""]]:
    """`level_terms` of a recurrent network: sum over its updates of decay^(last - i) times each one's (SMURF, Eq. 1).

    The estimates before the last have one size; each is enlarged to 1/`factor` of the picture and held against it.
    What is hidden is decided by the last update. Smoothness is asked of each estimate at its own size.
    """
    if len({flow.shape for flow in forward[:-1]}) != 1:
        raise ValueError(
            f"Estimates of shapes {[flow.shape for flow in forward[:-1]]}; a sequence has one shape before the last. "
            "Use level_terms for a pyramid."
        )
    flows = jnp.stack(forward[:-1])
    height, rows = first.shape[0], flows.shape[1]
    here, there = (shrink(image, factor) if factor > 1 else image for image in (first, second))
    rough = shrink(first, height // rows)
    grey_here, grey_there, up = to_grey(here), to_grey(there), height // factor // rows
    shown = jnp.ones(grey_here.shape)
    if settings.occlusion:
        last, back = enlarge_flow(forward[-2], up), enlarge_flow(backward[-2], up)
        hidden = occluded(last, back, settings.occlusion_share, settings.occlusion_px2)
        shown = jax.lax.stop_gradient(1 - hide * hidden.astype(jnp.float32))

    @jax.checkpoint
    def terms(flow: Array) -> tuple[Array, Array, Array]:
        fine = enlarge_flow(flow, up)
        visible = jax.lax.stop_gradient(inside(fine).astype(jnp.float32) * shown)
        data = data_term(fine, grey_here, grey_there, visible, settings, factor.bit_length() - 1)
        return data, smoothness(flow, rough, settings.edge_weight, 1), smoothness(flow, rough, settings.edge_weight, 2)

    weights = decay ** jnp.arange(len(flows) - 1, -1, -1, dtype=jnp.float32)
    data, first_order, second_order = (jnp.sum(weights * each) for each in jax.lax.map(terms, flows))
    last_inside = inside(enlarge_flow(forward[-2], up)).astype(jnp.float32)
    return {
        "data": data,
        "smooth_first": first_order,
        "smooth_second": second_order,
        "hidden_share": jax.lax.stop_gradient(1 - jnp.mean(last_inside * shown)),
    }
