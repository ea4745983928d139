"""Learnable parameters by name: stored without bounds, read and given in physical units.

A leaf whose name starts with `log_` holds the logarithm of a positive value, one with `logit_` the log odds of a share
from 0 to 1; any other is the value itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .numerics import logit

_LOG, _LOGIT = "log_", "logit_"

ModuleT = TypeVar("ModuleT", bound=eqx.Module)


def check_positive(**values: float) -> None:
    """Raise `ValueError`, by name, for a value that cannot be kept as its logarithm."""
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name} is {value}; expected a positive value (it is kept as its logarithm).")


def check_shares(**values: float) -> None:
    """Raise `ValueError`, by name, for a value that is no share from 0 to 1."""
    for name, value in values.items():
        if not 0 <= value <= 1:
            raise ValueError(f"{name} is {value}; expected a share from 0 to 1.")


def check_whole(**values: int) -> None:
    """Raise `ValueError`, by name, for what is no whole number of at least 1."""
    for name, value in values.items():
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"{name} is {value!r}; expected a whole number of at least 1.")


def stored_log(value: float) -> Float[Array, ""]:
    """A positive value as it is stored. Raises `ValueError` for any other."""
    if value <= 0:
        raise ValueError(f"A positive value is needed for a parameter kept as its logarithm; found {value}.")
    return jnp.log(jnp.asarray(value, jnp.float32))


def stored_logit(value: float) -> Float[Array, ""]:
    """A share as it is stored, kept 1e-6 away from 0 and 1."""
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
    """The module with these values, named and in the units of `physical`, in place of its own.

    Raises `ValueError` for names that are missing or unknown, and for values that such a parameter cannot have.
    """
    known = physical(module)
    if set(values) != set(known):
        lacking, surplus = sorted(set(known) - set(values)), sorted(set(values) - set(known))
        raise ValueError(f"not these parameters: missing {lacking}, unknown {surplus}.")
    leaves: dict[str, Array] = {}
    for name, leaf in vars(module).items():
        if not isinstance(leaf, jax.Array):
            continue
        if name.startswith(_LOG):
            check_positive(**{name.removeprefix(_LOG): values[name.removeprefix(_LOG)]})
            leaves[name] = stored_log(values[name.removeprefix(_LOG)])
        elif name.startswith(_LOGIT):
            share = values[name.removeprefix(_LOGIT)]
            check_shares(**{name.removeprefix(_LOGIT): share})
            leaves[name] = stored_logit(share)
        else:
            leaves[name] = jnp.asarray(values[name], jnp.float32)
    names = list(leaves)
    return eqx.tree_at(lambda m: [getattr(m, name) for name in names], module, [leaves[name] for name in names])
