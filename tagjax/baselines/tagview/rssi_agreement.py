"""Do two tags' strengths order as their objects' distances do? (Tagview, V.C, Eq. 9)"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float


def agreement(
    rssi_dbm: Float[Array, "tags time"],
    heard: Bool[Array, "tags time"],
    distance_px: Float[Array, "traces time"],
    seen: Bool[Array, "traces time"],
    *,
    rssi_width_db: float = 0.0,
    distance_width_px: float = 0.0,
) -> Float[Array, "traces traces tags tags"]:
    """[k, l, i, j]: how far tags i and j on traces k and l agree, in [0, 1]; 1/2 says nothing either way.

    The paper sets x_p = [r_i > r_j], y_p = [S_k > S_l] and takes the mean of x xor y. That is right although an
    exclusive or counts where vectors differ: the stronger tag is the *nearer* one, so on right pairs x_p = 1 goes with
    y_p = 0, and x and y differ. Two things do not hold as printed. Where r_i = r_j (strengths come in steps of 0.5 dB)
    x is 0 both for (i, j) and for (j, i), so that the measure depends on which edge is named first; here a tie counts
    one half. And the second vector is named by S_i, S_j: it is the traces k, l that are meant. With signs,

        agreement = mean of (1 - sgn(r_i - r_j) sgn(S_k - S_l)) / 2

    over the times at which all four are known, 1/2 where there is none. Widths above 0 take tanh(difference / width)
    for the sign: it then has gradients, and its limit is the sign. On undistorted pictures S orders as the distance.
    """
    stronger, farther = _order(rssi_dbm, rssi_width_db), _order(distance_px, distance_width_px)
    both_heard, both_seen = (_together(known, rssi_dbm.dtype) for known in (heard, seen))
    product = jnp.einsum(
        "klt,ijt->klij", farther * both_seen, stronger * both_heard, precision=jax.lax.Precision.HIGHEST
    )
    return 0.5 - 0.5 * product / jnp.maximum(shared_times(heard, seen), 1.0)


def shared_times(
    heard: Bool[Array, "tags time"], seen: Bool[Array, "traces time"]
) -> Float[Array, "traces traces tags tags"]:
    """[k, l, i, j]: at how many times traces k and l are seen and the strengths of tags i and j are known."""
    both_heard, both_seen = (_together(known, float) for known in (heard, seen))
    return jnp.einsum("klt,ijt->klij", both_seen, both_heard, precision=jax.lax.Precision.HIGHEST)


def _together(known: Bool[Array, "rows time"], dtype: DTypeLike) -> Float[Array, "rows rows time"]:
    return (known[:, None] & known[None, :]).astype(dtype)


def _order(value: Float[Array, "rows time"], width: float) -> Float[Array, "rows rows time"]:
    """Sign (softened over `width`) of value[i] - value[j]; antisymmetric to the last bit."""
    difference = value[:, None] - value[None, :]
    order = jnp.tanh(difference / width) if width > 0 else jnp.sign(difference)
    # A compiler may fuse what a value comes from into the subtraction; then x - x is a rounding error, with a sign.
    return 0.5 * (order - jnp.swapaxes(order, 0, 1))
