"""Learnable parameters by name: stored unconstrained, read and set in physical units.

A leaf whose name starts with `log_` holds the logarithm of a positive value, one with `logit_` the log odds of a
fraction from 0 to 1; any other holds the value itself.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .numerics import logit

_LOG, _LOGIT = "log_", "logit_"
_MIN_FLOAT32, _MAX_FLOAT32 = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)

ModuleT = TypeVar("ModuleT", bound=eqx.Module)


def check_positive(**values: float) -> None:
    """Raise `ValueError` with the name of a value that is not positive, or is 0 or infinite in float32."""
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name} is {value}; expected a positive value (it is stored as its logarithm).")
        if not _MIN_FLOAT32 <= value <= _MAX_FLOAT32:
            raise ValueError(
                f"{name} is {reprlib.repr(value)}; expected {_MIN_FLOAT32:g} to {_MAX_FLOAT32:g}, as float32 has."
            )


def check_fractions(**values: float) -> None:
    """Raise `ValueError` with the name of a value that is not a fraction from 0 to 1."""
    for name, value in values.items():
        if not 0 <= value <= 1:
            raise ValueError(f"{name} is {value}; expected a fraction from 0 to 1.")


def check_positive_integers(**values: int) -> None:
    """Raise `ValueError` with the name of a value that is not an integer of at least 1."""
    for name, value in values.items():
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"{name} is {value!r}; expected an integer of at least 1.")


def log_parameter(value: float) -> Float[Array, ""]:
    """The stored logarithm of a positive value. Raises `ValueError` for any other value."""
    if value <= 0:
        raise ValueError(f"The value is {value}; expected a positive value (it is stored as its logarithm).")
    return jnp.log(jnp.asarray(value, jnp.float32))


def logit_parameter(value: float) -> Float[Array, ""]:
    """The stored log odds of a fraction, clipped to 1e-6 from 0 and 1."""
    return jnp.asarray(logit(min(max(value, 1e-6), 1.0 - 1e-6)), jnp.float32)


def physical(module: eqx.Module) -> dict[str, float]:
    """The scalar parameters of a module in physical units, by name."""
    values = {}
    for name, leaf in vars(module).items():
        if isinstance(leaf, jax.Array):
            if name.startswith(_LOG):
                values[name.removeprefix(_LOG)] = float(jnp.exp(leaf))
            elif name.startswith(_LOGIT):
                values[name.removeprefix(_LOGIT)] = float(jax.nn.sigmoid(leaf))
            else:
                values[name] = float(leaf)
    return values


def with_physical(module: ModuleT, values: Mapping[str, float]) -> ModuleT:
    """The module with these values, with the names and units of `physical`.

    Raises `ValueError` for missing and unknown names, and for values that the parameter cannot have.
    """
    known = physical(module)
    if set(values) != set(known):
        missing, unknown = sorted(set(known) - set(values)), sorted(set(values) - set(known))
        raise ValueError(f"The names of the parameters differ: missing {missing}, unknown {unknown}.")
    leaves: dict[str, Array] = {}
    for name, leaf in vars(module).items():
        if not isinstance(leaf, jax.Array):
            continue
        if name.startswith(_LOG):
            check_positive(**{name.removeprefix(_LOG): values[name.removeprefix(_LOG)]})
            leaves[name] = log_parameter(values[name.removeprefix(_LOG)])
        elif name.startswith(_LOGIT):
            fraction = values[name.removeprefix(_LOGIT)]
            check_fractions(**{name.removeprefix(_LOGIT): fraction})
            leaves[name] = logit_parameter(fraction)
        else:
            if not -_MAX_FLOAT32 <= values[name] <= _MAX_FLOAT32:
                raise ValueError(f"{name} is {reprlib.repr(values[name])}; expected a value that is finite in float32.")
            leaves[name] = jnp.asarray(values[name], jnp.float32)
    names = list(leaves)
    return eqx.tree_at(lambda m: [getattr(m, name) for name in names], module, [leaves[name] for name in names])
