"""Tracer and flow network learned together: the flow is computed inside the objective, whose gradient reaches the network."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

from ..core.settings import ConfigError
from ..flow.estimates import padding
from ..flow.losses import FlowLossSettings, total_loss
from ..flow.network import AbstractFlowNetwork, flow_both_ways
from ..flow.stationary import is_moving
from ..flow.weights import save_weights
from ..tracing.tracer import AbstractTracer, Frame
from .flow_step import terms_both_ways
from .hindsight import FilmedFrames

FramesT = TypeVar("FramesT", bound=Frame | FilmedFrames)


class Flow(eqx.Module):
    """The flow of a clip, as `Frame` holds it."""

    forward_px: Float[Array, "time height width 2"]
    backward_px: Float[Array, "time height width 2"]

    def replace_in(self, frames: FramesT) -> FramesT:
        """The clip with this flow in place of its own."""
        if isinstance(frames, FilmedFrames):
            return eqx.tree_at(lambda f: f.backward_px, frames, self.backward_px)
        return eqx.tree_at(lambda f: (f.forward_px, f.backward_px), frames, (self.forward_px, self.backward_px))


class JointModel(eqx.Module):
    """A tracer, the flow network that gives its flow, and the weight of the network's own loss beside the tracer's objective."""

    tracer: AbstractTracer
    network: AbstractFlowNetwork
    weight: float = eqx.field(static=True)
    loss: FlowLossSettings = eqx.field(static=True)

    @property
    def own_loss(self) -> FlowLossSettings | None:
        """The settings of the network's own loss; None where it has no weight, and is not computed."""
        return self.loss if self.weight > 0 else None


PAIRS_AT_ONCE = 4
"""Pairs of pictures whose flow is computed together; the last group may be smaller, and is then compiled separately."""


def network_flow(
    network: AbstractFlowNetwork, frames: Frame | FilmedFrames, settings: FlowLossSettings | None
) -> tuple[Flow, Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The flow of a clip's pictures at its working resolution, and the network's loss on them with its terms.

    As in the cache, flow that explains the pictures no better than zero flow is set to zero (`is_moving`). The loss is
    computed before that, on the whole pictures, padded by their edges to the sizes that the network needs; without
    `settings` it is 0 and has no terms. Frames of pieces have no forward flow then: it is 0.
    """
    if frames.colour is None:
        raise ValueError("found a clip without pictures; load it with colour=True to compute flow from them.")
    stride = _stride(frames)

    def pair(network: AbstractFlowNetwork, one: UInt8[Array, "_ _ 3"], other: UInt8[Array, "_ _ 3"]):
        height, width, _ = one.shape
        sides = [padding(size, network.divisor) for size in (height, width)]
        dtype = frames.depth_m.dtype
        pictures = jnp.stack(
            [jnp.pad(each, (*sides, (0, 0)), mode="edge").astype(dtype) / 255 for each in (one, other)]
        )
        place = tuple(slice(before, before + size) for (before, _), size in zip(sides, (height, width), strict=True))

        def working(flow: Array, here: Array, there: Array) -> Array:
            moved = is_moving(flow, here, there)[..., None]
            return jnp.where(moved, flow, 0.0)[place][::stride, ::stride] / stride

        if settings is None and isinstance(frames, FilmedFrames):
            here, there = network.encode(pictures[0]), network.encode(pictures[1])
            backward = working(network.decode(there, here)[-1], *pictures[::-1])
            return (jnp.zeros_like(backward), backward), {}
        forward, backward = flow_both_ways(network, pictures[0], pictures[1])
        terms = {}
        if settings is not None:
            terms = terms_both_ways(forward, backward, pictures, pictures.shape[1:3], jnp.ones((), dtype), settings)
        return (working(forward[-1], *pictures), working(backward[-1], *pictures[::-1])), terms

    # One group after the other, to bound the memory of activations; but not by `lax.map`: in a loop XLA's CPU backend takes
    # twelve times as long over convolutions.
    several = eqx.filter_checkpoint(eqx.filter_vmap(pair, in_axes=(None, 0, 0)))
    places = [slice(i, i + PAIRS_AT_ONCE) for i in range(0, len(frames.colour) - 1, PAIRS_AT_ONCE)]
    groups = [several(network, frames.colour[:-1][place], frames.colour[1:][place]) for place in places]
    (forward, backward), terms = jax.tree.map(lambda *parts: jnp.concatenate(parts), *groups)
    first = jnp.zeros_like(forward[:1])
    terms = jax.tree.map(jnp.mean, terms)
    flow = Flow(*(jnp.concatenate([first, way]) for way in (forward, backward)))
    loss = jnp.zeros(()) if settings is None else total_loss(terms, settings)
    return flow, loss, {f"flow/{name}": value for name, value in terms.items()}


def _stride(frames: Frame | FilmedFrames) -> int:
    """The stride in pixels from the pictures to the working resolution."""
    assert frames.colour is not None
    (height, width), (rows, columns) = frames.colour.shape[1:3], frames.depth_m.shape[1:3]
    stride = -(-height // rows)
    if (-(-height // stride), -(-width // stride)) != (rows, columns):
        raise ValueError(
            f"found pictures of {height}x{width} pixels with depth of {rows}x{columns}; expected the pictures at every n-th pixel."
        )
    return stride


def save_network(path: Path, model: JointModel, settings: Mapping[str, Any]) -> None:
    """Write the weights of the model's flow network; `settings` are those that it was built from. `make_flow` reads the file."""
    save_weights(path, model.network, {"flow": dict(settings), "learned_with": type(model.tracer).__name__})


@dataclasses.dataclass(frozen=True)
class JointSettings:
    """A flow network that is learned with the tracer."""

    flow: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    init: str | None = "default"  # initial weights: `default` or a file; random if None
    clip_norm: float = 1.0
    weight: float = 1.0  # of the network's own loss beside the tracer's objective
    loss: FlowLossSettings = dataclasses.field(default_factory=lambda: FlowLossSettings(occlusion_after=0))

    def __post_init__(self) -> None:
        if self.weight < 0:
            raise ConfigError(f"weight is {self.weight}; expected 0 or more.")
        if self.loss.self_supervision > 0:
            raise ConfigError(
                "loss.self_supervision is above 0, which only experiments.train_flow supports; expected 0."
            )
