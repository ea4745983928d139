"""Dwell evidence: how well each segment's motion explains each tag's raw phases, every read counted once.

What a dwell's reads say of the next one is one phasor a (tag, antenna, segment); see `radio.reader_model` for the equations.
It is that of the last read. So a read touches one row of segments, and a frame without reads touches no phasor: only the
distances, which all tags share, are summed every frame.

Evidence is the log likelihood ratio to phases at random, in nats; that of several antennas adds up. Slot 0 is the static
background: a tag that stays in place.
"""

from __future__ import annotations

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from ...core.constrained import Positive
from ...radio.arrivals import Arrivals
from ...radio.reader_model import ReaderModel
from .cells import row_sources
from .labels import STATIC

_SHORTEST_FRAME_S = 1e-6
_CHUNK = 8  # reads: valid ones come first in a frame's buffer, which is mostly empty
_FEW = 512  # segments: hardly ever more exist, after the first seconds

_Rows = tuple[Array, Array, Array]
ReadsT = TypeVar("ReadsT", bound=tuple[Any, ...])


class DwellState(eqx.Module):
    """What the reads so far amount to, for the tags at each segment."""

    real: Float[Array, "tag antenna segment"]  # phasor of the phase at the dwell's last read
    imaginary: Float[Array, "tag antenna segment"]
    read_m: Float[Array, "tag antenna segment"]  # `distance_m` at the dwell's last read
    distance_m: Float[Array, "antenna segment"]  # sum of the increments, inherited by newborn segments
    channel: Int[Array, "tag antenna"]  # of the present dwell; -1 before the first read
    log_likelihood: Float[Array, "tag segment"]  # decayed sum over reads, nats

    @staticmethod
    def nothing(num_tags: int, num_antennas: int, num_segments: int) -> DwellState:
        """Before the first read."""
        rows = (num_tags, num_antennas, num_segments)
        return DwellState(
            real=jnp.zeros(rows),
            imaginary=jnp.zeros(rows),
            read_m=jnp.zeros(rows),
            distance_m=jnp.zeros(rows[1:]),
            channel=jnp.full(rows[:2], -1, jnp.int32),
            log_likelihood=jnp.zeros((num_tags, num_segments)),
        )

    @property
    def moved_m(self) -> Float[Array, "tag antenna segment"]:
        """Distance moved since the dwell's last read."""
        return self.distance_m[None] - self.read_m


