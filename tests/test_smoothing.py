"""Smoothing: recordings played backwards, and what later frames tell of earlier ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import synthetic_clips as synthetic

from tagjax.core.settings import ConfigError
from tagjax.flow.cache import pair_flow
from tagjax.metrics.recordings import ScoreSettings
from tagjax.recording import Recording, RecordingError
from tagjax.recording.store import open_recording
from tagjax.recording.time_reversal import time_reversed
from tagjax.tagattention.literal import TagAttentionLiteral
from tagjax.tracing.clips import Clip, ClipSettings, load_clip
from tagjax.tracing.recordings import trace_recording
from tagjax.training.evaluate import evaluate_tracers

EPCS = list(synthetic.EPCS)
NUM_FRAMES = 20


@pytest.fixture(scope="module")
def recording() -> Recording:
    return synthetic.recording(NUM_FRAMES)


def test_twice_backwards_is_forwards(recording: Recording) -> None:
    back = time_reversed(recording)
    back.check()
    again = time_reversed(back)
    np.testing.assert_array_equal(again.time_ns, recording.time_ns)
    for field in dataclasses.fields(recording.reads):
        np.testing.assert_array_equal(getattr(again.reads, field.name), getattr(recording.reads, field.name))
    for frames, turned, once_more in (
        (recording.colour, back.colour, again.colour),
        (recording.depth, back.depth, again.depth),
    ):
        np.testing.assert_array_equal(turned[:], frames[:][::-1])
        np.testing.assert_array_equal(turned[3:7], frames[:][::-1][3:7])
        np.testing.assert_array_equal(turned[2], frames[NUM_FRAMES - 3])
        np.testing.assert_array_equal(turned[-1], frames[0])
        np.testing.assert_array_equal(once_more[5:], frames[5:])
        assert turned[7:3].shape == frames[7:3].shape
        with pytest.raises(IndexError, match="Frame 20 of 20"):
            turned[20]
        with pytest.raises(IndexError, match="expected a slice of step 1"):
            turned[::2]


def test_a_clock_that_goes_backwards_turns_doppler_and_keeps_phases(recording: Recording) -> None:
    reads = dataclasses.replace(
        recording.reads,
        doppler_hz=np.arange(recording.reads.num_reads, dtype=np.float32),
        reader_time_ns=recording.reads.time_ns + 5,
    )
    back = time_reversed(recording.with_reads(reads)).reads
    back.check()
    np.testing.assert_array_equal(back.phase_rad, reads.phase_rad[::-1])
    np.testing.assert_array_equal(back.doppler_hz, -reads.doppler_hz[::-1])
    np.testing.assert_array_equal(np.diff(back.time_ns), np.diff(reads.time_ns)[::-1])
    assert back.reader_time_ns is not None
    np.testing.assert_array_equal(np.diff(back.reader_time_ns), np.diff(back.time_ns))


def test_flow_backwards_is_the_same_pairs_the_other_way_round() -> None:
    rng = np.random.default_rng(0)
    picture = np.kron(rng.integers(0, 255, (12, 16, 3)), np.ones((6, 6, 1))).astype(np.uint8)
    colour = np.stack([np.roll(picture, 2 * t * t, axis=1) for t in range(5)])
    size = {"height": picture.shape[0], "width": picture.shape[1]}
    still = synthetic.recording(5)
    recording = dataclasses.replace(
        still,
        colour=colour,
        depth=np.ones(colour.shape[:3], np.float32),
        intrinsics=dataclasses.replace(still.intrinsics, **size),
        truth=None,
    )
    back = time_reversed(recording)
    # The same pictures as a recording of its own: DIS does not know which way time runs.
    alone = dataclasses.replace(back, reversed_from=None)
    for first, last in ((0, 5), (0, 1), (2, 4)):
        for turned, expected in zip(
            pair_flow(back, first, last, "dis"), pair_flow(alone, first, last, "dis"), strict=True
        ):
            assert turned.shape == expected.shape
            np.testing.assert_array_equal(turned, expected)
    assert np.abs(pair_flow(back, 0, 5, "dis")[0]).max() > 1.0


def test_reversed_reads_give_reversed_distances(recording: Recording) -> None:
    """By an independent way: the reads of the turned recording give the truth's differences, frames reversed."""
    clip = load_clip(time_reversed(recording), 0, NUM_FRAMES, stride=1, flow="zero", epcs=EPCS)
    truth = load_clip(time_reversed(recording), 0, NUM_FRAMES, stride=1, flow="zero", epcs=EPCS, estimator="truth")
    time_s = recording.frame_time_s()
    for tag, label in enumerate(synthetic.BOXES):
        travelled = synthetic.offset_m(label, time_s)[::-1]
        step = np.asarray(clip.frames.radio.relative_m[6:, tag, 0, -1])
        np.testing.assert_allclose(step, travelled[6:] - travelled[2:-4], atol=6e-3)
        np.testing.assert_allclose(
            truth.frames.radio.relative_m[6:, tag, 0, -1], travelled[6:] - travelled[2:-4], atol=1e-6
        )


def _load(one: Recording, start: int, stop: int, *, epcs: Sequence[str]) -> Clip:
    return load_clip(one, start, stop, stride=1, flow="zero", epcs=epcs)


def test_a_forward_only_tracer_is_refused_for_smoothing(tmp_path: Path) -> None:
    recording = open_recording(synthetic.stored(tmp_path, 8)[0])
    settings = ScoreSettings(smooth=True, num_pictures=1, from_s=0.2)
    with pytest.raises(RecordingError, match="TagAttentionLiteral has no backward pass; expected TagAttention"):
        next(trace_recording(TagAttentionLiteral(), recording, _load, epcs=EPCS, settings=settings))
    common = {
        "recordings": [recording],
        "clips": ClipSettings(stride=4, flow="zero"),
        "settings": settings,
        "progress": False,
    }
    with pytest.raises(ConfigError, match=r"scores.smooth is true, which TagAttentionLiteral does not support"):
        evaluate_tracers({"paper": TagAttentionLiteral()}, folder=tmp_path, **common)
