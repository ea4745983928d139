"""Constrained parameters: the value they hold, and that no step of an optimizer leaves the constraint."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.core.build import build
from tagjax.core.constrained import (
    Fraction,
    Negative,
    Positive,
    learning_only,
    named_values,
    static_settings,
    with_named_values,
)
from tagjax.core.settings import ConfigError


@pytest.mark.parametrize("value", [1e-30, 0.064, 1.0, 4.0, 1e30])
def test_a_positive_value_comes_back(value):
    parameter = Positive(value)
    assert parameter.unconstrained.dtype == jnp.float32
    assert float(parameter.value) == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("value", [-1e-30, -0.0374, -4.0])
def test_a_negative_value_comes_back(value):
    assert float(Negative(value).value) == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("value", [0.0, 1.0, -1e-60, -1e60, float("nan"), -float("inf")])
def test_values_that_are_not_negative_are_refused(value):
    with pytest.raises(ValueError, match="expected"):
        Negative(value)


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


class Inner(eqx.Module):
    size_m: Positive
    offset: jax.Array
    steps: int = eqx.field(static=True)

    def __init__(self, size_m: float = 0.1, steps: int = 3) -> None:
        self.size_m, self.offset, self.steps = Positive(size_m), jnp.asarray(-1.0), steps


class Outer(eqx.Module):
    inner: Inner | None
    part: Fraction

    def __init__(self, inner: Inner | None = None, part: float = 0.5) -> None:
        self.inner, self.part = inner, Fraction(part)


def test_values_have_dotted_names_and_come_back():
    outer = Outer(Inner())
    values = named_values(outer)
    assert {name: round(value, 6) for name, value in values.items()} == {
        "inner.size_m": 0.1,
        "inner.offset": -1.0,
        "part": 0.5,
    }
    changed = with_named_values(outer, values | {"inner.size_m": 0.2, "inner.offset": 3.0})
    assert named_values(changed)["inner.size_m"] == pytest.approx(0.2)
    assert named_values(changed)["inner.offset"] == 3.0
    assert jax.tree.structure(changed) == jax.tree.structure(outer)
    assert named_values(Outer()) == {"part": 0.5}  # a stage that is off has no parameters
    assert static_settings(outer) == {"inner.steps": 3}
    assert static_settings(Outer()) == {"inner": None}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"part": 0.5}, r"missing \['inner.offset', 'inner.size_m'\]"),
        ({"inner.size_m": 0.1, "inner.offset": 0.0, "part": 0.5, "more": 1.0}, r"unknown \['more'\]"),
        ({"inner.size_m": -0.1, "inner.offset": 0.0, "part": 0.5}, "inner.size_m: value is -0.1"),
        ({"inner.size_m": 0.1, "inner.offset": float("nan"), "part": 0.5}, "inner.offset: found nan"),
        ({"inner.size_m": 0.1, "inner.offset": 1e60, "part": 0.5}, "inner.offset: found 1e"),
    ],
)
def test_other_names_and_impossible_values_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        with_named_values(Outer(Inner()), values)


def test_gradients_reach_the_named_scalars_only():
    def total(module: Outer) -> jax.Array:
        leaves = jax.tree.leaves(eqx.filter(learning_only(module, ["inner.s*", "part"]), eqx.is_inexact_array))
        return sum((jnp.sum(leaf) for leaf in leaves), jnp.zeros(()))

    slopes = eqx.filter_grad(total)(Outer(Inner()))
    assert float(slopes.inner.size_m.unconstrained) == float(slopes.part.unconstrained) == 1.0
    assert float(slopes.inner.offset) == 0.0
    assert named_values(learning_only(Outer(Inner()), ["*"])) == named_values(Outer(Inner()))
    with pytest.raises(ValueError, match=r"inner\.sise_m is no parameter; .*: inner\.size_m, inner\.offset, part\.$"):
        learning_only(Outer(Inner()), ["part", "inner.sise_m"])


def test_a_module_is_built_from_nested_settings():
    built = build({"_target_": "outer", "inner": {"size_m": 0.3}, "part": 0.2}, {"outer": Outer}, where="tracer")
    assert named_values(built)["inner.size_m"] == pytest.approx(0.3)
    assert build({"_target_": "outer", "inner": None}, {"outer": Outer}, where="tracer").inner is None


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"inner": {"sise_m": 1.0}}, "tracer.inner: unknown key sise_m; known keys are size_m, steps"),
        ({"inner": {"size_m": -1.0}}, "tracer.inner: value is -1.0; expected a positive value"),
        ({"inner": {"size_m": "wide"}}, "tracer.inner: "),
        ({"part": 2.0}, "tracer: value is 2.0"),
    ],
)
def test_wrong_nested_settings_are_refused_with_their_path(settings, message):
    with pytest.raises(ConfigError, match=message):
        build({"_target_": "outer", **settings}, {"outer": Outer}, where="tracer")
