"""RAFT, the small network (Teed and Deng, ECCV 2020): a recurrent update that looks up all-pairs costs.

Flow is at 1/8 of the image. Each update reads the costs around the flow's target, at four resolutions of the second
image, and a recurrent unit corrects the flow. One `lax.scan` for all updates keeps compilation short.
"""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ..image.warp import pixel_grid
from ._layers import Conv, enlarge_flow
from .network import AbstractFlowNetwork

_STRIDE = 8
_FEATURES = 128
_HIDDEN, _CONTEXT = 96, 64


def _instance_norm(x: Array) -> Array:
    """Each channel minus its mean over the image, divided by its standard deviation."""
    centred = x - jnp.mean(x, axis=(0, 1), keepdims=True)
    return centred * jax.lax.rsqrt(jnp.mean(centred * centred, axis=(0, 1), keepdims=True) + 1e-5)


class _Bottleneck(eqx.Module):
    """Residual block: 1 x 1 to a quarter of the channels, 3 x 3, 1 x 1 back."""

    layers: tuple[Conv, Conv, Conv]
    shortcut: Conv | None
    normed: bool = eqx.field(static=True)

    def __init__(self, inputs: int, outputs: int, stride: int, normed: bool, *, key: PRNGKeyArray):
        keys = jax.random.split(key, 4)
        inner = outputs // 4
        self.layers = (
            Conv(inputs, inner, 1, key=keys[0]),
            Conv(inner, inner, stride=stride, key=keys[1]),
            Conv(inner, outputs, 1, key=keys[2]),
        )
        self.shortcut = Conv(inputs, outputs, 1, stride=stride, key=keys[3]) if stride > 1 else None
        self.normed = normed

    def __call__(self, x: Float[Array, "height width inputs"]) -> Float[Array, "rows columns outputs"]:
        norm = _instance_norm if self.normed else (lambda y: y)
        y = x
        for layer in self.layers:
            y = jax.nn.relu(norm(layer(y)))
        return jax.nn.relu(y + (x if self.shortcut is None else norm(self.shortcut(x))))


class _Encoder(eqx.Module):
    """Features at 1/8 of the image: 7 x 7, six residual blocks of 32, 64 and 96 channels, 1 x 1."""

    enter: Conv
    blocks: tuple[_Bottleneck, ...]
    leave: Conv
    normed: bool = eqx.field(static=True)

    def __init__(self, outputs: int, normed: bool, *, key: PRNGKeyArray):
        keys = jax.random.split(key, 8)
        sizes = ((32, 32, 1), (32, 32, 1), (32, 64, 2), (64, 64, 1), (64, 96, 2), (96, 96, 1))
        self.enter = Conv(3, 32, 7, stride=2, key=keys[0])
        self.blocks = tuple(_Bottleneck(a, b, s, normed, key=k) for (a, b, s), k in zip(sizes, keys[1:7], strict=True))
        self.leave = Conv(96, outputs, 1, key=keys[7])
        self.normed = normed

    def __call__(self, image: Float[Array, "height width 3"]) -> Float[Array, "rows columns outputs"]:
        x = self.enter(image)
        x = jax.nn.relu(_instance_norm(x) if self.normed else x)
        for block in self.blocks:
            x = block(x)
        return self.leave(x)


class _Update(eqx.Module):
    """One update: motion features from costs and flow, a convolutional GRU, a head that predicts the correction."""

    cost: Conv
    flow_enter: Conv
    flow_refine: Conv
    motion: Conv
    gates: Conv
    candidate: Conv
    head_enter: Conv
    head: Conv

    def __init__(self, costs: int, *, key: PRNGKeyArray):
        keys = jax.random.split(key, 8)
        joined = _HIDDEN + _CONTEXT + 82
        self.cost = Conv(costs, 96, 1, key=keys[0])
        self.flow_enter = Conv(2, 64, 7, key=keys[1])
        self.flow_refine = Conv(64, 32, key=keys[2])
        self.motion = Conv(96 + 32, 80, key=keys[3])
        self.gates = Conv(joined, 2 * _HIDDEN, key=keys[4])
        self.candidate = Conv(joined, _HIDDEN, key=keys[5])
        self.head_enter = Conv(_HIDDEN, 128, key=keys[6])
        # Nearly zero, also the sum of a dozen: the estimate of an untrained network is zero.
        self.head = Conv(128, 2, gain=0.001, key=keys[7])

    def __call__(
        self,
        hidden: Float[Array, "height width hidden"],
        context: Float[Array, "height width context"],
        costs: Float[Array, "height width costs"],
        flow_px: Float[Array, "height width 2"],
    ) -> tuple[Float[Array, "height width hidden"], Float[Array, "height width 2"]]:
        relu = jax.nn.relu
        moving = relu(self.flow_refine(relu(self.flow_enter(flow_px))))
        motion = relu(self.motion(jnp.concatenate([relu(self.cost(costs)), moving], axis=-1)))
        inputs = jnp.concatenate([context, motion, flow_px], axis=-1)
        update, reset = jnp.split(jax.nn.sigmoid(self.gates(jnp.concatenate([hidden, inputs], axis=-1))), 2, axis=-1)
        candidate = jnp.tanh(self.candidate(jnp.concatenate([reset * hidden, inputs], axis=-1)))
        hidden = (1 - update) * hidden + update * candidate
        return hidden, self.head(relu(self.head_enter(hidden)))


