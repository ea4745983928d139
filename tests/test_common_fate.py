"""Common fate: the shared way, the evidence that rests on it, and what it makes of two things with one distance."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic_clips as synthetic
from scipy.spatial.transform import Rotation

from tagjax.core.geometry import pixel_rays
from tagjax.recording import Intrinsics
from tagjax.tagattention import TagAttention
from tagjax.tagattention.common_fate import common_fate, fate_attention, shared_shift
from tagjax.tagattention.motion import empty_places, push_places
from tagjax.tracing.tracer import Camera, Frame, trace

SPREAD, SLACK, FLOOR = 0.015, 0.25, 0.02
THING, ARM = np.array([0.03, -0.05, 0.02]), np.array([-0.04, 0.06, 0.02])


def _evidence(shift_m, known, log_odds, spread=SPREAD, slack=SLACK, floor=FLOOR):
    spread, slack, floor = (jnp.asarray(value, shift_m.dtype) for value in (spread, slack, floor))
    return common_fate(shift_m, known, log_odds, spread_m=spread, slack=slack, floor=floor)


def _two_parts(rng, dtype=np.float32):
    """4 x 6 segments: four columns come with the thing, two with the arm, by some millimetres' noise."""
    shift = np.where(np.arange(6)[None, :, None] < 4, THING, ARM) + rng.normal(0, 0.002, (4, 6, 3))
    return shift.astype(dtype), np.full((4, 6), 16.0, dtype), np.full((4, 6), 3.0, dtype)


def test_the_common_motion_is_that_of_the_majority_not_the_mean():
    shift, known, _ = _two_parts(np.random.default_rng(0))
    shared = shared_shift(jnp.asarray(shift), jnp.asarray(known), jnp.asarray(SPREAD), jnp.asarray(SLACK))
    np.testing.assert_allclose(shared, shift[:, :4].mean(axis=(0, 1)), atol=1e-3)
    assert np.linalg.norm(shift.mean(axis=(0, 1)) - THING) > 0.03
    nothing = shared_shift(jnp.asarray(shift), jnp.zeros((4, 6)), jnp.asarray(SPREAD), jnp.asarray(SLACK))
    np.testing.assert_array_equal(nothing, np.zeros(3))


def test_evidence_is_the_log_of_the_attention_above_its_floor():
    shift, known, log_odds = _two_parts(np.random.default_rng(1))
    found = np.asarray(_evidence(*map(jnp.asarray, (shift, known, log_odds))))
    shared = shift[:, :4].mean(axis=(0, 1))
    variance = SPREAD**2 + SLACK**2 * np.sum(shared**2)
    attention = np.exp(-np.sum((shift - shared) ** 2, axis=-1) / (2 * variance))
    np.testing.assert_allclose(found, np.log((attention + FLOOR) / (1 + FLOOR)), atol=0.02)
    assert (found <= 0).all()
    np.testing.assert_allclose(found[:, 4:], np.log(FLOOR / (1 + FLOOR)), atol=1e-3)
    np.testing.assert_allclose(
        fate_attention(jnp.asarray(shift), jnp.asarray(THING, jnp.float32), jnp.asarray(SPREAD), jnp.asarray(SLACK)),
        np.exp(-np.sum((shift - THING) ** 2, -1) / (2 * (SPREAD**2 + SLACK**2 * np.sum(THING**2)))),
        atol=1e-5,
    )


def test_no_direction_is_special():
    """Unlike a distance's change, which is what lies along the line of sight."""
    shift, known, log_odds = _two_parts(np.random.default_rng(2))
    turned = (Rotation.from_rotvec([0.4, -1.1, 0.7]).apply(shift.reshape(-1, 3)).reshape(shift.shape)).astype(
        np.float32
    )
    one, other = (_evidence(*map(jnp.asarray, (way, known, log_odds))) for way in (shift, turned))
    np.testing.assert_allclose(one, other, atol=1e-3)


def test_the_best_segments_form_the_object():
    """The arm is larger here; but the tag's radio speaks for the thing."""
    shift, known, log_odds = _two_parts(np.random.default_rng(3))
    log_odds[:, :2] += 6.0
    shift[:, 2:4] = shift[:, 4:]
    found = np.asarray(_evidence(*map(jnp.asarray, (shift, known, log_odds))))
    assert found[:, :2].min() > -0.1
    assert found[:, 2:].max() < -3.0


def test_what_is_not_known_is_not_judged():
    shift, known, log_odds = _two_parts(np.random.default_rng(4))
    known[1, 5], log_odds[1, 5] = 0.0, 50.0
    found = np.asarray(_evidence(*map(jnp.asarray, (shift, known, log_odds))))
    assert found[1, 5] == 0.0
    assert found[0, 5] < -3.0
    np.testing.assert_array_equal(
        _evidence(jnp.asarray(shift), jnp.zeros((4, 6)), jnp.asarray(log_odds)), np.zeros((4, 6))
    )


