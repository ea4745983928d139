"""The single-shot detector's network: a small convolutional net over default boxes (SSD, Liu et al., 2016)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .default_boxes import SHAPES_PX


class Convolution(eqx.Module):
    """3 x 3 convolution of pictures with channels last, zeros beyond the edge."""

    weight: Float[Array, "3 3 inputs outputs"]
    bias: Float[Array, " outputs"]
    stride: int = eqx.field(static=True)

    def __init__(self, inputs: int, outputs: int, stride: int, *, key: PRNGKeyArray):
        scale = jnp.asarray((2.0 / (9 * inputs)) ** 0.5, jnp.float32)
        self.weight = scale * jax.random.normal(key, (3, 3, inputs, outputs), jnp.float32)
        self.bias = jnp.zeros(outputs, jnp.float32)
        self.stride = stride

    def __call__(self, x: Float[Array, "height width inputs"]) -> Float[Array, "_ _ outputs"]:
        out = jax.lax.conv_general_dilated(
            x[None], self.weight, (self.stride, self.stride), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        return out[0] + self.bias[None, None, :]


class BoxNetwork(eqx.Module):
    """Scores and offsets of all default boxes of a picture, at a quarter of its resolution.

    One scale of feature map, where SSD has several: a camera at the ceiling sees all objects at nearly one size.
    """

    layers: tuple[Convolution, ...]
    head: Convolution

    def __init__(self, widths: tuple[int, int, int] = (16, 32, 48), depth: int = 3, *, key: PRNGKeyArray):
        """Two layers that halve the picture, `depth` more on a quarter of it."""
        keys = jax.random.split(key, depth + 3)
        sizes = [(3, widths[0], 2), (widths[0], widths[1], 2), (widths[1], widths[2], 1)]
        sizes += [(widths[2], widths[2], 1)] * (depth - 1)
        self.layers = tuple(Convolution(*size, key=one) for size, one in zip(sizes, keys[:-1], strict=False))
        head = Convolution(widths[2], 5 * len(SHAPES_PX), 1, key=keys[-1])
        # Nearly all default boxes are background: the initial bias expresses it.
        bias = jnp.zeros((len(SHAPES_PX), 5)).at[:, 0].set(-4.0).reshape(-1)
        self.head = eqx.tree_at(lambda h: (h.weight, h.bias), head, (0.1 * head.weight, bias))

    def __call__(self, image: Float[Array, "height width 3"]) -> tuple[Float[Array, " boxes"], Float[Array, "boxes 4"]]:
        """Log odds that each default box contains an object, and its offsets. Sides are multiples of 4, RGB 0 to 1."""
        x = (image - 0.5) * 4.0
        for layer in self.layers:
            x = jax.nn.relu(layer(x))
        output = self.head(x).reshape(-1, 5)
        return output[:, 0], output[:, 1:]
