"""Flows by name: `zero`, OpenCV's, and networks with their weights; any of them smoothed by how far its two ways agree,
or at rest where rest explains the pictures as well; and the flow along a video.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import opencv, wls
from .estimates import NetworkFlow, consistency, flow_along
from .images import check_images, to_float
from .opencv import FlowFunction
from .stationary import BLOCK_PX, GAIN, GENTLE_BLOCK_PX, GENTLE_GAIN, zero_stationary
from .weights import find_weights, load_network, packaged_weights, weights_metadata
from .wls import weighted_least_squares


class ZeroFlow:
    """No motion anywhere: what every flow has to beat."""

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        one, _ = check_images(first, second)
        return np.zeros((*one.shape[:2], 2), np.float32)


class ZeroStationaryFlow:
    """Another flow, zero where rest explains the pictures as well (`zero_stationary`, gently): for a camera that stands."""

    def __init__(self, flow: FlowFunction):
        self.flow = flow

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return zero_stationary(
            np.asarray(self.flow(first, second)), first, second, gain=GENTLE_GAIN, block_px=GENTLE_BLOCK_PX
        )

    def along(self, pictures: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Flow forward and backward between neighbouring pictures, as `flow_along` of the other gives it."""
        return zero_stationary_along(self.flow, pictures, gain=GENTLE_GAIN, block_px=GENTLE_BLOCK_PX)


class SmoothedFlow:
    """Another flow, smoothed within the pictures' edges by how far the ways there and back agree (`tagjax.flow.wls`)."""

    def __init__(self, flow: FlowFunction):
        self.flow = flow

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        ((forward, backward),) = flow_along(self.flow, (first, second))
        return _smoothed(forward, backward, first)

    def along(self, pictures: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Flow forward and backward between neighbouring pictures, each of the other's ways asked for once."""
        for (forward, backward), (one, other) in _with_pictures(self.flow, pictures):
            yield _smoothed(forward, backward, one), _smoothed(backward, forward, other)


def _with_pictures(
    flow: FlowFunction, pictures: Iterable[np.ndarray]
) -> Iterator[tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]]:
    """`flow_along`, each pair's flow with its two pictures."""
    pictures, again = itertools.tee(pictures)
    return zip(flow_along(flow, pictures), itertools.pairwise(again), strict=True)


@jax.jit
def _smoothed_by_agreement(
    flow_px: Float[Array, "height width 2"],
    back_px: Float[Array, "height width 2"],
    picture: Float[Array, "height width 3"],
) -> Float[Array, "height width 2"]:
    return weighted_least_squares(flow_px, consistency(flow_px, back_px), picture)


def _smoothed(flow_px: np.ndarray, back_px: np.ndarray, picture: np.ndarray) -> np.ndarray:
    picture, _ = check_images(picture, picture)
    return np.asarray(_smoothed_by_agreement(*map(jnp.asarray, (flow_px, back_px, to_float(picture)))))


CLASSICAL: dict[str, Callable[[], FlowFunction]] = {"zero": ZeroFlow, **opencv.FLOWS}
"""Flows that learn nothing, by name."""

VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "pyramid_mid": ("pyramid", {"octaves": (-1, 0, 1), "medians": 2}),
    "pyramid_fine": ("pyramid", {"octaves": (-1, 0, 1, 2), "medians": 2}),
}
"""Packaged weights with other settings of their network, by name; `<name>:<weights.safetensors>` has a file's weights in their place."""

_UNTRAINED = ("flownet_s", "flownet_c", "raft_small")

SUFFIXES: dict[str, tuple[Callable[[FlowFunction], FlowFunction], str]] = {
    "+wls": (SmoothedFlow, wls.settings_key()),
    "+rest": (ZeroStationaryFlow, f"{GENTLE_GAIN:g}-{GENTLE_BLOCK_PX}"),
}
"""What may follow a flow's name, one after the other: what it makes of the flow before it, and a key of its settings."""


