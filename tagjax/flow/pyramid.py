"""The default flow network: a small feature pyramid, a cost volume at each level, and learned upsampling.

After PWC-Net (Sun et al., CVPR 2018) with UFlow's normalised cost volumes (Jonschkowski et al., ECCV 2020) and RAFT's
convex upsampling (Teed and Deng, ECCV 2020), reduced to the speed of two CPU cores at video rate.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ..image.median import median_filter
from ..image.warp import gather
from ._layers import Conv, SeparableConv, convex_upsample, enlarge, enlarge_flow, rectify, shrink, space_to_depth
from .cost_volume import cost_volume, normalise_features
from .network import AbstractFlowNetwork, Levels

_FINEST = 4
_HIDDEN = 32
_MEDIAN_PX = 5
_CONVEX = 2
"""Factor of the learned upsampling in the last step; the remaining factor is bilinear, which is much faster."""


_Layer = Conv | SeparableConv
_MakeLayer = Callable[..., _Layer]


class _Decoder(eqx.Module):
    """Correction of the flow at one level from the costs around the flow of the coarser level."""

    context: Conv
    layers: tuple[_Layer, ...]
    head: _Layer
    match: Conv | None
    radius: int = eqx.field(static=True)

    def __init__(
        self, features: int, widths: Sequence[int], radius: int, layer: _MakeLayer, matched: int, *, key: PRNGKeyArray
    ):
        keys = jax.random.split(key, len(widths) + 2)
        sizes = [(2 * radius + 1) ** 2 + _HIDDEN + 2, *widths]
        self.context = Conv(features, _HIDDEN, 1, key=keys[-2])
        self.layers = tuple(layer(a, b, key=k) for a, b, k in zip(sizes[:-1], sizes[1:], keys[:-2], strict=True))
        # Nearly zero, so that the first estimate of an untrained network is zero.
        self.head = layer(widths[-1], 2, gain=0.01, key=keys[-1])
        self.match = Conv(features, matched, 1, key=jax.random.fold_in(key, 0)) if matched else None
        self.radius = radius

    def __call__(
        self,
        first: Float[Array, "height width features"],
        second: Float[Array, "height width features"],
        flow_px: Float[Array, "height width 2"],
        hidden: Float[Array, "height width hidden"],
    ) -> tuple[Float[Array, "height width 2"], Float[Array, "height width hidden"]]:
        one, other = (first, second) if self.match is None else (self.match(first), self.match(second))
        one, other = normalise_features(one, other)
        other, _ = gather(other, flow_px)
        cost = rectify(cost_volume(one, other, self.radius))
        x = jnp.concatenate([cost, rectify(self.context(first)) + hidden, flow_px], axis=-1)
        for layer in self.layers:
            x = rectify(layer(x))
        return flow_px + self.head(x), x


class PyramidFlow(AbstractFlowNetwork):
    """Levels at 1/4 to 1/32 of the image, coarse to fine, then convex upsampling by four.

    `widths` are the numbers of features of the levels, finest first; `radii` their search radii in pixels of the level;
    `iterations` the numbers of corrections with the same weights, each around the last flow (None: two, but one at the
    finest and the coarsest level); `decoder_widths` the hidden layers (a last one of 32 is added).

    `octaves` are the scales of the image, as powers of two, at which the same weights are applied in turn, each from
    the flow of the one before: all levels at the smallest scale, the finest two up to scale 0, the finest only above.
    -1 doubles the search range; each octave above 0 doubles the resolution and takes four times as long.

    `separable` uses `SeparableConv` for every 3 x 3 convolution: a third to an eighth of the time. `matched` are the
    numbers of features of each level that the costs are computed from, projected from all; 0 or None: all features.

    `medians` is the number of final 5 x 5 median filters of the flow (Sun et al., CVPR 2010). Filters between the
    octaves would improve large motion, but lose objects of a few pixels. Raises `ValueError` for impossible settings.
    """

    encoders: tuple[tuple[_Layer, _Layer], ...]
    decoders: tuple[_Decoder, ...]
    upsampler: Conv
    iterations: tuple[int, ...] = eqx.field(static=True, converter=tuple)
    octaves: tuple[int, ...] = eqx.field(static=True, converter=tuple)
    medians: int = eqx.field(static=True)
    divisor: int = eqx.field(static=True)

    def __init__(
        self,
        widths: Sequence[int] = (32, 64, 96, 96),
        radii: Sequence[int] = (2, 3, 4, 4),
        iterations: Sequence[int] | None = None,
        decoder_widths: Sequence[Sequence[int]] = ((32, 32), (64, 64), (64, 64), (64, 64)),
        octaves: Sequence[int] = (0,),
        medians: int = 0,
        separable: bool = False,
        matched: Sequence[int] | None = None,
        *,
        seed: int = 0,
    ):
        if iterations is None:
            iterations = [1 if n in (0, len(widths) - 1) else 2 for n in range(len(widths))]
        lengths = [len(given) for given in (widths, radii, iterations, decoder_widths)]
        if len(set(lengths)) > 1 or not widths:
            raise ValueError(
                "{} widths, {} radii, {} iterations, {} decoder_widths; expected one of each for every level.".format(
                    *lengths
                )
            )
        if min(iterations) < 1:
            raise ValueError(f"iterations are {tuple(iterations)}; expected at least 1 for every level.")
        if (
            not octaves
            or list(octaves) != list(range(octaves[0], octaves[-1] + 1))
            or not octaves[0] <= 0 <= octaves[-1]
        ):
            raise ValueError(f"octaves are {tuple(octaves)}; expected consecutive increasing integers that include 0.")
        if medians < 0:
            raise ValueError(f"medians is {medians}; expected the number of median filters, 0 or more.")
        count = len(widths)
        matched = [0] * count if matched is None else list(matched)
        if len(matched) != count or min(matched) < 0:
            raise ValueError(f"matched is {tuple(matched)}; expected a number of features for each of {count} levels.")
        layer = SeparableConv if separable else Conv
        keys = jax.random.split(jax.random.key(seed), 3 * count + 1)
        first = layer(3 * _FINEST**2, widths[0], key=keys[0])
        downs = [
            Conv(a, b, 2, stride=2, padding=0, key=keys[n + 1]) for n, (a, b) in enumerate(itertools.pairwise(widths))
        ]
        refines = [layer(width, width, key=keys[count + n]) for n, width in enumerate(widths)]
        self.encoders = tuple(zip([first, *downs], refines, strict=True))
        self.decoders = tuple(
            _Decoder(widths[n], [*decoder_widths[n], _HIDDEN], radii[n], layer, matched[n], key=keys[2 * count + n])
            for n in range(count)
        )
        self.iterations = tuple(iterations)
        self.upsampler = Conv(_HIDDEN, 9 * _CONVEX**2, 1, gain=0.1, key=keys[-1])
        self.octaves, self.medians = tuple(octaves), medians
        self.divisor = _FINEST * 2 ** (count - 1 - self.octaves[0])

    def encode(self, image: Float[Array, "height width 3"]) -> tuple[Levels, ...]:
        """Features of every octave, finest level first; the image is normalised to zero mean and unit contrast."""
        return tuple(self._features(_sized(image, octave), self._levels(octave)) for octave in self.octaves)

    def decode(self, first: tuple[Levels, ...], second: tuple[Levels, ...]) -> Levels:
        flows: list[Array] = []
        finer = jnp.zeros((*first[0][0].shape[:2], 2))
        for one, other in zip(first, second, strict=True):
            # The flow of the last octave has the size of this octave's finest level.
            flow = _sized_flow(finer, 1 - len(one))
            hidden = jnp.zeros((*flow.shape[:2], _HIDDEN))
            for level in reversed(range(len(one))):
                if level < len(one) - 1:
                    flow, hidden = enlarge_flow(flow, 2), enlarge(hidden, 2)
                for _ in range(self.iterations[level]):
                    flow, hidden = self.decoders[level](one[level], other[level], flow, hidden)
                flows.append(flow)
            finer = convex_upsample(flow, self.upsampler(hidden), _CONVEX)
        last = _sized_flow(finer, 1 - self.octaves[-1])
        for _ in range(self.medians):
            last = median_filter(last, _MEDIAN_PX)
        return (*flows, last)

    def _levels(self, octave: int) -> int:
        """Number of levels, finest first, that an octave uses."""
        if octave == self.octaves[0]:
            return len(self.encoders)
        return 1 if octave > 0 else min(2, len(self.encoders))

    def _features(self, image: Float[Array, "height width 3"], levels: int) -> Levels:
        x = space_to_depth(image, _FINEST)
        mean = jnp.tile(jnp.mean(jnp.mean(x, axis=(0, 1)).reshape(-1, 3), axis=0), _FINEST**2).reshape(1, 1, -1)
        x = (x - mean) * jax.lax.rsqrt(jnp.mean(jnp.square(x - mean)) + 1e-3)
        features = []
        for enter, refine in self.encoders[:levels]:
            x = rectify(refine(rectify(enter(x))))
            features.append(x)
        return tuple(features)


def _sized(image: Float[Array, "height width channel"], octave: int) -> Float[Array, "rows columns channel"]:
    """2^octave times as large."""
    if octave == 0:
        return image
    return enlarge(image, 2**octave) if octave > 0 else shrink(image, 2**-octave)


def _sized_flow(flow_px: Float[Array, "height width 2"], octave: int) -> Float[Array, "rows columns 2"]:
    """2^octave times as large, in pixels of that size."""
    return _sized(flow_px, octave) * 2.0**octave
