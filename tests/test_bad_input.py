"""The tracer on segments, live and on recordings, with input that is not as it should be: defined, finite, and reported once."""

from __future__ import annotations

import dataclasses
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_segment_tracer import TRACER, clip_of, scene

from tagjax.recording import Recording, RecordingWarning, TagReads
from tagjax.recording.reads import join_reads
from tagjax.tagattention.segments import Segmenter, SegmentTracker, TagAttention
from tagjax.tracing import live as live_module
from tagjax.tracing.clips import ClipSettings, clip_loader
from tagjax.tracing.live import LiveFrame, LiveTracer
from tagjax.tracing.recordings import trace_recording
from tagjax.tracing.tracer import trace

SCENE = scene(40)
MOVED_FROM = 34


def _no_flow(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.zeros((*first.shape[:2], 2), np.float32)


def _live(**settings) -> LiveTracer:
    given = {"flow": _no_flow, "num_places": 2, **settings}
    return LiveTracer(TRACER, SCENE.intrinsics, SCENE.antennas_m, **given)


def _reads(number: int, reads: TagReads = SCENE.reads) -> TagReads:
    since = SCENE.time_ns[number - 1] if number else -1
    return reads[(reads.time_ns > since) & (reads.time_ns <= SCENE.time_ns[number])]


def _process(
    live: LiveTracer, number: int, *, later_ns: int = 0, reads: TagReads | None = None, depth=None
) -> LiveFrame:
    reads = _reads(number) if reads is None else reads
    reads = dataclasses.replace(reads, time_ns=reads.time_ns + later_ns)
    depth_m = SCENE.depth_metres(number) if depth is None else depth
    return live.process(np.asarray(SCENE.colour[number]), depth_m, int(SCENE.time_ns[number]) + later_ns, reads)


def _finite(found) -> bool:
    leaves = [leaf for leaf in jax.tree.leaves(found) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in leaves)


@pytest.fixture(scope="module")
def last() -> LiveFrame:
    """The last frame of the scene as it should be."""
    live = _live()
    return [_process(live, number) for number in range(30)][-1]


def _same(found: LiveFrame, last: LiveFrame) -> None:
    order = jnp.array([found.places[epc] for epc in last.places])
    assert bool(jnp.all(last.trace.tags.detected))
    np.testing.assert_allclose(found.trace.box_px[order], last.trace.box_px, atol=1e-3)
    np.testing.assert_allclose(found.trace.tags.confidence[order], last.trace.tags.confidence, atol=1e-4)


def test_no_tag_is_no_detection():
    live = _live()
    found = [_process(live, number, reads=TagReads.empty()) for number in range(4)][-1]
    assert found.places == {}
    assert _finite(found.trace)
    assert not bool(jnp.any(found.trace.tags.detected))


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_depth_that_is_always_missing_is_no_detection(value):
    live = _live()
    depth = np.full(SCENE.image_shape, value, np.float32)
    all_found = [_process(live, number, depth=depth) for number in range(8)]
    assert all(_finite(found.trace) for found in all_found)
    found = all_found[-1]
    assert set(found.places) == {"tag-a", "tag-b"}
    assert not bool(jnp.any(found.trace.tags.detected))
    assert bool(jnp.all(found.trace.labels == -1))


def test_flow_that_is_never_finite_counts_as_none(last):
    live = _live(flow=lambda first, second: np.full((*first.shape[:2], 2), np.nan, np.float32))
    _same([_process(live, number) for number in range(30)][-1], last)


def test_reads_that_cannot_be_used_are_left_out_and_counted(last):
    live, num_unused = _live(), []
    found = _process(live, 0)
    for number in range(1, 30):
        good = _reads(number)
        bad = good[:4]
        if bad.num_reads == 4:
            bad = dataclasses.replace(
                bad,
                antenna=np.array([9, 1, 1, 1], np.int16),
                carrier_hz=np.array([915e6, np.nan, 915e6, 915e6]),
                phase_rad=np.array([1.0, 1.0, np.nan, 1.0]),
                time_ns=np.array([*bad.time_ns[:3], SCENE.time_ns[number] + 10**9]),
            )
            found = _process(live, number, reads=join_reads([good, bad]))
            num_unused.append(found.num_unused)
        else:
            found = _process(live, number)
    assert set(num_unused) == {4}
    assert found.num_dropped == 0
    _same(found, last)


@pytest.mark.parametrize("back_ns", [0, 10**9])
def test_a_frame_that_is_not_later_is_refused_and_the_next_goes_on(last, back_ns):
    live = _live()
    for number in range(21):
        _process(live, number)
    with pytest.raises(ValueError, match="expected a later time"):
        _process(live, 20, later_ns=-back_ns)
    _same([_process(live, number) for number in range(21, 30)][-1], last)


def test_times_that_repeat_or_go_back_in_a_clip_stay_finite():
    clip = clip_of(scene())
    time_s = clip.frames.time_s.at[20].set(clip.frames.time_s[19]).at[25].set(clip.frames.time_s[5])
    frames = eqx.tree_at(lambda f: f.time_s, clip.frames, time_s)
    found = eqx.filter_jit(trace)(TRACER, clip.camera, frames)
    assert _finite(found)
    assert bool(jnp.all(found.detected[-2:]))


def test_a_gap_of_30_seconds_is_survived():
    live, gap_ns = _live(), 30 * 10**9
    found = [_process(live, number, later_ns=gap_ns if number >= 20 else 0) for number in range(40)]
    assert all(_finite(one.trace) for one in found)
    assert bool(jnp.all(found[19].trace.tags.detected))
    assert bool(jnp.all(found[39].trace.tags.detected))


def test_times_of_days_later_are_rebased_at_once():
    live, days_ns = _live(), 10 * 86400 * 10**9
    found = [_process(live, number, later_ns=days_ns if number else 0) for number in range(3)]
    assert all(_finite(one.trace) for one in found)
    assert float(live._state.tags.time_s) < live_module._REBASE_S


def _many(number: int, count: int) -> TagReads:
    """The reads of a frame, each by another tag as well."""
    own = _reads(number)
    row = np.zeros(count, int)
    many = dataclasses.replace(own[row], epc=np.array([f"tag-{place}" for place in range(count)]))
    return join_reads([own, many])


def test_more_than_64_tags_are_all_traced():
    live = _live(num_places=64, num_reads=256)
    _process(live, 2, reads=_many(2, 70))
    found = _process(live, 3, reads=_many(3, 70))
    assert {"tag-a", "tag-b", *(f"tag-{place}" for place in range(70))} == set(found.places)
    assert found.trace.tags.confidence.shape == (128,)
    assert found.num_dropped == found.num_unused == 0


def test_tags_beyond_the_places_wait_and_are_reported_once(monkeypatch):
    monkeypatch.setattr(live_module, "MAX_TAGS", 2)
    live = _live(forget_s=1.0)
    _process(live, 0)
    with pytest.warns(RecordingWarning, match="found more than 2 tags") as caught:
        found = [_process(live, number, reads=_many(number, 3)) for number in range(1, 6)]
    assert len(caught) == 1
    for one in found:
        assert set(one.places) == {"tag-a", "tag-b"}
        assert one.num_unused == 3
    own = _many(25, 2)
    found = _process(live, 25, reads=own[np.isin(own.epc, ["tag-0", "tag-1"])])  # the others were read 1.3 s ago
    assert set(found.places) == {"tag-0", "tag-1"}


def test_the_memory_of_hidden_bodies_has_a_place_for_each_tag():
    live = _live(num_places=1)
    for number in range(6):
        _process(live, number)
    hidden = live._state.tags.hidden
    assert hidden.evidence_nats.shape == hidden.age_s.shape == (2,)
    assert hidden.centre_m.shape == (2, 3)


@pytest.mark.parametrize("antennas", [(), (0,), (2,), (1, 1)])
def test_antennas_without_a_position_are_refused(antennas):
    with pytest.raises(ValueError, match="expected numbers of antennas that have a position"):
        _live(antennas=antennas)


def test_one_slot_beside_the_background_is_enough():
    clip = clip_of(SCENE)
    one = TagAttention(segments=SegmentTracker(segmenter=Segmenter(num_segments=2)))
    found = eqx.filter_jit(trace)(one, clip.camera, clip.frames)
    assert _finite(found)


def _with_moved_camera() -> Recording:
    """From frame 34 on every surface, the confirmed background too, is 30 cm nearer."""
    depth = np.asarray(SCENE.depth).copy()
    depth[MOVED_FROM:] -= 0.3
    return dataclasses.replace(SCENE, depth=depth)


def _finite_live(live: LiveTracer, recording: Recording, numbers: range) -> bool:
    return all(_finite(_process(live, number, depth=recording.depth_metres(number)).trace) for number in numbers)


def test_a_camera_that_moves_is_reported_once_live():
    live, moved = _live(), _with_moved_camera()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _finite_live(live, moved, range(MOVED_FROM + 2))
    assert not live.camera_moved
    with pytest.warns(RecordingWarning, match=r"the camera moved 2\.3 s after the first frame") as caught:
        assert _finite_live(live, moved, range(MOVED_FROM + 2, 40))
    assert len(caught) == 1
    assert live.camera_moved


def _finite_offline(recording: Recording) -> bool:
    traces = trace_recording(TRACER, recording, clip_loader(ClipSettings(flow="zero")), epcs=["tag-a", "tag-b"])
    return all(_finite(found) for _, found in traces)


def test_a_camera_that_moves_is_reported_once_a_recording():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _finite_offline(SCENE)
    with pytest.warns(RecordingWarning, match="synthetic: the camera moved before frame 40: ") as caught:
        assert _finite_offline(_with_moved_camera())
    assert len(caught) == 1
