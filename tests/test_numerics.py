"""Elementary functions against NumPy's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from tagjax.core.numerics import cos_sin


def test_cos_sin_is_numpys():
    angle = np.concatenate([np.linspace(-20, 20, 4001), [0.0, np.pi, -np.pi, 3 * np.pi, 1e4, -1e4]]).astype(np.float32)
    cos, sin = jax.jit(cos_sin)(jnp.asarray(angle))
    assert cos.dtype == sin.dtype == jnp.float32
    np.testing.assert_allclose(cos, np.cos(angle.astype(float)), atol=1e-6)
    np.testing.assert_allclose(sin, np.sin(angle.astype(float)), atol=1e-6)


def test_the_derivatives_of_cos_sin_are_minus_sin_and_cos():
    angle = np.linspace(-9, 9, 101)
    with jax.enable_x64(True):
        at = jnp.asarray(angle)
        cos, sin = jax.jvp(jax.jit(cos_sin), (at,), (jnp.ones_like(at),))[1]
    np.testing.assert_allclose(cos, -np.sin(angle), atol=1e-9)
    np.testing.assert_allclose(sin, np.cos(angle), atol=1e-9)
