"""One training step: the gradient through the whole tracer, clipped and guarded, then the update.

The gradient is the mean over a step's clips. One device computes them one after the other (gradient accumulation: memory
is that of one clip); several devices compute one clip each at the same time; several processes each do so with their
part of the clips and exchange gradients, not clips. Clips that run together have equal shapes, because one compiled
program runs on all devices; clips of other shapes (more tags, another camera) form separate groups.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
from .devices import AXIS, local_mesh, replicate_locally, shard_locally
from .hindsight import FilmedFrames, HindsightSettings, PieceFrames
from .joint import Flow, JointModel, network_flow
from .objective import ObjectiveSettings, objective
from .optimizers import guarded_update
from .processes import mean_over_processes
from .state import TrainState

Frames = Frame | PieceFrames | FilmedFrames
"""What a sample consists of."""


@runtime_checkable
class ClipLike(Protocol):
    """The part of a clip that a step needs."""

    @property
    def camera(self) -> Camera: ...

    @property
    def frames(self) -> Frames: ...


Objective = ObjectiveSettings | HindsightSettings
"""What is learned: from clips, or from hindsight (pieces of recordings)."""


def objective_terms(
    tracer: AbstractTracer, camera: Camera, frames: Frames, key: Array, settings: Objective
) -> tuple[dict[str, Float[Array, ""]], dict[str, Array]]:
    """Every term that has a weight, unweighted, and diagnostics, of one clip or piece."""
    if isinstance(settings, HindsightSettings):
        assert not isinstance(frames, Frame)
        return settings.terms(tracer, camera, frames)
    assert isinstance(frames, Frame)
    return objective(tracer, camera, frames, key, settings)


def make_optimizer(inner: optax.GradientTransformation, clip_norm: float) -> optax.GradientTransformation:
    """The given optimiser behind a clip of the gradient's global norm."""
    if clip_norm <= 0:
        raise ValueError(f"clip_norm is {clip_norm}; expected a positive bound of the gradient's global norm.")
    return optax.chain(optax.clip_by_global_norm(clip_norm), inner)


Model = AbstractTracer | JointModel
"""A trained model: a tracer, alone or with the flow network that gives its flow."""


def make_joint_optimizer(
    tracer: optax.GradientTransformation, network: optax.GradientTransformation
) -> optax.GradientTransformation:
    """One optimiser for the tracer of a `JointModel`, another for its flow network."""

    def labels(learnable: JointModel) -> JointModel:
        parts = {"tracer": learnable.tracer, "network": learnable.network}
        labelled = {name: jax.tree.map(lambda _, name=name: name, part) for name, part in parts.items()}
        return JointModel(labelled["tracer"], labelled["network"], learnable.weight, learnable.loss)

    return optax.partition({"tracer": tracer, "network": network}, labels)


@large_program()
def clip_gradient(
    model: Model, camera: Camera, frames: Frames, key: Array, settings: Objective
) -> tuple[PyTree, dict[str, Float[Array, ""]]]:
    """Gradient of the weighted objective of one clip, each term's value, and with `term_norms` its gradient's norm.

    For a `JointModel` a term's norm is that of its gradient by the tracer's parameters; a second norm is by the flow.
    """
    return _clip_gradient(model, camera, frames, key, settings)


def _clip_gradient(
    model: Model, camera: Camera, frames: Frames, key: Array, settings: Objective
) -> tuple[PyTree, dict[str, Float[Array, ""]]]:
    bounded = settings.bounded if isinstance(settings, HindsightSettings) else lambda gradient: gradient
    if not isinstance(model, JointModel):
        (gradient, _), logged = _term_gradients(model, None, camera, frames, key, settings)
        return bounded(gradient), logged
    assert not isinstance(frames, PieceFrames)
    learnable, static = eqx.partition(model.network, eqx.is_inexact_array)

    def compute_flow(learnable: PyTree) -> tuple[tuple[Flow, Array], dict[str, Array]]:
        flow, loss, terms = network_flow(eqx.combine(learnable, static), frames, model.own_loss)
        return (flow, loss), terms

    (flow, loss), pull, terms = jax.vjp(compute_flow, learnable, has_aux=True)
    # Each term is differentiated to the flow separately, and their sum once through the network.
    (gradient, by_flow), logged = _term_gradients(model.tracer, flow, camera, frames, key, settings)
    (by_network,) = pull((by_flow, jnp.asarray(model.weight, loss.dtype)))
    logged |= {**terms, "flow": loss, "loss": logged["loss"] + model.weight * loss}
    logged["gradient_norm/network"] = optax.tree.norm(by_network)
    return JointModel(bounded(gradient), by_network, model.weight, model.loss), logged


