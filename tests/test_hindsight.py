"""Offline smoothing of the tracer on segments: evidence handed over by pixels, both passes' reads, frames before the first motion."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_segment_tracer import BOXES, EPCS, TRACER, clip_of, scene

from tagjax.radio.arrivals import Arrivals
from tagjax.radio.reader_model import ReaderModel
from tagjax.recording import Recording
from tagjax.recording.time_reversal import time_reversed
from tagjax.tagattention.segments.dwell import DwellEvidence, DwellState
from tagjax.tagattention.segments.hindsight import handed_over
from tagjax.tracing.clips import load_clip
from tagjax.tracing.recordings import TraceSettings, trace_recording
from tagjax.tracing.tracer import Trace


def test_a_segment_has_the_mean_over_the_pixels_that_it_shares():
    rng = np.random.default_rng(0)
    num_segments = 7
    labels, later_labels = rng.integers(-1, 6, (2, 12, 15)).astype(np.int32)  # no pixel of slot 6
    labels[labels == 5] = 4
    later_labels[labels == 4] = -1  # the backward pass has no label on slot 4
    values = rng.normal(size=(3, 2, num_segments)).astype(np.float32)
    expected = np.empty_like(values)
    for here in range(num_segments):
        shared = [
            later_labels[row, column]
            for row in range(12)
            for column in range(15)
            if labels[row, column] == here and later_labels[row, column] >= 0
        ]
        if here == 0 or not shared:
            expected[..., here] = values[..., 0]
        else:
            expected[..., here] = np.mean([values[..., there] for there in shared], axis=0)
    found = jax.jit(handed_over)(jnp.asarray(labels), jnp.asarray(later_labels), jnp.asarray(values))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_array_equal(found[..., 4], values[..., 0])


def test_the_same_segments_hand_over_their_own_values():
    labels = jnp.asarray(np.arange(6, dtype=np.int32).reshape(2, 3))
    values = jnp.arange(12.0).reshape(2, 6)
    np.testing.assert_array_equal(handed_over(labels, labels, values), values)


def _dwell(time_s: np.ndarray, phase_rad: np.ndarray, channel: int) -> Arrivals:
    """The reads of a dwell of one tag at one antenna."""
    count = len(time_s)
    none = jnp.zeros(count, jnp.int32)
    return Arrivals(
        tag=none,
        antenna=none,
        time_s=jnp.asarray(time_s, jnp.float32),
        phase_rad=jnp.asarray(phase_rad, jnp.float32),
        carrier_hz=jnp.full(count, 915e6, jnp.float32),
        channel=none + channel,
        rssi_dbm=jnp.full(count, -55.0, jnp.float32),
        valid=jnp.ones(count, bool),
    )


def test_both_passes_together_have_every_read_once():
    """Without forgetting the evidence of both passes adds up to that of all reads, at every frame.

    Segments stay the same, and each frame has a dwell of two reads: what these say of each other is the same from either end.
    """
    num_frames, num_segments, dt_s = 9, 5, 0.2
    end_s = (num_frames - 1) * dt_s
    rng = np.random.default_rng(1)
    increment_m = 0.01 * rng.normal(size=(num_frames - 1, 1, num_segments)).astype(np.float32)
    phase_rad = rng.uniform(0, 2 * np.pi, (num_frames - 1, 2))
    stage, reader = DwellEvidence(memory_s=1e9), ReaderModel()
    depth_m, same = jnp.full(num_segments, 2.0), jnp.full(num_segments, -2, jnp.int32)
    step = eqx.filter_jit(stage.step)

    def run(backward: bool) -> list[np.ndarray]:
        """The evidence after each frame, in the order in which the pass comes to them."""
        state, out = DwellState.nothing(1, 1, num_segments), [np.zeros((1, num_segments), np.float32)]
        for index in range(num_frames - 1):
            interval = num_frames - 2 - index if backward else index
            time_s, moved_m = dt_s * (interval + np.array([0.1, 0.8])), increment_m[interval]
            if backward:
                reads = _dwell(end_s - time_s[::-1], phase_rad[interval, ::-1], interval)
            else:
                reads = _dwell(time_s, phase_rad[interval], interval)
            since_s, now_s = (jnp.asarray(at * dt_s, jnp.float32) for at in (index, index + 1))
            moved = jnp.asarray(-moved_m if backward else moved_m)
            state, evidence = step(reader, state, reads, moved, depth_m, same, since_s, now_s)
            out.append(np.asarray(evidence))
        return out

    forward, backward = run(False), run(True)[::-1]
    total = np.array([ahead + behind for ahead, behind in zip(forward, backward, strict=True)])
    assert np.abs(total[-1]).max() > 5.0
    assert np.abs(total[-1] - forward[num_frames // 2]).max() > 1.0
    np.testing.assert_allclose(total, np.broadcast_to(total[-1], total.shape), atol=2e-4 * np.abs(total).max())


@pytest.mark.parametrize("shift_ns", [0, 1])
def test_a_read_belongs_to_one_pass_at_every_frame(shift_ns: int):
    """Also reads at the very time of a frame, of which the scene has many."""
    one = scene(12)
    one = one.with_reads(dataclasses.replace(one.reads, time_ns=one.reads.time_ns + shift_ns))
    num_reads = [np.asarray(clip_of(each).frames.arrivals.valid).sum(axis=1) for each in (one, time_reversed(one))]
    assert np.isin(one.reads.time_ns, one.time_ns).any() == (shift_ns == 0)
    until, after = np.cumsum(num_reads[0]), np.cumsum(num_reads[1])[::-1]
    counted = (one.reads.time_ns > one.time_ns[0]) & (one.reads.time_ns <= one.time_ns[-1])
    np.testing.assert_array_equal(until + after, np.full(12, counted.sum()))
    for frame in range(12):
        np.testing.assert_array_equal(until[frame], np.sum(counted & (one.reads.time_ns <= one.time_ns[frame])))


def _late(num_frames: int = 36, still: int = 14) -> Recording:
    """The scene, whose objects rest at first; their tags are first read a little after they have begun to move."""
    moving = scene(num_frames)
    frame = np.maximum(np.arange(num_frames) - still, 0)
    start_ns = int(moving.time_ns[still]) - int(moving.time_ns[0])
    reads = dataclasses.replace(moving.reads, time_ns=moving.reads.time_ns + start_ns)
    kept = (reads.time_ns > moving.time_ns[still + 4]) & (reads.time_ns <= moving.time_ns[-1])
    return dataclasses.replace(moving, depth=np.asarray(moving.depth)[frame]).with_reads(reads[kept])


def _traces(one: Recording, smooth: bool, **settings: int) -> list[Trace]:
    def load(part: Recording, start: int, stop: int, *, epcs):
        return load_clip(part, start, stop, stride=1, flow="zero", epcs=epcs)

    chosen = TraceSettings(smooth=smooth, **settings)
    return [out for _, out in trace_recording(TRACER, one, load, epcs=list(EPCS), settings=chosen)]


@pytest.mark.ci
def test_offline_finds_a_tag_before_its_first_motion_and_read():
    one = _late()
    online, offline = _traces(one, False), _traces(one, True, frames_at_once=17)
    assert len(offline) == one.num_frames
    before = slice(8, 16)  # at rest the objects are background by now; there is no read before frame 19
    for tag, label in enumerate(EPCS.values()):
        x0, y0, x1, y1 = BOXES[label]
        true = np.zeros(one.image_shape, bool)
        true[2 * y0 : 2 * y1 + 2, 2 * x0 : 2 * x1 + 2] = True
        for early, late in zip(online[before], offline[before], strict=True):
            assert not early.detected[tag]
            mask = late.mask[tag] > 0.5
            assert np.sum(mask & true) / np.sum(mask | true) > 0.8
        assert all(out.detected[tag] for out in offline[14:16])


@pytest.mark.ci
def test_with_nothing_to_come_offline_is_online():
    """At the last frame the backward pass has no read; where it begins it knows no body either."""
    one = scene(30)
    online, offline = _traces(one, False)[-1], _traces(one, True)[-1]
    np.testing.assert_allclose(offline.mask, online.mask, atol=0.02)
    np.testing.assert_allclose(offline.confidence, online.confidence, atol=0.01)


@pytest.mark.ci
def test_tags_in_groups_are_smoothed_as_all_at_once():
    one = _late(30, 8)
    together, apart = _traces(one, True), _traces(one, True, tags_at_once=1)
    for all_tags, each in zip(together, apart, strict=True):
        # What a tag's body is by later frames is no background, for the tags of its group: elsewhere segments differ.
        np.testing.assert_allclose(each.box_px, all_tags.box_px, atol=1.0)
        np.testing.assert_array_equal(each.detected, all_tags.detected)
