"""State and update of flow training: the loss of a batch, the optimiser, and a running average of the weights."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PyTree, UInt32

from ..core.compilation import large_program
from ..flow.loss_terms import crop_margin_px, occluded, self_supervision_term
from ..flow.losses import FlowLossSettings, distillation_term, level_terms, sequence_terms, total_loss
from ..flow.network import AbstractFlowNetwork, Levels, flow_both_ways
from .devices import check_batch, replicate, shard
from .optimizers import guarded_update


class FlowTrainState(eqx.Module):
    """Network, the running average of its weights (which is saved), optimiser state, and number of steps done."""

    network: AbstractFlowNetwork
    average: AbstractFlowNetwork
    optimizer_state: PyTree
    step: Int[Array, ""]
    key: UInt32[Array, " 2"]

    @classmethod
    def create(
        cls, network: AbstractFlowNetwork, optimizer: optax.GradientTransformation, *, seed: int
    ) -> FlowTrainState:
        """The state before the first step."""
        learnable = eqx.filter(network, eqx.is_inexact_array)
        copy = jax.tree.map(lambda leaf: jnp.array(leaf) if eqx.is_array(leaf) else leaf, network)
        return cls(network, copy, optimizer.init(learnable), jnp.zeros((), jnp.int32), jax.random.PRNGKey(seed))


def pair_terms(
    network: AbstractFlowNetwork,
    clean: Float[Array, "2 rows columns 3"],
    augmented: Float[Array, "2 height width 3"],
    mask_occluded: Float[Array, ""],
    settings: FlowLossSettings,
    *,
    self_supervise: bool,
) -> dict[str, Float[Array, ""]]:
    """Terms of the loss of one pair, in both directions: flow of the augmented images, evaluated on the clean images.

    The clean images may extend beyond the augmented ones by the same margin at every side.
    """
    forward, backward = flow_both_ways(network, augmented[0], augmented[1])
    terms = terms_both_ways(forward, backward, clean, augmented.shape[1:3], mask_occluded, settings)
    if not self_supervise:
        return {**terms, "self_supervision": jnp.zeros(())}
    border = settings.self_supervision_border_px
    small = augmented[:, border:-border, border:-border]
    there, back = flow_both_ways(network, small[0], small[1])
    parts = [
        self_supervision_term(
            mine[-1], whole[-1], occluded(mine[-1], other[-1]), occluded(whole[-1], whole_other[-1]), border
        )
        for mine, other, whole, whole_other in ((there, back, forward, backward), (back, there, backward, forward))
    ]
    return {**terms, "self_supervision": (parts[0] + parts[1]) / 2}


def terms_both_ways(
    forward: Levels,
    backward: Levels,
    clean: Float[Array, "2 rows columns 3"],
    size: tuple[int, ...],
    mask_occluded: Float[Array, ""],
    settings: FlowLossSettings,
) -> dict[str, Float[Array, ""]]:
    """Terms for flow of the central (height, width) `size` part of two images; the mean of both directions."""
    margin, (height, width) = crop_margin_px(size, clean.shape[1:3]), size
    middle = clean[:, margin : margin + height, margin : margin + width]
    terms_of = sequence_terms if settings.sequence_decay > 0 else level_terms
    # Mapped, not written twice: less to compile.
    ways = [jax.tree.map(lambda *way: jnp.stack(way), *order) for order in ((forward, backward), (backward, forward))]
    both = jax.vmap(lambda there, back, here, other: terms_of(there, back, here, other, mask_occluded, settings))
    return jax.tree.map(jnp.mean, both(ways[0], ways[1], middle, clean[::-1]))


def batch_loss(
    network: AbstractFlowNetwork,
    clean: Float[Array, "batch 2 rows columns 3"],
    augmented: Float[Array, "batch 2 height width 3"],
    step: Int[Array, ""],
    settings: FlowLossSettings,
    *,
    self_supervise: bool,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Mean loss over a batch, and its terms. Pictures are in [0, 1]; `self_supervise` adds the self-supervision term."""
    mask_occluded = (step >= settings.occlusion_after).astype(jnp.float32)
    one = jax.vmap(lambda c, s: pair_terms(network, c, s, mask_occluded, settings, self_supervise=self_supervise))
    terms = jax.tree.map(jnp.mean, one(clean, augmented))
    begun = (step - settings.self_supervision_after).astype(jnp.float32)
    ramp = jnp.clip(begun / max(settings.self_supervision_ramp, 1), 0.0, 1.0)
    terms["self_supervision"] = ramp * terms["self_supervision"]
    return total_loss(terms, settings), terms


