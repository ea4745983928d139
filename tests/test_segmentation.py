"""Segments, cut, centre and box against closed forms, SciPy and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.cluster.vq import kmeans2

from tagjax.tagattention import segmentation

# Compiled as a whole: as single operations most of the time would go into compiling each.
segment = jax.jit(segmentation.segment, static_argnames=("cell", "num_iterations"))
bounding_box, cdf_corner, min_max, pool, unpool = map(
    jax.jit,
    (segmentation.bounding_box, segmentation.cdf_corner, segmentation.min_max, segmentation.pool, segmentation.unpool),
)


def _two_planes(height=24, width=32, edge=13):
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    z = np.where(x < edge, 1.0, 2.5)
    return jnp.asarray(np.stack([0.01 * x * z, 0.01 * y * z, z], axis=-1).astype(np.float32))


def test_shares_sum_to_one_on_valid_pixels_only():
    points = _two_planes()
    valid = jnp.ones((24, 32), dtype=bool).at[3, 4].set(False)
    segments = segment(points, valid, jnp.asarray(0.05), cell=8)
    total = jnp.sum(segments.share, axis=0)
    np.testing.assert_allclose(total, valid.astype(jnp.float32), atol=1e-5)
    np.testing.assert_allclose(jnp.sum(segments.weight), 24 * 32 - 1, rtol=1e-4)


def test_hard_segments_do_not_cross_a_depth_edge():
    points = _two_planes()
    segments = segment(points, jnp.ones((24, 32), dtype=bool), jnp.asarray(1e-3), cell=8, num_iterations=5)
    near = (points[..., 2] < 2.0).astype(jnp.float32)
    mean, _ = pool(segments, near[..., None], jnp.ones((24, 32)))
    alive = np.asarray(segments.weight) > 0.5
    purity = np.asarray(mean[..., 0])[alive]
    assert np.all((purity < 1e-3) | (purity > 1 - 1e-3))


def test_hard_segments_are_the_kmeans_of_scipy_where_all_seeds_are_neighbours():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(16, 24, 3)).astype(np.float32)
    points[:, :8] += 5.0
    points[:, 16:] -= 5.0
    cell = 8
    seeds = points.reshape(2, cell, 3, cell, 3).mean(axis=(1, 3)).reshape(-1, 3)
    # Seeds of opposite columns are no neighbours, but lie too far apart to be chosen.
    expected, labels = kmeans2(points.reshape(-1, 3), seeds, iter=8, minit="matrix")
    segments = segment(
        jnp.asarray(points), jnp.ones((16, 24), dtype=bool), jnp.asarray(1e-4), cell=cell, num_iterations=8
    )
    means, mass = pool(segments, jnp.asarray(points), jnp.ones((16, 24)))
    np.testing.assert_allclose(np.asarray(means).reshape(-1, 3), expected, atol=2e-3)
    np.testing.assert_array_equal(np.round(np.asarray(mass).reshape(-1)), np.bincount(labels, minlength=6))


def test_pool_then_unpool_of_a_constant_is_the_constant():
    segments = segment(_two_planes(), jnp.ones((24, 32), dtype=bool), jnp.asarray(0.05), cell=8)
    mean, _ = pool(segments, jnp.full((24, 32, 2), 3.0), jnp.ones((24, 32)))
    np.testing.assert_allclose(unpool(segments, mean), 3.0, rtol=1e-4)


def test_pool_and_unpool_are_adjoint():
    rng = np.random.default_rng(1)
    segments = segment(_two_planes(20, 27, 11), jnp.ones((20, 27), dtype=bool), jnp.asarray(0.1), cell=6)
    pixels = jnp.asarray(rng.normal(size=(20, 27, 1)).astype(np.float32))
    grid = jnp.asarray(rng.normal(size=(*segments.weight.shape, 1)).astype(np.float32))
    mean, mass = pool(segments, pixels, jnp.ones((20, 27)))
    np.testing.assert_allclose(
        jnp.sum(mean * mass[..., None] * grid), jnp.sum(pixels * unpool(segments, grid)), rtol=1e-3
    )


@pytest.mark.ci
def test_segmentation_survives_a_frame_without_depth_and_its_gradient_too():
    nothing = jnp.zeros((16, 16), dtype=bool)

    def total(points):
        segments = segment(points, nothing, jnp.asarray(0.05), cell=8)
        mean, _ = pool(segments, points, nothing.astype(points.dtype))
        return jnp.sum(unpool(segments, mean))

    value, gradient = jax.value_and_grad(total)(jnp.zeros((16, 16, 3)))
    assert float(value) == 0.0
    assert bool(jnp.isfinite(gradient).all())


@pytest.mark.ci
def test_temperature_gradient_agrees_with_finite_differences(gradients_agree):
    points = np.asarray(_two_planes(8, 8, 3))

    def pooled(temperature):
        here = jnp.asarray(points, temperature.dtype)
        segments = segment(here, jnp.ones((8, 8), dtype=bool), temperature, cell=4, num_iterations=2)
        return segments.share

    with jax.enable_x64(True):
        moved = [pooled(jnp.asarray(0.3 + d)) for d in (-1e-5, 1e-5)]
        numeric = float(jnp.sum(moved[1] ** 2) - jnp.sum(moved[0] ** 2)) / 2e-5
        exact = float(jax.grad(lambda t: jnp.sum(pooled(t) ** 2))(jnp.asarray(0.3)))
    # Cells and their sums are kept in float32.
    np.testing.assert_allclose(exact, numeric, rtol=2e-2)


def test_min_max_spans_0_to_1_over_valid_pixels():
    value = jnp.asarray([[1.0, 3.0], [5.0, 100.0]])
    valid = jnp.asarray([[True, True], [True, False]])
    np.testing.assert_allclose(min_max(value, valid), [[0.0, 0.5], [1.0, 0.0]])
    assert float(jnp.abs(min_max(jnp.ones((2, 2)), valid)).max()) == 0.0
    assert bool(jnp.isfinite(jax.grad(lambda v: min_max(v, jnp.zeros((2, 2), bool)).sum())(value)).all())


@pytest.mark.parametrize("object_level", [0.4, 0.7, 0.9])
def test_last_corner_lies_between_background_and_object(object_level):
    rng = np.random.default_rng(0)
    background = np.clip(np.abs(rng.normal(0.0, 0.05, 900)), 0, 0.15)
    thing = np.clip(rng.normal(object_level, 0.004, 100), 0, 1)
    probability = jnp.asarray(np.concatenate([background, thing]).astype(np.float32)[None])
    cut = float(cdf_corner(probability, jnp.ones((1, 1000), bool), jnp.asarray(0.02), jnp.asarray(1e-5)))
    assert background.max() < cut < object_level
    kept = np.asarray(probability[0]) > cut
    assert kept[:900].sum() == 0
    assert kept[900:].mean() > 0.75


def test_corner_moves_smoothly_and_defaults_to_one_half():
    probability = jnp.asarray(np.random.default_rng(0).uniform(size=(20, 20)).astype(np.float32))
    valid = jnp.ones((20, 20), bool)
    gradient = jax.grad(lambda p: cdf_corner(p, valid, jnp.asarray(0.01), jnp.asarray(0.01)))(probability)
    assert bool(jnp.isfinite(gradient).all())
    assert float(jnp.abs(gradient).max()) > 0
    np.testing.assert_allclose(cdf_corner(probability, valid, jnp.asarray(0.9), jnp.asarray(1e-4)), 0.5, atol=1e-4)


def test_box_of_a_binary_mask_is_exact():
    mask = jnp.zeros((20, 30)).at[5:11, 7:19].set(1.0)
    np.testing.assert_array_equal(bounding_box(mask), [7, 5, 18, 10])
    np.testing.assert_array_equal(bounding_box(mask.at[19, 29].set(1.0)), [7, 5, 29, 19])
    np.testing.assert_array_equal(bounding_box(mask.at[:].set(1.0)), [0, 0, 29, 19])
    np.testing.assert_array_equal(bounding_box(jnp.zeros((4, 4))), jnp.zeros(4))
