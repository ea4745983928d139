"""One training step: gradients of every term through the whole tracer, clipped and guarded, then the update."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PyTree

from ..tracer import AbstractTracer, Camera, Frame
from .loss import ObjectiveSettings, objective
from .state import TrainState


@runtime_checkable
class ClipLike(Protocol):
    """What a step needs of a clip."""

    @property
    def camera(self) -> Camera: ...

    @property
    def frames(self) -> Frame: ...


def make_optimizer(inner: optax.GradientTransformation, clip_norm: float) -> optax.GradientTransformation:
    """The given optimiser behind a clip of the gradient's global norm."""
    if clip_norm <= 0:
        raise ValueError(f"clip_norm is {clip_norm}; expected a positive bound of the gradient's global norm.")
    return optax.chain(optax.clip_by_global_norm(clip_norm), inner)


@eqx.filter_jit
def clip_gradient(
    tracer: AbstractTracer, camera: Camera, frames: Frame, key: Array, settings: ObjectiveSettings
) -> tuple[PyTree, dict[str, Float[Array, ""]]]:
    """Gradient of the weighted objective of one clip, and each term's value and gradient norm."""
    learnable, rest = eqx.partition(tracer, eqx.is_inexact_array)
    weights = settings.weights()

    def terms(learnable: PyTree) -> tuple[dict[str, Array], dict[str, Array]]:
        return objective(eqx.combine(learnable, rest), camera, frames, key, settings)

    values, pull, diagnostics = jax.vjp(terms, learnable, has_aux=True)
    # One batched pull-back of all terms: compiled once, however many there are.
    names = list(weights)
    chosen = {name: jnp.asarray([float(other == name) for other in names], values[name].dtype) for name in names}
    (gradients,) = jax.vmap(pull)(chosen)
    logged = dict(diagnostics)
    for number, name in enumerate(names):
        logged[name] = values[name]
        logged[f"gradient_norm/{name}"] = optax.tree.norm(jax.tree.map(lambda leaf, n=number: leaf[n], gradients))
    share = list(weights.values())
    total = jax.tree.map(lambda leaf: jnp.tensordot(jnp.asarray(share, leaf.dtype), leaf, axes=1), gradients)
    logged["loss"] = sum((weight * values[name] for name, weight in weights.items()), start=jnp.zeros(()))
    return total, logged


@eqx.filter_jit
def clip_loss(
    tracer: AbstractTracer, camera: Camera, frames: Frame, key: Array, settings: ObjectiveSettings
) -> dict[str, Float[Array, ""]]:
    """Terms, diagnostics and the weighted sum of one clip, without gradients."""
    values, diagnostics = objective(tracer, camera, frames, key, settings)
    weights = settings.weights()
    loss = sum((weight * values[name] for name, weight in weights.items()), start=jnp.zeros(()))
    return {**diagnostics, **values, "loss": loss}


@eqx.filter_jit
def _apply(
    state: TrainState, gradient: PyTree, loss: Array, optimizer: optax.GradientTransformation
) -> tuple[TrainState, dict[str, Array]]:
    norm = optax.tree.norm(gradient)
    usable = jnp.isfinite(norm) & jnp.isfinite(loss)
    safe = jax.tree.map(lambda g: jnp.where(usable, g, jnp.zeros_like(g)), gradient)
    learnable, rest = eqx.partition(state.tracer, eqx.is_inexact_array)
    with jax.numpy_dtype_promotion("standard"):  # Optax takes powers of its integer step count
        updates, optimizer_state = optimizer.update(safe, state.optimizer_state, learnable)
    keep = lambda new, old: jnp.where(usable, new, old)  # noqa: E731
    tracer = eqx.combine(jax.tree.map(keep, optax.apply_updates(learnable, updates), learnable), rest)
    optimizer_state = jax.tree.map(keep, optimizer_state, state.optimizer_state)
    done = TrainState(tracer, optimizer_state, state.step + 1, state.key)
    return done, {"gradient_norm": norm, "skipped": 1.0 - usable.astype(jnp.float32)}


def train_step(
    state: TrainState,
    clips: Sequence[ClipLike],
    optimizer: optax.GradientTransformation,
    settings: ObjectiveSettings,
) -> tuple[TrainState, dict[str, float]]:
    """One update from the mean gradient over some clips, which may differ in shape.

    A gradient or loss that is not finite changes nothing but the step count; `skipped` is then 1.
    """
    if not clips:
        raise ValueError("A training step needs at least one clip.")
    key = state.step_key()
    gradients, logs = [], []
    for number, clip in enumerate(clips):
        gradient, logged = clip_gradient(
            state.tracer, clip.camera, clip.frames, jax.random.fold_in(key, number), settings
        )
        gradients.append(gradient)
        logs.append(logged)
    mean: Any = jax.tree.map(lambda *leaves: sum(leaves) / len(leaves), *gradients)
    averaged = {name: sum(log[name] for log in logs) / len(logs) for name in logs[0]}
    state, more = _apply(state, mean, jnp.asarray(averaged["loss"]), optimizer)
    return state, {name: float(value) for name, value in {**averaged, **more}.items()}
