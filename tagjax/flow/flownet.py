"""FlowNetS and FlowNetC (Dosovitskiy et al., ICCV 2015), the backbone of UnFlow and of TagAttention's flow.

Ten convolutions down to 1/64 of the image, four learned enlargements up to 1/4. All layers are those of the
published networks, each with a bias: 38.7 million parameters, and 39.2 million with the correlation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ._layers import SLOPE, Conv, enlarge_flow, rectify
from .cost_volume import cost_volume
from .network import AbstractFlowNetwork

_UNIT_PX = 20.0
"""Unit of the flow within the network, pixels of the image, at every level; the output is in pixels."""

_CONTRACTING = (
    (64, 7, 2),  # conv1: channels, size, stride
    (128, 5, 2),
    (256, 5, 2),
    (256, 3, 1),  # conv3_1
    (512, 3, 2),
    (512, 3, 1),
    (512, 3, 2),
    (512, 3, 1),
    (1024, 3, 2),
    (1024, 3, 1),  # conv6_1
)
_EXPANDING = (512, 256, 128, 64)
_NUM_SEPARATE = 3
"""Number of first layers of FlowNetC that process each image separately."""

_REDIRECTED = 32
_REACH, _STEP = 20, 2
"""Largest displacement of FlowNetC's correlation and the step between displacements, in cells of 8 pixels."""


class _Enlarge(eqx.Module):
    """Transposed convolution, 4 x 4, stride 2, padding 1, as four 2 x 2 convolutions, one for each output parity.

    Equal to XLA's dilated form, whose weight gradient takes 7 s instead of 0.4 s over the four layers of
    FlowNet at 512 x 384 on two CPU cores.
    """

    weight: Float[Array, "4 4 inputs outputs"]
    bias: Float[Array, " outputs"]

    def __init__(self, inputs: int, outputs: int, *, key: PRNGKeyArray | None):
        """He's initial weights; without a key, bilinear interpolation of each channel."""
        if key is None:
            ramp = jnp.asarray([0.25, 0.75, 0.75, 0.25], jnp.float32)
            self.weight = jnp.outer(ramp, ramp)[:, :, None, None] * jnp.eye(inputs, outputs)[None, None]
        else:
            scale = math.sqrt(2.0 / ((1 + SLOPE**2) * 4 * inputs))
            self.weight = scale * jax.random.normal(key, (4, 4, inputs, outputs), jnp.float32)
        self.bias = jnp.zeros((outputs,), jnp.float32)

    def __call__(self, x: Float[Array, "height width inputs"]) -> Float[Array, "rows columns outputs"]:
        height, width, _ = x.shape
        padding = ((1, 0), (0, 1))
        parts = [
            jax.lax.conv_general_dilated(
                x[None],
                self.weight[row::2, column::2],
                (1, 1),
                [padding[row], padding[column]],
                dimension_numbers=("NHWC", "HWIO", "NHWC"),
            )[0]
            for row in (0, 1)
            for column in (0, 1)
        ]
        cells = jnp.stack(parts).reshape(2, 2, height, width, -1).transpose(2, 0, 3, 1, 4)
        return cells.reshape(2 * height, 2 * width, -1) + self.bias.reshape(1, 1, -1)


class _Expanding(eqx.Module):
    """The refinement: at each level a flow from all features there, enlarged together with the features."""

    features: tuple[_Enlarge, ...]
    flows: tuple[_Enlarge, ...]
    heads: tuple[Conv, ...]

    def __init__(self, coarsest: int, sides: Sequence[int], widths: Sequence[int], *, key: PRNGKeyArray):
        """`sides` are the channels of the skip connections from the contracting part, coarse to fine."""
        known = [coarsest, *(side + width + 2 for side, width in zip(sides, widths, strict=True))]
        keys = jax.random.split(key, 2 * len(known))
        self.features = tuple(
            _Enlarge(a, b, key=k) for a, b, k in zip(known[:-1], widths, keys[: len(widths)], strict=True)
        )
        self.flows = tuple(_Enlarge(2, 2, key=None) for _ in widths)
        # Nearly zero, so that the first estimate of an untrained network is zero.
        self.heads = tuple(Conv(a, 2, gain=0.01, key=k) for a, k in zip(known, keys[-len(known) :], strict=True))

    def __call__(
        self, coarsest: Float[Array, "height width features"], sides: Sequence[Float[Array, ...]]
    ) -> tuple[Float[Array, "_ _ 2"], ...]:
        """Flows in pixels of their own levels, from 1/64 to 1/4 of the image, and the last at its full size."""
        x, flows = coarsest, [self.heads[0](coarsest)]
        for feature, flow, head, side in zip(self.features, self.flows, self.heads[1:], sides, strict=True):
            x = jnp.concatenate([side, rectify(feature(x)), flow(flows[-1])], axis=-1)
            flows.append(head(x))
        finest = 2 ** (6 - len(self.features))
        strides = [finest * 2**n for n in reversed(range(len(flows)))]
        levels = [_UNIT_PX / stride * flow for stride, flow in zip(strides, flows, strict=True)]
        return (*levels, enlarge_flow(levels[-1], finest))


def _scaled(channels: int, width: float) -> int:
    if width <= 0:
        raise ValueError(f"width is {width}; expected the factor of the published channels, above 0.")
    return max(1, round(width * channels))


