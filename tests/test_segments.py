"""Persistent segments: each step against its plain twin, known motions, gradients, and degenerate frames."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import segments_numpy as plain

from tagjax.tagattention.segments import Background, Segmenter, SegmentFrame, SegmentTracker
from tagjax.tagattention.segments.carry import on_surface
from tagjax.tagattention.segments.cells import births
from tagjax.tagattention.segments.increments import segment_motion
from tagjax.tagattention.segments.step import focal_px
from tagjax.tracing.tracer import Camera

DT_S = 1 / 30
ANTENNAS_M = np.array([[0.4, -0.3, 0.1], [-0.5, 0.2, 0.0]], np.float32)


def _camera(height: int, width: int, focal: float) -> Camera:
    y, x = np.mgrid[:height, :width].astype(np.float32)
    rays = np.stack([(x - (width - 1) / 2) / focal, (y - (height - 1) / 2) / focal, np.ones_like(x)], axis=-1)
    return Camera(jnp.asarray(rays.astype(np.float32)), jnp.asarray(ANTENNAS_M))


def _scalar(value: float) -> jax.Array:
    return jnp.asarray(value, jnp.float32)


def _random_scene(seed: int, num_frames: int, *, height: int = 23, width: int = 31):
    """A noisy wall and a nearer box that moves and pauses, holes in the depth, and flow with errors."""
    rng = np.random.default_rng(seed)
    wall = 1.6 + 0.01 * np.arange(width)[None] + rng.normal(0, 0.002, (height, width))
    left = 3.0
    for t in range(num_frames):
        speed = 0.0 if t % 12 > 7 else 1.0 + seed % 2
        left += speed
        depth = wall + rng.normal(0, 0.002, wall.shape)
        box = slice(6, 17), slice(int(left), int(left) + 9)
        depth[box] = 0.8 - 0.004 * t + rng.normal(0, 0.002, depth[box].shape)
        depth[rng.random(depth.shape) < 0.01] = 0.0
        flow = rng.normal(0, 0.02, (height, width, 2))
        flow[box] += (-speed, 0.0)
        flow[rng.random(depth.shape) < 0.02] += 3.0
        yield depth.astype(np.float32), flow.astype(np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_the_background_is_the_twins(seed: int) -> None:
    rng, shape, focal = np.random.default_rng(seed), (9, 13), 60.0
    model, memory = Background(), plain.Memory(*shape)
    state, step = model.init(*shape), eqx.filter_jit(model.step)
    surfaces, shown = rng.uniform(0.5, 3, (4, *shape)), np.zeros(shape, int)
    num_confirmed = np.zeros(30, int)
    for t in range(30):
        shown = np.where(rng.random(shape) < 0.03, rng.integers(0, 4, shape), shown)
        depth = np.take_along_axis(surfaces, shown[None], 0)[0] + rng.normal(0, 0.002, shape) + 0.002 * t
        depth = depth.astype(np.float32)
        valid = rng.random(shape) < 0.95
        flow = (rng.normal(0, 0.5, (*shape, 2)) * (rng.random(shape) < 0.1)[..., None]).astype(np.float32)
        dt = 0.11 + 0.01 * rng.random()
        state, view = step(
            state, jnp.asarray(depth), jnp.asarray(valid), jnp.asarray(flow), _scalar(dt), _scalar(focal)
        )
        want = memory.step(depth, valid, flow, dt, focal)
        for name in ("confirmed", "matched", "still", "early", "ripe"):
            np.testing.assert_array_equal(getattr(view, name), want[name], err_msg=f"{name} of frame {t}")
        np.testing.assert_allclose(view.age_s, want["age_s"], atol=1e-4)
        num_confirmed[t] = want["confirmed"].sum()
    np.testing.assert_allclose(
        state.confirmed_m, np.reshape([p["b"] for p in memory.pixels], shape), atol=1e-5
    )  # fmt: skip
    assert num_confirmed[0] == 0
    assert 20 < num_confirmed.max() < 117


@pytest.mark.parametrize(("seed", "num_segments"), [(0, 80), (1, 80), (2, 24)])
def test_labels_and_increments_are_the_twins(seed: int, num_segments: int) -> None:
    segmenter = Segmenter(num_segments=num_segments, side_m=0.1, min_side_px=3, max_side_px=7)
    tracker = SegmentTracker(Background(confirm_s=0.41, early_s=0.11), segmenter)
    frames = list(_random_scene(seed, 20))
    shape = frames[0][0].shape
    camera = _camera(shape[0], shape[1], 50.0)
    rays = np.asarray(camera.rays, np.float64)
    memory, twin = plain.Memory(*shape), plain.Labels(segmenter, *shape)
    step, state = eqx.filter_jit(tracker.step), tracker.init(camera)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plain, "BACKGROUND", plain.BACKGROUND | {"confirm_s": 0.41, "early_s": 0.11})
        num_new = unplaced = static = 0
        for t, (depth, flow) in enumerate(frames):
            last = twin.depth
            state, frame = step(camera, state, jnp.asarray(depth), jnp.asarray(flow), _scalar(DT_S))
            valid = plain.surface(depth)
            view = memory.step(depth, valid, flow, DT_S, 50.0)
            counted, source, missing = twin.step(rays, depth.astype(float), valid, flow, view, DT_S, 50.0)
            np.testing.assert_array_equal(frame.labels, twin.labels, err_msg=f"frame {t}")
            np.testing.assert_array_equal(frame.source, source, err_msg=f"frame {t}")
            assert int(frame.num_unplaced) == missing
            increment, motion, known = plain.motion(
                rays, ANTENNAS_M.astype(float), twin.labels, counted, depth.astype(float), last, flow, num_segments
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


def _box_frame(t: float, dt: float, camera: Camera, *, velocity=(0.5, 0.06, -0.2), slope: float = 0.4):
    """Depth, exact backward flow and mask of a slanted square, 24 cm wide, in front of a wall at 2.5 m, at time `t`."""
    rays = np.asarray(camera.rays, np.float64)
    velocity = np.array(velocity)
    start = np.array([-0.25, 0.0, 1.3])
    place = start + velocity * t
    # A plane through the place: z = place_z + slope * (x - place_x), with x = ray_x * z.
    depth = (place[2] - slope * place[0]) / (1 - slope * rays[..., 0])
    point = rays * depth[..., None]
    mask = (np.abs(point[..., :2] - place[:2]) < 0.12).all(axis=-1)
    before = point - velocity * dt
    focal = float(focal_px(camera))
    flow = (before[..., :2] / before[..., 2:] - rays[..., :2]) * focal
    depth = np.where(mask, depth, 2.5)
    return depth.astype(np.float32), np.where(mask[..., None], flow, 0).astype(np.float32), mask, point


def _run(tracker: SegmentTracker, camera: Camera, frames, dt: float = DT_S) -> list[SegmentFrame]:
    step, state, out = eqx.filter_jit(tracker.step), tracker.init(camera), []
    for depth, flow in frames:
        state, frame = step(camera, state, jnp.asarray(depth), jnp.asarray(flow), _scalar(dt))
        out.append(frame)
    return out


def test_a_rigid_box_keeps_its_segments_and_its_increments_add_up() -> None:
    camera, tracker = _camera(64, 112, 100.0), SegmentTracker(segmenter=Segmenter(num_segments=512))
    scene = [_box_frame(t * DT_S, DT_S, camera) for t in range(31)]
    frames = _run(tracker, camera, [(depth, flow) for depth, flow, _, _ in scene])
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


def _noisy(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return (depth + rng.normal(0, 0.001, depth.shape)).astype(np.float32)


def test_a_shadow_on_a_confirmed_floor_is_static() -> None:
    rng, camera = np.random.default_rng(0), _camera(40, 60, 60.0)
    floor = 1.5 + 0.02 * np.arange(40)[:, None] + np.zeros((40, 60))
    frames = []
    for t in range(110):
        flow = np.zeros((40, 60, 2), np.float32)
        if t >= 50:
            flow[10:26, (t - 50) // 2 : (t - 50) // 2 + 20] = (-1.2, 0.4)
        frames.append((_noisy(floor, rng), flow))
    out = _run(SegmentTracker(segmenter=Segmenter(num_segments=256)), camera, frames)
    assert (np.asarray(out[30].labels) > 0).mean() > 0.9  # not yet confirmed
    for frame in out[50:]:
        np.testing.assert_array_equal(frame.labels, 0)
        assert float(jnp.max(jnp.abs(frame.increment_m))) == 0


def test_an_object_that_stood_still_for_a_second_keeps_its_segments_when_it_moves() -> None:
    rng, camera = np.random.default_rng(1), _camera(64, 112, 100.0)
    frames, masks = [], []
    for t in range(60):
        time = max(t - 30, 0) * DT_S
        depth, flow, mask, _ = _box_frame(time, DT_S if t > 30 else 0.0, camera)
        frames.append((_noisy(depth, rng), flow))
        masks.append(mask)
    out = _run(SegmentTracker(segmenter=Segmenter(num_segments=512)), camera, frames)
    first, last = (np.asarray(out[t].labels) for t in (0, -1))
    own = np.unique(first[masks[0]])
    inside = last[masks[-1] & (last >= 0)]
    assert np.isin(inside, own[own > 0]).mean() >= 0.9
    life = np.asarray(out[-1].life_s)[inside]
    assert np.median(life) > 1.9


def test_the_place_where_an_object_stood_is_background_soon_after_it_has_left() -> None:
    rng, camera = np.random.default_rng(2), _camera(40, 60, 60.0)
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=256))
    step, state = eqx.filter_jit(tracker.step), tracker.init(camera)
    wall, box = np.full((40, 60), 2.0), (slice(12, 28), slice(20, 40))
    still = jnp.zeros((40, 60, 2))
    history = []
    for t in range(125):
        depth = wall.copy()
        if t < 60 or t == 124:
            depth[box] = 1.2
        state, frame = step(camera, state, jnp.asarray(_noisy(depth, rng)), still, _scalar(DT_S))
        history.append((np.asarray(frame.labels)[box], np.asarray(state.background.confirmed_m)[box]))
    np.testing.assert_array_equal(history[59][0][1:-1, 1:-1], 0)  # confirmed, as part of the scene
    np.testing.assert_allclose(history[59][1], 1.2, atol=5e-3)
    np.testing.assert_array_equal(history[63][1], 0)  # the wall behind shows: the box has left
    np.testing.assert_array_equal(history[123][0], 0)
    np.testing.assert_allclose(history[123][1], 2.0, atol=5e-3)
    assert (history[124][0][1:-1, 1:-1] > 0).all()  # it comes back as something new


def test_compiled_and_eager_steps_agree() -> None:
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=80, side_m=0.1, min_side_px=3))
    frames = list(_random_scene(3, 4))
    shape = frames[0][0].shape
    camera = _camera(shape[0], shape[1], 50.0)
    eager = compiled = tracker.init(camera)
    step = eqx.filter_jit(tracker.step)
    for depth, flow in frames:
        given = jnp.asarray(depth), jnp.asarray(flow), _scalar(DT_S)
        eager, one = tracker.step(camera, eager, *given)
        compiled, two = step(camera, compiled, *given)
        np.testing.assert_array_equal(one.labels, two.labels)
        np.testing.assert_array_equal(one.source, two.source)
        np.testing.assert_allclose(one.increment_m, two.increment_m, atol=1e-6)


def test_gradients_of_increments_with_frozen_labels(gradients_agree) -> None:
    rng, (height, width) = np.random.default_rng(4), (5, 6)
    labels = rng.integers(0, 4, (height, width)).astype(np.int32)
    counted = rng.random((height, width)) < 0.9
    rays = np.asarray(_camera(height, width, 8.0).rays)
    depth, last = (1.0 + 0.002 * rng.normal(size=(height, width)) for _ in range(2))
    last[1, 2], last[3, 4] = 0.0, 1.6  # missing; another surface
    flow = rng.choice([-0.7, -0.3, 0.2, 0.6, 1.3], (height, width, 2))

    def motion(flow_px, depth_m, last_depth_m):
        camera = Camera(jnp.asarray(rays, flow_px.dtype), jnp.asarray(ANTENNAS_M, flow_px.dtype))
        found = segment_motion(
            camera, jnp.asarray(labels), jnp.asarray(counted), depth_m, last_depth_m, flow_px, 5
        )  # fmt: skip
        return jnp.concatenate([found.increment_m, found.motion_m.T])

    gradients_agree(motion, (flow, depth, last))
    assert np.abs(np.asarray(motion(*(jnp.asarray(a, jnp.float32) for a in (flow, depth, last))))).max() > 1e-3


def test_gradients_through_whole_steps_reach_flow_and_depth_alone_and_stay_finite() -> None:
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=80, side_m=0.1, min_side_px=3))
    frames = list(_random_scene(5, 3))
    shape = frames[0][0].shape
    camera = _camera(shape[0], shape[1], 50.0)

    @eqx.filter_jit
    @jax.grad
    def gradient(flows, depths):
        state, total = tracker.init(camera), jnp.zeros(())
        for t in range(3):
            state, frame = tracker.step(camera, state, depths[t], flows[t], _scalar(DT_S))
            total = total + jnp.sum(frame.increment_m)
            total = total + jnp.sum(frame.displacement_m) + jnp.sum(frame.centre_m) + jnp.sum(frame.life_s)
        return total

    depths, flows = (jnp.asarray(np.stack(each)) for each in zip(*frames, strict=True))
    found = np.asarray(gradient(flows, depths))
    assert np.isfinite(found).all()
    assert np.abs(found[1:]).max() > 0
    np.testing.assert_array_equal(found[0], 0)


@pytest.mark.parametrize("settings", [{"num_segments": 80}, {"num_segments": 2}, {"num_segments": 12}])
def test_degenerate_frames_give_defined_and_finite_segments(settings: dict) -> None:
    tracker = SegmentTracker(segmenter=Segmenter(side_m=0.1, min_side_px=3, **settings))
    frames = list(_random_scene(6, 6))
    shape = frames[0][0].shape
    nothing, still = np.zeros(shape, np.float32), np.zeros((*shape, 2), np.float32)
    camera = _camera(shape[0], shape[1], 50.0)
    far = np.full_like(still, 1e9)
    sequence = [(nothing, still), *frames[:3], (frames[3][0], far), (nothing, still), frames[4], (frames[5][0], still)]
    out = _run(tracker, camera, sequence)
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
    assert float(out[6].area[1:].sum()) > 0  # after a blank frame blocks again
    if tracker.segmenter.num_segments < 80:
        assert sum(int(frame.num_unplaced) for frame in out) > 0


def test_a_step_between_frames_at_one_time_changes_no_label() -> None:
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=80, side_m=0.1, min_side_px=3))
    depth, flow = next(_random_scene(7, 1))
    camera, still = _camera(depth.shape[0], depth.shape[1], 50.0), np.zeros_like(flow)
    first, second = _run(tracker, camera, [(depth, still)] * 2, dt=0.0)
    kept = np.asarray(first.labels) > 0
    assert (np.asarray(first.labels) == np.asarray(second.labels))[kept].mean() > 0.95
    np.testing.assert_allclose(second.increment_m, 0, atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_segments": 1}, "num_segments is 1; expected at least 2"),
        ({"max_side_px": 2}, "max_side_px is 2; expected at least min_side_px, 4"),
        ({"side_m": 0.0}, "side_m is 0.0; expected a positive value"),
        ({"depth_weight": -1.0}, "depth_weight is -1.0; expected at least 0"),
        ({"min_pixels": 0}, "min_pixels is 0; expected an integer of at least 1"),
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
