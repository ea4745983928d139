"""Flow of two images of any size: padding, both directions, occlusion, and confidence.

A network is compiled once for every padded size; sizes are rounded up to its divisor, so that they share compiled code.
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
from .loss_terms import consistency_error_px2
from .network import AbstractFlowNetwork

TOLERANCE_FRACTION, TOLERANCE_PX2 = 0.01, 0.5
"""Forward-backward error, as a fraction of the squared lengths plus pixels^2, above which a pixel is occluded."""

_MIN_SIDE_PX = 64
"""Shortest side that the coarsest level of every network can process."""

_ROUNDING = 1.01 / 255
"""Images that nowhere differ by more are equal up to rounding: their flow is zero."""

_executor = ThreadPoolExecutor(1, "tagjax-flow")
_compiled: set[Any] = set()


class FlowEstimate(eqx.Module):
    """Forward and backward flow (pixels), each on its own image's pixels, occlusion masks and confidence
    (`consistency`).
    """

    forward_px: Float[Array, "height width 2"]
    backward_px: Float[Array, "height width 2"]
    forward_occluded: Bool[Array, "height width"]
    backward_occluded: Bool[Array, "height width"]
    forward_confidence: Float[Array, "height width"]
    backward_confidence: Float[Array, "height width"]


HostFlow = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From images to flow, both on the host: a `FlowFunction` (`tagjax.flow.opencv`)."""


def consistency(
    flow_px: Float[Array, "height width 2"],
    back_px: Float[Array, "height width 2"],
    area: Int[Array, " 4"] | None = None,
) -> Float[Array, "height width"]:
    """Forward-backward consistency, 0 to 1: t / (t + |f + b|^2), t = 0.01 (|f|^2 + |b|^2) + 0.5 pixels^2.

    b is the backward flow at x + f. The value is 1 where the two flows cancel, 1/2 at the threshold of Sundaram et al.
    (ECCV 2010) for an occluded pixel, and 0 where the target is more than half a pixel outside the image, or outside
    its part `area` (x0 y0 x1 y1, inclusive).
    """
    height, width, _ = flow_px.shape
    if area is None:
        area = jnp.asarray([0, 0, width - 1, height - 1], jnp.int32)
    error, length = consistency_error_px2(flow_px, back_px)
    tolerance = TOLERANCE_FRACTION * length + TOLERANCE_PX2
    x, y = pixel_grid(height, width, flow_px.dtype)
    u, v = x + flow_px[..., 0], y + flow_px[..., 1]
    left, top, right, bottom = area.astype(flow_px.dtype)
    inside = (u >= left - 0.5) & (u <= right + 0.5) & (v >= top - 0.5) & (v <= bottom + 0.5)
    return jnp.where(inside, tolerance / (tolerance + error), 0.0)


