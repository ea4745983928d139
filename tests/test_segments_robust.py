"""Segments of frames that are not as they should be: defined, finite, and reported."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from segments_scenes import DT_S, box_frame, noisy, pinhole, random_scene, run

from tagjax.tagattention.segments import Segmenter, SegmentTracker


@pytest.mark.parametrize("settings", [{"num_segments": 80}, {"num_segments": 2}, {"num_segments": 12}])
def test_degenerate_frames_give_defined_and_finite_segments(settings: dict) -> None:
    tracker = SegmentTracker(segmenter=Segmenter(side_m=0.1, min_side_px=3, **settings))
    frames = list(random_scene(6, 6))
    shape = frames[0][0].shape
    nothing, still = np.zeros(shape, np.float32), np.zeros((*shape, 2), np.float32)
    camera = pinhole(shape[0], shape[1], 50.0)
    far = np.full_like(still, 1e9)
    sequence = [(nothing, still), *frames[:3], (frames[3][0], far), (nothing, still), frames[4], (frames[5][0], still)]
    out = run(tracker, camera, sequence)
    for frame in out:
        for leaf in jax.tree.leaves(frame):
            assert np.isfinite(np.asarray(leaf, np.float64)).all()
        labels = np.asarray(frame.labels)
        assert labels.min() >= -1
        assert labels.max() < tracker.segmenter.num_segments
        np.testing.assert_array_equal(frame.area, np.bincount(labels[labels >= 0], minlength=len(frame.area)))
    for blank in (out[0], out[5]):
        np.testing.assert_array_equal(blank.labels, -1)
        assert int(blank.num_unplaced) == 0
    assert float(out[6].area[1:].sum()) > 0
    if tracker.segmenter.num_segments < 80:
        assert sum(int(frame.num_unplaced) for frame in out) > 0


def test_a_frame_without_depth_leaves_the_segments_as_they_are() -> None:
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=80, side_m=0.1, min_side_px=3))
    (depth, flow), *_ = random_scene(8, 1)
    still, nothing = np.zeros_like(flow), np.zeros_like(depth)
    camera = pinhole(depth.shape[0], depth.shape[1], 50.0)
    before, blank, after = run(tracker, camera, [(depth, still), (nothing, still), (depth, still)])
    assert float(blank.area.sum()) == 0.0
    assert int((blank.source > -2).sum()) == 0
    kept = np.asarray(before.labels) > 0
    assert (np.asarray(before.labels) == np.asarray(after.labels))[kept].mean() > 0.95
    old = np.asarray(before.area) > 0
    assert np.mean(np.asarray(after.life_s)[old] > 0) > 0.95


def test_a_step_between_frames_at_one_time_changes_no_label() -> None:
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=80, side_m=0.1, min_side_px=3))
    depth, flow = next(random_scene(7, 1))
    camera, still = pinhole(depth.shape[0], depth.shape[1], 50.0), np.zeros_like(flow)
    first, second = run(tracker, camera, [(depth, still)] * 2, dt=0.0)
    kept = np.asarray(first.labels) > 0
    assert (np.asarray(first.labels) == np.asarray(second.labels))[kept].mean() > 0.95
    np.testing.assert_allclose(second.increment_m, 0, atol=1e-6)


def _moving_box(rate_hz: float, seconds: float, *, dropped: tuple[int, ...] = (), num_segments: int = 512):
    """A slanted square that rests for 0.5 s and then moves, at a frame rate; some frames are missing.

    Returns its segment frames, the last mask, and the sum of the median true and measured motion (x) since it set out.
    """
    view, rng = pinhole(64, 112, 100.0), np.random.default_rng(0)
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=num_segments))
    step, state = eqx.filter_jit(tracker.step), tracker.init(view)
    times = [t / rate_hz for t in range(int(seconds * rate_hz)) if t not in dropped]
    out, measured, last, mask = [], 0.0, 0.0, np.zeros(view.rays.shape[:2], bool)
    for t, time in enumerate(times):
        moved, before = max(time - 0.5, 0.0), max(last - 0.5, 0.0)
        depth, flow, mask, _ = box_frame(moved, moved - before, view, velocity=(0.4, 0.0, -0.2))
        dt = time - last if t else 0.0
        state, frame = step(
            view, state, jnp.asarray(noisy(depth, rng)), jnp.asarray(flow), jnp.asarray(dt, jnp.float32)
        )
        own = np.asarray(frame.labels)[mask]
        own = own[own > 0]
        if len(own):
            measured += float(np.median(np.asarray(frame.motion_m)[own, 0]))
        out.append(frame)
        last = time
    return out, mask, 0.4 * max(last - 0.5, 0.0), measured


@pytest.mark.parametrize(
    ("rate_hz", "dropped"), [(7.0, ()), (15.0, ()), (30.0, ()), (30.0, (24, 31, 32)), (10.0, (9,))]
)
def test_segments_last_and_measure_the_same_motion_at_any_frame_rate(rate_hz: float, dropped: tuple[int, ...]) -> None:
    frames, mask, moved, measured = _moving_box(rate_hz, 1.5, dropped=dropped)
    own = np.asarray(frames[-1].labels)[mask]
    own = own[own > 0]
    assert len(own) > 0.8 * mask.sum()
    assert np.median(np.asarray(frames[-1].life_s)[own]) > 1.2
    assert moved > 0.3
    np.testing.assert_allclose(measured, moved, atol=0.02)


def test_frames_without_flow_keep_the_labels_and_measure_depth_alone() -> None:
    view, rng = pinhole(64, 112, 100.0), np.random.default_rng(3)
    scene = [box_frame(t * DT_S, DT_S, view, velocity=(0.0, 0.0, -0.5)) for t in range(16)]
    frames = [(noisy(depth, rng), np.zeros_like(flow)) for depth, flow, _, _ in scene]
    out = run(SegmentTracker(segmenter=Segmenter(num_segments=512)), view, frames)
    inner = scene[0][2] & scene[-1][2]
    own = np.asarray(out[-1].labels)[inner]
    assert np.isin(own, np.asarray(out[0].labels)[inner]).mean() > 0.95
    moved = np.sum([np.asarray(frame.motion_m)[:, 2] for frame in out], axis=0)
    # Towards the camera by 25 cm. The flow of the expansion is missing, which a slanted surface turns into some depth.
    np.testing.assert_allclose(np.median(moved[own[own > 0]]), -0.25, atol=0.03)


def test_after_a_frame_without_depth_everything_starts_anew_but_the_background() -> None:
    view, rng = pinhole(40, 60, 60.0), np.random.default_rng(4)
    wall, still = np.full((40, 60), 2.0), np.zeros((40, 60, 2), np.float32)
    frames = [(noisy(wall, rng), still) for _ in range(60)]
    blank = (np.zeros((40, 60), np.float32), still)
    out = run(SegmentTracker(segmenter=Segmenter(num_segments=256)), view, [*frames, blank, *frames[:3]])
    np.testing.assert_array_equal(out[60].labels, -1)
    for leaf in (out[60].area, out[60].increment_m, out[60].motion_m, out[60].background_lost):
        np.testing.assert_array_equal(leaf, 0)
    np.testing.assert_array_equal(out[61].labels, 0)


def test_a_camera_that_moves_loses_the_background() -> None:
    view, rng = pinhole(40, 60, 60.0), np.random.default_rng(5)
    wall = 1.5 + 0.02 * np.arange(60)[None] + np.zeros((40, 60))
    still = np.zeros((40, 60, 2), np.float32)
    person = wall.copy()
    person[:, 20:34] = 1.0
    moved = np.roll(wall, 12, axis=1) + 0.1
    frames = [(noisy(depth, rng), still) for depth in [wall] * 60 + [person] * 2 + [wall] * 2 + [moved] * 2]
    out = run(SegmentTracker(segmenter=Segmenter(num_segments=256)), view, frames)
    lost = np.array([float(frame.background_lost) for frame in out])
    np.testing.assert_array_equal(lost[:40], 0)  # nothing is confirmed yet
    assert (lost[40:60] < 0.02).all()
    np.testing.assert_allclose(lost[60:62], 14 / 60, atol=0.03)
    assert lost[64] > 0.95


def test_pieces_beyond_the_slots_are_counted_and_the_others_stay() -> None:
    view, rng = pinhole(64, 112, 100.0), np.random.default_rng(6)
    far = noisy(np.full((64, 112), 2.5), rng)
    near = far.copy()
    near[8:56, 10:100] = 1.2
    still = np.zeros((64, 112, 2), np.float32)
    out = run(SegmentTracker(segmenter=Segmenter(num_segments=200)), view, [(far, still), (near, still), (near, still)])
    assert int(out[0].num_unplaced) == 0
    assert int(out[1].num_unplaced) > 20
    kept = (np.asarray(out[0].labels) > 0) & (near == far)
    assert (np.asarray(out[1].labels) == np.asarray(out[0].labels))[kept].mean() > 0.8


def test_a_single_segment_is_tracked() -> None:
    view = pinhole(24, 32, 40.0)
    depth, flow = np.zeros((24, 32), np.float32), np.zeros((24, 32, 2), np.float32)
    out = []
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=2, start_side_px=40, max_side_px=12))
    frames = []
    for t in range(6):
        depth = np.zeros((24, 32), np.float32)
        depth[8:16, 6 + t : 14 + t] = 1.0
        flow = np.zeros((24, 32, 2), np.float32)
        flow[8:16, 6 + t : 14 + t, 0] = -1.0
        frames.append((depth, flow))
    out = run(tracker, view, frames)
    for frame in out:
        np.testing.assert_array_equal(np.unique(frame.labels), [-1, 1])
    np.testing.assert_allclose(
        np.sum([np.asarray(frame.motion_m)[1] for frame in out], axis=0), [5 / 40, 0, 0], atol=1e-4
    )
