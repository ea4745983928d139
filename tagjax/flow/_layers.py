"""Building blocks of flow networks: convolutions in (height, width, channel) order, and changes of size.

XLA runs this order faster on CPUs than Equinox's own (channel, height, width).
"""

from __future__ import annotations

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

SLOPE = 0.1
"""Of the leaky rectifier for negative values, as FlowNet and its successors have it."""


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
        out = jax.lax.conv_general_dilated(
            x[None],
            self.weight,
            (self.stride, self.stride),
            [(self.padding, self.padding)] * 2,
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )[0]
        return out + self.bias.reshape(1, 1, -1)


def rectify(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Leaky rectifier."""
    return jnp.maximum(x, SLOPE * x)


def space_to_depth(image: Float[Array, "height width channel"], factor: int) -> Float[Array, "rows columns deep"]:
    """Squares of factor x factor pixels become the channels of one."""
    height, width, channels = image.shape
    cells = image.reshape(height // factor, factor, width // factor, factor, channels)
    return cells.transpose(0, 2, 1, 3, 4).reshape(height // factor, width // factor, factor * factor * channels)


def shrink(image: Float[Array, "height width channel"], factor: int) -> Float[Array, "rows columns channel"]:
    """Mean of every square of factor x factor pixels."""
    height, width, channels = image.shape
    return jnp.mean(image.reshape(height // factor, factor, width // factor, factor, channels), axis=(1, 3))


def enlarge(image: Float[Array, "height width channel"], factor: int) -> Float[Array, "rows columns channel"]:
    """Bilinear, pixel centres kept: the inverse of `shrink` for linear images."""
    height, width, channels = image.shape
    return jax.image.resize(image, (height * factor, width * factor, channels), "linear")


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
    # Sums of nine terms written out: XLA makes one loop of them, several times faster than a softmax and a product.
    pieces = [logits[..., k * cells : (k + 1) * cells] for k in range(9)]
    largest = jax.lax.stop_gradient(functools.reduce(jnp.maximum, pieces))
    shares = [jnp.exp(piece - largest) for piece in pieces]
    total = functools.reduce(jnp.add, shares)

    def mixed(axis: int) -> Array:
        around = [padded[i : i + height, j : j + width, axis : axis + 1] for i in range(3) for j in range(3)]
        fine = functools.reduce(jnp.add, [share * value for share, value in zip(shares, around, strict=True)]) / total
        cut = fine.reshape(height, width, factor, factor).transpose(0, 2, 1, 3)
        return cut.reshape(height * factor, width * factor)

    return jnp.stack([mixed(0), mixed(1)], axis=-1)