def _term_gradients(
    tracer: AbstractTracer,
    flow: Flow | None,
    camera: Camera,
    frames: Frames,
    key: Array,
    settings: Objective,
) -> tuple[tuple[PyTree, Flow | None], dict[str, Float[Array, ""]]]:
    """Gradient of the weighted terms by the tracer and, where it is given, by the flow; and the values to log.

    The backward pass through time is most of the work: it runs once, or once per term with `term_norms`.
    """
    learnable, static = eqx.partition(tracer, eqx.is_inexact_array)
    weights = settings.weights()

    def terms(inputs: tuple[PyTree, Flow | None]) -> tuple[dict[str, Array], dict[str, Array]]:
        learnable, flow = inputs
        given = frames if flow is None or isinstance(frames, PieceFrames) else flow.replace_in(frames)
        return objective_terms(eqx.combine(learnable, static), camera, given, key, settings)

    values, pull, diagnostics = jax.vjp(terms, (learnable, flow), has_aux=True)
    logged = {**diagnostics, **values}
    cotangents = {name: jnp.asarray(weight, values[name].dtype) for name, weight in weights.items()}
    if settings.term_norms:
        # One batched pull-back of all terms, compiled once for any number of them.
        names = list(weights)
        chosen = {
            name: jnp.asarray([float(other == name) for other in names], cotangents[name].dtype) for name in names
        }
        (gradients,) = jax.vmap(pull)(chosen)
        for number, name in enumerate(names):
            by_tracer, by_flow = jax.tree.map(lambda leaf, n=number: leaf[n], gradients)
            logged[f"gradient_norm/{name}"] = optax.tree.norm(by_tracer)
            if flow is not None:
                logged[f"gradient_norm/{name}/flow"] = optax.tree.norm(by_flow)
        factors = list(weights.values())
        total = jax.tree.map(lambda leaf: jnp.tensordot(jnp.asarray(factors, leaf.dtype), leaf, axes=1), gradients)
    else:
        (total,) = pull(cotangents)
    logged["loss"] = sum((weight * values[name] for name, weight in weights.items()), start=jnp.zeros(()))
    return total, logged


@large_program()
def _gradients_side_by_side(
    model: Model, camera: Camera, frames: Frames, keys: UInt32[Array, "clip 2"], settings: Objective
) -> tuple[PyTree, dict[str, Float[Array, " clip"]]]:
    """`clip_gradient` of stacked clips, one on each device of this process."""
    arrays, static = eqx.partition(model, eqx.is_array)

    def on_one(arrays: PyTree, camera: Camera, frames: Frames, key: Array) -> Any:
        # Each device holds one clip: mapped, not vectorised, so that it runs the program of a single clip.
        camera, frames, key = jax.tree.map(lambda leaf: leaf[0], (camera, frames, key))
        result = _clip_gradient(eqx.combine(arrays, static), camera, frames, key, settings)
        return jax.tree.map(lambda leaf: leaf[None], result)

    replicated, sharded = PartitionSpec(), PartitionSpec(AXIS)
    run = jax.shard_map(
        on_one, mesh=local_mesh(), in_specs=(replicated, sharded, sharded, sharded), out_specs=sharded, check_vma=False
    )
    return run(arrays, camera, frames, keys)


def _shapes(clip: ClipLike) -> Any:
    leaves, structure = jax.tree.flatten((clip.camera, clip.frames))
    return structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)


