"""Dwell evidence: how well each segment's motion explains each tag's raw phases, every read counted once.

What a dwell's reads say of the next one is one phasor a (tag, antenna, segment); see `radio.reader_model` for the equations.
It is that of the last read. So a read touches one row of segments, and a frame without reads touches no phasor: only the
distances, which all tags share, are summed every frame.

Evidence is the log likelihood ratio to phases at random, in nats; that of several antennas adds up. Slot 0 is the static
background: a tag that stays in place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from ...core.constrained import Positive
from ...radio.arrivals import Arrivals
from ...radio.reader_model import ReaderModel
from .cells import NOT_NEW, row_sources
from .labels import STATIC

_SHORTEST_FRAME_S = 1e-6
_CHUNK = 8  # reads: valid ones come first in a frame's buffer, which is mostly empty
_BLOCK = 512  # slots that exist: reads are worked in for so many at a time
_FEW = 256  # newborn segments: more only in the first frame, hardly ever later
_FEW_ROWS = 16  # tags times antennas, of which all slots are as soon copied

_Rows = tuple[Array, Array, Array]
ReadsT = TypeVar("ReadsT", bound=tuple[Any, ...])
CarryT = TypeVar("CarryT")


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

    def with_evidence(self, log_likelihood: Float[Array, "tag segment"]) -> DwellState:
        """The state with this evidence."""
        return eqx.tree_at(lambda one: one.log_likelihood, self, log_likelihood)

    def of_tags(self) -> list[Any]:
        """The arrays with one row a tag."""
        return [self.real, self.imaginary, self.read_m, self.channel, self.log_likelihood]

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
        increment_m = increment_m.at[:, STATIC].set(0.0)
        span_s = jnp.maximum(now_s - since_s, _SHORTEST_FRAME_S)
        fraction = jnp.clip((arrivals.time_s - since_s) / span_s, 0.0, 1.0)
        fresh = jnp.exp(-jnp.maximum(now_s - arrivals.time_s, 0.0) / self.memory_s.value)
        shape, last_m = state.real.shape, _taken(state.distance_m, row_sources(newborn_source))
        rows = (-1, shape[-1])
        tables = state.real.reshape(rows), state.imaginary.reshape(rows), state.read_m.reshape(rows)
        begin = (*_of_sources(tables, newborn_source), self._begun(state, newborn_source, since_s, now_s))
        goes_on, channel = _in_dwells(arrivals, state.channel)
        reads = in_chunks((arrivals, goes_on, fraction, fresh))
        motion = last_m, increment_m, increment_m / span_s, depth_m
        *tables, log_likelihood = _after_reads(reader, begin, reads, motion, exists)
        real, imaginary, read_m = (table.reshape(shape) for table in tables)
        after = DwellState(real, imaginary, read_m, last_m + increment_m, channel, log_likelihood)
        return after, log_likelihood

    def _begun(
        self,
        state: DwellState,
        newborn_source: Int[Array, " segment"],
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
    ) -> Float[Array, "tag segment"]:
        """The evidence with which the frame at `now_s` begins: that of the last one, `inherited`, as far as it lasts."""
        decay = jnp.exp(-(now_s - since_s) / self.memory_s.value)
        return inherited(decay * _taken(state.log_likelihood, row_sources(newborn_source)), newborn_source)


def inherited(
    log_likelihood: Float[Array, "tag segment"], newborn_source: Int[Array, " segment"]
) -> Float[Array, "tag segment"]:
    """The evidence with which a frame begins, of that of each segment's source.

    A segment from slot 0 or from nowhere was at rest there, or it comes into view: through a door, from behind something.
    What it did before is then unknown, so reads of that time say nothing against it. Evidence for a tag at rest is kept.
    """
    unknown = past_unknown(newborn_source)
    return jnp.where(unknown[None], jnp.maximum(log_likelihood, 0.0), log_likelihood)


def past_unknown(newborn_source: Int[Array, " segment"]) -> Bool[Array, " segment"]:
    """The new segments that come from slot 0 or from nowhere."""
    slot = jnp.arange(len(newborn_source))
    return (newborn_source > NOT_NEW) & (newborn_source <= STATIC) & (slot != STATIC)


def _of_sources(tables: _Rows, newborn_source: Int[Array, " segment"]) -> _Rows:
    """The rows with those of each newborn segment's source, which costs little where few are newborn."""
    num, source = newborn_source.shape[0], row_sources(newborn_source)
    newborn = source != jnp.arange(num, dtype=source.dtype)

    def of_few() -> _Rows:
        (slots,) = jnp.nonzero(newborn, size=_FEW, fill_value=num)
        return jax.tree.map(lambda rows: _put(rows, slots, _taken(rows, _taken(source, slots))), tables)

    def of_all() -> _Rows:
        return jax.tree.map(lambda rows: _taken(rows, source), tables)

    if num <= _FEW or len(tables[0]) <= _FEW_ROWS:
        return of_all()
    return jax.lax.cond(jnp.sum(newborn, dtype=jnp.int32) <= _FEW, of_few, of_all)


def _in_dwells(
    arrivals: Arrivals, channel: Int[Array, "tag antenna"]
) -> tuple[Bool[Array, " reads"], Int[Array, "tag antenna"]]:
    """Which reads go on with a dwell that had reads before, and the channels of the dwells after all reads."""
    row, order = arrivals.tag * channel.shape[1] + arrivals.antenna, jnp.arange(len(arrivals.tag), dtype=jnp.int32)
    before = (row[:, None] == row[None]) & (order[:, None] > order[None]) & arrivals.valid[None]
    of_row = (row[None] == jnp.arange(channel.size, dtype=row.dtype)[:, None]) & arrivals.valid[None]
    last, last_of_row = (jnp.max(jnp.where(reads, order[None], -1), axis=1) for reads in (before, of_row))
    flat = channel.reshape(-1)
    then = jnp.where(last >= 0, arrivals.channel[last], flat[row])
    after = jnp.where(last_of_row >= 0, arrivals.channel[last_of_row], flat)
    return arrivals.channel == then, after.reshape(channel.shape)


