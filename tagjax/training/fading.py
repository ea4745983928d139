"""Gradients that fade into the past.

A recurrent tracer multiplies gradients from frame to frame; without fading, those of the first frames dominate all others.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _faded(leaf: Array, memory: float) -> Array:
    del memory
    return leaf


@_faded.defjvp
def _(memory: float, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return primals[0], memory * tangents[0]


def faded(state: PyTree, memory: float) -> PyTree:
    """The state itself; gradients with respect to its floats are multiplied by `memory`, 0 to 1."""
    floats = lambda leaf: jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)  # noqa: E731
    return jax.tree.map(lambda leaf: _faded(leaf, memory) if floats(leaf) else leaf, state)
