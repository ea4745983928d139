"""A segment's unknown depth, integrated out by a Kalman filter on the phases at several antennas.

A camera without depth gives the ray r of a segment (z = 1) and its change. The segment's place is exp(s) r with the unknown log
depth s. A tag there has at antenna a, at x_a, the phase (times m, which is 2 where phases count modulo pi)

    theta_a = m wave |exp(s) r - x_a| + c_a    modulo 2 pi ,    wave = 4 pi f / c ,

with an unknown offset c_a. The state is (s, ds/dt, theta_1, ..., theta_N). The change of the ray and of the depth moves the
phases, linearised; a read measures one of them. What is observable: the offsets hide the ranges themselves, so reads tell how
ranges change. N antennas measure N changes; one of them is spent on the unknown motion in depth, and the depth itself follows
from how far a sideways motion changes the ranges. With one antenna a motion in depth explains whatever is read.

A hop of the reader adds a phase that is common to its antennas, which share its oscillator; what reflections change is each
antenna's own. A phase is known modulo 2 pi only: the update matches the moments of the mixture over whole turns and outliers.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_TURNS = (-2, -1, 0, 1, 2)
_DEPTH, _RATE, _PHASES = 0, 1, 2
_LOG_DEPTHS = (-1.2, 3.0)  # 0.3 to 20 m: no place is nearer or farther
_LOST_VARIANCE = 6.0  # rad^2: modulo 2 pi a phase that is less certain than this may be anything


class DepthBelief(eqx.Module):
    """A normal distribution over (log depth, its rate 1/s, phase at each antenna in rad).

    The functions below take one tag's, of which the state's axes come first. Of several tags the tags' axis comes before them.
    """

    mean: Float[Array, "*rows"]
    covariance: Float[Array, "*table"]


class Ranges(eqx.Module):
    """The phases of a segment's ranges at its most probable depth, and their derivatives by the log depth; both rad."""

    phase: Float[Array, " antenna *batch"]
    slope: Float[Array, " antenna *batch"]


def ranges_at(
    log_depth: Float[Array, "*batch segment"],
    ray: Float[Array, "segment 2"],
    antennas_m: Float[Array, "antenna 3"],
    wave: Float[Array, ""],
) -> Ranges:
    """The phases (not modulo anything) of the places at these depths on the rays; `wave` is their phase a metre, rad/m."""
    depth_m = jnp.exp(log_depth)
    x, y = (jnp.broadcast_to(axis, depth_m.shape) for axis in ray.T)
    place = depth_m * x, depth_m * y, depth_m
    phases, slopes = [], []
    for antenna_m in antennas_m:
        away = [axis - other for axis, other in zip(place, antenna_m, strict=True)]
        range_m = jnp.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2 + 1e-6)
        along = place[0] * away[0] + place[1] * away[1] + place[2] * away[2]
        phases.append(wave * range_m)
        slopes.append(wave * along / range_m)
    return Ranges(jnp.stack(phases), jnp.stack(slopes))


def settled(
    belief: DepthBelief, elapsed_s: Float[Array, ""], rate_std: Float[Array, "*#batch"], settle_s: Float[Array, ""]
) -> DepthBelief:
    """The belief with the depth `elapsed_s` later; the phases stay.

    The rate of the log depth settles to 0 within `settle_s`, and has in the long run the standard deviation `rate_std`.
    """
    kept = jnp.exp(-elapsed_s / settle_s)
    log_depth = jnp.clip(belief.mean[_DEPTH] + elapsed_s * belief.mean[_RATE], *_LOG_DEPTHS)
    mean = belief.mean.at[_DEPTH].set(log_depth).at[_RATE].multiply(kept)
    rows = belief.covariance.at[_DEPTH].add(elapsed_s * belief.covariance[_RATE]).at[_RATE].multiply(kept)
    both = rows.at[:, _DEPTH].add(elapsed_s * rows[:, _RATE]).at[:, _RATE].multiply(kept)
    return DepthBelief(mean, both.at[_RATE, _RATE].add(jnp.square(rate_std) * (1.0 - jnp.square(kept))))


def moved(
    belief: DepthBelief,
    before: Ranges,
    after: Ranges,
    elapsed_s: Float[Array, ""],
    variance: Float[Array, "antenna *#batch"],
) -> DepthBelief:
    """The belief whose phases have gone on from the ranges `before` to those `after`, with the error `variance`, rad^2.

    The rate of the belief is still that before: `settled` comes after.
    """
    by_depth, by_rate = after.slope - before.slope, after.slope * elapsed_s
    mean = belief.mean.at[_PHASES:].add(after.phase - before.phase)
    rows = belief.covariance
    rows = rows.at[_PHASES:].add(by_depth[:, None] * rows[_DEPTH][None] + by_rate[:, None] * rows[_RATE][None])
    both = rows.at[:, _PHASES:].add(by_depth[None] * rows[:, _DEPTH, None] + by_rate[None] * rows[:, _RATE, None])
    return DepthBelief(mean, with_phase_variance(both, variance))


