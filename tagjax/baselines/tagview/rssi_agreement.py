"""Agreement of the order of two tags' RSSI with the order of their objects' distances (Tagview, V.C, Eq. 9)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float


def agreement(
    rssi_dbm: Float[Array, "tags time"],
    rssi_known: Bool[Array, "tags time"],
    distance_px: Float[Array, "traces time"],
    seen: Bool[Array, "traces time"],
    *,
    rssi_width_db: float = 0.0,
    distance_width_px: float = 0.0,
) -> Float[Array, "traces traces tags tags"]:
    """[k, l, i, j]: agreement of tags i and j on traces k and l, in [0, 1]; 1/2 is no evidence either way.

    The paper sets x_p = [r_i > r_j], y_p = [S_k > S_l] and takes the mean of x xor y, which counts where they differ:
    the stronger tag is the *nearer* one, so for right pairs x_p = 1 coincides with y_p = 0. Two details differ from the
    printed text. Where r_i = r_j (RSSI comes in steps of 0.5 dB) x is 0 both for (i, j) and for (j, i), which makes the
    measure depend on the order of the edges; here a tie counts one half. And the second vector is printed with S_i,
    S_j, where the traces k, l are meant. With signs,

        agreement = mean of (1 - sgn(r_i - r_j) sgn(S_k - S_l)) / 2

    over the times at which all four are known, 1/2 where there is none. A width above 0 replaces the sign by
    tanh(difference / width), which has gradients and the sign as its limit. On undistorted pictures the order of S is
    that of the distances.
    """
    stronger, farther = _order(rssi_dbm, rssi_width_db), _order(distance_px, distance_width_px)
    both_known, both_seen = (_both(valid, rssi_dbm.dtype) for valid in (rssi_known, seen))
    product = jnp.einsum(
        "klt,ijt->klij", farther * both_seen, stronger * both_known, precision=jax.lax.Precision.HIGHEST
    )
    return 0.5 - 0.5 * product / jnp.maximum(shared_times(rssi_known, seen), 1.0)


def shared_times(
    rssi_known: Bool[Array, "tags time"], seen: Bool[Array, "traces time"]
) -> Float[Array, "traces traces tags tags"]:
    """[k, l, i, j]: the number of times at which traces k and l are seen and the RSSI of tags i and j is known."""
    both_known, both_seen = (_both(valid, float) for valid in (rssi_known, seen))
    return jnp.einsum("klt,ijt->klij", both_seen, both_known, precision=jax.lax.Precision.HIGHEST)


def _both(valid: Bool[Array, "rows time"], dtype: DTypeLike) -> Float[Array, "rows rows time"]:
    return (valid[:, None] & valid[None, :]).astype(dtype)


def _order(value: Float[Array, "rows time"], width: float) -> Float[Array, "rows rows time"]:
    """Sign (softened over `width`) of value[i] - value[j]; antisymmetric to the last bit."""
    difference = value[:, None] - value[None, :]
    order = jnp.tanh(difference / width) if width > 0 else jnp.sign(difference)
    # A compiler may fuse earlier operations into the subtraction; then x - x is a rounding error with a sign.
    return 0.5 * (order - jnp.swapaxes(order, 0, 1))