def test_gradients_are_those_of_finite_differences(gradients_agree):
    """By every argument of the attention; of the evidence by its settings; and finite where nothing moves."""
    shift, known, log_odds = _two_parts(np.random.default_rng(5), np.float64)
    gradients_agree(fate_attention, (shift, THING, SPREAD, SLACK))
    with jax.enable_x64(True):
        parts = [jnp.asarray(part) for part in (shift, known, log_odds)]
        settings = [jnp.asarray(value, jnp.float64) for value in (SPREAD, SLACK, FLOOR)]
        total = jax.jit(lambda way, *three: jnp.sum(_evidence(way, *parts[1:], *three)))
        by_each = jax.grad(total, argnums=(0, 1, 2, 3))
        # The mode moves with the kernel, too, which no gradient goes through: too little to show here.
        for number, gradient in enumerate(by_each(parts[0], *settings)[1:]):
            step = 1e-4 * settings[number]
            ends = [
                total(parts[0], *(s + sign * step if i == number else s for i, s in enumerate(settings)))
                for sign in (1, -1)
            ]
            np.testing.assert_allclose(gradient, (ends[0] - ends[1]) / (2 * step), rtol=1e-3)
        for gradient in by_each(jnp.zeros_like(parts[0]), *settings):
            assert bool(jnp.isfinite(gradient).all())


def test_jit_is_eager_and_vmap_a_loop():
    parts = [_two_parts(np.random.default_rng(seed)) for seed in (7, 8)]
    stacked = [jnp.asarray(np.stack(leaves)) for leaves in zip(*parts, strict=True)]
    together = jax.jit(jax.vmap(_evidence))(*stacked)
    for number, part in enumerate(parts):
        np.testing.assert_allclose(together[number], _evidence(*map(jnp.asarray, part)), atol=1e-5)


def _rays(height: int, width: int, focal_px: float) -> np.ndarray:
    return pixel_rays(Intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height))


def test_places_follow_a_plane_in_space():
    """2 px a frame to the right, and 3 cm towards the camera: each pixel's place over the window, in closed form."""
    rays, window = _rays(10, 40, 400.0), 4
    places, depths = empty_places(10, 40, window), 2.0 - 0.03 * np.arange(window)
    flow = jnp.broadcast_to(jnp.asarray([-2.0, 0.0]), (10, 40, 2))
    for depth in depths:
        places = push_places(places, flow, jnp.asarray(rays * depth, jnp.float32), jnp.asarray(0.1))
    shift, known = places.shift_m()
    assert bool(known[:, 6:].all())
    assert not bool(known[:, :6].any())
    np.testing.assert_array_equal(shift[:, :6], 0.0)
    before = np.roll(rays, 2 * (window - 1), axis=1)[:, 6:] * depths[0]
    np.testing.assert_allclose(shift[:, 6:], rays[:, 6:] * depths[-1] - before, atol=1e-5)


def _one_distance_two_ways() -> tuple[Camera, Frame, np.ndarray]:
    """A large and a small part side by side whose distances change alike; the small one slides to the right besides."""
    height, width, num_frames = 24, 32, 24
    time_s = np.arange(num_frames) / 10.0
    rays = _rays(height, width, 40.0)
    parts = np.zeros((2, height, width), bool)
    parts[0, 4:20, 4:18] = parts[1, 4:20, 18:26] = True
    range_m = 2.0 + 0.3 * np.cos(2.5 * time_s)
    depth = np.full((num_frames, height, width), 5.0)
    both = parts.any(axis=0)
    depth[:, both] = range_m[:, None] / np.linalg.norm(rays[both], axis=-1)
    flow = np.zeros((num_frames, height, width, 2))
    flow[1:, parts[1], 0] = -2.0
    frames = synthetic.unread_frames(time_s, depth, range_m[None, None], flow)
    return Camera(jnp.asarray(rays), jnp.zeros((1, 3))), frames, parts


@pytest.mark.ci
def test_a_tracer_parts_what_only_the_camera_can():
    """The tag's distance is that of both parts; with common fate the mask keeps to the one that it began with."""
    camera, frames, parts = _one_distance_two_ways()

    def covered(weight):
        tracer = TagAttention(cell=4, alpha_m2=1e-3, prior_weight=3.0, fate_weight=weight)
        return [float(eqx.filter_jit(trace)(tracer, camera, frames).mask[-1, 0][part].mean()) for part in parts]

    without, fate = covered(1e-12), covered(0.5)
    assert min(without) > 0.8
    assert fate[0] > 0.8
    assert fate[1] < 0.3
