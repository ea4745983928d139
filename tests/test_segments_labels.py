"""Persistent segments: labels and increments against their plain twins, a rigid motion, and settings."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import segments_numpy as plain
from segments_scenes import ANTENNAS_M, DT_S, box_frame, pinhole, random_scene, run, scalar

from tagjax.tagattention.segments import Background, Segmenter, SegmentTracker
from tagjax.tagattention.segments.carry import on_surface
from tagjax.tagattention.segments.cells import NO_LABEL, NOT_NEW, births
from tagjax.tagattention.segments.given import first_given, given_slots


def test_a_given_object_is_one_segment_with_its_own_motion() -> None:
    camera, velocity = pinhole(48, 64, 60.0), np.array([0.5, 0.06, -0.2])
    tracker = SegmentTracker(None, Segmenter(num_segments=512))
    step, state = eqx.filter_jit(tracker.step), tracker.init(camera)
    slot = first_given(512) + 4
    for number in range(8):
        depth, flow, mask, _ = box_frame(number * DT_S, DT_S, camera, velocity=velocity)
        gone = number == 5
        objects = jnp.asarray(np.where(mask & (not gone), 5, 0), jnp.int32)
        last = state.segments.labels
        state, frame = step(camera, state, jnp.asarray(depth), jnp.asarray(flow), scalar(DT_S), objects)
        np.testing.assert_array_equal(frame.labels == slot, mask & (not gone))
        assert int(frame.area[slot]) == (0 if gone else int((mask & np.asarray(on_surface(jnp.asarray(depth)))).sum()))
        assert int(frame.source[slot]) == (NO_LABEL if number in (0, 6) else NOT_NEW)
        if number in (0, 5, 6):
            assert not bool(frame.known[slot])
            continue
        np.testing.assert_allclose(frame.motion_m[slot], velocity * DT_S, atol=2e-4)
        # What is not given has segments of its own, which go on.
        beside = np.asarray(last)[:, -8:]
        assert (beside > 0).all()
        assert (np.asarray(frame.labels)[:, -8:] == beside).mean() > 0.9
    with pytest.raises(ValueError, match="expected 32 more slots"):
        given_slots(jnp.zeros((4, 4), jnp.int32), 60, 28)


@pytest.mark.parametrize(("seed", "num_segments"), [(0, 80), (1, 80), (2, 24)])
def test_labels_and_increments_are_the_twins(seed: int, num_segments: int) -> None:
    segmenter = Segmenter(num_segments=num_segments, side_m=0.1, min_side_px=3, max_side_px=7, reach=1.2)
    tracker = SegmentTracker(Background(confirm_s=0.41, early_s=0.11), segmenter)
    frames = list(random_scene(seed, 20))
    shape = frames[0][0].shape
    camera = pinhole(shape[0], shape[1], 50.0)
    rays = np.asarray(camera.rays, np.float64)
    memory, twin = plain.Memory(*shape), plain.Labels(segmenter, *shape)
    step, state = eqx.filter_jit(tracker.step), tracker.init(camera)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plain, "BACKGROUND", plain.BACKGROUND | {"confirm_s": 0.41, "early_s": 0.11})
        num_new = unplaced = static = 0
        for t, (depth, flow) in enumerate(frames):
            last = twin.depth
            state, frame = step(camera, state, jnp.asarray(depth), jnp.asarray(flow), scalar(DT_S))
            valid = plain.surface(depth)
            view = memory.step(depth, valid, flow, DT_S, 50.0)
            counted, source, missing = twin.step(rays, depth.astype(float), valid, flow, view, DT_S, 50.0)
            np.testing.assert_array_equal(frame.labels, twin.labels, err_msg=f"frame {t}")
            np.testing.assert_array_equal(frame.source, source, err_msg=f"frame {t}")
            assert int(frame.num_unplaced) == missing
            increment, motion, known = plain.motion(
                rays,
                ANTENNAS_M.astype(float),
                twin.labels,
                counted,
                depth.astype(float),
                last,
                flow,
                0.02 + segmenter.max_speed_m_s * DT_S,
                num_segments,
            )
            twin.displaced(motion)
            np.testing.assert_allclose(frame.increment_m, increment, atol=1e-5)
            np.testing.assert_allclose(frame.motion_m, motion, atol=1e-5)
            np.testing.assert_array_equal(frame.known, known)
            np.testing.assert_array_equal(frame.area, twin.area)
            np.testing.assert_allclose(frame.life_s, twin.life, atol=1e-5)
            np.testing.assert_allclose(frame.displacement_m, twin.displacement, atol=1e-4)
            np.testing.assert_array_equal(frame.moved, twin.moved)
            num_new, unplaced = num_new + (t > 0) * int((source > -2).sum()), unplaced + missing
            static += int((twin.labels == 0).sum())
        assert num_new > 2
        assert static > 500
        assert twin.moved.any()
        assert (unplaced > 0) == (num_segments == 24)


@pytest.mark.parametrize("seed", range(4))
def test_cells_and_sources_of_new_segments_are_the_twins(seed: int) -> None:
    rng, shape = np.random.default_rng(seed), (26, 35)
    hole = rng.random(shape) < 0.5
    side = np.where(np.arange(35) < 17, rng.uniform(3, 4, shape), rng.uniform(4.4, 6, shape)).astype(np.float32)
    carried = rng.integers(-1, 5, shape).astype(np.int32)
    free = rng.random(24 if seed < 3 else 120) < 0.7
    free[0] = False
    given = (jnp.asarray(each) for each in (hole, side, carried, free))
    found = births(*given, min_side_px=3, min_pixels=4)
    want = plain.born(hole, side, carried, free, 3, 4)
    for one, other in zip(found, want, strict=True):
        np.testing.assert_array_equal(one, other)
    assert (want[2] > 0) == (seed < 3)
    assert seed < 3 or len(np.unique(want[1])) == 7  # -2, and sources -1 to 4


def test_a_rigid_box_keeps_its_segments_and_its_increments_add_up() -> None:
    camera, tracker = pinhole(64, 112, 100.0), SegmentTracker(segmenter=Segmenter(num_segments=512))
    scene = [box_frame(t * DT_S, DT_S, camera) for t in range(31)]
    frames = run(tracker, camera, [(depth, flow) for depth, flow, _, _ in scene])
    first, last = np.asarray(frames[0].labels), np.asarray(frames[-1].labels)
    mask, point = scene[-1][2] & np.asarray(on_surface(jnp.asarray(scene[-1][0]))), scene[-1][3]
    own = np.unique(first[scene[0][2]])
    own = own[own > 0]
    assert mask.sum() > 300
    assert np.isin(last[mask], own).mean() >= 0.95
    assert np.isin(last[~mask], own).sum() <= 0.02 * mask.sum()
    # The same point of the box, 30 frames before: its own segment, or the next one where it lay at an outline.
    before = point[mask] - np.array([0.5, 0.06, -0.2]) * 30 * DT_S
    pixel = np.rint(before[:, :2] / before[:, 2:] * 100.0 + np.array([111, 63]) / 2).astype(int)
    assert (last[mask] == first[pixel[:, 1], pixel[:, 0]]).mean() >= 0.75

    summed = np.sum([np.asarray(frame.increment_m) for frame in frames], axis=0)
    moved = np.sum([np.asarray(frame.motion_m) for frame in frames], axis=0)
    displacement = np.array([0.5, 0.06, -0.2]) * 30 * DT_S
    area, life = np.asarray(frames[-1].area), np.asarray(frames[-1].life_s)
    lasting = own[(area[own] >= 4) & (life[own] > 0.99)]
    assert area[lasting].sum() >= 0.95 * mask.sum()
    centre = np.asarray(frames[-1].centre_m)[lasting]
    for antenna in range(2):
        now, then = (np.linalg.norm(c - ANTENNAS_M[antenna], axis=1) for c in (centre, centre - displacement))
        np.testing.assert_allclose(summed[antenna, lasting], now - then, atol=5e-3)
    # At outlines taps are missing on one side, which is worth half a pixel across the line of sight.
    np.testing.assert_allclose(moved[lasting], np.broadcast_to(displacement, (len(lasting), 3)), atol=1e-2)
    np.testing.assert_allclose(np.asarray(frames[-1].displacement_m)[lasting], moved[lasting], atol=1e-4)
    assert np.asarray(frames[-1].moved)[lasting].all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_segments": 1}, "num_segments is 1; expected at least 2"),
        ({"max_side_px": 2}, "max_side_px is 2; expected at least min_side_px, 4"),
        ({"side_m": 0.0}, "side_m is 0.0; expected a positive value"),
        ({"depth_weight": -1.0}, "depth_weight is -1.0; expected at least 0"),
        ({"min_pixels": -1}, "min_pixels is -1; expected an integer of at least 0"),
    ],
)
def test_impossible_settings_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Segmenter(**settings)
    with pytest.raises(ValueError, match=r"confirm_s is 0\.0; expected a positive value"):
        Background(confirm_s=0.0)


def test_the_first_blocks_leave_a_quarter_of_the_slots() -> None:
    assert Segmenter().start_side(212, 256) == 6
    assert Segmenter(start_side_px=9).start_side(212, 256) == 9
    with pytest.raises(ValueError, match="expected fewer than num_segments, 2048"):
        Segmenter(start_side_px=2).init(212, 256)
    for shape in ((1, 1), (1, 500), (37, 90)):
        side = Segmenter(num_segments=20).start_side(*shape)
        assert -(-shape[0] // side) * -(-shape[1] // side) < 20
