"""Flows by name: `zero`, OpenCV's, and networks with their weights; and the flow along a video."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from . import opencv
from .estimate import NetworkFlow
from .opencv import FlowFunction
from .pictures import check_pictures
from .weights import find_weights, load_network, packaged_weights, weights_about


class ZeroFlow:
    """No motion anywhere: what every flow has to beat."""

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        one, _ = check_pictures(first, second)
        return np.zeros((*one.shape[:2], 2), np.float32)


CLASSICAL: dict[str, Callable[[], FlowFunction]] = {"zero": ZeroFlow, **opencv.FLOWS}
"""Flows that learn nothing, by name."""

VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {"pyramid_fine": ("pyramid", {"octaves": (-1, 0, 1, 2)})}
"""Packaged weights with other settings of their network, by name."""


def make_flow(name: str) -> FlowFunction:
    """A flow by name: `CLASSICAL`, packaged weights (`pyramid`), one of `VARIANTS`, or the path of an .npz of weights.

    Raises `ValueError` for a name that is none of these, and for weights that cannot be used.
    """
    if name in CLASSICAL:
        return CLASSICAL[name]()
    path = _weights(name)
    return _network_flow(name, str(path), _stamp(path))


def flow_key(name: str) -> str:
    """A name for what `make_flow(name)` computes that is a file name, too: weights go by their digest.

    Other weights have another key, wherever they lie. Errors as of `make_flow`.
    """
    if name in CLASSICAL:
        return name
    path = _weights(name)
    key = _weights_key(str(path), _stamp(path))
    return f"{key}-{name}" if name in VARIANTS else key


def flow_along(flow: FlowFunction, pictures: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Flow forward and backward between neighbouring pictures of a video: one pair fewer than pictures.

    A network sees each picture once. Errors as of `check_pictures`.
    """
    if isinstance(flow, NetworkFlow):
        yield from flow.along(pictures)
        return
    before = None
    for picture in pictures:
        if before is not None:
            yield flow(before, picture), flow(picture, before)
        before = picture


def _weights(name: str) -> Path:
    if name in VARIANTS:
        return find_weights(VARIANTS[name][0])
    if name.endswith(".npz") or name in packaged_weights():
        return find_weights(name)
    there = ", ".join(packaged_weights()) or "none"
    raise ValueError(
        f"Unknown optical flow {name!r}; expected one of {', '.join((*CLASSICAL, *VARIANTS))}, packaged weights ({there}), "
        "or the path of an .npz file of weights."
    )


def _stamp(path: Path) -> tuple[int, int]:
    """What changes with a file's content."""
    about = path.stat()
    return about.st_mtime_ns, about.st_size


@functools.lru_cache(maxsize=4)
def _network_flow(name: str, path: str, stamp: tuple[int, int]) -> NetworkFlow:
    changes = VARIANTS[name][1] if name in VARIANTS else {}
    return NetworkFlow(load_network(path, **changes))


@functools.lru_cache(maxsize=64)
def _weights_key(path: str, stamp: tuple[int, int]) -> str:
    digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    network = str(weights_about(path)["flow"]["_target_"]).rsplit(".", 1)[-1]
    return f"{network}-{digest[:16]}"
