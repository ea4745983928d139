"""Which reads arrive with which frame, against plain loops, and what happens to those that find no place."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tagjax.recording import TagReads
from tagjax.tracing.arrivals import frame_arrivals

EPCS, ANTENNAS = ("b", "a"), (3, 1)
FRAMES_NS = np.arange(1, 7) * 100_000_000


def _reads(num_reads: int = 200, seed: int = 0) -> TagReads:
    """Reads of three tags by three antennas over 0.7 s; a tenth lack their carrier."""
    rng = np.random.default_rng(seed)
    carrier = rng.choice([902.75e6, 915.25e6, 926.75e6], num_reads)
    carrier[rng.random(num_reads) < 0.1] = np.nan
    rssi = rng.uniform(-70, -50, num_reads).astype(np.float32)
    rssi[3::17] = np.nan
    return TagReads(
        epc=rng.choice(["a", "b", "c"], num_reads),
        time_ns=np.sort(rng.integers(0, 700_000_000, num_reads)),
        antenna=rng.choice([1, 2, 3], num_reads).astype(np.int16),
        carrier_hz=carrier,
        phase_rad=rng.uniform(0, 2 * np.pi, num_reads),
        rssi_dbm=rssi,
        doppler_hz=np.full(num_reads, np.nan, np.float32),
    )


def _of_frame(reads: TagReads, frame: int) -> list[int]:
    return [
        i
        for i in range(reads.num_reads)
        if FRAMES_NS[frame - 1] < reads.time_ns[i] <= FRAMES_NS[frame]
        and reads.epc[i] in EPCS and reads.antenna[i] in ANTENNAS and np.isfinite(reads.carrier_hz[i])
    ]  # fmt: skip


def test_every_frame_has_the_reads_since_the_last():
    reads = _reads()
    reads.time_ns[:3] = [50_000_000, 100_000_000, 100_000_001]  # on the first frame, and right after it
    reads = reads[np.argsort(reads.time_ns)]
    arrivals, unused = frame_arrivals(reads, EPCS, ANTENNAS, FRAMES_NS, 50_000_000, 32)
    assert not arrivals.valid[0].any()  # nothing came before the first frame
    for frame in range(1, 6):
        own = _of_frame(reads, frame)
        assert arrivals.valid[frame].tolist() == [True] * len(own) + [False] * (32 - len(own))
        expected = {
            "tag": [EPCS.index(reads.epc[i]) for i in own],
            "antenna": [ANTENNAS.index(reads.antenna[i]) for i in own],
            "time_s": (reads.time_ns[own] - 50_000_000) * 1e-9,
            "phase_rad": reads.phase_rad[own],
            "carrier_hz": reads.carrier_hz[own],
            "channel": reads.carrier_hz[own] / 1e3,
            "rssi_dbm": np.where(np.isnan(reads.rssi_dbm[own]), -60.0, reads.rssi_dbm[own]),
        }
        for name, values in expected.items():
            np.testing.assert_allclose(getattr(arrivals, name)[frame, : len(own)], values, rtol=1e-6)
    between = (reads.time_ns > FRAMES_NS[0]) & (reads.time_ns <= FRAMES_NS[-1]) & np.isin(reads.epc, EPCS)
    elsewhere = between & (reads.antenna == 2)
    assert unused.num_other_antenna == elsewhere.sum() > 0
    assert unused.num_unknown_carrier == (between & ~elsewhere & np.isnan(reads.carrier_hz)).sum() > 0
    assert unused.num_dropped.tolist() == [0] * 6
    total = between.sum() - unused.num_other_antenna - unused.num_unknown_carrier
    assert arrivals.valid.sum() == total


def test_the_first_frame_has_the_reads_since_a_given_time():
    reads = _reads()
    whole, _ = frame_arrivals(reads, EPCS, ANTENNAS, FRAMES_NS, 0, 32)
    part, _ = frame_arrivals(reads, EPCS, ANTENNAS, FRAMES_NS[3:], 0, 32, since_ns=int(FRAMES_NS[2]))
    for name in ("tag", "time_s", "phase_rad", "channel", "valid"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[3:])


@pytest.mark.parametrize("num_reads", [1, 2, 5, 8])
def test_of_too_many_reads_the_newest_of_each_tag_stay(num_reads):
    reads = _reads(300, seed=1)
    arrivals, unused = frame_arrivals(reads, EPCS, ANTENNAS, FRAMES_NS, 0, num_reads)
    for frame in range(1, 6):
        own = _of_frame(reads, frame)
        by_tag = [[i for i in reversed(own) if reads.epc[i] == epc] for epc in EPCS]
        preferred = []
        for rank in range(len(own)):
            preferred += sorted((one[rank] for one in by_tag if rank < len(one)), reverse=True)
        expected = sorted(preferred[:num_reads])
        np.testing.assert_allclose(arrivals.phase_rad[frame, : len(expected)], reads.phase_rad[expected], rtol=1e-6)
        assert arrivals.valid[frame].sum() == len(expected)
        assert unused.num_dropped[frame] == len(own) - len(expected)
    assert unused.num_dropped[1:].min() > 0
    assert np.all(np.diff(arrivals.time_s[1:], axis=1) >= 0)


def test_phases_grow_with_distance():
    reads = dataclasses.replace(_reads(), phase_sign=-1)
    arrivals, _ = frame_arrivals(reads, EPCS, ANTENNAS, FRAMES_NS, 0, 32)
    own = _of_frame(reads, 2)
    np.testing.assert_allclose(arrivals.phase_rad[2, : len(own)], 2 * np.pi - reads.phase_rad[own], rtol=1e-5)


def test_a_recording_without_reads_has_empty_buffers():
    arrivals, unused = frame_arrivals(TagReads.empty(), EPCS, ANTENNAS, FRAMES_NS, 0, 4)
    assert arrivals.valid.shape == (6, 4)
    assert not arrivals.valid.any()
    assert np.all(np.isfinite(arrivals.rssi_dbm))
    assert (unused.num_other_antenna, unused.num_unknown_carrier, unused.num_dropped.sum()) == (0, 0, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_reads": 0}, "num_reads is 0; expected at least 1"),
        ({"epcs": ("a", "a")}, "epcs is .*; expected each once"),
        ({"antennas": (1, 1)}, "antennas is .*; expected each once"),
        ({"frame_time_ns": FRAMES_NS[::-1]}, "expected frames in order of time"),
        ({"since_ns": 10**12}, "expected frames in order of time"),
    ],
)
def test_what_no_buffer_can_have_is_refused(change, message):
    given = {"epcs": EPCS, "antennas": ANTENNAS, "frame_time_ns": FRAMES_NS, "origin_ns": 0, "num_reads": 4}
    with pytest.raises(ValueError, match=message):
        frame_arrivals(_reads(), **{**given, **change})
