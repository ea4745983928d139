"""Building blocks of flow networks: convolutions in (height, width, channel) order, and resizing.

XLA runs this order faster on CPUs than Equinox's (channel, height, width).
"""

from __future__ import annotations

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

SLOPE = 0.1
"""Slope of the leaky rectifier for negative values, as in FlowNet and its successors."""


class Conv(eqx.Module):
    """A convolution with bias; He's initial weights times `gain`, zero bias."""

    weight: Float[Array, "rows columns inputs outputs"]
    bias: Float[Array, " outputs"]
    stride: int = eqx.field(static=True)
    padding: int = eqx.field(static=True)

    def __init__(
        self,
        inputs: int,
        outputs: int,
        size: int = 3,
        *,
        stride: int = 1,
        padding: int | None = None,
        gain: float = 1.0,
        key: PRNGKeyArray,
    ):
        """`padding` is size // 2 unless given; size 2 with stride 2 and no padding keeps pixel centres."""
        scale = gain * math.sqrt(2.0 / ((1 + SLOPE**2) * size * size * inputs))
        self.weight = scale * jax.random.normal(key, (size, size, inputs, outputs), jnp.float32)
        self.bias = jnp.zeros((outputs,), jnp.float32)
        self.stride = stride
        self.padding = size // 2 if padding is None else padding

    def __call__(self, x: Float[Array, "height width inputs"]) -> Float[Array, "rows columns outputs"]:
        if self.weight.shape[0] == self.stride == 1:
            return _product(x, self.weight[0, 0]) + self.bias.reshape(1, 1, -1)
        out = jax.lax.conv_general_dilated(
            x[None],
            self.weight,
            (self.stride, self.stride),
            [(self.padding, self.padding)] * 2,
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )[0]
        return out + self.bias.reshape(1, 1, -1)


class SeparableConv(eqx.Module):
    """A depthwise separable convolution, 3 x 3 then 1 x 1 (Xception, Chollet, CVPR 2017), with bias.

    On CPUs the depthwise part is nine additions of shifted images and the other a matrix product, which uses every
    core: with 32 channels a third of the time of `Conv`, with 64 an eighth.
    """

    depth: Float[Array, "3 3 inputs"]
    point: Conv

    def __init__(self, inputs: int, outputs: int, *, gain: float = 1.0, key: PRNGKeyArray):
        one, other = jax.random.split(key)
        self.depth = jax.random.normal(one, (3, 3, inputs), jnp.float32) / 3
        self.point = Conv(inputs, outputs, 1, gain=gain, key=other)

    def __call__(self, x: Float[Array, "height width inputs"]) -> Float[Array, "height width outputs"]:
        height, width, _ = x.shape
        padded = jnp.pad(x, ((1, 1), (1, 1), (0, 0)))
        moved = [
            padded[i : i + height, j : j + width] * self.depth[i, j].reshape(1, 1, -1)
            for i in range(3)
            for j in range(3)
        ]
        return self.point(functools.reduce(jnp.add, moved))


def _product(
    x: Float[Array, "height width inputs"], matrix: Float[Array, "inputs outputs"]
) -> Float[Array, "height width outputs"]:
    """Each pixel's channels times the matrix; unlike a convolution of 1 x 1 it uses every core."""
    height, width, inputs = x.shape
    return (x.reshape(-1, inputs) @ matrix).reshape(height, width, -1)


def rectify(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Leaky rectifier."""
    return jnp.maximum(x, SLOPE * x)


def space_to_depth(image: Float[Array, "height width channel"], factor: int) -> Float[Array, "rows columns deep"]:
    """Squares of factor x factor pixels become the channels of one pixel."""
    height, width, channels = image.shape
    cells = image.reshape(height // factor, factor, width // factor, factor, channels)
    return cells.transpose(0, 2, 1, 3, 4).reshape(height // factor, width // factor, factor * factor * channels)


def shrink(image: Float[Array, "height width channel"], factor: int) -> Float[Array, "rows columns channel"]:
    """Mean of every square of factor x factor pixels."""
    height, width, channels = image.shape
    return jnp.mean(image.reshape(height // factor, factor, width // factor, factor, channels), axis=(1, 3))


def enlarge(image: Float[Array, "height width channel"], factor: int) -> Float[Array, "rows columns channel"]:
    """Bilinear, pixel centres kept: the inverse of `shrink` for linear images.

    A weighted sum of shifted copies: on CPUs a seventh of the time of `jax.image.resize`, which uses matrix products.
    """
    return _enlarge_axis(_enlarge_axis(image, factor, 0), factor, 1)


def _enlarge_axis(image: Float[Array, "height width channel"], factor: int, axis: int) -> Array:
    length = image.shape[axis]
    padded = jnp.pad(image, [(int(axis == n), int(axis == n)) for n in range(3)], mode="edge")
    before, here, after = (jax.lax.slice_in_dim(padded, n, n + length, axis=axis) for n in range(3))
    parts = []
    for n in range(factor):
        # Offset of the fine pixel's centre from that of its coarse pixel, in coarse pixels.
        offset = (n + 0.5) / factor - 0.5
        parts.append((1 - abs(offset)) * here + abs(offset) * (before if offset < 0 else after))
    fine = jnp.stack(parts, axis=axis + 1)
    return fine.reshape(*image.shape[:axis], length * factor, *image.shape[axis + 1 :])


def enlarge_flow(flow_px: Float[Array, "height width 2"], factor: int) -> Float[Array, "rows columns 2"]:
    """A flow field at `factor` times the resolution, in pixels of that resolution."""
    return factor * enlarge(flow_px, factor)


def convex_upsample(
    flow_px: Float[Array, "height width 2"], logits: Float[Array, "height width weights"], factor: int
) -> Float[Array, "rows columns 2"]:
    """Each fine pixel's flow as a mixture of its 3 x 3 coarse neighbours' (RAFT, Teed and Deng, ECCV 2020).

    `logits` has 9 factor^2 channels, neighbour before fine row before fine column. The result is in fine pixels.
    """
    height, width, _ = flow_px.shape
    cells = factor * factor
    padded = jnp.pad(factor * flow_px, ((1, 1), (1, 1), (0, 0)), mode="edge")
    # Sums of nine terms, written out: XLA fuses them into one loop, several times faster than a softmax and a product.
    pieces = [logits[..., k * cells : (k + 1) * cells] for k in range(9)]
    largest = jax.lax.stop_gradient(functools.reduce(jnp.maximum, pieces))
    # Without the barrier each of the three sums would compute the exponentials again.
    mixing = jax.lax.optimization_barrier([jnp.exp(piece - largest) for piece in pieces])
    total = functools.reduce(jnp.add, mixing)

    def mixed(axis: int) -> Array:
        around = [padded[i : i + height, j : j + width, axis : axis + 1] for i in range(3) for j in range(3)]
        fine = functools.reduce(jnp.add, [weight * value for weight, value in zip(mixing, around, strict=True)]) / total
        cut = fine.reshape(height, width, factor, factor).transpose(0, 2, 1, 3)
        return cut.reshape(height * factor, width * factor)

    return jnp.stack([mixed(0), mixed(1)], axis=-1)
