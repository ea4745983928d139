"""State and update of flow training: the unsupervised loss of a batch, Adam, and a running average of the weights."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PyTree, UInt32

from ..core.compilation import large_program
from ..flow.losses import (
    FlowLossSettings,
    imitation_term,
    level_terms,
    margin_of,
    occluded,
    sequence_terms,
    teaching_term,
    weighted,
)
from ..flow.network import AbstractFlowNetwork, Levels, flow_both_ways
from .devices import check_batch, copied, spread


class FlowTrainState(eqx.Module):
    """Network, the running average of its weights (which is what is kept), optimiser state, and steps done."""

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
    seen: Float[Array, "2 height width 3"],
    hide: Float[Array, ""],
    settings: FlowLossSettings,
    *,
    teach: bool,
) -> dict[str, Float[Array, ""]]:
    """Terms of the loss of one pair, both ways: flow from the varied pictures, held against the clean ones.

    The clean pictures may reach beyond the varied ones, alike at every side.
    """
    forward, backward = flow_both_ways(network, seen[0], seen[1])
    terms = terms_both_ways(forward, backward, clean, seen.shape[1:3], hide, settings)
    if not teach:
        return {**terms, "teaching": jnp.zeros(())}
    border = settings.self_supervision_border_px
    small = seen[:, border:-border, border:-border]
    there, back = flow_both_ways(network, small[0], small[1])
    parts = [
        teaching_term(mine[-1], whole[-1], occluded(mine[-1], other[-1]), occluded(whole[-1], whole_other[-1]), border)
        for mine, other, whole, whole_other in ((there, back, forward, backward), (back, there, backward, forward))
    ]
    return {**terms, "teaching": (parts[0] + parts[1]) / 2}


def terms_both_ways(
    forward: Levels,
    backward: Levels,
    clean: Float[Array, "2 rows columns 3"],
    size: tuple[int, ...],
    hide: Float[Array, ""],
    settings: FlowLossSettings,
) -> dict[str, Float[Array, ""]]:
    """Terms of estimates for the middle of two pictures, a part of (height, width) `size`; the mean of both ways."""
    margin, (height, width) = margin_of(size, clean.shape[1:3]), size
    middle = clean[:, margin : margin + height, margin : margin + width]
    terms_of = sequence_terms if settings.sequence_decay > 0 else level_terms
    # Mapped, not written twice: less to compile.
    ways = [jax.tree.map(lambda *way: jnp.stack(way), *order) for order in ((forward, backward), (backward, forward))]
    both = jax.vmap(lambda there, back, here, other: terms_of(there, back, here, other, hide, settings))
    return jax.tree.map(jnp.mean, both(ways[0], ways[1], middle, clean[::-1]))


def batch_loss(
    network: AbstractFlowNetwork,
    clean: Float[Array, "batch 2 rows columns 3"],
    seen: Float[Array, "batch 2 height width 3"],
    step: Int[Array, ""],
    settings: FlowLossSettings,
    *,
    teach: bool,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Mean loss over a batch, and its terms. Pictures are 0 to 1; `teach` once the teacher has begun."""
    hide = (step >= settings.occlusion_after).astype(jnp.float32)
    one = jax.vmap(lambda c, s: pair_terms(network, c, s, hide, settings, teach=teach))
    found = jax.tree.map(jnp.mean, one(clean, seen))
    begun = (step - settings.self_supervision_after).astype(jnp.float32)
    ramp = jnp.clip(begun / max(settings.self_supervision_ramp, 1), 0.0, 1.0)
    found["teaching"] = ramp * found["teaching"]
    return weighted(found, settings), found


def imitation_loss(
    network: AbstractFlowNetwork,
    seen: Float[Array, "batch 2 height width 3"],
    teacher_px: Float[Array, "batch height width 2"],
    settings: FlowLossSettings,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Mean over a batch of `imitation_term`, first to second picture; it is the whole loss of a student."""

    def one(pair: Array, flow_px: Array) -> Array:
        return imitation_term(network.decode(network.encode(pair[0]), network.encode(pair[1])), flow_px, settings)

    value = jnp.mean(jax.vmap(one)(seen, teacher_px))
    return value, {"imitation": value}


@large_program(level=1, donate="all-except-first")
def _update(
    samples: dict[str, Array],
    state: FlowTrainState,
    optimizer: optax.GradientTransformation,
    settings: FlowLossSettings,
    average_over: float,
    teach: bool,
) -> tuple[FlowTrainState, dict[str, Array]]:
    clean, seen = (samples[name].astype(jnp.float32) / 255 for name in ("clean", "seen"))
    learnable, rest = eqx.partition(state.network, eqx.is_inexact_array)

    def loss(learnable: PyTree) -> tuple[Array, dict[str, Array]]:
        network = eqx.combine(learnable, rest)
        if "flow_px" in samples:
            return imitation_loss(network, seen, samples["flow_px"], settings)
        return batch_loss(network, clean, seen, state.step, settings, teach=teach)

    (value, terms), gradient = jax.value_and_grad(loss, has_aux=True)(learnable)
    norm = optax.tree.norm(gradient)
    usable = jnp.isfinite(norm) & jnp.isfinite(value)
    safe = jax.tree.map(lambda g: jnp.where(usable, g, jnp.zeros_like(g)), gradient)
    with jax.numpy_dtype_promotion("standard"):  # Optax takes powers of its integer step count
        updates, optimizer_state = optimizer.update(safe, state.optimizer_state, learnable)
    keep = lambda new, old: jnp.where(usable, new, old)  # noqa: E731
    learnt = jax.tree.map(keep, optax.apply_updates(learnable, updates), learnable)
    # The average begins as the mean of all steps, so that the first weights are soon forgotten.
    done = state.step.astype(jnp.float32)
    share = jnp.maximum(1 / average_over, 1 / (done + 1))
    averaged, _ = eqx.partition(state.average, eqx.is_inexact_array)
    averaged = jax.tree.map(lambda a, b: a + share * (b - a), averaged, learnt)
    after = FlowTrainState(
        eqx.combine(learnt, rest),
        eqx.combine(averaged, rest),
        jax.tree.map(keep, optimizer_state, state.optimizer_state),
        state.step + 1,
        state.key,
    )
    numbers = {**terms, "loss": value, "gradient_norm": norm, "skipped": 1.0 - usable.astype(jnp.float32)}
    return after, numbers


def flow_step(
    state: FlowTrainState,
    samples: Sequence[dict[str, np.ndarray]],
    optimizer: optax.GradientTransformation,
    settings: FlowLossSettings,
    average_over: float,
) -> tuple[FlowTrainState, dict[str, float]]:
    """One update on a batch of `vary`'s pairs: towards the teacher's flow where they have it.

    A loss or gradient that is not finite changes nothing but the count.

    All devices share the batch, whose size must be a multiple of theirs; of several processes each gives its share.
    """
    if not samples:
        raise ValueError("A training step needs at least one pair.")
    check_batch(len(samples) * jax.process_count())
    batch = {name: spread(jnp.asarray(np.stack([sample[name] for sample in samples]))) for name in samples[0]}
    # Chosen here, not by a condition on the device: inside one, XLA's CPU backend takes ten times as long a step.
    teach = settings.self_supervision > 0 and int(state.step) > settings.self_supervision_after
    state, numbers = _update(batch, copied(state), optimizer, settings, average_over, teach)
    return state, {name: float(value) for name, value in numbers.items()}