def halve(features: Float[Array, "height width channel"]) -> Float[Array, "rows columns channel"]:
    """Mean of every two by two; an odd last row or column is left out; a side of one is residuals."""
    height, width, channels = features.shape
    tall, wide = min(2, height), min(2, width)
    rows, columns = height // tall, width // wide
    cells = features[: rows * tall, : columns * wide].reshape(rows, tall, columns, wide, channels)
    return jnp.mean(cells, axis=(1, 3))


def _hats(centre: Array, radius: int, size: int) -> Array:
    """Bilinear weights (pixel, displacement, position) of sampling `size` positions around each centre."""
    at = centre[:, None] + jnp.arange(-radius, radius + 1, dtype=centre.dtype)[None]
    return jax.nn.relu(1 - jnp.abs(at[..., None] - jnp.arange(size, dtype=centre.dtype)[None, None]))


def _look_up(
    volume: Float[Array, "pixel rows columns"], x: Float[Array, " pixel"], y: Float[Array, " pixel"], radius: int
) -> Float[Array, "pixel window window"]:
    pixels, rows, columns = volume.shape
    reach = jnp.arange(-radius, radius + 1, dtype=x.dtype)
    u, v = jnp.broadcast_arrays(x[:, None, None] + reach[None, None], y[:, None, None] + reach[None, :, None])
    left, top = jnp.floor(u), jnp.floor(v)
    start = (rows * columns * jnp.arange(pixels))[:, None, None]
    total = jnp.zeros(u.shape, volume.dtype)
    for row in (top, top + 1):
        for column in (left, left + 1):
            inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            weight = jnp.where(inside, (1 - jnp.abs(u - column)) * (1 - jnp.abs(v - row)), 0)
            at = jnp.where(inside, row * columns + column, 0).astype(start.dtype) + start
            total = total + weight * jnp.take(volume.reshape(-1), at)
    return total


def _look_up_forward(volume: Array, x: Array, y: Array, radius: int) -> tuple[Array, Any]:
    return _look_up(volume, x, y, radius), (x, y, volume.shape)


def _look_up_backward(radius: int, residuals: Any, cotangent: Array) -> tuple[Array, Array, Array]:
    x, y, (_, rows, columns) = residuals
    along = jnp.einsum("nyx,nxw->nyw", cotangent, _hats(x, radius, columns))
    return jnp.einsum("nyw,nyh->nhw", along, _hats(y, radius, rows)), jnp.zeros_like(x), jnp.zeros_like(y)


_differentiable_look_up = jax.custom_vjp(_look_up, nondiff_argnums=(3,))
_differentiable_look_up.defvjp(_look_up_forward, _look_up_backward)


def look_up(
    volume: Float[Array, "pixel rows columns"], x: Float[Array, " pixel"], y: Float[Array, " pixel"], radius: int
) -> Float[Array, "pixel window window"]:
    """Each pixel's costs in the window around its (x, y), row before column, bilinearly; 0 beyond the border.

    The gradient reaches the volume only. It is a product of dense weights, without a scatter: on two CPU cores
    half the time of the gather's own gradient.
    """
    return _differentiable_look_up(volume, x, y, radius)


