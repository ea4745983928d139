"""Smoothing of a whole picture at once that stops at the edges of another: weighted least squares, an axis at a time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_LEAST = 1e-12
"""Weight that every pixel has at least: where nothing else reaches, it keeps what it has."""


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

    The affinity of neighbours is b_pq = exp(-|I_p - I_q| / edge), |.| the mean over the guide's colours. S solves rows and
    columns in turn, exactly each, with strength 1.5 4^(T-t) / (4^T - 1) in round t of T: the Fast Global Smoother (Min et
    al., IEEE TIP 2014), and the quotient its way with weights. A pixel without weight takes what its neighbours on its own
    side of the guide's edges have, or keeps its own where no weight reaches it. Solved by
    `jax.lax.linalg.tridiagonal_solve`. Raises `ValueError` for a negative strength, an edge that is not positive and no
    round.
    """
    if strength < 0 or edge <= 0 or num_rounds < 1:
        raise ValueError(
            f"strength {strength}, edge {edge}, num_rounds {num_rounds}; expected at least 0, above 0, at least 1."
        )
    across, down = _affinities(guide, edge), _affinities(guide.swapaxes(0, 1), edge)
    share = weights[..., None] + _LEAST
    weighted = jnp.concatenate([share * values, share], axis=-1)
    for turn in range(num_rounds):
        now = 1.5 * 4 ** (num_rounds - 1 - turn) / (4**num_rounds - 1) * strength
        weighted = _along_rows(weighted, now * across)
        weighted = _along_rows(weighted.swapaxes(0, 1), now * down).swapaxes(0, 1)
    return weighted[..., :-1] / weighted[..., -1:]


def _affinities(guide: Float[Array, "line place colour"], edge: float) -> Float[Array, "line gap"]:
    """Between each pixel of a row and the next."""
    return jnp.exp(-jnp.mean(jnp.abs(jnp.diff(guide, axis=1)), axis=-1) / edge)


def _along_rows(
    values: Float[Array, "line place channel"], affinities: Float[Array, "line gap"]
) -> Float[Array, "line place channel"]:
    """u with u_p + sum_{neighbours q in the row} b_pq (u_p - u_q) = f_p."""
    before, after = jnp.pad(affinities, ((0, 0), (1, 0))), jnp.pad(affinities, ((0, 0), (0, 1)))
    return jax.lax.linalg.tridiagonal_solve(-before, 1 + before + after, -after, values)
