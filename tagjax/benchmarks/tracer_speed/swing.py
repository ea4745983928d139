"""A recording played forth and back without end, with any number of tags: what the tracer is timed on."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...recording import Intrinsics, Recording, TagReads
from ...recording.reads import concatenate_reads, join_reads
from ...recording.store import save_recording
from ...recording.time_reversal import time_reversed


@dataclasses.dataclass(frozen=True)
class Shot:
    """One frame as the sensors give it."""

    colour: np.ndarray  # (height, width, 3) uint8
    depth_m: np.ndarray  # (height, width), 0 = missing
    time_ns: int
    reads: TagReads  # since the last frame


def stored_scene(path: Path, *, width: int, num_frames: int, seed: int) -> None:
    """Simulate and store four objects in the hands of two people, with a third person who walks behind them."""
    from ...sim.record import (  # a live stream, whose start is timed, has no simulator
        CaptureSettings,
        simulate_recording,
    )
    from ...sim.stories import build_scenario

    settings = {"kinds": ["bottle", "toy", "box", "bag"], "num_walkers": 1, "stationary_s": 0.3}
    scenario = build_scenario("handheld", np.random.default_rng(seed), max(1.5, num_frames / 30 + 0.2), settings)
    capture = CaptureSettings(width=width, shadows=False)
    save_recording(simulate_recording(scenario, capture, seed=seed, name="benchmark", num_frames=num_frames), path)


@dataclasses.dataclass(frozen=True)
class Swing:
    """Frames and reads forth and back; the motion has no jump where it turns."""

    recording: Recording
    order: np.ndarray  # (period,) frames of the recording
    time_ns: np.ndarray  # (period,) from the start of a period
    period_ns: int
    reads: TagReads  # of a period, from its start

    @staticmethod
    def of(recording: Recording, *, num_tags: int) -> Swing:
        """The recording with this number of tags: its own, or copies of them with other phase offsets."""
        time_ns = np.asarray(recording.time_ns, np.int64)
        begin_ns, length_ns = int(time_ns[0]), int(time_ns[-1] - time_ns[0])
        forth = np.arange(len(time_ns))
        order = np.concatenate([forth, forth[-2:0:-1]])
        ahead = time_ns - begin_ns
        reads = []
        for number, one in enumerate((recording, time_reversed(recording))):
            own = one.reads[(one.reads.time_ns >= begin_ns) & (one.reads.time_ns <= time_ns[-1])]
            shift_ns = number * length_ns - begin_ns
            reads.append(
                dataclasses.replace(own, time_ns=own.time_ns + shift_ns, reader_time_ns=None, arrival_time_ns=None)
            )
        return Swing(
            recording=recording,
            order=order,
            time_ns=np.concatenate([ahead, 2 * length_ns - ahead[-2:0:-1]]),
            period_ns=2 * length_ns,
            reads=_with_tags(concatenate_reads(reads), recording.reads.epcs, num_tags),
        )

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the camera."""
        return self.recording.intrinsics

    @property
    def epcs(self) -> list[str]:
        """The tags."""
        return list(self.reads.epcs)

    def shots(self, num_frames: int) -> Iterator[Shot]:
        """The first frames. Pictures are read from the store when they are due: a stream's memory has no recording in it."""
        last_ns = -1
        for number in range(num_frames):
            loop, place = divmod(number, len(self.order))
            now_ns = int(self.time_ns[place]) + loop * self.period_ns
            # The reads between the last frame of a period and the first of the next are those of the last period.
            parts = [self._reads(last_ns, now_ns, one) for one in {max(loop - 1, 0), loop}]
            frame = int(self.order[place])
            yield Shot(
                np.asarray(self.recording.colour[frame]), self.recording.depth_metres(frame), now_ns, join_reads(parts)
            )
            last_ns = now_ns

    def _reads(self, after_ns: int, until_ns: int, loop: int) -> TagReads:
        stamp = self.reads.time_ns + loop * self.period_ns
        first, last = np.searchsorted(stamp, [after_ns, until_ns], side="right")
        return dataclasses.replace(self.reads[slice(first, last)], time_ns=stamp[first:last])


def _with_tags(reads: TagReads, epcs: list[str], num_tags: int) -> TagReads:
    rng, parts = np.random.default_rng(0), []
    for number in range(num_tags):
        own = reads[reads.epc == epcs[number % len(epcs)]]
        epc, offset = f"tag-{number}", rng.uniform(0, own.phase_period_rad)
        # Copies are read some microseconds apart.
        parts.append(
            dataclasses.replace(
                own,
                epc=np.full(own.num_reads, epc),
                time_ns=own.time_ns + 1000 * number,
                phase_rad=np.mod(own.phase_rad + offset, own.phase_period_rad),
            )
        )
    return join_reads(parts)
