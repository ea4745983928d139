"""Phase evidence: how well a thing's motion explains the tag's raw phases, every read counted once.

While a reader stays on one channel (a dwell, 0.2 s by FCC rules), a read r of a tag at distance d has the phase
4 pi f d(t_r) / c + offset + noise, with an offset that nobody knows. With von Mises noise of concentration w_r and a flat
prior of the offset, the likelihood of n reads depends on one number, their phasor S:

    S = sum_r w_r exp(j (phi_r - 4 pi f d(t_r) / c)) ,    p(phi_1 .. phi_n) = I0(|S|) / prod_r 2 pi I0(w_r) .

So a read that makes S of S' is worth log I0(|S|) - log I0(|S'|) - log I0(w) more than any phase at random. TagVision's
coherence |S| (INFOCOM 2017) is what this grows with; unlike that, it adds up over reads and dwells as evidence does.

S is turned to the thing's present distance, where it has the same angle everywhere on a rigid thing: pixels may be mixed.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..core.numerics import log_i0, safe_norm
from ..radio.phase import distance_to_phase
from ..radio.reads import PhaseReads

MAX_FRESH_READS = 16
"""Of more reads between two frames the newest are used."""


class Phasor(eqx.Module):
    """What the reads of the present dwell amount to, for things that moved in some way."""

    total: Float[Array, "*batch 2"]  # S, real and imaginary part, turned to the present distance
    moved_m: Float[Array, "*batch"]  # since the dwell's first read

    @staticmethod
    def nothing(shape: tuple[int, ...]) -> Phasor:
        return Phasor(jnp.zeros((*shape, 2)), jnp.zeros(shape))


class PhaseNoise(eqx.Module):
    """What phases do beside thermal noise."""

    spread_rad2: Float[Array, ""]  # variance of a read
    slack: Float[Array, ""]  # standard deviation as a share of the motion since the dwell began
    outlier: Float[Array, ""]  # share of reads with any phase


class Fresh(eqx.Module):
    """The reads since the last frame, and which dwell each belongs to."""

    reads: PhaseReads  # `valid` are those since the last frame
    left: Float[Array, " reads"]  # share of the time between the frames that is left after a read
    began: Float[Array, " reads"]  # the same of the first read of its dwell; 1 if that came before
    goes_on: Bool[Array, " reads"]  # its dwell began before
    before: Float[Array, "reads reads"]  # 1 where [r, q] are of one dwell and q comes first
    last: Int[Array, ""]  # index of the newest; -1 without any
    channel: Int[Array, ""]  # after it


def fresh_reads(
    reads: PhaseReads, channel: Int[Array, ""], since_s: Float[Array, ""], now_s: Float[Array, ""]
) -> Fresh:
    """The reads in (since_s, now_s], of a buffer that ends with the newest until now (as `window_reads` makes them).

    `channel` is that of the read before them, -1 if there was none.
    """
    newest = jax.tree.map(lambda leaf: leaf[-MAX_FRESH_READS:], reads)
    valid = newest.valid & (newest.time_s > since_s) & (newest.time_s <= now_s)
    order = jnp.arange(valid.shape[0])
    same = (newest.channel[:, None] == newest.channel[None, :]) & valid[None, :]
    left = jnp.clip((now_s - newest.time_s) / jnp.maximum(now_s - since_s, 1e-6), 0.0, 1.0)
    goes_on = valid & (newest.channel == channel)
    last = jnp.max(jnp.where(valid, order, -1))
    return Fresh(
        reads=eqx.tree_at(lambda one: one.valid, newest, valid),
        left=left,
        began=jnp.where(goes_on, 1.0, left[jnp.argmax(same, axis=1)]),
        goes_on=goes_on,
        before=(same & (order[None, :] < order[:, None])).astype(left.dtype),
        last=last,
        channel=jnp.where(last >= 0, newest.channel[jnp.maximum(last, 0)], channel),
    )


def explain(
    phasor: Phasor, step_m: Float[Array, ""], fresh: Fresh, noise: PhaseNoise, *, doubled_angle: bool
) -> tuple[Float[Array, ""], Phasor]:
    """Log likelihood ratio of the fresh reads, explained by one thing that moved `step_m` since the last frame, to chance.

    Also its phasor after them. Distances change linearly between frames. With `doubled_angle` phases count modulo pi.
    """
    reads, valid = fresh.reads, fresh.reads.valid
    multiple = 2.0 if doubled_angle else 1.0
    wave = distance_to_phase(jnp.ones_like(reads.carrier_hz), reads.carrier_hz)  # radians a metre
    moved = jnp.where(fresh.goes_on, phasor.moved_m, 0.0) + (fresh.began - fresh.left) * step_m
    variance = jnp.square(reads.sigma_rad) + noise.spread_rad2 + jnp.square(noise.slack * wave * moved)
    weight = jnp.where(valid, 1.0 / (multiple**2 * variance), 0.0)
    angle = multiple * (reads.phase_rad + wave * fresh.left * step_m)
    own = weight[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    turned = _turn(phasor.total, multiple * wave * step_m)
    held = jnp.where(fresh.goes_on[:, None], turned, 0.0)
    past = held + fresh.before @ own
    gain = log_i0(safe_norm(past + own)) - log_i0(safe_norm(past)) - log_i0(weight)
    each = jnp.logaddexp(jnp.log1p(-noise.outlier) + gain, jnp.log(noise.outlier))
    # An outlier is no part of the phasor either.
    own = own * jnp.exp(jnp.log1p(-noise.outlier) + gain - each)[:, None]
    after = held + fresh.before @ own + own
    heard, at = fresh.last >= 0, jnp.maximum(fresh.last, 0)
    return jnp.sum(jnp.where(valid, each, 0.0)), Phasor(
        jnp.where(heard, after[at], turned[-1]),
        jnp.where(heard, moved[at] + fresh.left[at] * step_m, phasor.moved_m + step_m),
    )


def _turn(phasor: Float[Array, " 2"], angle_rad: Float[Array, " reads"]) -> Float[Array, "reads 2"]:
    """The phasor turned by each of the angles."""
    cos, sin = jnp.cos(angle_rad), jnp.sin(angle_rad)
    real, imaginary = phasor[0], phasor[1]
    return jnp.stack([real * cos - imaginary * sin, real * sin + imaginary * cos], axis=-1)
