"""The default flow network: a small feature pyramid, a cost volume at each level, and learned upsampling.

After PWC-Net (Sun et al., CVPR 2018) with UFlow's normalised cost volumes (Jonschkowski et al., ECCV 2020) and RAFT's
convex upsampling (Teed and Deng, ECCV 2020), cut to what two CPU cores do at video rate.
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
"""The last step's learned upsampling; the rest is bilinear: by four at once would take as long as all the costs."""


_Layer = Conv | SeparableConv
_MakeLayer = Callable[..., _Layer]


class _Decoder(eqx.Module):
    """Correction of the flow at one level from the costs around the flow of the level above."""

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
        # Nearly zero: from scratch, the first estimate is no motion.
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
    """Levels at 1/4 to 1/32 of the picture, coarse to fine, then convex upsampling by four.

    `widths` are the features of the levels, finest first, `radii` their search radii in pixels of the level,
    `iterations` how often each corrects its flow with the same weights, around where the last correction led (None:
    twice, but once at the finest and the roughest), and `decoder_widths` the hidden layers (the last is always 32).

    `octaves` are the sizes of the picture, as powers of two, that the same weights are laid on in turn, each going on
    from the flow of the one before: all levels on the smallest, the finest two where the picture is not enlarged, the
    finest alone where it is. -1 reaches twice as far; each above 0 is twice as exact and takes four times as long.

    `separable` splits every convolution of 3 x 3 in two (`SeparableConv`): a third to an eighth of the time each.
    `matched` are the features of each level that costs are made of, mixed from all of them; 0, or None: all, as they are.

    `medians` is how often the flow is median filtered over 5 x 5 pixels in the end (Sun et al., CVPR 2010). Filtered
    between the octaves, too, large motion would gain, and things of a few pixels lose.
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
                "{} widths, {} radii, {} iterations, {} decoder_widths; one of each for every level.".format(*lengths)
            )
        if min(iterations) < 1:
            raise ValueError(f"iterations are {tuple(iterations)}; every level takes at least 1.")
        if (
            not octaves
            or list(octaves) != list(range(octaves[0], octaves[-1] + 1))
            or not octaves[0] <= 0 <= octaves[-1]
        ):
            raise ValueError(f"octaves are {tuple(octaves)}; expected neighbouring ones with 0 among them, rising.")
        if medians < 0:
            raise ValueError(f"medians is {medians}; expected how often the flow is filtered, 0 for never.")
        count = len(widths)
        matched = [0] * count if matched is None else list(matched)
        if len(matched) != count or min(matched) < 0:
            raise ValueError(
                f"matched is {tuple(matched)}; expected one number of features for each of {count} levels."
            )
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
        """Features of every octave, finest level first; the picture's mean and contrast are taken out."""
        return tuple(self._features(_sized(image, octave), self._levels(octave)) for octave in self.octaves)

    def decode(self, first: tuple[Levels, ...], second: tuple[Levels, ...]) -> Levels:
        flows: list[Array] = []
        finer = jnp.zeros((*first[0][0].shape[:2], 2))
        for one, other in zip(first, second, strict=True):
            # The last octave's flow has the size of this one's finest level.
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
        """How many of the levels, finest first, are used on an octave."""
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
