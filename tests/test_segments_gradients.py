"""Segments under transformations: compiled and eager steps, and gradients in depth and flow."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from segments_scenes import ANTENNAS_M, DT_S, pinhole, random_scene, scalar

from tagjax.tagattention.segments import Segmenter, SegmentTracker
from tagjax.tagattention.segments.increments import segment_motion
from tagjax.tracing.tracer import Camera


def test_compiled_and_eager_steps_agree() -> None:
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=80, side_m=0.1, min_side_px=3))
    frames = list(random_scene(3, 4))
    shape = frames[0][0].shape
    camera = pinhole(shape[0], shape[1], 50.0)
    eager = compiled = tracker.init(camera)
    step = eqx.filter_jit(tracker.step)
    for depth, flow in frames:
        given = jnp.asarray(depth), jnp.asarray(flow), scalar(DT_S)
        with jax.disable_jit():  # loops and branches as well: eager ones are compiled anew at each step
            eager, one = tracker.step(camera, eager, *given)
        compiled, two = step(camera, compiled, *given)
        np.testing.assert_array_equal(one.labels, two.labels)
        np.testing.assert_array_equal(one.source, two.source)
        np.testing.assert_allclose(one.increment_m, two.increment_m, atol=1e-6)


def test_gradients_of_increments_with_frozen_labels(gradients_agree) -> None:
    rng, (height, width) = np.random.default_rng(4), (5, 6)
    labels = rng.integers(0, 4, (height, width)).astype(np.int32)
    counted = rng.random((height, width)) < 0.9
    rays = np.asarray(pinhole(height, width, 8.0).rays)
    depth, last = (1.0 + 0.002 * rng.normal(size=(height, width)) for _ in range(2))
    last[1, 2], last[3, 4] = 0.0, 1.6  # missing; another surface
    flow = rng.choice([-0.7, -0.3, 0.2, 0.6, 1.3], (height, width, 2))

    def motion(flow_px, depth_m, last_depth_m):
        camera = Camera(jnp.asarray(rays, flow_px.dtype), jnp.asarray(ANTENNAS_M, flow_px.dtype))
        found = segment_motion(
            camera, jnp.asarray(labels), jnp.asarray(counted), depth_m, last_depth_m, flow_px, jnp.asarray(0.5, flow_px.dtype), 5
        )  # fmt: skip
        return jnp.concatenate([found.increment_m, found.motion_m.T])

    gradients_agree(motion, (flow, depth, last))
    assert np.abs(np.asarray(motion(*(jnp.asarray(a, jnp.float32) for a in (flow, depth, last))))).max() > 1e-3


def test_gradients_through_whole_steps_reach_flow_and_depth_alone_and_stay_finite() -> None:
    tracker = SegmentTracker(segmenter=Segmenter(num_segments=80, side_m=0.1, min_side_px=3))
    frames = list(random_scene(5, 3))
    shape = frames[0][0].shape
    camera = pinhole(shape[0], shape[1], 50.0)

    @eqx.filter_jit
    @jax.grad
    def gradient(flows, depths):
        def step(state, pictures):
            depth, flow = pictures
            state, frame = tracker.step(camera, state, depth, flow, scalar(DT_S))
            sums = (frame.increment_m, frame.displacement_m, frame.centre_m, frame.life_s)
            return state, sum(jnp.sum(each) for each in sums)

        return jnp.sum(jax.lax.scan(step, tracker.init(camera), (depths, flows))[1])

    depths, flows = (jnp.asarray(np.stack(each)) for each in zip(*frames, strict=True))
    found = np.asarray(gradient(flows, depths))
    assert np.isfinite(found).all()
    assert np.abs(found[1:]).max() > 0
    np.testing.assert_array_equal(found[0], 0)
