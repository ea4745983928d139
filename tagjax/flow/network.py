"""The interface of flow networks: features of one image, and flow from the features of two."""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractFlowNetwork(eqx.Module):
    """A flow network in two parts, so that each image of a video is encoded once for both directions.

    Images are RGB, 0 to 1, with sides that are multiples of `divisor` (`tagjax.flow.estimates` takes any size).
    """

    divisor: eqx.AbstractVar[int]

    @abc.abstractmethod
    def encode(self, image: Float[Array, "height width 3"]) -> Any:
        """Features of one image."""

    @abc.abstractmethod
    def decode(self, first: Any, second: Any) -> tuple[Float[Array, "_ _ 2"], ...]:
        """Flow from the first image to the second, on the first's pixels: estimates from coarse to final.

        Each estimate is in pixels of its own resolution; the last has the resolution of the images.
        """


Levels = tuple[Float[Array, "_ _ _"], ...]


def flow_both_ways(
    network: AbstractFlowNetwork, first: Float[Array, "height width 3"], second: Float[Array, "height width 3"]
) -> tuple[Levels, Levels]:
    """All estimates of the flow first to second, and of the flow second to first, as one batch of two."""
    forward, backward = network.encode(first), network.encode(second)
    here = jax.tree.map(lambda a, b: jnp.stack([a, b]), forward, backward)
    there = jax.tree.map(lambda a, b: jnp.stack([b, a]), forward, backward)
    both = jax.vmap(network.decode)(here, there)
    return tuple(level[0] for level in both), tuple(level[1] for level in both)
