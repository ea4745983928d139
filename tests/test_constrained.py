"""Constrained parameters: the value they hold, and that no step of an optimizer leaves the constraint."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.core.constrained import Fraction, Positive


@pytest.mark.parametrize("value", [1e-30, 0.064, 1.0, 4.0, 1e30])
def test_a_positive_value_comes_back(value):
    parameter = Positive(value)
    assert parameter.unconstrained.dtype == jnp.float32
    assert float(parameter.value) == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("value", [1e-9, 0.04, 0.5, 0.999])
def test_a_fraction_comes_back(value):
    parameter = Fraction(value)
    assert parameter.unconstrained.dtype == jnp.float32
    assert float(parameter.value) == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("value", [0.0, -1.0, 1e-60, 1e60, float("nan"), float("inf")])
def test_values_that_are_not_positive_are_refused(value):
    with pytest.raises(ValueError, match="expected"):
        Positive(value)


@pytest.mark.parametrize("value", [0.0, 1.0, -0.1, 1.5, float("nan")])
def test_values_that_are_no_fraction_are_refused(value):
    with pytest.raises(ValueError, match="strictly between 0 and 1"):
        Fraction(value)


@pytest.mark.parametrize("step", [-50.0, -1.0, 1.0, 50.0])
def test_no_step_leaves_the_constraint(step):
    positive, fraction = jax.tree.map(lambda leaf: leaf + step, (Positive(0.2), Fraction(0.04)))
    assert 0 < float(positive.value) < np.inf
    assert 0 <= float(fraction.value) <= 1


def test_the_gradient_is_that_of_the_transformation():
    gradient = eqx.filter_grad(lambda pair: pair[0].value + pair[1].value)((Positive(0.2), Fraction(0.04)))
    assert float(gradient[0].unconstrained) == pytest.approx(0.2, rel=1e-5)
    assert float(gradient[1].unconstrained) == pytest.approx(0.04 * 0.96, rel=1e-5)
    assert len(jax.tree.leaves(gradient)) == 2  # one array each: nothing else to learn
