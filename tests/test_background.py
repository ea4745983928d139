"""The memory of the still background: what replaces what, what comes back, and what stands in front."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from tagjax.tagattention.background import empty_background, in_front, is_background, remember


def _full(value: float) -> jnp.ndarray:
    return jnp.full((2, 3), value)


VALID = jnp.ones((2, 3), dtype=bool)


def test_a_passer_by_is_not_remembered_and_the_wall_comes_back():
    background = empty_background(1, 2, 3)
    assert not is_background(background, _full(3.0), VALID).any()
    np.testing.assert_array_equal(in_front(background, _full(3.0), VALID), 0.0)
    background = remember(background, _full(3.0), VALID, jnp.full((1, 2, 3), -4.0))
    person = _full(2.0)
    np.testing.assert_array_equal(in_front(background, person, VALID), 1.0)
    after = remember(background, person, VALID, jnp.full((1, 2, 3), 7.0))
    np.testing.assert_array_equal(after.distance_m, background.distance_m)
    np.testing.assert_array_equal(after.log_odds, -4.0)
    assert is_background(after, _full(3.02), VALID).all()
    np.testing.assert_array_equal(in_front(after, _full(3.02), VALID), -1.0)


def test_a_farther_surface_takes_the_place_of_a_nearer_one():
    """A bag that stood there from the start was the background, until it is taken away."""
    background = remember(empty_background(1, 2, 3), _full(2.0), VALID, jnp.zeros((1, 2, 3)))
    background = remember(background, _full(3.0), VALID, jnp.full((1, 2, 3), -1.0))
    np.testing.assert_array_equal(background.distance_m, 3.0)
    np.testing.assert_array_equal(in_front(background, _full(2.0), VALID), 1.0)


def test_noise_is_averaged_and_missing_depth_ignored():
    rng = np.random.default_rng(0)
    background = empty_background(1, 2, 3)
    for _ in range(200):
        noisy = jnp.asarray(4.0 + rng.normal(0, 0.02, (2, 3)), jnp.float32)
        background = remember(background, noisy, VALID, jnp.zeros((1, 2, 3)))
    np.testing.assert_allclose(background.distance_m, 4.0, atol=0.025)
    hole = remember(background, _full(0.0), ~VALID, jnp.ones((1, 2, 3)))
    np.testing.assert_array_equal(hole.distance_m, background.distance_m)
    np.testing.assert_array_equal(hole.log_odds, background.log_odds)
    np.testing.assert_array_equal(in_front(hole, _full(0.0), ~VALID), 0.0)
