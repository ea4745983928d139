"""The training state."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int, PyTree, UInt32

from ..tracing.tracer import AbstractTracer
from .joint import JointModel


@runtime_checkable
class HasStep(Protocol):
    """Any training state: it holds the number of steps done."""

    @property
    def step(self) -> Int[Array, ""]: ...


class TrainState(eqx.Module):
    """Model, optimiser state, number of steps done, and the key from which the key of each step is folded.

    `model` is the tracer, alone or in a `JointModel`.
    """

    model: AbstractTracer | JointModel
    optimizer_state: PyTree
    step: Int[Array, ""]
    key: UInt32[Array, " 2"]

    @classmethod
    def create(
        cls, model: AbstractTracer | JointModel, optimizer: optax.GradientTransformation, *, seed: int
    ) -> TrainState:
        """The state before the first step. Every inexact array of the model is learned."""
        learnable = eqx.filter(model, eqx.is_inexact_array)
        if not jax.tree.leaves(learnable):
            raise ValueError(
                f"{type(model).__name__} holds no learnable array, so there is nothing to train. Evaluate it without training."
            )
        return cls(model, optimizer.init(learnable), jnp.zeros((), jnp.int32), jax.random.PRNGKey(seed))

    @property
    def tracer(self) -> AbstractTracer:
        return self.model.tracer if isinstance(self.model, JointModel) else self.model

    def step_key(self) -> UInt32[Array, " 2"]:
        """The key of the next step: a function of seed and step only, so that resuming is exact."""
        return jax.random.fold_in(self.key, self.step)