def _centred(image: Array) -> Array:
    return image - jnp.mean(image, axis=(0, 1), keepdims=True)


def _contract(layers: Sequence[Conv], x: Array) -> list[Array]:
    """The output of each layer."""
    outputs = []
    for layer in layers:
        x = rectify(layer(x))
        outputs.append(x)
    return outputs


def strided_cost_volume(
    first: Float[Array, "height width channel"],
    second: Float[Array, "height width channel"],
    radius: int,
    stride: int,
) -> Float[Array, "height width displacement"]:
    """`cost_volume` at displacements that are multiples of `stride`, `radius` of them to each side.

    Only rows and columns a multiple of `stride` apart are compared: each such sub-grid is an ordinary cost volume.
    """
    height, width, channels = first.shape
    spare = ((0, -height % stride), (0, -width % stride), (0, 0))
    rows, columns = -(-height // stride), -(-width // stride)

    def split(image: Array) -> Array:
        cells = jnp.pad(image, spare).reshape(rows, stride, columns, stride, channels)
        return cells.transpose(1, 3, 0, 2, 4).reshape(stride * stride, rows, columns, channels)

    costs = jax.vmap(lambda one, other: cost_volume(one, other, radius))(split(first), split(second))
    costs = costs.reshape(stride, stride, rows, columns, -1).transpose(2, 0, 3, 1, 4)
    return costs.reshape(rows * stride, columns * stride, -1)[:height, :width]


class FlowNetS(AbstractFlowNetwork):
    """The simple network: both images stacked as input. 38,676,514 parameters.

    `width` scales the channels (FlowNet 2.0 has thin variants of 3/8).
    """

    contracting: tuple[Conv, ...]
    expanding: _Expanding
    divisor: int = eqx.field(static=True)

    def __init__(self, width: float = 1.0, *, seed: int = 0):
        sizes = [_scaled(channels, width) for channels, _, _ in _CONTRACTING]
        keys = jax.random.split(jax.random.key(seed), len(sizes) + 1)
        self.contracting = tuple(
            Conv(inputs, outputs, size, stride=stride, key=key)
            for inputs, outputs, (_, size, stride), key in zip(
                [6, *sizes[:-1]], sizes, _CONTRACTING, keys, strict=False
            )
        )
        self.expanding = _Expanding(
            sizes[9], [sizes[n] for n in (7, 5, 3, 1)], [_scaled(n, width) for n in _EXPANDING], key=keys[-1]
        )
        self.divisor = 64

    def encode(self, image: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
        """The image minus its mean colour: this network has no features of a single image."""
        return _centred(image)

    def decode(
        self, first: Float[Array, "height width 3"], second: Float[Array, "height width 3"]
    ) -> tuple[Float[Array, "_ _ 2"], ...]:
        known = _contract(self.contracting, jnp.concatenate([first, second], axis=-1))
        return self.expanding(known[9], [known[n] for n in (7, 5, 3, 1)])


class FlowNetC(AbstractFlowNetwork):
    """The network with a correlation of the two images' features at 1/8. 39,175,298 parameters.

    `width` scales the channels.
    """

    alone: tuple[Conv, ...]
    redirect: Conv
    contracting: tuple[Conv, ...]
    expanding: _Expanding
    divisor: int = eqx.field(static=True)

    def __init__(self, width: float = 1.0, *, seed: int = 0):
        sizes = [_scaled(channels, width) for channels, _, _ in _CONTRACTING]
        keys = jax.random.split(jax.random.key(seed), len(sizes) + 2)
        redirected = _scaled(_REDIRECTED, width)
        costs = (2 * (_REACH // _STEP) + 1) ** 2
        entries = [3, *sizes[:-1]]
        entries[_NUM_SEPARATE] = costs + redirected
        layers = [
            Conv(inputs, outputs, size, stride=stride, key=key)
            for inputs, outputs, (_, size, stride), key in zip(entries, sizes, _CONTRACTING, keys, strict=False)
        ]
        self.alone, self.contracting = tuple(layers[:_NUM_SEPARATE]), tuple(layers[_NUM_SEPARATE:])
        self.redirect = Conv(sizes[_NUM_SEPARATE - 1], redirected, 1, key=keys[-2])
        self.expanding = _Expanding(
            sizes[9], [sizes[n] for n in (7, 5, 3, 1)], [_scaled(n, width) for n in _EXPANDING], key=keys[-1]
        )
        self.divisor = 64

    def encode(
        self, image: Float[Array, "height width 3"]
    ) -> tuple[Float[Array, "quarter _ _"], Float[Array, "eighth _ _"]]:
        """Features at 1/4 and at 1/8 of the image, without its mean colour."""
        _, side, joined = _contract(self.alone, _centred(image))
        return side, joined

    def decode(
        self, first: tuple[Float[Array, ...], ...], second: tuple[Float[Array, ...], ...]
    ) -> tuple[Float[Array, "_ _ 2"], ...]:
        side, here = first
        costs = rectify(strided_cost_volume(here, second[1], _REACH // _STEP, _STEP))
        x = jnp.concatenate([rectify(self.redirect(here)), costs], axis=-1)
        known = _contract(self.contracting, x)
        return self.expanding(known[6], [known[4], known[2], known[0], side])
