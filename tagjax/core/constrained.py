"""Constrained learnable parameters: Modules that hold an unconstrained array and return the value in physical units.

An optimizer moves the unconstrained array, and no value that it can take leaves the constraint. The constraint is part of
the parameter's type, so no list of names is kept.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .parameters import check_positive


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
