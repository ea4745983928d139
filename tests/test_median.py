"""The median filter against SciPy's, OpenCV's and its own gradient."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import median_filter as scipy_median

from tagjax.image.median import median_filter


@pytest.mark.parametrize("size", [1, 3, 5, 7])
@pytest.mark.parametrize("shape", [(9, 12, 2), (3, 2, 1), (1, 6, 3)])
def test_it_is_scipys(size: int, shape: tuple[int, int, int]) -> None:
    image = np.random.default_rng(size).normal(size=shape).astype(np.float32)
    expected = scipy_median(image, (size, size, 1), mode="nearest")
    np.testing.assert_array_equal(median_filter(jnp.asarray(image), size), expected)
    ties = np.round(image)
    np.testing.assert_array_equal(
        jax.jit(median_filter, static_argnums=1)(jnp.asarray(ties), size),
        scipy_median(ties, (size, size, 1), mode="nearest"),
    )


def test_it_is_opencvs_for_all_pictures_of_a_batch() -> None:
    images = np.random.default_rng(1).normal(size=(3, 20, 17, 2)).astype(np.float32)
    expected = [[cv2.medianBlur(np.ascontiguousarray(image[..., k]), 5) for k in range(2)] for image in images]
    found = jax.vmap(lambda image: median_filter(image, 5))(jnp.asarray(images))
    np.testing.assert_array_equal(found, np.moveaxis(np.asarray(expected), 1, -1))


def test_a_step_stays_and_a_spike_goes() -> None:
    step = np.zeros((12, 12, 1), np.float32)
    step[:, 6:] = 5.0
    spiked = step.copy()
    spiked[4, 3] = 90.0
    np.testing.assert_array_equal(median_filter(jnp.asarray(spiked), 3), step)


def test_the_gradient_goes_to_the_pixels_that_the_medians_are() -> None:
    image = jnp.asarray(np.random.default_rng(2).permutation(7 * 6).reshape(7, 6, 1), jnp.float32)
    weights = jnp.asarray(np.random.default_rng(3).normal(size=(7, 6, 1)), jnp.float32)
    gradient = jax.grad(lambda x: jnp.sum(weights * median_filter(x, 3)))(image)
    medians = np.asarray(median_filter(image, 3)).ravel()
    expected = [np.sum(np.asarray(weights).ravel()[medians == value]) for value in np.asarray(image).ravel()]
    np.testing.assert_allclose(gradient.ravel(), expected, rtol=1e-6, atol=1e-6)
    flat = jax.grad(lambda x: jnp.sum(weights * median_filter(x, 5)))(jnp.zeros((7, 6, 1)))
    np.testing.assert_allclose(jnp.sum(flat), jnp.sum(weights), rtol=1e-5)


@pytest.mark.parametrize("size", [0, 2, -3])
def test_an_even_size_is_refused(size: int) -> None:
    with pytest.raises(ValueError, match="expected an odd number"):
        median_filter(jnp.zeros((4, 4, 1)), size)
