"""Connected segments against SciPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from tagjax.tagattention.segments.connection import GAP, connected, reached, touching


def cloud(seed: int):
    """The middles and sizes of 150 segments in a cubic metre, four in five of them members."""
    rng = np.random.default_rng(seed)
    centre, size = rng.uniform(0, 1, (150, 3)), rng.uniform(0.05, 0.2, 150) / GAP
    apart = np.linalg.norm(centre[:, None] - centre[None], axis=-1)
    touch = apart < 0.5 * GAP * (size[:, None] + size[None])
    return jnp.asarray(centre, jnp.float32), jnp.asarray(size, jnp.float32), touch, rng.random(150) < 0.8


@pytest.mark.parametrize("seed", range(4))
def test_components_are_those_of_scipy(seed: int):
    centre, size, touch, member = cloud(seed)
    np.testing.assert_array_equal(touching(centre, size), touch)
    _, expected = connected_components(touch & member[:, None] & member[None], directed=False)
    found = np.asarray(connected(jnp.asarray(touch), jnp.asarray(member)))
    np.testing.assert_array_equal(found[:, None] == found[None], expected[:, None] == expected[None])
    starts = np.array([0, 40, 149])
    of_starts = jax.vmap(lambda start: reached(jnp.asarray(touch), jnp.asarray(member), start))(jnp.asarray(starts))
    for start, own in zip(starts, np.asarray(of_starts), strict=True):
        with_start = member | (np.arange(150) == start)
        _, label = connected_components(touch & with_start[:, None] & with_start[None], directed=False)
        np.testing.assert_array_equal(own, (label == label[start]) & with_start)


def test_long_chains():
    centre, every = jnp.zeros((100, 3)).at[:, 0].set(jnp.arange(100.0)), jnp.ones(100, bool)
    touch = touching(centre, jnp.full(100, 1.5 / GAP))
    np.testing.assert_array_equal(connected(touch, every), 99)
    np.testing.assert_array_equal(reached(touch, every, jnp.asarray(50)), np.abs(np.arange(100) - 50) <= 16)