def _gradients(
    model: Model, clips: Sequence[ClipLike], keys: Sequence[Array], settings: Objective
) -> Iterator[tuple[PyTree, dict[str, Array]]]:
    """Gradient and logged values of each clip, in no particular order."""
    count = jax.local_device_count()
    if count == 1 or len(clips) == 1:
        for clip, key in zip(clips, keys, strict=True):
            yield clip_gradient(model, clip.camera, clip.frames, key, settings)
        return
    alike: dict[Any, list[int]] = {}
    for number, clip in enumerate(clips):
        alike.setdefault(_shapes(clip), []).append(number)
    replicated = replicate_locally(model)
    for numbers in alike.values():
        for start in range(0, len(numbers), count):
            chosen = numbers[start : start + count]
            # Devices without a clip repeat the last one, and their result is ignored.
            filled = [*chosen, *chosen[-1:] * (count - len(chosen))]
            together = jax.tree.map(
                lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]),
                *[(clips[number].camera, clips[number].frames, keys[number]) for number in filled],
            )
            camera, frames, stacked_keys = shard_locally(together)
            results = _gradients_side_by_side(replicated, camera, frames, stacked_keys, settings)
            results = jax.device_put(results, jax.local_devices()[0])
            for place in range(len(chosen)):
                yield jax.tree.map(lambda leaf, place=place: leaf[place], results)


@large_program()
def clip_loss(
    model: Model, camera: Camera, frames: Frames, key: Array, settings: Objective
) -> dict[str, Float[Array, ""]]:
    """Terms, diagnostics and the weighted sum of one clip, without gradients."""
    terms: dict[str, Array] = {"loss": jnp.zeros(())}
    if isinstance(model, JointModel):
        assert not isinstance(frames, PieceFrames)
        flow, own_loss, flow_terms = network_flow(model.network, frames, model.own_loss)
        model, frames, terms = (
            model.tracer,
            flow.replace_in(frames),
            {**flow_terms, "flow": own_loss, "loss": model.weight * own_loss},
        )
    values, diagnostics = objective_terms(model, camera, frames, key, settings)
    loss = sum((weight * values[name] for name, weight in settings.weights().items()), start=terms["loss"])
    return {**terms, **diagnostics, **values, "loss": loss}


def known_mean(values: Sequence[Array]) -> Float[Array, ""]:
    """The mean of the values that are not NaN; NaN without any."""
    return jnp.nanmean(jnp.stack([jnp.asarray(value) for value in values]))


def mean_logs(logs: Sequence[Mapping[str, Array]]) -> dict[str, Float[Array, ""]]:
    """The mean of each value that samples log, over those that have it. A loss that is not finite stays so."""
    means = {name: known_mean([log[name] for log in logs]) for name in logs[0]}
    return {**means, "loss": jnp.mean(jnp.stack([log["loss"] for log in logs]))}


@eqx.filter_jit
def _apply(
    state: TrainState, gradient: PyTree, loss: Array, optimizer: optax.GradientTransformation
) -> tuple[TrainState, dict[str, Array]]:
    learnable, static = eqx.partition(state.model, eqx.is_inexact_array)
    learnable, optimizer_state, _, logged = guarded_update(optimizer, gradient, loss, state.optimizer_state, learnable)
    return TrainState(eqx.combine(learnable, static), optimizer_state, state.step + 1, state.key), logged


def train_step(
    state: TrainState,
    clips: Sequence[ClipLike],
    optimizer: optax.GradientTransformation,
    settings: Objective,
) -> tuple[TrainState, dict[str, float]]:
    """One update from the mean gradient over some clips, which may differ in shape.

    The clips are distributed over all devices; each process passes the same number of clips. A gradient or loss that is
    not finite changes nothing but the step count; `skipped` is then 1.
    """
    if not clips:
        raise ValueError("A training step needs at least one clip.")
    key = state.step_key()
    # A clip's key follows from its index in the whole batch, whichever process or device computes it.
    first, step = jax.process_index(), jax.process_count()
    keys = [jax.random.fold_in(key, first + step * number) for number in range(len(clips))]
    total, logs = None, []
    for gradient, logged in _gradients(state.model, clips, keys, settings):
        total = gradient if total is None else jax.tree.map(jnp.add, total, gradient)
        logs.append(logged)
    mean = jax.tree.map(lambda leaf: leaf / len(clips), total)
    mean, averaged = mean_over_processes((mean, mean_logs(logs)))
    state, more = _apply(state, mean, jnp.asarray(averaged["loss"]), optimizer)
    return state, {name: float(value) for name, value in {**averaged, **more}.items()}
