"""The static background of segments: against its plain twin, shadows, objects that stand still, and places that they leave."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import segments_numpy as plain
from segments_scenes import DT_S, box_frame, noisy, pinhole, run, scalar

from tagjax.tagattention.segments import Background, Segmenter, SegmentTracker


@pytest.mark.parametrize("seed", range(3))
def test_the_background_is_the_twins(seed: int) -> None:
    rng, shape, focal = np.random.default_rng(seed), (9, 13), 60.0
    model, memory = Background(), plain.Memory(*shape)
    state, step = model.init(*shape), eqx.filter_jit(model.step)
    surfaces, shown = rng.uniform(0.5, 3, (4, *shape)), np.zeros(shape, int)
    num_confirmed, num_front = np.zeros(30, int), np.zeros(30, int)
    for t in range(30):
        shown = np.where(rng.random(shape) < 0.03, rng.integers(0, 4, shape), shown)
        depth = np.take_along_axis(surfaces, shown[None], 0)[0] + rng.normal(0, 0.002, shape) + 0.002 * t
        depth = depth.astype(np.float32)
        valid = rng.random(shape) < 0.95
        flow = (rng.normal(0, 0.5, (*shape, 2)) * (rng.random(shape) < 0.1)[..., None]).astype(np.float32)
        dt = 0.11 + 0.01 * rng.random()
        state, view = step(state, jnp.asarray(depth), jnp.asarray(valid), jnp.asarray(flow), scalar(dt), scalar(focal))
        want = memory.step(depth, valid, flow, dt, focal)
        for name in ("confirmed", "matched", "still", "front", "early", "ripe"):
            np.testing.assert_array_equal(getattr(view, name), want[name], err_msg=f"{name} of frame {t}")
        np.testing.assert_allclose(view.age_s, want["age_s"], atol=1e-4)
        num_confirmed[t], num_front[t] = want["confirmed"].sum(), (want["front"] & want["matched"]).sum()
    np.testing.assert_allclose(
        state.confirmed_m, np.reshape([p["b"] for p in memory.pixels], shape), atol=1e-5
    )  # fmt: skip
    assert num_confirmed[0] == 0
    assert 20 < num_confirmed.max() < 117
    assert 5 < num_front[-1] < 80


def test_a_shadow_on_a_confirmed_floor_is_static() -> None:
    rng, camera = np.random.default_rng(0), pinhole(40, 60, 60.0)
    floor = 1.5 + 0.02 * np.arange(40)[:, None] + np.zeros((40, 60))
    frames = []
    for t in range(110):
        flow = np.zeros((40, 60, 2), np.float32)
        if t >= 50:
            flow[10:26, (t - 50) // 2 : (t - 50) // 2 + 20] = (-1.2, 0.4)
        frames.append((noisy(floor, rng), flow))
    out = run(SegmentTracker(segmenter=Segmenter(num_segments=256)), camera, frames)
    assert (np.asarray(out[30].labels) > 0).mean() > 0.9  # not yet confirmed
    for frame in out[50:]:
        np.testing.assert_array_equal(frame.labels, 0)
        assert float(jnp.max(jnp.abs(frame.increment_m))) == 0


def test_an_object_that_stood_still_for_a_second_keeps_its_segments_when_it_moves() -> None:
    rng, camera = np.random.default_rng(1), pinhole(64, 112, 100.0)
    frames, masks = [], []
    for t in range(60):
        time = max(t - 30, 0) * DT_S
        depth, flow, mask, _ = box_frame(time, DT_S if t > 30 else 0.0, camera)
        frames.append((noisy(depth, rng), flow))
        masks.append(mask)
    out = run(SegmentTracker(segmenter=Segmenter(num_segments=512)), camera, frames)
    first, last = (np.asarray(out[t].labels) for t in (0, -1))
    own = np.unique(first[masks[0]])
    inside = last[masks[-1] & (last >= 0)]
    assert np.isin(inside, own[own > 0]).mean() >= 0.9
    life = np.asarray(out[-1].life_s)[inside]
    assert np.median(life) > 1.9


def test_the_place_where_an_object_stood_is_background_soon_after_it_has_left() -> None:
    rng, camera = np.random.default_rng(2), pinhole(40, 60, 60.0)
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=256))
    step, state = eqx.filter_jit(tracker.step), tracker.init(camera)
    wall, box = np.full((40, 60), 2.0), (slice(12, 28), slice(20, 40))
    still = jnp.zeros((40, 60, 2))
    history = []
    for t in range(125):
        depth = wall.copy()
        if t < 60 or t == 124:
            depth[box] = 1.2
        state, frame = step(camera, state, jnp.asarray(noisy(depth, rng)), still, scalar(DT_S))
        history.append((np.asarray(frame.labels)[box], np.asarray(state.background.confirmed_m)[box]))
    np.testing.assert_array_equal(history[59][0][1:-1, 1:-1], 0)  # confirmed, as part of the scene
    np.testing.assert_allclose(history[59][1], 1.2, atol=5e-3)
    np.testing.assert_array_equal(history[63][1], 0)  # the wall behind shows: the box has left
    np.testing.assert_array_equal(history[123][0], 0)
    np.testing.assert_allclose(history[123][1], 2.0, atol=5e-3)
    assert (history[124][0][1:-1, 1:-1] > 0).all()  # it comes back as something new


def test_a_person_who_walks_away_is_not_taken_for_the_surface_that_was_at_rest_there() -> None:
    model, shape, dt = Background(), (4, 6), 0.1
    state, step = model.init(*shape), eqx.filter_jit(model.step)
    still, valid = jnp.zeros((*shape, 2)), jnp.ones(shape, bool)
    in_front = []
    for t in range(40):
        depth = jnp.full(shape, 3.0 if t < 10 else min(3.0 + 0.1 * (t - 9), 4.5))
        state, view = step(state, depth, valid, still, scalar(dt), scalar(200.0))
        in_front.append(np.asarray(view.front))
    assert np.all(in_front[12:25])
    assert not np.any(in_front[-1])  # the wall at 4.5 m, at rest
    np.testing.assert_allclose(state.rested_m, 4.5, atol=1e-3)
