"""The rival of every body: a tag that moves on a smooth path of its own, which nothing in view follows.

The path is not known, only that its radial speed changes slowly. So a bank of radial speeds u_k predicts each read as a body
of this speed would (`radio.reader_model`), each with a probability w_k. Between reads these diffuse: the speed is a random walk
of variance `walk_m2_s3` a second. A read whose log likelihood ratio to a phase at random is g_k at the speed u_k has

    g = log(sum_k w_k exp(g_k)) ,    w_k <- w_k exp(g_k - g)

on a free path. Phases at random are no rival: any motion explains a steady phase better than they do. What follows a tag
explains its reads better than a free path, which has to learn each change of speed from them.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...core.parameters import check_positive
from ...radio.arrivals import Arrivals
from ...radio.reader_model import ReaderModel
from .dwell import in_chunks, over_chunks

_SHORTEST_WALK_M_S = 1e-3  # far below the spacing of speeds: they stay what they are
_DEPTH_M = 2.0  # errors of the motion count as those of a body at this depth do


class FreePathState(eqx.Module):
    """What the reads so far amount to, for each tag and antenna."""

    real: Float[Array, "tag antenna speed"]  # phasor of the phase at the dwell's last read
    imaginary: Float[Array, "tag antenna speed"]
    probability: Float[Array, "tag antenna speed"]  # sums to 1
    time_s: Float[Array, "tag antenna"]  # of the last read; NaN before the first
    channel: Int[Array, "tag antenna"]  # of the present dwell; -1 before the first read
    log_likelihood: Float[Array, " tag"]  # decayed sum over reads, nats


class FreePath(eqx.Module):
    """Stage: evidence of the reads for a free path, nats. `FreePath()` has good values; the score changes little with them."""

    max_speed_m_s: float = eqx.field(static=True)
    walk_m2_s3: float = eqx.field(static=True)
    num_speeds: int = eqx.field(static=True)

    def __init__(self, *, max_speed_m_s: float = 2.4, walk_m2_s3: float = 2.0, num_speeds: int = 49) -> None:
        """Raises `ValueError` for a value that is not positive, or fewer than three speeds."""
        check_positive(max_speed_m_s=max_speed_m_s, walk_m2_s3=walk_m2_s3)
        if num_speeds < 3:
            raise ValueError(f"num_speeds is {num_speeds}; expected at least 3.")
        self.max_speed_m_s, self.walk_m2_s3 = float(max_speed_m_s), float(walk_m2_s3)
        self.num_speeds = num_speeds

    def init(self, num_tags: int, num_antennas: int) -> FreePathState:
        """Before the first read: every speed is as probable as any other."""
        rows = (num_tags, num_antennas)
        return FreePathState(
            real=jnp.zeros((*rows, self.num_speeds)),
            imaginary=jnp.zeros((*rows, self.num_speeds)),
            probability=jnp.full((*rows, self.num_speeds), 1.0 / self.num_speeds),
            time_s=jnp.zeros(rows) + jnp.nan,
            channel=jnp.full(rows, -1, jnp.int32),
            log_likelihood=jnp.zeros(num_tags),
        )

    def step(
        self,
        reader: ReaderModel,
        state: FreePathState,
        arrivals: Arrivals,
        memory_s: Float[Array, ""],
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
    ) -> tuple[FreePathState, Float[Array, " tag"]]:
        """The state after the frame at `now_s`, and what its reads, `arrivals`, add to the evidence of each tag, nats.

        Evidence decays as that of bodies does, by exp(-age / memory_s). Cost: reads x speeds^2, for their diffusion.
        """
        speeds = np.linspace(-self.max_speed_m_s, self.max_speed_m_s, self.num_speeds)
        speed_m_s = jnp.asarray(speeds, arrivals.time_s.dtype)
        apart2 = jnp.square(speed_m_s[:, None] - speed_m_s[None])
        fresh = jnp.exp(-jnp.maximum(now_s - arrivals.time_s, 0.0) / memory_s)

        def add(carry: tuple[FreePathState, Array], one: tuple[Arrivals, Array]) -> tuple[FreePathState, Array]:
            state, added = carry
            read, weight = one
            at = (read.tag, read.antenna)
            last_s = state.time_s[at]
            gap_s = jnp.where(jnp.isfinite(last_s), jnp.maximum(read.time_s - last_s, 0.0), 0.0)
            walk_m_s = jnp.maximum(jnp.sqrt(self.walk_m2_s3 * gap_s + 1e-12), _SHORTEST_WALK_M_S)
            spread = jnp.exp(-0.5 * apart2 / jnp.square(walk_m_s))
            probability = (spread / jnp.sum(spread, axis=0, keepdims=True)) @ state.probability[at]
            goes_on = read.channel == state.channel[at]
            real, imaginary = (jnp.where(goes_on, row[at], 0.0) for row in (state.real, state.imaginary))
            depth_m = jnp.asarray(_DEPTH_M, gap_s.dtype)
            real, imaginary = reader.moved(real, imaginary, speed_m_s * gap_s, depth_m, read.carrier_hz)
            concentration = reader.concentration(read.rssi_dbm, speed_m_s)
            evidence, real, imaginary = reader.add_read(real, imaginary, concentration, read.phase_rad)
            explained = probability * jnp.exp(evidence)  # bounded: an outlier has log(q), and i0e(after) is at most 1
            total = jnp.sum(explained)
            after = FreePathState(
                real=state.real.at[at].set(real),
                imaginary=state.imaginary.at[at].set(imaginary),
                probability=state.probability.at[at].set(explained / total),
                time_s=state.time_s.at[at].set(read.time_s),
                channel=state.channel.at[at].set(read.channel),
                log_likelihood=state.log_likelihood,
            )
            return after, added.at[read.tag].add(weight * jnp.log(total))

        def add_valid(carry: tuple[FreePathState, Array], one: tuple[Arrivals, Array]) -> tuple[tuple, None]:
            # Padding costs nothing. What a read computes is computed again for gradients.
            own = jax.checkpoint(add, prevent_cse=False)
            return jax.lax.cond(one[0].valid, own, lambda carry, _: carry, carry, one), None

        begin = state, jnp.zeros_like(state.log_likelihood)
        after, added = over_chunks(add_valid, begin, in_chunks((arrivals, fresh)))
        kept = jnp.exp(-(now_s - since_s) / memory_s)
        return eqx.tree_at(lambda one: one.log_likelihood, after, kept * state.log_likelihood + added), added