def split_suffixes(name: str) -> tuple[str, str]:
    """A flow's name without its `SUFFIXES`, and those, or nothing."""
    bare = name
    while (last := _last_suffix(bare)) is not None:
        bare = bare.removesuffix(last)
    return bare, name[len(bare) :]


def _last_suffix(name: str) -> str | None:
    return next((suffix for suffix in SUFFIXES if name.endswith(suffix)), None)


def make_flow(name: str) -> FlowFunction:
    """A flow by name: `CLASSICAL`, packaged weights (`pyramid`), one of `VARIANTS`, or the path of a .safetensors of weights.

    `pyramid_fine:<weights.safetensors>` is a variant with the weights of a file, such as fine-tuned ones. With `SUFFIXES` after
    it, in that order applied. Raises `ValueError` for a name that is none of these, and for weights that cannot be used.
    """
    if (suffix := _last_suffix(name)) is not None:
        return SUFFIXES[suffix][0](make_flow(name.removesuffix(suffix)))
    if name in CLASSICAL:
        return CLASSICAL[name]()
    path = _weights(name)
    return _network_flow(name, str(path), _stamp(path))


def flow_key(name: str) -> str:
    """A name for what `make_flow(name)` computes that is a file name, too: weights go by their digest.

    Other weights have another key, wherever they lie, and so have other settings. Errors as of `make_flow`.
    """
    if (suffix := _last_suffix(name)) is not None:
        return f"{flow_key(name.removesuffix(suffix))}{suffix}-{SUFFIXES[suffix][1]}"
    if name in CLASSICAL:
        return name
    path = _weights(name)
    key = _weights_key(str(path), _stamp(path))
    variant, _ = _variant(name)
    if variant is None:
        return key
    changes = hashlib.sha256(repr(sorted(VARIANTS[variant][1].items())).encode()).hexdigest()
    return f"{key}-{variant}-{changes[:8]}"


def zero_stationary_along(
    flow: FlowFunction, pictures: Iterable[np.ndarray], *, gain: float = GAIN, block_px: int = BLOCK_PX
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """`flow_along`, zero where rest explains the pictures as well (`zero_stationary`)."""
    for (forward, backward), (one, other) in _with_pictures(flow, pictures):
        yield (
            zero_stationary(forward, one, other, gain=gain, block_px=block_px),
            zero_stationary(backward, other, one, gain=gain, block_px=block_px),
        )


def _variant(name: str) -> tuple[str | None, str]:
    """The variant that a name is, if any, and whose weights it has: packaged ones, or a file's."""
    variant, _, source = name.partition(":")
    if variant not in VARIANTS:
        return None, name
    return variant, source or VARIANTS[variant][0]


def _weights(name: str) -> Path:
    variant, source = _variant(name)
    if variant is not None or source.endswith(".safetensors") or source in packaged_weights():
        return find_weights(source)
    there = ", ".join(packaged_weights()) or "none"
    if name in _UNTRAINED:
        raise ValueError(
            f"The network {name!r} comes without weights (there are: {there}). Train it, `python -m experiments.train_flow "
            f"flow={name}`, and give <run>/weights.safetensors as the flow."
        )
    raise ValueError(
        f"Unknown optical flow {name!r}; expected one of {', '.join((*CLASSICAL, *VARIANTS))}, packaged weights ({there}), "
        f"the path of a .safetensors file of weights, or <variant>:<path>; {' and '.join(SUFFIXES)} may follow."
    )


def _stamp(path: Path) -> tuple[int, int]:
    """What changes with a file's content."""
    about = path.stat()
    return about.st_mtime_ns, about.st_size


@functools.lru_cache(maxsize=4)
def _network_flow(name: str, path: str, stamp: tuple[int, int]) -> NetworkFlow:
    variant, _ = _variant(name)
    return NetworkFlow(load_network(path, **({} if variant is None else VARIANTS[variant][1])))


@functools.lru_cache(maxsize=64)
def _weights_key(path: str, stamp: tuple[int, int]) -> str:
    digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    network = str(weights_metadata(path)["flow"]["_target_"]).rsplit(".", 1)[-1]
    return f"{network}-{digest[:16]}"
