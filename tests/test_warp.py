"""Warps against closed forms, OpenCV and finite differences."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from tagjax.image import warp

gather, splat = jax.jit(warp.gather), jax.jit(warp.splat)


def _smooth(shape, seed=0):
    rng = np.random.default_rng(seed)
    blurred = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), 2.0)
    return np.ascontiguousarray(blurred).reshape(shape)


def test_gather_with_zero_flow_is_the_identity():
    image = jnp.asarray(_smooth((12, 17, 3)))
    out, covered = gather(image, jnp.zeros((12, 17, 2)))
    np.testing.assert_array_equal(out, image)
    assert bool(covered.all())


def test_gather_agrees_with_opencv_remap():
    image = _smooth((24, 31))
    flow = 2.0 * _smooth((24, 31, 2), seed=1)
    x, y = np.meshgrid(np.arange(31, dtype=np.float32), np.arange(24, dtype=np.float32))
    target_x, target_y = x + flow[..., 0], y + flow[..., 1]
    inside = (target_x >= 0) & (target_x <= 30) & (target_y >= 0) & (target_y <= 23)
    expected = cv2.remap(image, target_x, target_y, cv2.INTER_LINEAR)
    out, covered = gather(jnp.asarray(image)[..., None], jnp.asarray(flow))
    assert bool(np.asarray(covered)[inside].all())
    # OpenCV rounds the weights of its bilinear remap to 1/32 of a pixel.
    np.testing.assert_allclose(np.asarray(out)[inside, 0], expected[inside], atol=0.03 * np.ptp(image))


def test_gather_outside_the_picture_is_not_covered():
    _, covered = gather(jnp.ones((4, 4, 1)), jnp.full((4, 4, 2), 10.0))
    assert not covered.any()


def test_taps_are_the_four_pixels_around_with_weights_inside_only():
    image = _smooth((5, 6, 2))
    flow = np.random.default_rng(0).uniform(-4, 4, (5, 6, 2)).astype(np.float32)
    flow[0, :3] = [[-1.0, 0.0], [4.0, 0.0], [0.0, 4.0]]  # onto the border and just beyond, in whole pixels
    taps = warp.gather_taps(jnp.asarray(image), jnp.asarray(flow))
    mixed = np.sum([value * weight[..., None] for value, weight in taps], axis=0)
    total = np.sum([weight for _, weight in taps], axis=0)
    for row in range(5):
        for column in range(6):
            x, y = column + flow[row, column, 0], row + flow[row, column, 1]
            u, v = np.meshgrid(np.arange(6), np.arange(5))
            weights = np.clip(1 - np.abs(u - x), 0, None) * np.clip(1 - np.abs(v - y), 0, None)
            np.testing.assert_allclose(total[row, column], weights.sum(), atol=1e-5)
            np.testing.assert_allclose(mixed[row, column], np.tensordot(weights, image, 2), atol=1e-5)


def test_what_moves_nowhere_or_far_away_is_not_covered_and_harms_nothing():
    image = jnp.ones((4, 5, 1)).at[0, 0].set(jnp.nan)
    flow = jnp.zeros((4, 5, 2)).at[2, 2, 0].set(jnp.nan).at[3, 3].set(jnp.inf).at[3, 4].set(-1e20).at[1, 1].set(2e9)
    out, covered = gather(image, flow)
    gone = [(2, 2), (3, 3), (3, 4), (1, 1)]
    assert not any(bool(covered[place]) for place in gone)
    assert not any(float(out[place][0]) for place in gone)
    assert int(covered.sum()) == 20 - len(gone)
    np.testing.assert_array_equal(np.isnan(out), np.isnan(image))


def test_at_whole_pixels_the_gradient_leads_to_the_next():
    image = jnp.asarray(_smooth((4, 6, 1)))
    slope = jax.grad(lambda flow: jnp.sum(gather(image, flow)[0]))(jnp.zeros((4, 6, 2)))
    np.testing.assert_allclose(slope[:, :-1, 0], np.diff(image[..., 0], axis=1), atol=1e-6)
    np.testing.assert_allclose(slope[:-1, :, 1], np.diff(image[..., 0], axis=0), atol=1e-6)


def test_splat_by_whole_pixels_moves_the_image_and_marks_the_hole():
    image = jnp.asarray(_smooth((8, 9, 2)))
    flow = jnp.broadcast_to(jnp.asarray([2.0, -1.0]), (8, 9, 2))
    out, filled = splat(image, flow)
    np.testing.assert_allclose(out[:-1, 2:], image[1:, :-2], atol=1e-6)
    assert bool(filled[:-1, 2:].all())
    assert not filled[-1].any()
    assert not filled[:, :2].any()
    assert float(jnp.abs(out[-1]).max()) == 0.0


def test_splat_conserves_mass_inside():
    """Splat averages, so a pixel's mass is the weight that it receives times its value; none leaves the picture here."""
    rng = np.random.default_rng(3)
    flow = np.pad(rng.uniform(-1, 1, (6, 7, 2)).astype(np.float32), ((2, 2), (2, 2), (0, 0)))
    image = _smooth((10, 11, 1))
    x, y = np.meshgrid(np.arange(11), np.arange(10))
    target_x, target_y = x + flow[..., 0], y + flow[..., 1]
    weight = np.zeros((10, 11))
    expected = np.zeros((10, 11))
    for row in range(10):
        for column in range(11):
            near = np.clip(1 - np.abs(target_x - column), 0, None) * np.clip(1 - np.abs(target_y - row), 0, None)
            weight[row, column] = near.sum()
            expected[row, column] = (near * image[..., 0]).sum()
    out, filled = splat(jnp.asarray(image), jnp.asarray(flow))
    mass = weight * np.asarray(out)[..., 0]
    np.testing.assert_array_equal(np.asarray(filled), weight > 0)
    np.testing.assert_allclose(mass, expected, atol=1e-5)
    np.testing.assert_allclose(mass.sum(), image.sum(), rtol=1e-5)


def test_gradients_agree_with_finite_differences(gradients_agree):
    image = _smooth((5, 6, 2))
    # Off the integers, where bilinear interpolation has its kinks.
    flow = np.random.default_rng(1).uniform(0.2, 0.8, (5, 6, 2))
    gradients_agree(lambda im, f: gather(im, f)[0][1:-2, 1:-2], (image, flow))
    gradients_agree(lambda im, f: splat(im, f)[0], (image, flow))


def test_jit_and_vmap_change_nothing():
    images = jnp.stack([jnp.asarray(_smooth((6, 7, 2), seed)) for seed in range(3)])
    flows = jnp.stack([jnp.asarray(_smooth((6, 7, 2), 10 + seed)) for seed in range(3)])
    for way in (gather, splat):
        looped = jnp.stack([way(im, f)[0] for im, f in zip(images, flows, strict=True)])
        np.testing.assert_allclose(jax.jit(jax.vmap(way))(images, flows)[0], looped, atol=1e-6)
