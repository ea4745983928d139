"""Pairs of images for flow training as Grain's random access sources, and an endless stream of augmented pairs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import grain
import numpy as np
from jaxtyping import UInt8

from ..core.stream import Stream
from ..core.types import LazyArray
from ..recording import RecordingError
from .augmentation import AugmentationSettings, augment


class PairSource:
    """All pairs of images of a sequence whose distance is one of `gaps` frames. Raises `RecordingError` if there is
    none.
    """

    def __init__(self, sequence: LazyArray, gaps: Sequence[int]):
        count = sequence.shape[0]
        self._sequence = sequence
        self._pairs = [(t, t + gap) for gap in gaps for t in range(count - gap)]
        if not self._pairs:
            raise RecordingError(
                f"No two of {count} images are {' or '.join(map(str, gaps))} frames apart; use a longer sequence or smaller gaps."
            )

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index) -> UInt8[np.ndarray, "2 height width 3"]:
        first, second = self._pairs[int(index)]
        return np.stack([np.asarray(self._sequence[first]), np.asarray(self._sequence[second])])


class StackedPairs:
    """Stored pairs, (pair, 2, height, width, 3)."""

    def __init__(self, pairs: LazyArray):
        self._pairs = pairs

    def __len__(self) -> int:
        return self._pairs.shape[0]

    def __getitem__(self, index) -> UInt8[np.ndarray, "2 height width 3"]:
        return np.asarray(self._pairs[int(index)])


class TeacherPairs:
    """Stored pairs, (pair, 2, height, width, 3), with a teacher's flow from first to second, (pair, height, width, 2)
    in pixels.
    """

    def __init__(self, pairs: LazyArray, flow_px: LazyArray):
        if tuple(flow_px.shape) != (pairs.shape[0], *pairs.shape[2:4], 2):
            raise ValueError(
                f"Flow of shape {tuple(flow_px.shape)} for pairs of shape {tuple(pairs.shape)}; expected "
                f"{(pairs.shape[0], *pairs.shape[2:4], 2)}."
            )
        self._pairs, self._flow_px = pairs, flow_px

    def __len__(self) -> int:
        return self._pairs.shape[0]

    def __getitem__(self, index) -> dict[str, np.ndarray]:
        number = int(index)
        return {"pair": np.asarray(self._pairs[number]), "flow_px": np.asarray(self._flow_px[number], np.float32)}


class _Augment(grain.transforms.RandomMap):
    def __init__(self, settings: AugmentationSettings):
        self._settings = settings

    def random_map(self, element: Any, rng: np.random.Generator) -> Any:
        if isinstance(element, dict):
            return augment(element["pair"], rng, self._settings, element["flow_px"])
        return augment(element, rng, self._settings)


def pair_dataset(
    sources: Sequence[PairSource | StackedPairs | TeacherPairs],
    weights: Sequence[float],
    settings: AugmentationSettings,
    *,
    seed: int,
    workers: int = 0,
    shard: tuple[int, int] = (0, 1),
) -> Stream:
    """An endless, shuffled stream of augmented pairs (`augment`); its iterator resumes exactly.

    Sources are mixed in proportion to `weights`. `workers` processes read them; `shard` (i, n) is every n-th pair of
    the stream, from the i-th on. Raises `ValueError` unless there is a positive weight for each source.
    """
    if len(sources) != len(weights) or not sources or min(weights) <= 0:
        raise ValueError(f"{len(sources)} sources with weights {list(weights)}; expected a positive weight for each.")
    datasets = [
        grain.MapDataset.source(cast(Any, source)).seed(seed + number).shuffle().repeat().random_map(_Augment(settings))
        for number, source in enumerate(sources)
    ]
    mixed = grain.MapDataset.mix(datasets, weights=list(weights)) if len(datasets) > 1 else datasets[0]
    return Stream(mixed, workers=workers, prefetch=16, shard=shard)
