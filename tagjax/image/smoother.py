"""Global edge-preserving smoothing of an image, guided by another: weighted least squares, separably."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_MIN_WEIGHT = 1e-12
"""Minimum weight of a pixel: where no other weight reaches, it keeps its value."""


def fast_global_smooth(
    values: Float[Array, "height width channel"],
    weights: Float[Array, "height width"],
    guide: Float[Array, "height width colour"],
    *,
    strength: float,
    edge: float,
    num_rounds: int = 2,
) -> Float[Array, "height width channel"]:
    """S(w f) / S(w), where S(g) nearly minimises sum (u - g)^2 + strength sum_{neighbours p, q} b_pq (u_p - u_q)^2.

    The affinity of neighbours is b_pq = exp(-|I_p - I_q| / edge), |.| the mean over the guide's colours. S solves rows
    and columns alternately, each exactly, with strength 1.5 4^(T-t) / (4^T - 1) in round t of T: the Fast Global
    Smoother (Min et al., IEEE TIP 2014), and the quotient handles weights as there. A pixel without weight takes the
    values of its neighbours on the same side of the guide's edges, or keeps its own where no weight reaches it. Solved
    by `jax.lax.linalg.tridiagonal_solve`. Raises `ValueError` for a negative strength, an edge that is not positive,
    and fewer than one round.
    """
    if strength < 0 or edge <= 0 or num_rounds < 1:
        raise ValueError(
            f"strength {strength}, edge {edge}, num_rounds {num_rounds}; expected at least 0, above 0, at least 1."
        )
    across, down = _affinities(guide, edge), _affinities(guide.swapaxes(0, 1), edge)
    weight = weights[..., None] + _MIN_WEIGHT
    weighted = jnp.concatenate([weight * values, weight], axis=-1)
    for number in range(num_rounds):
        current = 1.5 * 4 ** (num_rounds - 1 - number) / (4**num_rounds - 1) * strength
        weighted = _along_rows(weighted, current * across)
        weighted = _along_rows(weighted.swapaxes(0, 1), current * down).swapaxes(0, 1)
    return weighted[..., :-1] / weighted[..., -1:]


def _affinities(guide: Float[Array, "line place colour"], edge: float) -> Float[Array, "line gap"]:
    """Affinity of each pixel of a row and the next."""
    return jnp.exp(-jnp.mean(jnp.abs(jnp.diff(guide, axis=1)), axis=-1) / edge)


def _along_rows(
    values: Float[Array, "line place channel"], affinities: Float[Array, "line gap"]
) -> Float[Array, "line place channel"]:
    """u with u_p + sum_{neighbours q in the row} b_pq (u_p - u_q) = f_p."""
    before, after = jnp.pad(affinities, ((0, 0), (1, 0))), jnp.pad(affinities, ((0, 0), (0, 1)))
    return jax.lax.linalg.tridiagonal_solve(-before, 1 + before + after, -after, values)
