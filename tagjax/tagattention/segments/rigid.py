"""Rigid-motion consistency: which segments move as one rigid body with those that carry a tag.

A body moves by one rotation and translation. With the weights w of segments, their centres x before and y now, these are

    R, t = argmin sum w |y - R x - t|^2 ,

solved in closed form by the unit quaternion that maximises q^T N q (Horn, Journal of the Optical Society of America A,
1987). A segment whose residual r = y - R x - t is small against its displacement belongs to the body: the log ratio of two
normal distributions of r, with the variances of the flow's errors and of other motion. What travels far together is one body
even where its parts move against each other, as limbs do: the first variance grows with what the body travels.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...core.constrained import Positive
from ...core.numerics import safe_divide, safe_norm

LEAST_KNOWN = 1e-3
"""A lag at which less of the body's weight was there says nothing about the body's motion: it counts as none."""

_SQUARINGS = 7
"""The quaternion is found by the power 2^7 of N: eigenvalues whose ratio is 0.95 are separated by a factor of 700."""


class RigidMotion(eqx.Module):
    """Log ratio of each segment's motion, as part of a body against other motion, over several time lags.

    The defaults were chosen on simulated training recordings of hand-held objects at 2 m. There the residuals of an
    object's own segments are 4 to 10 mm over half a second, those of the arm that holds it 30 to 130 mm. A larger
    `travel_per_m` (0.8) takes in more of the limbs of walking people, and more of the arms that hold objects.
    """

    lags_s: tuple[float, ...] = eqx.field(static=True)  # motions over these times are compared
    noise_m: Positive  # standard deviation of a residual for a body at rest
    noise_fraction: Positive  # the same as a fraction of the displacement: errors of the flow
    travel_per_m: Positive  # the same, times the square of what the body travels: parts that hang together move
    other_fraction: Positive  # the same of segments that do not belong to the body
    most: Positive  # a lag adds at most this log ratio, nats: its errors are common to many segments
    least: Positive  # and at least minus this
    shrink_m2: Positive  # weight of no rotation, as the spread of points (m^2) that would determine it as well

    def __init__(
        self,
        *,
        lags_s: tuple[float, ...] = (0.17, 0.33, 0.67),
        noise_m: float = 0.004,
        noise_fraction: float = 0.08,
        travel_per_m: float = 0.3,
        other_fraction: float = 0.8,
        most: float = 2.0,
        least: float = 4.0,
        shrink_m2: float = 1e-3,
    ) -> None:
        """Raises `ValueError` for lags that do not grow or a value that is not positive."""
        lags_s = tuple(float(lag) for lag in lags_s)
        if not lags_s or not all(
            later > lag > 0 for lag, later in zip(lags_s, (*lags_s[1:], float("inf")), strict=True)
        ):
            raise ValueError(f"lags_s is {lags_s}; expected positive times in rising order.")
        self.lags_s = lags_s
        self.noise_m = Positive(noise_m)
        self.noise_fraction = Positive(noise_fraction)
        self.travel_per_m = Positive(travel_per_m)
        self.other_fraction = Positive(other_fraction)
        self.most = Positive(most)
        self.least = Positive(least)
        self.shrink_m2 = Positive(shrink_m2)

    def log_ratio(
        self,
        weight: Float[Array, " segment"],
        before_m: Float[Array, "lag segment 3"],
        known: Bool[Array, "lag segment"],
        centre_m: Float[Array, "segment 3"],
    ) -> Float[Array, " segment"]:
        """The sum over lags, nats; a lag at which a segment was not there yet adds 0.

        `before_m` are the segments' places a lag ago, `weight` (any scale) is how surely each belongs to the body.
        """
        lowest, highest = -self.least.value, self.most.value

        def of_lag(before: Float[Array, "segment 3"], there: Bool[Array, " segment"]) -> Float[Array, " segment"]:
            own = jnp.where(there, weight, 0.0)
            own = jnp.where(jnp.sum(own) > LEAST_KNOWN * jnp.sum(weight), own, 0.0)
            rotation, shift_m = rigid_fit(own, before, centre_m, self.shrink_m2.value)
            # Points last: XLA sums over a last axis of three several times as slowly on a CPU.
            residual_m2 = jnp.sum(jnp.square(centre_m.T - rotation @ before.T - shift_m[:, None]), axis=0)
            moved_m = safe_norm(centre_m - before)
            body_m = safe_divide(jnp.sum(own * moved_m), jnp.sum(own))
            moved_m = jnp.maximum(moved_m, body_m)
            inside = jnp.square(self.noise_m.value) + jnp.square(self.noise_fraction.value * moved_m)
            inside = inside + jnp.square(self.travel_per_m.value * jnp.square(body_m))
            outside = inside + jnp.square(self.other_fraction.value * moved_m)
            ratio = 1.5 * jnp.log(outside / inside) - 0.5 * residual_m2 * (1.0 / inside - 1.0 / outside)
            return jnp.where(there, jnp.clip(ratio, lowest, highest), 0.0)

        return jnp.sum(jax.vmap(of_lag)(before_m, known), axis=0)


def rigid_fit(
    weight: Float[Array, " point"],
    before_m: Float[Array, "point 3"],
    after_m: Float[Array, "point 3"],
    shrink_m2: Float[Array, ""],
) -> tuple[Float[Array, "3 3"], Float[Array, " 3"]]:
    """Rotation and translation from points to points by weighted least squares, y = R x + t.

    `shrink_m2` pulls the rotation to none as points of this spread (weighted variance, m^2) would. Without weight the
    motion is none.
    """
    total = jnp.sum(weight)
    share = safe_divide(weight, jnp.broadcast_to(total, weight.shape))
    middle_before, middle_after = share @ before_m, share @ after_m
    before, after = before_m.T - middle_before[:, None], after_m.T - middle_after[:, None]
    covariance = before @ (after * share[None]).T
    rotation = best_rotation(covariance, shrink_m2)
    return rotation, middle_after - rotation @ middle_before


def best_rotation(covariance: Float[Array, "3 3"], shrink: Float[Array, ""]) -> Float[Array, "3 3"]:
    """The rotation R that maximises trace(R C) with C[i, j] = sum w x_i y_j, pulled to none by `shrink` (unit of C).

    Where C determines no axis of rotation, none is taken about it. Always a proper rotation.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = covariance
    horn = jnp.array(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]
    )
    horn = horn.at[0, 0].add(shrink)
    # All eigenvalues of the sum are at least 0, so that powers single out the largest.
    power = horn + jnp.sqrt(jnp.sum(jnp.square(horn)) + 1e-20) * jnp.eye(4)
    power = power / jnp.trace(power)
    for _ in range(_SQUARINGS):
        power = power @ power
        power = power / jnp.trace(power)
    quaternion = power[:, 0] + jnp.array([1e-12, 0.0, 0.0, 0.0])
    w, x, y, z = quaternion / safe_norm(quaternion)
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