def padding(size: int, divisor: int) -> tuple[int, int]:
    """Padding before and after a side of `size` pixels, half each, to a multiple of `divisor` of at least 64."""
    spare = max(-(-size // divisor) * divisor, -(-_MIN_SIDE_PX // divisor) * divisor) - size
    return spare // 2, spare - spare // 2


def _padded(network: AbstractFlowNetwork, image: Any) -> tuple[Any, tuple[slice, slice], np.ndarray]:
    """An image padded by its edge pixels, the slices of the original in it, and its corners x0 y0 x1 y1."""
    height, width = image.shape[:2]
    (top, bottom), (left, right) = padding(height, network.divisor), padding(width, network.divisor)
    pad = jnp.pad if isinstance(image, jax.Array) else np.pad
    padded = pad(image, ((top, bottom), (left, right), (0, 0)), mode="edge")
    area = np.asarray([left, top, left + width - 1, top + height - 1], np.int32)
    return padded, (slice(top, top + height), slice(left, left + width)), area


def _to_float(image: Array) -> Array:
    return image.astype(jnp.float32) / 255 if image.dtype == jnp.uint8 else image


@jax.jit
def _zero_if_equal(flow_px: Array, first: Array, second: Array) -> Array:
    """The flow, or zero if the two images are equal up to rounding."""
    equal = jnp.max(jnp.abs(_to_float(first) - _to_float(second))) <= _ROUNDING
    return jnp.where(equal, 0.0, flow_px)


@eqx.filter_jit
def _encode(network: AbstractFlowNetwork, image: Array) -> Any:
    return network.encode(_to_float(image))


@eqx.filter_jit
def _forward(network: AbstractFlowNetwork, first: Array, second: Array) -> Array:
    flow_px = network.decode(network.encode(_to_float(first)), network.encode(_to_float(second)))[-1]
    return _zero_if_equal(flow_px, first, second)


@eqx.filter_jit
def _decode(network: AbstractFlowNetwork, first: Any, second: Any) -> Array:
    return network.decode(first, second)[-1]


@eqx.filter_jit
def _decode_both(network: AbstractFlowNetwork, first: Any, second: Any) -> tuple[Array, Array]:
    here, there = (jax.tree.map(lambda a, b: jnp.stack([a, b]), *pair) for pair in ((first, second), (second, first)))
    both = jax.vmap(network.decode)(here, there)[-1]
    return both[0], both[1]


@eqx.filter_jit
def _with_confidence(forward: Array, backward: Array, area: Array) -> FlowEstimate:
    first, second = consistency(forward, backward, area), consistency(backward, forward, area)
    return FlowEstimate(forward, backward, first <= 0.5, second <= 0.5, first, second)


def _apply_twice(
    function: Callable[..., Any], network: AbstractFlowNetwork, one: tuple, other: tuple
) -> tuple[Any, Any]:
    """`function` of the network and of each of two tuples of arguments.

    On CPUs in two threads, since XLA runs a network's convolutions on one core. The first call is sequential, so that
    it compiles once.
    """
    parts = jax.tree.leaves((network, one, other))
    key = (function, jax.tree.structure(network), tuple((jnp.shape(part), jnp.result_type(part)) for part in parts))
    traced = any(isinstance(part, jax.core.Tracer) for part in parts)
    if traced or jax.default_backend() != "cpu" or key not in _compiled:
        results = function(network, *one), function(network, *other)
        _compiled.add(key)
        return results
    later = _executor.submit(lambda: jax.block_until_ready(function(network, *other)))
    return jax.block_until_ready(function(network, *one)), later.result()


def _both_ways(network: AbstractFlowNetwork, first: Any, second: Any) -> tuple[Array, Array]:
    """Forward and backward flow from the features of two images: one batch, except on CPUs, where a batch is slower."""
    if jax.default_backend() == "cpu":
        return _apply_twice(_decode, network, (first, second), (second, first))
    return _decode_both(network, first, second)


def _checked(first: Any, second: Any) -> tuple[Any, Any]:
    """Images as `check_images` returns them; traced arrays have no values to check and pass unchanged."""
    traced = isinstance(first, jax.core.Tracer) or isinstance(second, jax.core.Tracer)
    return (jnp.asarray(first), jnp.asarray(second)) if traced else check_images(first, second)


def estimate(flow: AbstractFlowNetwork | HostFlow, first: Any, second: Any) -> FlowEstimate:
    """Forward and backward flow between two images with occlusion and confidence; zero between equal images.

    `flow` is a network, or a flow of `make_flow`, which is called once for each direction. Images and errors are those
    of `check_images`; for a network within a transformation of JAX, floats (height, width, 3) from 0 to 1. Sides that
    are too short, or no multiple of the network's divisor, are padded by the edge pixels, and the flow is cropped.
    """
    network = flow.network if isinstance(flow, NetworkFlow) else flow
    one, other = _checked(first, second)
    if not isinstance(network, AbstractFlowNetwork):
        height, width = one.shape[:2]
        forward, backward = (jnp.asarray(each, jnp.float32) for each in next(flow_along(network, (one, other))))
        return _with_confidence(forward, backward, jnp.asarray([0, 0, width - 1, height - 1], jnp.int32))
    one, slices, area = _padded(network, one)
    other, _, _ = _padded(network, other)
    features = _apply_twice(_encode, network, (one,), (other,))
    forward, backward = (_zero_if_equal(each, one, other) for each in _both_ways(network, *features))
    return jax.tree.map(lambda leaf: leaf[slices], _with_confidence(forward, backward, jnp.asarray(area)))


def _padded_flow(network: AbstractFlowNetwork, first: Any, second: Any) -> tuple[Array, tuple[slice, slice]]:
    """Flow from the first image to the second, both padded, and the slices of the original in it."""
    one, other = _checked(first, second)
    one, slices, _ = _padded(network, one)
    other, _, _ = _padded(network, other)
    return _forward(network, one, other), slices


def forward_flow(network: AbstractFlowNetwork, first: Any, second: Any) -> Float[Array, "height width 2"]:
    """Flow from the first image to the second, pixels; images and errors as of `estimate`."""
    flow_px, slices = _padded_flow(network, first, second)
    return flow_px[slices]


class NetworkFlow:
    """A flow network as a `FlowFunction`: images and flow on the host."""

    def __init__(self, network: AbstractFlowNetwork):
        self.network = network

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        flow_px, slices = _padded_flow(self.network, first, second)
        return np.asarray(flow_px)[slices]

    def along(self, images: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Forward and backward flow of consecutive images; each image is encoded once."""
        before, last, known = None, None, None
        for image in images:
            checked, _ = check_images(image, image if before is None else before)
            padded, slices, _ = _padded(self.network, checked)
            features = _encode(self.network, padded)
            if before is not None:
                forward, backward = (
                    _zero_if_equal(each, last, padded) for each in _both_ways(self.network, known, features)
                )
                yield np.asarray(forward)[slices], np.asarray(backward)[slices]
            before, last, known = image, padded, features


def flow_along(flow: HostFlow, images: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Forward and backward flow of consecutive images of a video: one pair fewer than images.

    A flow with a method `along` processes the video itself: a network encodes each image once, and a flow made of both
    directions computes each once. Errors as of `check_images`.
    """
    along = getattr(flow, "along", None)
    if along is not None:
        yield from along(images)
        return
    before = None
    for image in images:
        if before is not None:
            yield flow(before, image), flow(image, before)
        before = image
