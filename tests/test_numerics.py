"""Elementary functions against NumPy's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special

from tagjax.core.numerics import cos_sin, log_i0, safe_divide


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


def test_log_i0_is_scipys():
    x = np.array([0.0, 1e-3, 0.5, 3.0, 30.0, 400.0])
    np.testing.assert_allclose(log_i0(jnp.asarray(x, jnp.float32)), np.log(special.i0e(x)) + x, rtol=1e-5, atol=1e-6)


def test_the_derivatives_of_a_quotient_are_those_of_a_quotient():
    numerator, denominator = np.array([0.3, -2.0, 0.0]), np.array([0.7, -0.1, 5.0])
    by_numerator, by_denominator = jax.grad(lambda n, d: jnp.sum(safe_divide(n, d)), argnums=(0, 1))(
        jnp.asarray(numerator, jnp.float32), jnp.asarray(denominator, jnp.float32)
    )
    np.testing.assert_allclose(by_numerator, 1 / denominator, rtol=1e-6)
    np.testing.assert_allclose(by_denominator, -numerator / denominator**2, rtol=1e-6)
    assert jax.grad(safe_divide, argnums=(0, 1))(jnp.ones(()), jnp.zeros(())) == (0.0, 0.0)


def test_the_gradient_of_a_mean_is_finite_with_weights_whose_square_is_below_the_smallest_number():
    weight, value = jnp.array([0.2, 1.0, 0.5]), jnp.array([3.0, -1.0, 2.0])

    def mean(weight: jax.Array) -> jax.Array:
        return safe_divide(weight @ value, jnp.sum(weight))

    scale = 1e-25
    np.testing.assert_allclose(scale * jax.grad(mean)(scale * weight), jax.grad(mean)(weight), rtol=1e-5)
