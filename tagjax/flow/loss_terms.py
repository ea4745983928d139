"""Building blocks of the flow losses: robust penalties, masks, forward-backward consistency, SSIM, smoothness.

Forward-backward consistency, its occlusion mask and second-order smoothness after UnFlow (Meister et al., AAAI 2018);
edge-aware smoothness and self-supervision after UFlow (Jonschkowski et al., ECCV 2020). Functions take one pair;
`jax.vmap` for batches.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core.numerics import safe_sqrt
from ..image.warp import gather, pixel_grid

_EPSILON = 0.001
"""Of UnFlow's robust penalty, in the unit of its argument."""

_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""(rows down, columns right) of UnFlow's second differences: along both axes and both diagonals."""


def charbonnier(x: Float[Array, "*shape"], exponent: float, epsilon: float = 0.01) -> Float[Array, "*shape"]:
    """Robust penalty (|x| + epsilon)^exponent, after DDFlow and UFlow. Gradient 0 at 0."""
    magnitude = x * jax.lax.stop_gradient(jnp.sign(x))  # JAX's own |x| has gradient 1 at 0
    return (magnitude + epsilon) ** exponent


def generalised_charbonnier(x: Float[Array, "*shape"], exponent: float = 0.45) -> Float[Array, "*shape"]:
    """Robust penalty (x^2 + 0.001^2)^exponent of UnFlow, whose exponent is 0.45: then 0.002 at 0, with gradient 0."""
    return (x * x + _EPSILON**2) ** exponent


def masked_mean(values: Float[Array, "height width"], mask: Float[Array, "height width"]) -> Float[Array, ""]:
    """Mean over the mask; 0 where the mask is empty."""
    return jnp.sum(values * mask) / (jnp.sum(mask) + 1e-6)


def inside(flow_px: Float[Array, "height width 2"], margin_px: int = 0) -> Bool[Array, "height width"]:
    """Where the flow's target is within the image, or within `margin_px` around it."""
    height, width, _ = flow_px.shape
    x, y = pixel_grid(height, width, flow_px.dtype)
    u, v = x + flow_px[..., 0] + margin_px, y + flow_px[..., 1] + margin_px
    return (u >= 0) & (u <= width - 1 + 2 * margin_px) & (v >= 0) & (v <= height - 1 + 2 * margin_px)


def crop_margin_px(crop: tuple[int, ...], whole: tuple[int, ...]) -> int:
    """Pixels by which an image extends beyond a central crop at every side, from the two shapes. Raises `ValueError`
    otherwise.
    """
    margin = (whole[0] - crop[0]) // 2
    if margin < 0 or whole[:2] != (crop[0] + 2 * margin, crop[1] + 2 * margin):
        raise ValueError(
            f"An image of {whole[:2]} pixels and a crop of {crop[:2]}; expected the same margin at every side of the crop."
        )
    return margin


def consistency_error_px2(
    flow_px: Float[Array, "height width 2"], back_px: Float[Array, "height width 2"]
) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
    """Forward-backward error |f + b(x + f)|^2 and its scale |f|^2 + |b(x + f)|^2, pixels^2."""
    back, _ = gather(back_px, flow_px)
    gap = flow_px + back
    return jnp.sum(gap * gap, axis=-1), jnp.sum(flow_px * flow_px + back * back, axis=-1)


def consistency_term(
    flow_px: Float[Array, "height width 2"],
    back_px: Float[Array, "height width 2"],
    visible: Float[Array, "height width"],
) -> Float[Array, ""]:
    """Robust forward-backward error f + b(x + f): mean over both components and the visible pixels (UnFlow's
    E_C).

    Pixels whose target is outside `back_px` are left out. The gradient reaches both flows, the forward one also through
    the position at which the backward one is sampled.
    """
    back, _ = gather(back_px, flow_px)
    penalty = jnp.mean(generalised_charbonnier(flow_px + back), axis=-1)
    return masked_mean(penalty, visible * jax.lax.stop_gradient(inside(flow_px).astype(flow_px.dtype)))