class DwellEvidence(eqx.Module):
    """Evidence of the reads for each (tag, segment), forgotten with a time constant."""

    memory_s: Positive  # evidence decays as exp(-age / memory); scores change little from 2 to 6 s

    def __init__(self, *, memory_s: float = 4.0) -> None:
        """Raises `ValueError` for a memory that is not positive."""
        self.memory_s = Positive(memory_s)

    def step(
        self,
        reader: ReaderModel,
        state: DwellState,
        arrivals: Arrivals,
        increment_m: Float[Array, "antenna segment"],
        depth_m: Float[Array, " segment"],
        newborn_source: Int[Array, " segment"],
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
        exists: Bool[Array, " segment"] | None = None,
    ) -> tuple[DwellState, Float[Array, "tag segment"]]:
        """The state after the frame at `now_s`, and the evidence in nats.

        `arrivals` are the reads in (since_s, now_s], in order of time; `increment_m` is what each segment's distance to
        each antenna has grown since the frame at `since_s`, linearly in time, and `depth_m` its z. `newborn_source` is -2
        for a segment that goes on; a newborn one inherits evidence and phasors of this slot as it was at the last frame, -1
        those of slot 0, both as `inherited` says. Cost: reads x segments, and one copy of the state for the newborn segments. Slots that do not exist
        may be left out of the reads, because nothing but a newborn segment will be there; with `exists` None, or nowhere,
        all take part.
        """
        source = row_sources(newborn_source)
        increment_m = increment_m.at[:, STATIC].set(0.0)
        last_m = _taken(state.distance_m, source)
        memory_s = self.memory_s.value
        decay = jnp.exp(-(now_s - since_s) / memory_s)
        fraction = jnp.clip((arrivals.time_s - since_s) / jnp.maximum(now_s - since_s, _SHORTEST_FRAME_S), 0.0, 1.0)
        fresh = jnp.exp(-jnp.maximum(now_s - arrivals.time_s, 0.0) / memory_s)

        num_antennas, shape = increment_m.shape[0], state.real.shape
        reads = in_chunks((arrivals, fraction, fresh))
        tables = tuple(table.reshape(-1, shape[-1]) for table in (state.real, state.imaginary, state.read_m))
        of_tags = tables, decay * state.log_likelihood

        def scanned(
            of_tags: tuple[_Rows, Array], last_m: Array, increment_m: Array, depth_m: Array
        ) -> tuple[_Rows, Array, Array]:
            """The tables and the evidence (some or all columns) after the reads, and the channels of the dwells."""
            tables, log_likelihood = of_tags
            speed_m_s = increment_m / jnp.maximum(now_s - since_s, _SHORTEST_FRAME_S)

            def updated(rows: _Rows, read: Arrivals, part: Array, goes_on: Array) -> tuple[Array, _Rows]:
                """The evidence of a read for every segment, and the rows of its tag and antenna after it."""
                distance_m = last_m[read.antenna] + part * increment_m[read.antenna]
                real, imaginary = (jnp.where(goes_on, row, 0.0) for row in rows[:2])
                moved_m = jnp.where(goes_on, distance_m - rows[2], 0.0)
                real, imaginary = reader.moved(real, imaginary, moved_m, depth_m, read.carrier_hz)
                concentration = reader.concentration(read.rssi_dbm, speed_m_s[read.antenna])
                evidence, real, imaginary = reader.add_read(real, imaginary, concentration, read.phase_rad)
                return evidence, (real, imaginary, distance_m)

            def add(carry: tuple[_Rows, Array, Array], one: tuple[Arrivals, Array, Array]) -> tuple[Any, None]:
                tables, log_likelihood, channel = carry
                read, part, weight = one
                at = read.tag * num_antennas + read.antenna
                rows = tuple(jax.lax.dynamic_index_in_dim(table, at, keepdims=False) for table in tables)
                # Padding costs nothing. What a read computes is computed again for gradients: kept, it takes 18 MB a frame.
                evidence, rows = jax.lax.cond(
                    read.valid,
                    jax.checkpoint(updated, prevent_cse=False),
                    lambda rows, *_: (jnp.zeros_like(rows[0]), rows),
                    rows,
                    read,
                    part,
                    read.channel == channel[at],
                )
                own = jax.lax.dynamic_index_in_dim(log_likelihood, read.tag, keepdims=False) + weight * evidence
                changed = zip(tables, rows, strict=True)
                return (
                    tuple(jax.lax.dynamic_update_index_in_dim(table, row, at, 0) for table, row in changed),
                    jax.lax.dynamic_update_index_in_dim(log_likelihood, own, read.tag, 0),
                    channel.at[at].set(jnp.where(read.valid, read.channel, channel[at])),
                ), None

            def add_chunk(carry: Any, chunk: tuple[Arrivals, Array, Array]) -> tuple[Any, None]:
                some = jnp.any(chunk[0].valid)
                return jax.lax.cond(some, lambda: jax.lax.scan(add, carry, chunk)[0], lambda: carry), None

            begin = tables, log_likelihood, state.channel.reshape(-1)
            return jax.lax.scan(add_chunk, begin, reads)[0]

        def of_all() -> tuple[_Rows, Array, Array]:
            tables, before = jax.tree.map(lambda rows: _taken(rows, source), of_tags)
            return scanned((tables, inherited(before, newborn_source)), last_m, increment_m, depth_m)

        def of_those(exists: Bool[Array, " segment"]) -> tuple[_Rows, Array, Array]:
            (slots,) = jnp.nonzero(exists, size=_FEW, fill_value=shape[-1])
            tables, before = jax.tree.map(lambda rows: _taken(rows, _taken(source, slots)), of_tags)
            before = inherited(before, _taken(newborn_source, slots), slots)
            columns = (_taken(rows, slots) for rows in (last_m, increment_m, depth_m))
            *changed, channel = scanned((tables, before), *columns)
            put = lambda rows, own: rows.at[:, slots].set(own, mode="drop", indices_are_sorted=True)  # noqa: E731
            return (*jax.tree.map(put, of_tags, tuple(changed)), channel)

        if exists is None or shape[-1] <= _FEW:
            tables, log_likelihood, channel = of_all()
        else:
            some, exists = jnp.any(exists), exists.at[STATIC].set(True)
            few = some & (jnp.sum(exists, dtype=jnp.int32) <= _FEW)
            tables, log_likelihood, channel = jax.lax.cond(few, lambda: of_those(exists), of_all)
        real, imaginary, read_m = (table.reshape(shape) for table in tables)
        distance_m = last_m + increment_m
        after = DwellState(real, imaginary, read_m, distance_m, channel.reshape(shape[:2]), log_likelihood)
        return after, log_likelihood


def inherited(
    log_likelihood: Float[Array, "tag some"],
    newborn_source: Int[Array, " some"],
    slots: Int[Array, " some"] | None = None,
) -> Float[Array, "tag some"]:
    """The evidence with which a frame begins, of that of each segment's source.

    A segment from slot 0 or from nowhere was at rest there, or it comes into view: through a door, from behind something.
    What it did before is then unknown, so reads of that time say nothing against it. Evidence for a tag at rest is kept.
    `slots` are the segments, all if None.
    """
    slots = jnp.arange(newborn_source.shape[0]) if slots is None else slots
    unknown = (newborn_source > -2) & (newborn_source <= STATIC) & (slots != STATIC)
    return jnp.where(unknown[None], jnp.maximum(log_likelihood, 0.0), log_likelihood)


def in_chunks(reads: ReadsT) -> ReadsT:
    """(chunk, _CHUNK) reads, the first of which are `Arrivals`, with invalid ones at the end: a chunk of such reads costs nothing."""
    more = -reads[0].valid.shape[0] % _CHUNK
    return jax.tree.map(lambda leaf: jnp.pad(leaf, (0, more)).reshape(-1, _CHUNK), reads)


def _taken(rows: Shaped[Array, "*batch segment"], slots: Int[Array, " some"]) -> Shaped[Array, "*batch some"]:
    return jnp.take(rows, slots, axis=-1, mode="clip")