def distillation_loss(
    network: AbstractFlowNetwork,
    augmented: Float[Array, "batch 2 height width 3"],
    teacher_px: Float[Array, "batch height width 2"],
    settings: FlowLossSettings,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Mean over a batch of `distillation_term`, first to second image: the whole loss of a student network."""

    def one(pair: Array, flow_px: Array) -> Array:
        return distillation_term(network.decode(network.encode(pair[0]), network.encode(pair[1])), flow_px, settings)

    value = jnp.mean(jax.vmap(one)(augmented, teacher_px))
    return value, {"distillation": value}


@large_program(level=1, donate="all-except-first")
def _update(
    samples: dict[str, Array],
    state: FlowTrainState,
    optimizer: optax.GradientTransformation,
    settings: FlowLossSettings,
    average_over: float,
    self_supervise: bool,
) -> tuple[FlowTrainState, dict[str, Array]]:
    clean, augmented = (samples[name].astype(jnp.float32) / 255 for name in ("clean", "augmented"))
    learnable, static = eqx.partition(state.network, eqx.is_inexact_array)

    def loss(learnable: PyTree) -> tuple[Array, dict[str, Array]]:
        network = eqx.combine(learnable, static)
        if "flow_px" in samples:
            return distillation_loss(network, augmented, samples["flow_px"], settings)
        return batch_loss(network, clean, augmented, state.step, settings, self_supervise=self_supervise)

    (value, terms), gradient = jax.value_and_grad(loss, has_aux=True)(learnable)
    learnt, optimizer_state, usable, logged = guarded_update(
        optimizer, gradient, value, state.optimizer_state, learnable
    )
    # The average starts as the mean of all steps, so that the influence of the first weights decays quickly.
    done = state.step.astype(jnp.float32)
    weight = jnp.maximum(1 / average_over, 1 / (done + 1))
    averaged, _ = eqx.partition(state.average, eqx.is_inexact_array)
    averaged = jax.tree.map(lambda a, b: jnp.where(usable, a + weight * (b - a), a), averaged, learnt)
    after = FlowTrainState(
        eqx.combine(learnt, static),
        eqx.combine(averaged, static),
        optimizer_state,
        state.step + 1,
        state.key,
    )
    return after, {**terms, "loss": value, **logged}


def flow_step(
    state: FlowTrainState,
    samples: Sequence[dict[str, np.ndarray]],
    optimizer: optax.GradientTransformation,
    settings: FlowLossSettings,
    average_over: float,
) -> tuple[FlowTrainState, dict[str, float]]:
    """One update on a batch of augmented pairs: by distillation where they hold a teacher's flow.

    A loss or gradient that is not finite changes nothing but the step count.

    The batch is sharded over all devices, and its size must be a multiple of their number; each process passes its own
    part.
    """
    if not samples:
        raise ValueError("A training step needs at least one pair.")
    check_batch(len(samples) * jax.process_count())
    batch = {name: shard(jnp.asarray(np.stack([sample[name] for sample in samples]))) for name in samples[0]}
    # Chosen here, not by a condition on the device: inside one, XLA's CPU backend takes ten times as long a step.
    self_supervise = settings.self_supervision > 0 and int(state.step) > settings.self_supervision_after
    state, numbers = _update(batch, replicate(state), optimizer, settings, average_over, self_supervise)
    return state, {name: float(value) for name, value in numbers.items()}
