"""Flow of two pictures of any size: padding, both directions, what is hidden, and how sure it is.

The network runs compiled, once for every padded size; sizes are rounded up to its divisor, so that they share code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..image.warp import pixel_grid
from .images import check_images
from .losses import consistency_error_px2
from .network import AbstractFlowNetwork

SHARE, FLOOR_PX2 = 0.01, 0.5
"""Gap of the way there and back, as a share of the squared lengths and in pixels^2, beyond which a pixel is hidden."""

_SMALLEST = 64
"""Pixels of a side that every network's roughest level can do with."""

_ROUNDING = 1.01 / 255
"""Pictures that nowhere differ by more show the same: any motion would be a guess."""

_second_thread = ThreadPoolExecutor(1, "tagjax-flow")
_compiled: set[Any] = set()


class FlowEstimate(eqx.Module):
    """Flow both ways, each on its own picture's pixels, where its target is hidden, and how sure it is (`consistency`)."""

    forward_px: Float[Array, "height width 2"]
    backward_px: Float[Array, "height width 2"]
    forward_occluded: Bool[Array, "height width"]
    backward_occluded: Bool[Array, "height width"]
    forward_confidence: Float[Array, "height width"]
    backward_confidence: Float[Array, "height width"]


HostFlow = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Pictures on the host to flow on the host: a `FlowFunction` (`tagjax.flow.opencv`)."""


def consistency(
    flow_px: Float[Array, "height width 2"],
    back_px: Float[Array, "height width 2"],
    area: Int[Array, " 4"] | None = None,
) -> Float[Array, "height width"]:
    """How well the way back leads back, 0 to 1: t / (t + |f + b|^2), t = 0.01 (|f|^2 + |b|^2) + 0.5 pixels^2.

    b is the other flow at x + f. 1 where the two cancel, 1/2 where Sundaram et al. (ECCV 2010) begin to call a pixel
    hidden, and 0 where the target is more than half a pixel outside the picture, or outside its part x0 y0 x1 y1
    (inclusive) that `area` names.
    """
    height, width, _ = flow_px.shape
    if area is None:
        area = jnp.asarray([0, 0, width - 1, height - 1], jnp.int32)
    gap, length = consistency_error_px2(flow_px, back_px)
    tolerance = SHARE * length + FLOOR_PX2
    x, y = pixel_grid(height, width, flow_px.dtype)
    u, v = x + flow_px[..., 0], y + flow_px[..., 1]
    left, top, right, bottom = area.astype(flow_px.dtype)
    inside = (u >= left - 0.5) & (u <= right + 0.5) & (v >= top - 0.5) & (v <= bottom + 0.5)
    return jnp.where(inside, tolerance / (tolerance + gap), 0.0)


def padding(size: int, divisor: int) -> tuple[int, int]:
    """Pixels before and after a side of `size`, half each, that make it a multiple of `divisor` and 64 at the least."""
    spare = max(-(-size // divisor) * divisor, -(-_SMALLEST // divisor) * divisor) - size
    return spare // 2, spare - spare // 2


def _padded(network: AbstractFlowNetwork, picture: Any) -> tuple[Any, tuple[slice, slice], np.ndarray]:
    """A picture with its edge pixels repeated, where it lies in that, and the corners of this area."""
    height, width = picture.shape[:2]
    (top, bottom), (left, right) = padding(height, network.divisor), padding(width, network.divisor)
    fill = jnp.pad if isinstance(picture, jax.Array) else np.pad
    grown = fill(picture, ((top, bottom), (left, right), (0, 0)), mode="edge")
    area = np.asarray([left, top, left + width - 1, top + height - 1], np.int32)
    return grown, (slice(top, top + height), slice(left, left + width)), area


def _unit(picture: Array) -> Array:
    return picture.astype(jnp.float32) / 255 if picture.dtype == jnp.uint8 else picture


@jax.jit
def _still(flow_px: Array, first: Array, second: Array) -> Array:
    """The flow, or none where the two pictures are the same one: a still scene has none, however it looks."""
    same = jnp.max(jnp.abs(_unit(first) - _unit(second))) <= _ROUNDING
    return jnp.where(same, 0.0, flow_px)


@eqx.filter_jit
def _encode(network: AbstractFlowNetwork, picture: Array) -> Any:
    return network.encode(_unit(picture))


@eqx.filter_jit
def _forward(network: AbstractFlowNetwork, first: Array, second: Array) -> Array:
    flow_px = network.decode(network.encode(_unit(first)), network.encode(_unit(second)))[-1]
    return _still(flow_px, first, second)


@eqx.filter_jit
def _decode(network: AbstractFlowNetwork, first: Any, second: Any) -> Array:
    return network.decode(first, second)[-1]


@eqx.filter_jit
def _decode_both(network: AbstractFlowNetwork, first: Any, second: Any) -> tuple[Array, Array]:
    here, there = (jax.tree.map(lambda a, b: jnp.stack([a, b]), *pair) for pair in ((first, second), (second, first)))
    both = jax.vmap(network.decode)(here, there)[-1]
    return both[0], both[1]


@eqx.filter_jit
def _judged(forward: Array, backward: Array, area: Array) -> FlowEstimate:
    ahead, back = consistency(forward, backward, area), consistency(backward, forward, area)
    return FlowEstimate(forward, backward, ahead <= 0.5, back <= 0.5, ahead, back)


def _twice(function: Callable[..., Any], network: AbstractFlowNetwork, one: tuple, other: tuple) -> tuple[Any, Any]:
    """`function` of the network and of each of two tuples of arguments.

    On CPUs a thread for each: XLA runs a network's convolutions on one core. The first time they take turns, so that
    only one of them compiles.
    """
    parts = jax.tree.leaves((network, one, other))
    key = (function, jax.tree.structure(network), tuple((jnp.shape(part), jnp.result_type(part)) for part in parts))
    traced = any(isinstance(part, jax.core.Tracer) for part in parts)
    if traced or jax.default_backend() != "cpu" or key not in _compiled:
        found = function(network, *one), function(network, *other)
        _compiled.add(key)
        return found
    later = _second_thread.submit(lambda: jax.block_until_ready(function(network, *other)))
    return jax.block_until_ready(function(network, *one)), later.result()


def _both_ways(network: AbstractFlowNetwork, first: Any, second: Any) -> tuple[Array, Array]:
    """Flow from the features of each of two pictures to the other: one batch, but on CPUs, where that is slower."""
    if jax.default_backend() == "cpu":
        return _twice(_decode, network, (first, second), (second, first))
    return _decode_both(network, first, second)


def _checked(first: Any, second: Any) -> tuple[Any, Any]:
    """Pictures as `check_images` has them; what is being traced has no values to look at and is taken as it is."""
    traced = isinstance(first, jax.core.Tracer) or isinstance(second, jax.core.Tracer)
    return (jnp.asarray(first), jnp.asarray(second)) if traced else check_images(first, second)


def estimate(flow: AbstractFlowNetwork | HostFlow, first: Any, second: Any) -> FlowEstimate:
    """Flow between two pictures, both ways, with what is hidden and how sure it is; none between equal pictures.

    `flow` is a network, or any flow by name (`make_flow`), which is asked once for each way. Takes pictures as
    `check_images` does, whose errors it raises; of a network, within a transformation of JAX, floats (height, width, 3)
    from 0 to 1. Sides that are too short, or no multiple of the network's divisor, are padded by repeating the edge, and the
    flow is cut back.
    """
    network = flow.network if isinstance(flow, NetworkFlow) else flow
    one, other = _checked(first, second)
    if not isinstance(network, AbstractFlowNetwork):
        height, width = one.shape[:2]
        forward, backward = (jnp.asarray(way, jnp.float32) for way in next(flow_along(network, (one, other))))
        return _judged(forward, backward, jnp.asarray([0, 0, width - 1, height - 1], jnp.int32))
    one, place, area = _padded(network, one)
    other, _, _ = _padded(network, other)
    features = _twice(_encode, network, (one,), (other,))
    forward, backward = (_still(way, one, other) for way in _both_ways(network, *features))
    return jax.tree.map(lambda leaf: leaf[place], _judged(forward, backward, jnp.asarray(area)))


def _padded_flow(network: AbstractFlowNetwork, first: Any, second: Any) -> tuple[Array, tuple[slice, slice]]:
    """Flow from the first picture to the second, both padded, and where the pictures lie in it."""
    one, other = _checked(first, second)
    one, place, _ = _padded(network, one)
    other, _, _ = _padded(network, other)
    return _forward(network, one, other), place


def forward_flow(network: AbstractFlowNetwork, first: Any, second: Any) -> Float[Array, "height width 2"]:
    """Flow from the first picture to the second, pixels; pictures and errors as of `estimate`."""
    flow_px, place = _padded_flow(network, first, second)
    return flow_px[place]


class NetworkFlow:
    """A flow network as a `FlowFunction`: pictures and flow on the host."""

    def __init__(self, network: AbstractFlowNetwork):
        self.network = network

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        flow_px, place = _padded_flow(self.network, first, second)
        return np.asarray(flow_px)[place]

    def along(self, pictures: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Flow forward and backward between neighbouring pictures; each picture is encoded once."""
        before, last, known = None, None, None
        for picture in pictures:
            checked, _ = check_images(picture, picture if before is None else before)
            grown, place, _ = _padded(self.network, checked)
            features = _encode(self.network, grown)
            if before is not None:
                forward, backward = (_still(way, last, grown) for way in _both_ways(self.network, known, features))
                yield np.asarray(forward)[place], np.asarray(backward)[place]
            before, last, known = picture, grown, features


def flow_along(flow: HostFlow, pictures: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Flow forward and backward between neighbouring pictures of a video: one pair fewer than pictures.

    Who has a way of its own along a video (`along`) goes that way: a network sees each picture once, what needs both ways
    has them once. Errors as of `check_images`.
    """
    along = getattr(flow, "along", None)
    if along is not None:
        yield from along(pictures)
        return
    before = None
    for picture in pictures:
        if before is not None:
            yield flow(before, picture), flow(picture, before)
        before = picture
