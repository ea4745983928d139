"""What training carries from step to step."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int, PyTree, UInt32

from ..tracer import AbstractTracer


@runtime_checkable
class Stepped(Protocol):
    """Any training state: it knows how many steps were done."""

    @property
    def step(self) -> Int[Array, ""]: ...


class TrainState(eqx.Module):
    """Tracer, optimiser state, number of steps done, and the key from which every step's own key is folded."""

    tracer: AbstractTracer
    optimizer_state: PyTree
    step: Int[Array, ""]
    key: UInt32[Array, " 2"]

    @classmethod
    def create(cls, tracer: AbstractTracer, optimizer: optax.GradientTransformation, *, seed: int) -> TrainState:
        """The state before the first step. Every inexact array of the tracer is learned."""
        learnable = eqx.filter(tracer, eqx.is_inexact_array)
        if not jax.tree.leaves(learnable):
            raise ValueError(
                f"{type(tracer).__name__} holds no learnable array, so there is nothing to train. Evaluate it as it is."
            )
        return cls(tracer, optimizer.init(learnable), jnp.zeros((), jnp.int32), jax.random.PRNGKey(seed))

    def step_key(self) -> UInt32[Array, " 2"]:
        """The key of the step about to be done: a function of seed and step only, so that resuming is exact."""
        return jax.random.fold_in(self.key, self.step)
