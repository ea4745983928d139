"""Controls: reads of another recording, or of another time, and no true object of any tag."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import synthetic_clips as synthetic

from tagjax.recording import Recording, RecordingError
from tagjax.recording.controls import with_control


def _recording(name: str, *, later_ns: int = 0, phase: float = 0.0) -> Recording:
    one = synthetic.recording(30)
    reads = dataclasses.replace(
        one.reads, time_ns=one.reads.time_ns + later_ns, phase_rad=(one.reads.phase_rad + phase) % (2 * np.pi)
    )
    return dataclasses.replace(one, name=name, time_ns=one.time_ns + later_ns, reads=reads)


def test_none_changes_nothing() -> None:
    one = _recording("a")
    assert with_control([one], None) == [one]


def test_foreign_reads_change_places_and_keep_their_time_from_the_start() -> None:
    a, b = _recording("a"), _recording("b", later_ns=10**12, phase=1.0)
    first, second = with_control([a, b], "foreign")
    inside = a.reads.time_ns <= a.time_ns[-1]
    np.testing.assert_array_equal(first.reads.time_ns, a.reads.time_ns[inside])
    np.testing.assert_array_equal(first.reads.phase_rad, b.reads.phase_rad[inside])
    np.testing.assert_array_equal(second.reads.phase_rad, a.reads.phase_rad[inside])
    np.testing.assert_array_equal(second.time_ns, b.time_ns)
    first.check()
    second.check()
    with pytest.raises(RecordingError, match="control=foreign: found 1 recording; expected at least 2"):
        with_control([a], "foreign")


def test_reads_of_antennas_that_the_recording_lacks_are_left_out() -> None:
    a, b = _recording("a"), _recording("b")
    antenna = b.reads.antenna.copy()
    antenna[::2] = 2
    b = dataclasses.replace(b, reads=dataclasses.replace(b.reads, antenna=antenna), antennas_m=np.zeros((2, 3)))
    first, _ = with_control([a, b], "foreign")
    assert set(first.reads.antenna.tolist()) == {1}


def test_shifted_reads_are_half_a_recording_later_and_go_round() -> None:
    one = _recording("a", later_ns=10**12)
    (other,) = with_control([one], "shifted")
    first, length = int(one.time_ns[0]), int(one.time_ns[-1] - one.time_ns[0]) + 1
    kept = (one.reads.time_ns >= first) & (one.reads.time_ns < first + length)
    assert other.reads.num_reads == np.sum(kept)
    back = (other.reads.time_ns - first - length // 2) % length + first
    order = np.argsort(back, kind="stable")
    np.testing.assert_array_equal(back[order], one.reads.time_ns[kept])
    np.testing.assert_array_equal(other.reads.phase_rad[order], one.reads.phase_rad[kept])
    assert np.all(np.diff(other.reads.time_ns) >= 0)
    other.check()


def test_no_tag_has_a_true_object() -> None:
    (other,) = with_control([_recording("a")], "shifted")
    assert other.truth is not None
    assert not other.truth.tag_to_label
    assert not other.truth.tag_range_m
    assert other.truth.labels is not None
