"""The likelihood of the reads, given the motion of the teacher's masks: what teaches the reader's noise, and the flow.

Where the teacher is sure of a tag's mask, the tag moves as the mask does: its range to an antenna grows by the mean over the
mask's segments. The nats are those of `dwell`: each read is predicted from the dwell's earlier ones and that motion. A dwell
begins anew after frames in which no mask is sure, because the motion in between is unknown.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from ...core.numerics import safe_divide
from ...radio.arrivals import Arrivals
from ...radio.reader_model import ReaderModel
from ...tagattention.segments import SegmentTracker
from ...tagattention.segments.carry import on_surface
from ...tagattention.segments.cells import NOT_NEW
from ...tagattention.segments.dwell import DwellEvidence, DwellState
from ...tagattention.segments.increments import segment_motion
from ...tracing.tracer import Camera
from .pieces import PieceFrames

_FOR_EVER_S = 1e9  # no evidence decays


class FilmedFrames(eqx.Module):
    """Frames of a piece with their pictures and the flow that a network computes from these, zero before it does."""

    piece: PieceFrames
    colour: UInt8[Array, "time rows columns 3"]
    backward_px: Float[Array, "time height width 2"]

    @property
    def depth_m(self) -> Float[Array, "time height width"]:
        """Depth at the working resolution."""
        return self.piece.depth_m


def moved_by_flow(segments: SegmentTracker, camera: Camera, frames: FilmedFrames) -> PieceFrames:
    """The piece with the motion of its segments by this flow in place of its own; unknown at the first frame."""
    piece, segmenter = frames.piece, segments.segmenter

    def motion(labels: Array, depth_m: Array, last_m: Array, backward_px: Array, dt_s: Array) -> Any:
        counted = on_surface(depth_m)
        return segment_motion(
            camera, labels, counted, depth_m, last_m, backward_px,
            segmenter.max_change_m(dt_s), piece.found.area.shape[-1], segmenter.min_measured,
        )  # fmt: skip

    later = jax.vmap(motion)(
        piece.found.labels[1:], piece.depth_m[1:], piece.depth_m[:-1], frames.backward_px[1:], jnp.diff(piece.time_s)
    )
    first = jax.tree.map(lambda leaf: jnp.zeros_like(leaf[:1]), later)
    found = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), first, later)
    return eqx.tree_at(
        lambda one: (one.found.increment_m, one.found.motion_m, one.found.known),
        piece,
        (found.increment_m, found.motion_m, found.known),
    )


def read_nats(
    reader: ReaderModel, num_antennas: int, frames: PieceFrames, sure: Bool[Array, "time tag"]
) -> tuple[Float[Array, " tag"], Float[Array, " tag"]]:
    """Sum of the log likelihood ratios of each tag's reads to phases at random, nats, and the number of these reads.

    Reads of frames in which the mask is not `sure`, or the motion of none of its segments is known, do not count.
    """
    num_tags = sure.shape[1]
    dwell, own = DwellEvidence(memory_s=_FOR_EVER_S), jnp.arange(num_tags)
    going_on = jnp.full(num_tags + 1, NOT_NEW, frames.found.source.dtype)

    def step(carry: tuple[DwellState, Array], frame: tuple[PieceFrames, Array]) -> Any:
        (state, since_s), (seen, sure) = carry, frame
        found = seen.found
        weight = seen.target * jnp.where(found.known, found.area, 0.0)[None]
        total = jnp.sum(weight, axis=1)

        def mean(values: Float[Array, "segment axis"]) -> Float[Array, "axis slot"]:
            of_tags = safe_divide(weight @ values, jnp.broadcast_to(total[:, None], (num_tags, values.shape[1])))
            return jnp.pad(of_tags.T, ((0, 0), (1, 0)))  # slot 0 is at rest

        counts = sure & seen.present & (total > 0)
        depth_m = mean(found.centre_m)[2]
        state = _forgotten(state, ~counts)
        after, _ = dwell.step(
            reader, state, seen.arrivals, mean(found.increment_m.T), depth_m, going_on, since_s, seen.time_s
        )
        added = (after.log_likelihood - state.log_likelihood)[own, own + 1]
        number = _number(seen.arrivals, num_tags)
        out = jnp.where(counts, added, 0.0), jnp.where(counts, number, 0.0)
        return (_forgotten(after, ~counts), seen.time_s), out

    begin = DwellState.nothing(num_tags, num_antennas, num_tags + 1), frames.time_s[0]
    _, (nats, number) = jax.lax.scan(step, begin, (frames, sure))
    return jnp.sum(nats, axis=0), jnp.sum(number, axis=0)


def _forgotten(state: DwellState, tags: Bool[Array, " tag"]) -> DwellState:
    """The state without the phases of these tags' dwells."""
    gone = tags[:, None, None]
    phasors = jnp.where(gone, 0.0, state.real), jnp.where(gone, 0.0, state.imaginary)
    return eqx.tree_at(lambda one: (one.real, one.imaginary), state, phasors)


def _number(arrivals: Arrivals, num_tags: int) -> Float[Array, " tag"]:
    """The number of reads of each tag."""
    own = arrivals.tag[None] == jnp.arange(num_tags, dtype=arrivals.tag.dtype)[:, None]
    return jnp.sum(jnp.where(own & arrivals.valid[None], 1.0, 0.0), axis=1)
