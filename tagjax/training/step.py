"""One training step: the gradient through the whole tracer, clipped and guarded, then the update.

The gradient is the mean over a step's clips. One device takes them one after the other (gradient accumulation: memory
is that of one clip); several devices take as many at a time, each a clip of its own; several processes do so each with
their share and exchange gradients, not clips. Clips that run together have equal shapes, because one compiled program
runs on all devices; those of other shapes (more tags, another camera) form groups of their own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float, PyTree, UInt32

from ..core.compilation import large_program
from ..tracing.tracer import AbstractTracer, Camera, Frame
from .devices import AXIS, copied_here, mesh_here, spread_here
from .joint import Flow, JointModel, network_flow
from .loss import ObjectiveSettings, objective
from .processes import mean_over_processes
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


Model = AbstractTracer | JointModel
"""What is trained: a tracer, alone or with the flow network that it sees with."""


def make_joint_optimizer(
    tracer: optax.GradientTransformation, network: optax.GradientTransformation
) -> optax.GradientTransformation:
    """One optimiser for the tracer of a `JointModel`, another for its flow network."""

    def labels(learnable: JointModel) -> JointModel:
        parts = {"tracer": learnable.tracer, "network": learnable.network}
        told = {name: jax.tree.map(lambda _, name=name: name, part) for name, part in parts.items()}
        return JointModel(told["tracer"], told["network"], learnable.weight, learnable.loss)

    return optax.partition({"tracer": tracer, "network": network}, labels)


@large_program()
def clip_gradient(
    model: Model, camera: Camera, frames: Frame, key: Array, settings: ObjectiveSettings
) -> tuple[PyTree, dict[str, Float[Array, ""]]]:
    """Gradient of the weighted objective of one clip, each term's value, and with `term_norms` its gradient's norm.

    Of a `JointModel` the norm of a term is that of its gradient by the tracer's parameters; a second one is by the flow.
    """
    return _clip_gradient(model, camera, frames, key, settings)


def _clip_gradient(
    model: Model, camera: Camera, frames: Frame, key: Array, settings: ObjectiveSettings
) -> tuple[PyTree, dict[str, Float[Array, ""]]]:
    if not isinstance(model, JointModel):
        (gradient, _), logged = _term_gradients(model, None, camera, frames, key, settings)
        return gradient, logged
    learnable, rest = eqx.partition(model.network, eqx.is_inexact_array)

    def see(learnable: PyTree) -> tuple[tuple[Flow, Array], dict[str, Array]]:
        flow, loss, terms = network_flow(eqx.combine(learnable, rest), frames, model.loss)
        return (flow, loss), terms

    (flow, loss), pull, terms = jax.vjp(see, learnable, has_aux=True)
    # Each term goes back to the flow by itself, and their sum through the network: once, however many there are.
    (gradient, by_flow), logged = _term_gradients(model.tracer, flow, camera, frames, key, settings)
    (by_network,) = pull((by_flow, jnp.asarray(model.weight, loss.dtype)))
    logged |= {**terms, "flow": loss, "loss": logged["loss"] + model.weight * loss}
    logged["gradient_norm/network"] = optax.tree.norm(by_network)
    return JointModel(gradient, by_network, model.weight, model.loss), logged


def _term_gradients(
    tracer: AbstractTracer,
    flow: Flow | None,
    camera: Camera,
    frames: Frame,
    key: Array,
    settings: ObjectiveSettings,
) -> tuple[tuple[PyTree, Flow | None], dict[str, Float[Array, ""]]]:
    """Gradient of the weighted terms by the tracer and, where it is given, by the flow; and what there is to log.

    Backwards in time is most of the work: it is done once, or once a term where each term's norm is asked for.
    """
    learnable, rest = eqx.partition(tracer, eqx.is_inexact_array)
    weights = settings.weights()

    def terms(inputs: tuple[PyTree, Flow | None]) -> tuple[dict[str, Array], dict[str, Array]]:
        learnable, flow = inputs
        seen = frames if flow is None else flow.given_to(frames)
        return objective(eqx.combine(learnable, rest), camera, seen, key, settings)

    values, pull, diagnostics = jax.vjp(terms, (learnable, flow), has_aux=True)
    logged = {**diagnostics, **values}
    share = {name: jnp.asarray(weight, values[name].dtype) for name, weight in weights.items()}
    if settings.term_norms:
        # One batched pull-back of all terms: compiled once, however many there are.
        names = list(weights)
        chosen = {name: jnp.asarray([float(other == name) for other in names], share[name].dtype) for name in names}
        (gradients,) = jax.vmap(pull)(chosen)
        for number, name in enumerate(names):
            by_tracer, by_flow = jax.tree.map(lambda leaf, n=number: leaf[n], gradients)
            logged[f"gradient_norm/{name}"] = optax.tree.norm(by_tracer)
            if flow is not None:
                logged[f"gradient_norm/{name}/flow"] = optax.tree.norm(by_flow)
        weighed = list(weights.values())
        total = jax.tree.map(lambda leaf: jnp.tensordot(jnp.asarray(weighed, leaf.dtype), leaf, axes=1), gradients)
    else:
        (total,) = pull(share)
    logged["loss"] = sum((weight * values[name] for name, weight in weights.items()), start=jnp.zeros(()))
    return total, logged


@large_program()
def _gradients_side_by_side(
    model: Model, camera: Camera, frames: Frame, keys: UInt32[Array, "clip 2"], settings: ObjectiveSettings
) -> tuple[PyTree, dict[str, Float[Array, " clip"]]]:
    """`clip_gradient` of stacked clips, one on each device of this process."""
    arrays, rest = eqx.partition(model, eqx.is_array)

    def on_one(arrays: PyTree, camera: Camera, frames: Frame, key: Array) -> Any:
        # Each device holds one clip: mapped, not vectorised, so that its program is that of a single clip.
        camera, frames, key = jax.tree.map(lambda leaf: leaf[0], (camera, frames, key))
        found = _clip_gradient(eqx.combine(arrays, rest), camera, frames, key, settings)
        return jax.tree.map(lambda leaf: leaf[None], found)

    shared, spread = PartitionSpec(), PartitionSpec(AXIS)
    run = jax.shard_map(
        on_one, mesh=mesh_here(), in_specs=(shared, spread, spread, spread), out_specs=spread, check_vma=False
    )
    return run(arrays, camera, frames, keys)


def _shapes(clip: ClipLike) -> Any:
    leaves, structure = jax.tree.flatten((clip.camera, clip.frames))
    return structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)


def _gradients(
    model: Model, clips: Sequence[ClipLike], keys: Sequence[Array], settings: ObjectiveSettings
) -> Iterator[tuple[PyTree, dict[str, Array]]]:
    """Gradient and numbers of each clip, in no particular order."""
    count = jax.local_device_count()
    if count == 1 or len(clips) == 1:
        for clip, key in zip(clips, keys, strict=True):
            yield clip_gradient(model, clip.camera, clip.frames, key, settings)
        return
    alike: dict[Any, list[int]] = {}
    for number, clip in enumerate(clips):
        alike.setdefault(_shapes(clip), []).append(number)
    everywhere = copied_here(model)
    for numbers in alike.values():
        for start in range(0, len(numbers), count):
            chosen = numbers[start : start + count]
            # Devices for which no clip is left do the last one again, and are not asked.
            filled = [*chosen, *chosen[-1:] * (count - len(chosen))]
            together = jax.tree.map(
                lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]),
                *[(clips[number].camera, clips[number].frames, keys[number]) for number in filled],
            )
            camera, frames, stacked_keys = spread_here(together)
            found = _gradients_side_by_side(everywhere, camera, frames, stacked_keys, settings)
            found = jax.device_put(found, jax.local_devices()[0])
            for place in range(len(chosen)):
                yield jax.tree.map(lambda leaf, place=place: leaf[place], found)


@large_program()
def clip_loss(
    model: Model, camera: Camera, frames: Frame, key: Array, settings: ObjectiveSettings
) -> dict[str, Float[Array, ""]]:
    """Terms, diagnostics and the weighted sum of one clip, without gradients."""
    found: dict[str, Array] = {"loss": jnp.zeros(())}
    if isinstance(model, JointModel):
        flow, own, terms = network_flow(model.network, frames, model.loss)
        model, frames, found = model.tracer, flow.given_to(frames), {**terms, "flow": own, "loss": model.weight * own}
    values, diagnostics = objective(model, camera, frames, key, settings)
    loss = sum((weight * values[name] for name, weight in settings.weights().items()), start=found["loss"])
    return {**found, **diagnostics, **values, "loss": loss}


@eqx.filter_jit
def _apply(
    state: TrainState, gradient: PyTree, loss: Array, optimizer: optax.GradientTransformation
) -> tuple[TrainState, dict[str, Array]]:
    norm = optax.tree.norm(gradient)
    usable = jnp.isfinite(norm) & jnp.isfinite(loss)
    safe = jax.tree.map(lambda g: jnp.where(usable, g, jnp.zeros_like(g)), gradient)
    learnable, rest = eqx.partition(state.model, eqx.is_inexact_array)
    with jax.numpy_dtype_promotion("standard"):  # Optax takes powers of its integer step count
        updates, optimizer_state = optimizer.update(safe, state.optimizer_state, learnable)
    keep = lambda new, old: jnp.where(usable, new, old)  # noqa: E731
    model = eqx.combine(jax.tree.map(keep, optax.apply_updates(learnable, updates), learnable), rest)
    optimizer_state = jax.tree.map(keep, optimizer_state, state.optimizer_state)
    done = TrainState(model, optimizer_state, state.step + 1, state.key)
    return done, {"gradient_norm": norm, "skipped": 1.0 - usable.astype(jnp.float32)}


def train_step(
    state: TrainState,
    clips: Sequence[ClipLike],
    optimizer: optax.GradientTransformation,
    settings: ObjectiveSettings,
) -> tuple[TrainState, dict[str, float]]:
    """One update from the mean gradient over some clips, which may differ in shape.

    All devices share the clips; of several processes each gives its share, as many as the others. A gradient or loss
    that is not finite changes nothing but the step count; `skipped` is then 1.
    """
    if not clips:
        raise ValueError("A training step needs at least one clip.")
    key = state.step_key()
    # A clip's key is that of its place in the whole batch, whichever process or device it falls to.
    first, step = jax.process_index(), jax.process_count()
    keys = [jax.random.fold_in(key, first + step * number) for number in range(len(clips))]
    total, logs = None, []
    for gradient, logged in _gradients(state.model, clips, keys, settings):
        total = gradient if total is None else jax.tree.map(jnp.add, total, gradient)
        logs.append(logged)
    mean = jax.tree.map(lambda leaf: leaf / len(clips), total)
    averaged = {name: sum(log[name] for log in logs) / len(logs) for name in logs[0]}
    mean, averaged = mean_over_processes((mean, averaged))
    state, more = _apply(state, mean, jnp.asarray(averaged["loss"]), optimizer)
    return state, {name: float(value) for name, value in {**averaged, **more}.items()}
