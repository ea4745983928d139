"""The tag's phases so far in this dwell, as every pixel's motion explains them: a map that goes along with the flow.

Reflections bend the phase of what moves, by some share of the motion, but not that of what rests. So rest is refuted by far
less motion than it takes to tell two moving things apart, and only then do phases speak for or against a pixel.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..radio.reads import PhaseReads
from .motion import carry
from .phases import PhaseNoise, Phasor, explain, fresh_reads
from .segmentation import pool, unpool
from .view import Ranging, View


class PhaseMemory(eqx.Module):
    """Phasors of all pixels; of what rests, once as exactly as pixels are known and once exactly; and their channel.

    `moving` is the reads' evidence against rest since it was last in favour (Page's cumulative sum, Biometrika 1954), in
    nats against phases at random; `moved` is the most that it ever was: whether the tag has moved at all.
    """

    pixels: Phasor
    rest: Phasor
    channel: Int[Array, "*batch"]
    moving: Float[Array, "*batch"]
    moved: Float[Array, "*batch"]

    @staticmethod
    def nothing(num_tags: int, num_antennas: int, height: int, width: int) -> PhaseMemory:
        """Of a recording that has not begun."""
        each = (num_tags, num_antennas)
        return PhaseMemory(
            Phasor.nothing((*each, height, width)),
            Phasor.nothing((*each, 2)),
            jnp.full(each, -1, jnp.int32),
            moving=jnp.zeros(each),
            moved=jnp.zeros(each),
        )


def carry_phases(
    memory: PhaseMemory, backward_px: Float[Array, "height width 2"], followed: Bool[Array, "height width"]
) -> PhaseMemory:
    """The memory of the last frame moved along the flow; empty where what a pixel shows was not seen before."""

    def moved(leaf: Float[Array, "tag antenna height width *channel"]) -> Array:
        last = jnp.moveaxis(leaf, (2, 3), (0, 1))
        now = carry(last.reshape(*last.shape[:2], -1), backward_px, jnp.zeros(()))
        now = jnp.where(followed[..., None], now, 0.0)
        return jnp.moveaxis(now.reshape(last.shape), (0, 1), (2, 3))

    return eqx.tree_at(lambda one: one.pixels, memory, jax.tree.map(moved, memory.pixels))


def phase_evidence(
    view: View,
    ranging: Ranging,
    reads: PhaseReads,
    memory: PhaseMemory,
    noise: PhaseNoise,
    rest_spread_rad2: Float[Array, ""],
    *,
    doubled_angle: bool,
) -> tuple[Float[Array, "height width"], PhaseMemory]:
    """Log-likelihood ratio of object against background by one tag's reads at one antenna since the last frame.

    The background explains them by chance or by rest, whichever is better. Where rest explains them to within
    `rest_spread_rad2` and thermal noise, which a tag that moves does not, they say nothing.
    """
    fresh = fresh_reads(reads, memory.channel, view.time_s[-2], view.time_s[-1])

    def of(phasor: Phasor, step_m: Float[Array, ""], spread_rad2: Float[Array, ""]) -> tuple[Array, Phasor]:
        spread = PhaseNoise(spread_rad2, noise.slack, noise.outlier)
        return explain(phasor, step_m, fresh, spread, doubled_angle=doubled_angle)

    channels = jnp.concatenate([memory.pixels.total, memory.pixels.moved_m[..., None]], axis=-1)
    pooled, _ = pool(view.segments, channels, view.valid.astype(channels.dtype))
    step_m = ranging.rho_segment[..., -1] - ranging.rho_segment[..., -2]
    of_cells = jax.vmap(jax.vmap(of, in_axes=(0, 0, None)), in_axes=(0, 0, None))
    told, after = of_cells(Phasor(pooled[..., :2], pooled[..., 2]), step_m, noise.spread_rad2)
    still, rest = jax.vmap(of)(memory.rest, jnp.zeros(2), jnp.stack([noise.spread_rad2, rest_spread_rad2]))
    beyond = jax.nn.sigmoid(-still[1]) * (told - jax.nn.relu(still[0]))
    back = unpool(view.segments, jnp.concatenate([beyond[..., None], after.total, after.moved_m[..., None]], axis=-1))
    back = jnp.where(ranging.known[..., None], back, 0.0)
    moving = jax.nn.relu(memory.moving - still[1])
    pixels = Phasor(back[..., 1:3], back[..., 3])
    return back[..., 0], PhaseMemory(pixels, rest, fresh.channel, moving, jnp.maximum(memory.moved, moving))
