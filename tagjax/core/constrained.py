"""Constrained learnable parameters: Modules that hold an unconstrained array and return the value in physical units.

An optimizer moves the unconstrained array, and no value that it can take leaves the constraint. The constraint is part of
the parameter's type, so no list of names is kept.
"""

from __future__ import annotations

import dataclasses
import difflib
import fnmatch
import math
import operator
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .parameters import check_positive

_MAX_FLOAT32 = float(np.finfo(np.float32).max)

ModuleT = TypeVar("ModuleT", bound=eqx.Module)


class Positive(eqx.Module):
    """A positive value x, stored as log x: equal steps are equal ratios."""

    unconstrained: Float[Array, "*shape"]

    def __init__(self, value: float) -> None:
        """Raises `ValueError` for a value that is not positive, or is 0 or infinite in float32."""
        check_positive(value=value)
        self.unconstrained = jnp.asarray(math.log(value), jnp.float32)

    @property
    def value(self) -> Float[Array, "*shape"]:
        """The value, in the unit it was given in."""
        return jnp.exp(self.unconstrained)


class Negative(eqx.Module):
    """A negative value x, stored as log(-x): equal steps are equal ratios."""

    unconstrained: Float[Array, "*shape"]

    def __init__(self, value: float) -> None:
        """Raises `ValueError` for a value that is not negative, or is 0 or infinite in float32."""
        if not value < 0:
            raise ValueError(
                f"value is {value}; expected a negative value (it is stored as the logarithm of its amount)."
            )
        check_positive(amount=-value)
        self.unconstrained = jnp.asarray(math.log(-value), jnp.float32)

    @property
    def value(self) -> Float[Array, "*shape"]:
        """The value, in the unit it was given in."""
        return -jnp.exp(self.unconstrained)


class Fraction(eqx.Module):
    """A fraction p strictly between 0 and 1, stored as log odds log(p / (1 - p))."""

    unconstrained: Float[Array, "*shape"]

    def __init__(self, value: float) -> None:
        """Raises `ValueError` for a value that is not strictly between 0 and 1."""
        if not 0.0 < value < 1.0:
            raise ValueError(
                f"value is {value}; expected a fraction strictly between 0 and 1 (it is stored as its log odds). "
                "Give a value such as 1e-6 in place of 0."
            )
        self.unconstrained = jnp.asarray(math.log(value) - math.log1p(-value), jnp.float32)

    @property
    def value(self) -> Float[Array, "*shape"]:
        """The fraction."""
        return jax.nn.sigmoid(self.unconstrained)


Constrained = Positive | Negative | Fraction


def named_values(module: eqx.Module) -> dict[str, float]:
    """The learnable scalars of a module and of the modules in it, in physical units, by dotted name (`body.rigid.noise_m`)."""
    return {name: _value(leaf) for name, leaf in _named(module).items()}


def static_settings(module: eqx.Module) -> dict[str, Any]:
    """The static fields of a module and of the modules in it by dotted name (`body.num_rounds`), tuples as lists.

    A part that is off is None under its own name.
    """
    found: dict[str, Any] = {}
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        if field.metadata.get("static", False) or value is None:
            found[field.name] = list(value) if isinstance(value, tuple) else value
        elif isinstance(value, eqx.Module) and not isinstance(value, Constrained):
            found |= {f"{field.name}.{name}": inner for name, inner in static_settings(value).items()}
    return found


def with_named_values(module: ModuleT, values: Mapping[str, float]) -> ModuleT:
    """The module with these values, with the names and units of `named_values`.

    Raises `ValueError` for missing and unknown names, and for values that the parameter cannot have.
    """
    known = _named(module)
    if set(values) != set(known):
        missing, unknown = sorted(set(known) - set(values)), sorted(set(values) - set(known))
        raise ValueError(f"The names of the parameters differ: missing {missing}, unknown {unknown}.")
    if not known:
        return module
    replaced = []
    for name, leaf in known.items():
        try:
            replaced.append(_like(leaf, values[name]))
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    places = [operator.attrgetter(name) for name in known]
    return eqx.tree_at(lambda m: [place(m) for place in places], module, replaced)


def learning_only(module: ModuleT, patterns: Sequence[str]) -> ModuleT:
    """The module with a gradient for some of its learnable scalars only: those whose dotted names match a pattern (`attention.*`).

    Raises `ValueError` for a pattern that matches no name.
    """
    known = _named(module)
    for pattern in patterns:
        if not fnmatch.filter(known, pattern):
            near = difflib.get_close_matches(pattern, known, 5, 0.0)
            raise ValueError(
                f"{pattern} is no parameter; expected dotted names, or patterns of them such as body.*, of "
                f"{len(known)} parameters, for example: {', '.join(near)}."
            )
    held = [name for name in known if not any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)]
    if not held:
        return module
    places = [operator.attrgetter(name) for name in held]
    return eqx.tree_at(lambda m: [place(m) for place in places], module, replace_fn=jax.lax.stop_gradient)


def _named(module: eqx.Module) -> dict[str, Constrained | Array]:
    """The learnable scalars by dotted name, in the order of the fields."""
    found: dict[str, Constrained | Array] = {}
    for field in dataclasses.fields(module):
        leaf = getattr(module, field.name)
        if isinstance(leaf, Constrained) or (eqx.is_inexact_array(leaf) and leaf.ndim == 0):
            found[field.name] = leaf
        elif isinstance(leaf, eqx.Module):
            found |= {f"{field.name}.{name}": value for name, value in _named(leaf).items()}
    return found


def _value(leaf: Constrained | Array) -> float:
    return float(leaf.value if isinstance(leaf, Constrained) else leaf)


def _like(leaf: Constrained | Array, value: float) -> Constrained | Array:
    if isinstance(leaf, Constrained):
        return type(leaf)(value)
    if not abs(value) <= _MAX_FLOAT32:
        raise ValueError(f"found {reprlib.repr(value)}; expected a value that is finite in float32.")
    return jnp.asarray(value, jnp.float32)
