"""How well a tag's phase goes with an object's trace: the translating factor, a line, R squared (Tagview, IV)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import safe_divide


class LineFit(eqx.Module):
    """A line theta = slope * gamma + intercept through the samples that two sequences share."""

    slope: Float[Array, "*batch"]  # rad; 4 pi h / wavelength for a right pair
    intercept: Float[Array, "*batch"]  # rad; the mean of the pieces' own
    r_squared: Float[Array, "*batch"]  # 0 to 1
    count: Float[Array, "*batch"]  # samples


def translating_factor(distance_px: Float[Array, "*batch"], focal_px: Float[Array, ""]) -> Float[Array, "*batch"]:
    """gamma = sqrt(1 + S^2 / H^2) (Tagview, IV.A), the distance to the antenna in units of its height over the plane.

    S is the distance in the picture from the point that the antenna looks down on, H the focal length.
    """
    return jnp.sqrt(1.0 + (distance_px / focal_px) ** 2)


def fit_line(
    gamma: Float[Array, " time"],
    phase_rad: Float[Array, " time"],
    valid: Bool[Array, " time"],
    piece: Int[Array, " time"],
) -> LineFit:
    """Least squares (Eq. 6) and R^2 (Eq. 7) over the valid samples.

    Each piece (0 <= piece < time) has an intercept of its own, where a phase cannot be spliced over a gap or a hop; with one piece this is
    the paper's regression. R^2 is then the share of the variance within pieces that the line explains. Without
    variance in gamma slope and R^2 are 0, without variance in phase R^2 is 0; so it is where no more samples than
    unknowns are there, whose fit would be perfect whatever they are. Values and gradients are finite throughout.
    """
    size = gamma.shape[0]
    weight = valid.astype(gamma.dtype)
    total = jax.ops.segment_sum(weight, piece, size)

    def centred(x: Float[Array, " time"]) -> Float[Array, " time"]:
        kept = jnp.where(valid, x, 0.0)
        # Twice: the first mean of a float32 phase of hundreds of radians is not exact enough.
        for _ in range(2):
            kept = weight * (kept - safe_divide(jax.ops.segment_sum(kept, piece, size), total)[piece])
        return kept

    x, y = centred(gamma), centred(phase_rad)
    count = jnp.sum(weight)
    spare = count - jnp.sum((total > 0).astype(gamma.dtype)) - 1.0
    spread_x, spread_y = jnp.sum(x * x), jnp.sum(y * y)
    # What rounding leaves of equal values is no variance.
    tiny = 1e-12 if gamma.dtype == jnp.float32 else 1e-24
    moves = (spare > 0) & (spread_x > tiny * jnp.maximum(count, 1.0))
    slope = jnp.where(moves, safe_divide(jnp.sum(x * y), jnp.where(moves, spread_x, 1.0)), 0.0)
    turns = moves & (spread_y > tiny * jnp.maximum(count, 1.0))
    residual = jnp.sum((y - slope * x) ** 2)
    r_squared = jnp.where(turns, 1.0 - residual / jnp.where(turns, spread_y, 1.0), 0.0)
    means = [safe_divide(jnp.sum(jnp.where(valid, v, 0.0)), count) for v in (gamma, phase_rad)]
    return LineFit(slope, means[1] - slope * means[0], jnp.maximum(r_squared, 0.0), count)


def fit_pairs(
    gamma: Float[Array, "traces time"],
    seen: Bool[Array, "traces time"],
    phase_rad: Float[Array, "tags time"],
    heard: Bool[Array, "tags time"],
    piece: Int[Array, "tags time"],
) -> LineFit:
    """`fit_line` of every trace with every tag (traces first), over the times at which both are known."""

    def one(trace: tuple[Array, Array], tag: tuple[Array, Array, Array]) -> LineFit:
        return fit_line(trace[0], tag[0], trace[1] & tag[1], tag[2])

    over_tags = jax.vmap(one, in_axes=(None, 0))
    return jax.vmap(over_tags, in_axes=(0, None))((gamma, seen), (phase_rad, heard, piece))