def with_phase_variance(
    covariance: Float[Array, "state state *batch"], variance: Float[Array, "antenna *#batch"]
) -> Float[Array, "state state *batch"]:
    """The covariance with a variance of its own, rad^2, added to each phase."""
    for antenna in range(variance.shape[0]):
        at = _PHASES + antenna
        covariance = covariance.at[at, at].add(variance[antenna])
    return covariance


def _of_antenna(
    belief: DepthBelief, antenna: Float[Array, " antenna"]
) -> tuple[Float[Array, "*batch"], Float[Array, " state *batch"], Float[Array, "*batch"]]:
    """The phase at an antenna (1 in a vector of zeros), its covariance with the state, and its variance."""
    column = jnp.einsum("a,sa...->s...", antenna, belief.covariance[:, _PHASES:])
    return (
        jnp.einsum("a,a...->...", antenna, belief.mean[_PHASES:]),
        column,
        jnp.einsum("a,a...->...", antenna, column[_PHASES:]),
    )


def with_phase_set(
    belief: DepthBelief,
    antenna: Float[Array, " antenna"],
    phase_rad: Float[Array, ""],
    variance: Float[Array, "*#batch"],
    shifted: Float[Array, " antenna"],
) -> DepthBelief:
    """The belief after a read of a phase that was unknown, by a part that the phases with `shifted` 1 have in common.

    With the measurement h and g = (0, 0, shifted), errors become (1 - g h) of what they were, plus g times the read's.
    """
    expected, column, spread = _of_antenna(belief, antenna)
    g = jnp.concatenate([jnp.zeros(2), shifted]).reshape(-1, *[1] * (belief.mean.ndim - 1))
    cross = g[:, None] * column[None]
    own = g[:, None] * g[None] * (spread + variance)[None, None]
    covariance = belief.covariance - cross - jnp.swapaxes(cross, 0, 1) + own
    return DepthBelief(belief.mean + g * (phase_rad - expected)[None], covariance)


def with_read(
    belief: DepthBelief,
    antenna: Float[Array, " antenna"],
    phase_rad: Float[Array, ""],
    variance: Float[Array, "*#batch"],
    outlier: Float[Array, ""],
) -> tuple[DepthBelief, Float[Array, "*batch"]]:
    """The belief after a read, and its log likelihood ratio to a phase at random, nats.

    `variance` is that of the read, rad^2; `outlier` the probability of a phase at random. A phase that was not known before is
    set.
    """
    expected, column, spread = _of_antenna(belief, antenna)
    lost = spread > _LOST_VARIANCE
    total = jnp.where(lost, _LOST_VARIANCE, spread) + variance
    innovation = jnp.mod(phase_rad - expected + jnp.pi, 2.0 * jnp.pi) - jnp.pi
    turns = jnp.asarray(_TURNS, innovation.dtype).reshape(-1, *[1] * innovation.ndim)
    apart = innovation[None] + 2.0 * jnp.pi * turns
    level = -0.5 * jnp.square(apart) / total[None]
    log_ratio = jax.nn.logsumexp(level, axis=0) + 0.5 * jnp.log(2.0 * jnp.pi / total)
    inlier = (1.0 - outlier) * jnp.exp(log_ratio)
    likelihood = inlier + outlier
    fraction, weight = inlier / likelihood, jax.nn.softmax(level, axis=0)
    first, second = jnp.sum(weight * apart, axis=0), jnp.sum(weight * jnp.square(apart), axis=0)
    shift = fraction * first
    left = fraction * second + (1.0 - fraction) * total - jnp.square(shift)
    gain = column / total[None]
    covariance = belief.covariance - gain[:, None] * gain[None] * jnp.clip(total - left, 0.0, None)[None, None]
    read = _positive(DepthBelief(belief.mean + gain * shift[None], covariance))
    begun = with_phase_set(belief, antenna, phase_rad, variance, antenna)
    after = DepthBelief(
        jnp.where(lost[None], begun.mean, read.mean),
        jnp.where(lost[None, None], begun.covariance, read.covariance),
    )
    return after, jnp.where(lost, 0.0, jnp.log(likelihood))


def with_rate(belief: DepthBelief, rate: Float[Array, "*#batch"], variance: Float[Array, "*#batch"]) -> DepthBelief:
    """The belief after a measurement of the log depth's rate, 1/s, such as a change of scale; an infinite variance says nothing."""
    column = belief.covariance[:, _RATE]
    gain = column / (column[_RATE] + variance)[None]
    mean = belief.mean + gain * (rate - belief.mean[_RATE])[None]
    return _positive(DepthBelief(mean, belief.covariance - gain[:, None] * column[None]))


def _positive(belief: DepthBelief) -> DepthBelief:
    """The belief with no variance below 0, which rounding may leave."""
    covariance = belief.covariance
    for at in range(covariance.shape[0]):
        covariance = covariance.at[at, at].set(jnp.maximum(covariance[at, at], 0.0))
    return DepthBelief(belief.mean, covariance)