def look_up_products(
    first: Float[Array, "pixel channel"],
    second: Float[Array, "rows columns channel"],
    x: Float[Array, " pixel"],
    y: Float[Array, " pixel"],
    radius: int,
) -> Float[Array, "pixel window window"]:
    """`look_up` in the volume of all products first . second, without computing it: memory is linear in the pixels.

    The gradient reaches the features only.
    """
    rows, columns, channels = second.shape
    pixels = first.shape[0]
    x, y = jax.lax.stop_gradient((x, y))
    left, top = jnp.floor(x), jnp.floor(y)
    across, down = (x - left)[:, None, None], (y - top)[:, None, None]
    reach = 2 * radius + 2
    flat = second.reshape(-1, channels)

    @jax.checkpoint
    def products(offset: Array) -> Array:
        row, column = top - radius + offset // reach, left - radius + offset % reach
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        at = jnp.where(inside, row * columns + column, 0).astype(jnp.int32)
        return jnp.where(inside, jnp.sum(jnp.take(flat, at, axis=0) * first, axis=-1), 0)

    offsets = jnp.arange(reach * reach, dtype=x.dtype)
    window = jax.lax.map(products, offsets).reshape(reach, reach, pixels).transpose(2, 0, 1)
    window = (1 - across) * window[:, :, :-1] + across * window[:, :, 1:]
    return (1 - down) * window[:, :-1] + down * window[:, 1:]


class RAFTSmall(AbstractFlowNetwork):
    """The paper's small network: 990,162 parameters at 4 levels and radius 3.

    `updates` corrections, each with a flow at 1/8 of the image; the last is enlarged bilinearly. `levels` and `radius`
    set the search range: `radius` cells of 8 pixels at the finest of `levels` resolutions, twice as far at each next.
    `all_pairs` keeps every product of two features in memory, 4/3 (height width / 64)^2 floats; otherwise they are
    computed at each update, for large images. Raises `ValueError` for impossible settings.
    """

    features: _Encoder
    context: _Encoder
    update: _Update
    updates: int = eqx.field(static=True)
    levels: int = eqx.field(static=True)
    radius: int = eqx.field(static=True)
    all_pairs: bool = eqx.field(static=True)
    divisor: int = eqx.field(static=True)

    def __init__(self, updates: int = 12, levels: int = 4, radius: int = 3, all_pairs: bool = True, *, seed: int = 0):
        if updates < 1 or levels < 1 or radius < 0:
            raise ValueError(f"updates {updates}, levels {levels}, radius {radius}; expected at least 1, 1 and 0.")
        keys = jax.random.split(jax.random.key(seed), 3)
        self.features = _Encoder(_FEATURES, True, key=keys[0])
        self.context = _Encoder(_HIDDEN + _CONTEXT, False, key=keys[1])
        self.update = _Update(levels * (2 * radius + 1) ** 2, key=keys[2])
        self.updates, self.levels, self.radius, self.all_pairs = updates, levels, radius, all_pairs
        self.divisor = _STRIDE

    def encode(
        self, image: Float[Array, "height width 3"]
    ) -> tuple[Float[Array, "rows columns features"], Float[Array, "rows columns context"]]:
        """Features for the costs, and context features."""
        scaled = 2 * image - 1
        return self.features(scaled), self.context(scaled)

    def decode(
        self,
        first: tuple[Float[Array, "rows columns features"], Float[Array, "rows columns context"]],
        second: tuple[Float[Array, "rows columns features"], Float[Array, "rows columns context"]],
    ) -> tuple[Float[Array, "_ _ 2"], ...]:
        here, context_features = first
        rows, columns, channels = here.shape
        hidden, context = jnp.tanh(context_features[..., :_HIDDEN]), jax.nn.relu(context_features[..., _HIDDEN:])
        one = here.reshape(-1, channels) / math.sqrt(channels)
        # The products with a mean are the mean of the products: coarser volumes need no finest volume.
        others = [second[0]]
        for _ in range(self.levels - 1):
            others.append(halve(others[-1]))
        volumes = [jnp.einsum("nc,hwc->nhw", one, other) for other in others] if self.all_pairs else []
        x, y = (grid.reshape(-1) for grid in pixel_grid(rows, columns, here.dtype))

        def costs(flow: Array) -> Array:
            u, v = x + flow[..., 0].reshape(-1), y + flow[..., 1].reshape(-1)
            if self.all_pairs:
                windows = [look_up(volume, u / 2**n, v / 2**n, self.radius) for n, volume in enumerate(volumes)]
            else:
                windows = [
                    look_up_products(one, other, u / 2**n, v / 2**n, self.radius) for n, other in enumerate(others)
                ]
            return jnp.concatenate([window.reshape(rows, columns, -1) for window in windows], axis=-1)

        def step(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
            hidden, flow = carry
            # As in the paper: no gradient from an update to the flow of the updates before it.
            flow = jax.lax.stop_gradient(flow)
            hidden, correction = self.update(hidden, context, costs(flow), flow)
            return (hidden, flow + correction), flow + correction

        start = (hidden, jnp.zeros((rows, columns, 2), here.dtype))
        _, flows = jax.lax.scan(step, start, None, length=self.updates)
        return (*(flows[n] for n in range(self.updates)), enlarge_flow(flows[-1], _STRIDE))