def occluded(
    flow_px: Float[Array, "height width 2"],
    back_px: Float[Array, "height width 2"],
    fraction: float = 0.01,
    floor_px2: float = 0.5,
) -> Bool[Array, "height width"]:
    """Occlusion mask: |f + b|^2 >= fraction (|f|^2 + |b|^2) + floor (Sundaram et al., ECCV 2010), b at x + f."""
    error, length = consistency_error_px2(flow_px, back_px)
    return error >= fraction * length + floor_px2


def ssim_distance(
    first: Float[Array, "height width"], second: Float[Array, "height width"]
) -> Float[Array, "height width"]:
    """(1 - SSIM) / 2 over windows of 3 x 3 pixels (Wang et al., 2004): 0 (equal) to 1; edge pixels repeat."""

    def mean(image: Array) -> Array:
        padded = jnp.pad(image, 1, mode="edge")
        height, width = image.shape
        return sum((padded[i : i + height, j : j + width] for i in range(3) for j in range(3)), jnp.zeros(())) / 9

    one, other = mean(first), mean(second)
    variance_one, variance_other = mean(first * first) - one * one, mean(second * second) - other * other
    covariance = mean(first * second) - one * other
    light, contrast = 0.01**2, 0.03**2
    similarity = (2 * one * other + light) * (2 * covariance + contrast)
    return 0.5 * (1 - similarity / ((one**2 + other**2 + light) * (variance_one + variance_other + contrast)))


def smoothness(
    flow_px: Float[Array, "height width 2"], image: Float[Array, "height width 3"], edge_weight: float, order: int
) -> Float[Array, ""]:
    """Mean over both axes of exp(-w |dI|) sqrt(|d^n f|^2 + 0.001^2), n = `order` 1 or 2 (UFlow, Eq. 5).

    dI is the mean over colours of the difference between the first and the last of the n + 1 pixels of the flow's
    difference.
    """
    total = jnp.zeros(())
    for axis in (0, 1):
        change = jnp.diff(flow_px, n=order, axis=axis)
        first = jax.lax.slice_in_dim(image, 0, image.shape[axis] - order, axis=axis)
        last = jax.lax.slice_in_dim(image, order, image.shape[axis], axis=axis)
        weight = jnp.exp(-edge_weight * jnp.mean(jnp.abs(last - first), axis=-1))
        total = total + jnp.mean(weight * jnp.sum(safe_sqrt(change * change + 1e-6), axis=-1))
    return total / 2


def second_order_term(flow_px: Float[Array, "height width 2"]) -> Float[Array, ""]:
    """Robust second differences of the flow, without edge weights: sum over its components of the mean over the four
    directions (UnFlow's E_S).

    Each mean is over the pixels that have both neighbours: 0 if there are none.
    """
    height, width, _ = flow_px.shape
    total = jnp.zeros(())
    for down, right in _DIRECTIONS:
        rows, columns = max(height - 2 * down, 0), max(width - 2 * abs(right), 0)
        before, here, after = (
            flow_px[top : top + rows, left : left + columns]
            for top, left in ((down + n * down, abs(right) + n * right) for n in (-1, 0, 1))
        )
        penalty = generalised_charbonnier(before - 2 * here + after)
        total = total + jnp.sum(penalty) / max(rows * columns, 1)
    return total / len(_DIRECTIONS)


def self_supervision_term(
    student_px: Float[Array, "rows columns 2"],
    teacher_px: Float[Array, "height width 2"],
    student_occluded: Bool[Array, "rows columns"],
    teacher_occluded: Bool[Array, "height width"],
    border_px: int,
) -> Float[Array, ""]:
    """Error of a student on cropped images against a teacher on whole ones, where only the student is occluded (UFlow,
    Eq. 6).

    The student's image is the teacher's without `border_px` at each side. The teacher gets no gradient.
    """
    cut = slice(border_px, -border_px)
    valid = (~teacher_occluded[cut, cut] & student_occluded).astype(student_px.dtype)
    gap = student_px - jax.lax.stop_gradient(teacher_px[cut, cut])
    return jnp.sum(jnp.sum(safe_sqrt(gap * gap + 1e-6), axis=-1) * valid) / valid.size
