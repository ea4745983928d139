"""Flows by name: `zero`, OpenCV's, and networks with weights; optionally smoothed (`+wls`) or zero where the scene is
stationary (`+rest`).
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
from .stationary import BLOCK_PX, GAIN, MILD_BLOCK_PX, MILD_GAIN, zero_stationary
from .weights import SUFFIX, find_weights, load_network, packaged_weights, weights_metadata
from .wls import weighted_least_squares


class ZeroFlow:
    """Zero flow, the trivial baseline."""

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        one, _ = check_images(first, second)
        return np.zeros((*one.shape[:2], 2), np.float32)


class ZeroStationaryFlow:
    """Another flow, set to zero at stationary pixels (`zero_stationary` with mild settings), for a static camera."""

    def __init__(self, flow: FlowFunction):
        self.flow = flow

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return zero_stationary(
            np.asarray(self.flow(first, second)), first, second, gain=MILD_GAIN, block_px=MILD_BLOCK_PX
        )

    def along(self, images: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Forward and backward flow of consecutive images."""
        return zero_stationary_along(self.flow, images, gain=MILD_GAIN, block_px=MILD_BLOCK_PX)


class SmoothedFlow:
    """Another flow, smoothed within image edges with its forward-backward consistency as weights (`tagjax.flow.wls`)."""

    def __init__(self, flow: FlowFunction):
        self.flow = flow

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        ((forward, backward),) = flow_along(self.flow, (first, second))
        return _smoothed(forward, backward, first)

    def along(self, images: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Forward and backward flow of consecutive images; each direction is computed once."""
        for (forward, backward), (one, other) in _with_images(self.flow, images):
            yield _smoothed(forward, backward, one), _smoothed(backward, forward, other)


def _with_images(
    flow: FlowFunction, images: Iterable[np.ndarray]
) -> Iterator[tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]]:
    """`flow_along`, the flow of each pair with its two images."""
    images, again = itertools.tee(images)
    return zip(flow_along(flow, images), itertools.pairwise(again), strict=True)


@jax.jit
def _smooth_by_consistency(
    flow_px: Float[Array, "height width 2"],
    back_px: Float[Array, "height width 2"],
    image: Float[Array, "height width 3"],
) -> Float[Array, "height width 2"]:
    return weighted_least_squares(flow_px, consistency(flow_px, back_px), image)


def _smoothed(flow_px: np.ndarray, back_px: np.ndarray, image: np.ndarray) -> np.ndarray:
    image, _ = check_images(image, image)
    return np.asarray(_smooth_by_consistency(*map(jnp.asarray, (flow_px, back_px, to_float(image)))))


CLASSICAL: dict[str, Callable[[], FlowFunction]] = {"zero": ZeroFlow, **opencv.FLOWS}
"""Flows without weights, by name."""

VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "pyramid_mid": ("pyramid", {"octaves": (-1, 0, 1), "medians": 2}),
    "pyramid_fine": ("pyramid", {"octaves": (-1, 0, 1, 2), "medians": 2}),
}
"""Packaged weights with other settings of their network, by name; `<name>:<weights.safetensors>` takes a file's
weights."""

_UNTRAINED = ("flownet_s", "flownet_c", "raft_small")

SUFFIXES: dict[str, tuple[Callable[[FlowFunction], FlowFunction], str]] = {
    "+wls": (SmoothedFlow, wls.settings_key()),
    "+rest": (ZeroStationaryFlow, f"{MILD_GAIN:g}-{MILD_BLOCK_PX}"),
}
"""Suffixes of a flow's name: the wrapper of the flow, and a key of the wrapper's settings."""


def split_suffixes(name: str) -> tuple[str, str]:
    """A flow's name without its `SUFFIXES`, and the suffixes (or an empty string)."""
    bare = name
    while (last := _last_suffix(bare)) is not None:
        bare = bare.removesuffix(last)
    return bare, name[len(bare) :]


def _last_suffix(name: str) -> str | None:
    return next((suffix for suffix in SUFFIXES if name.endswith(suffix)), None)


def make_flow(name: str) -> FlowFunction:
    """A flow by name: `CLASSICAL`, packaged weights (`pyramid`), one of `VARIANTS`, or the path of a weights file.

    `pyramid_fine:<weights.safetensors>` is a variant with the weights of a file, such as fine-tuned ones. `SUFFIXES`
    may follow and are applied in that order. Raises `ValueError` for any other name, and for weights that cannot be
    used.
    """
    if (suffix := _last_suffix(name)) is not None:
        return SUFFIXES[suffix][0](make_flow(name.removesuffix(suffix)))
    if name in CLASSICAL:
        return CLASSICAL[name]()
    path = _weights(name)
    return _network_flow(name, str(path), _stamp(path))


def flow_key(name: str) -> str:
    """A file name that identifies the result of `make_flow(name)`: other weights or settings have another key.

    Weights are identified by the digest of their file, not by its path. Errors as of `make_flow`.
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
    flow: FlowFunction, images: Iterable[np.ndarray], *, gain: float = GAIN, block_px: int = BLOCK_PX
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """`flow_along`, set to zero at stationary pixels (`zero_stationary`)."""
    for (forward, backward), (one, other) in _with_images(flow, images):
        yield (
            zero_stationary(forward, one, other, gain=gain, block_px=block_px),
            zero_stationary(backward, other, one, gain=gain, block_px=block_px),
        )


def _variant(name: str) -> tuple[str | None, str]:
    """The variant that a name selects, if any, and its weights: a packaged name, or the path of a file."""
    variant, _, source = name.partition(":")
    if variant not in VARIANTS:
        return None, name
    return variant, source or VARIANTS[variant][0]


def _weights(name: str) -> Path:
    variant, source = _variant(name)
    if variant is not None or source.endswith(SUFFIX) or source in packaged_weights():
        return find_weights(source)
    available = ", ".join(packaged_weights()) or "none"
    if name in _UNTRAINED:
        raise ValueError(
            f"The network {name!r} has no packaged weights (packaged are: {available}). Train it, `python -m experiments.train_flow "
            f"flow={name}`, and give <run>/weights.safetensors as the flow."
        )
    raise ValueError(
        f"Unknown optical flow {name!r}; expected one of {', '.join((*CLASSICAL, *VARIANTS))}, packaged weights ({available}), "
        f"the path of a .safetensors file, or <variant>:<path>; {' and '.join(SUFFIXES)} may follow."
    )


def _stamp(path: Path) -> tuple[int, int]:
    """Time and size of a file, which change with its content."""
    status = path.stat()
    return status.st_mtime_ns, status.st_size


@functools.lru_cache(maxsize=4)
def _network_flow(name: str, path: str, stamp: tuple[int, int]) -> NetworkFlow:
    variant, _ = _variant(name)
    return NetworkFlow(load_network(path, **({} if variant is None else VARIANTS[variant][1])))


@functools.lru_cache(maxsize=64)
def _weights_key(path: str, stamp: tuple[int, int]) -> str:
    digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    network = str(weights_metadata(path)["flow"]["_target_"]).rsplit(".", 1)[-1]
    return f"{network}-{digest[:16]}"