def in_chunks(reads: ReadsT) -> ReadsT:
    """(chunk, _CHUNK) reads, the first of which are `Arrivals`, with invalid ones at the end: a chunk of such reads costs nothing."""
    more = -reads[0].valid.shape[0] % _CHUNK
    return jax.tree.map(lambda leaf: jnp.pad(leaf, (0, more)).reshape(-1, _CHUNK), reads)


def over_chunks(add: Callable[[CarryT, Any], tuple[CarryT, None]], begin: CarryT, chunks: tuple[Any, ...]) -> CarryT:
    """What `add`, a step of a scan, makes of `begin` over all reads, which are `in_chunks`."""

    def add_chunk(carry: CarryT, chunk: Any) -> tuple[CarryT, None]:
        return jax.lax.cond(jnp.any(chunk[0].valid), lambda: jax.lax.scan(add, carry, chunk)[0], lambda: carry), None

    return jax.lax.scan(add_chunk, begin, chunks)[0]


def _after_reads(
    reader: ReaderModel,
    rows: tuple[Array, Array, Array, Array],
    reads: tuple[Arrivals, Array, Array, Array],
    motion: tuple[Array, Array, Array, Array],
    exists: Bool[Array, " segment"] | None,
) -> tuple[Array, Array, Array, Array]:
    """The rows of phasors, distances and evidence after the reads, for the slots that exist, a block of them at a time."""
    num = rows[0].shape[-1]
    size = min(num, _BLOCK)
    exists = jnp.ones(num, bool) if exists is None else exists
    exists = jnp.where(jnp.any(exists), exists.at[STATIC].set(True), True)
    (slots,) = jnp.nonzero(exists, size=-(-num // size) * size, fill_value=num)

    def of_block(rows: Any, slots: Int[Array, " some"]) -> tuple[Any, None]:
        return jax.lax.cond(
            slots[0] < num, lambda: _block_after_reads(reader, rows, reads, motion, slots), lambda: rows
        ), None

    return jax.lax.scan(of_block, rows, slots.reshape(-1, size))[0]


def _block_after_reads(
    reader: ReaderModel,
    rows: tuple[Array, Array, Array, Array],
    reads: tuple[Arrivals, Array, Array, Array],
    motion: tuple[Array, Array, Array, Array],
    slots: Int[Array, " some"],
) -> tuple[Array, Array, Array, Array]:
    """The same for the given slots."""
    last_m, increment_m, speed_m_s, depth_m = (_taken(values, slots) for values in motion)

    def updated(own: _Rows, read: Arrivals, part: Array, goes_on: Array) -> tuple[Array, _Rows]:
        """The evidence of a read for every slot, and the rows of its tag and antenna after it."""
        distance_m = last_m[read.antenna] + part * increment_m[read.antenna]
        real, imaginary = (jnp.where(goes_on, row, 0.0) for row in own[:2])
        moved_m = jnp.where(goes_on, distance_m - own[2], 0.0)
        real, imaginary = reader.moved(real, imaginary, moved_m, depth_m, read.carrier_hz)
        concentration = reader.concentration(read.rssi_dbm, speed_m_s[read.antenna])
        evidence, real, imaginary = reader.add_read(real, imaginary, concentration, read.phase_rad)
        return evidence, (real, imaginary, distance_m)

    def add(rows: Any, one: tuple[Arrivals, Array, Array, Array]) -> tuple[Any, None]:
        *tables, log_likelihood = rows
        read, goes_on, part, weight = one
        at = read.tag * last_m.shape[0] + read.antenna
        own = tuple(_taken(table[at], slots) for table in tables)
        # Padding costs nothing. What a read computes is computed again for gradients: kept, it takes 18 MB a frame.
        evidence, own = jax.lax.cond(
            read.valid,
            jax.checkpoint(updated, prevent_cse=False),
            lambda own, *_: (jnp.zeros_like(own[0]), own),
            own, read, part, goes_on,
        )  # fmt: skip
        of_tag = _taken(log_likelihood[read.tag], slots) + weight * evidence
        put = [_put_row(table, at, slots, row) for table, row in zip(tables, own, strict=True)]
        return (*put, _put_row(log_likelihood, read.tag, slots, of_tag)), None

    return over_chunks(add, rows, reads)


def _taken(rows: Shaped[Array, "*batch segment"], slots: Int[Array, " some"]) -> Shaped[Array, "*batch some"]:
    return jnp.take(rows, slots, axis=-1, mode="clip")


def _put(
    rows: Shaped[Array, "row segment"], slots: Int[Array, " some"], own: Shaped[Array, "row some"]
) -> Shaped[Array, "row segment"]:
    """The rows with others at these slots, which are in order; there may be too many."""
    return rows.at[:, slots].set(own, mode="drop", indices_are_sorted=True)


def _put_row(
    rows: Shaped[Array, "row segment"], at: Int[Array, ""], slots: Int[Array, " some"], own: Shaped[Array, " some"]
) -> Shaped[Array, "row segment"]:
    return rows.at[at, slots].set(own, mode="drop", indices_are_sorted=True)
