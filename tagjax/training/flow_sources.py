"""Images for flow training: synthetic pairs, rendered once and cached, and the user's sequences."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from ..core.array_cache import cached_array, write_rows
from ..core.stream import Stream
from ..core.types import LazyArray
from ..flow.augmentation import AugmentationSettings
from ..flow.flying_chairs import FlyingChairs, is_flying_chairs
from ..flow.image_pairs import PairSource, StackedPairs, TeacherPairs, pair_dataset
from ..flow.image_sequences import open_sequence
from ..sim.flow_pairs import FlowPair, FlowPairSettings, flow_pairs
from ..sim.rendering.textures import PHOTOGRAPHS, photograph
from .flow_teacher import cut_pairs, cut_stored_pairs, teacher_flow

_BATCH = 16
_SHARD = 128
_PHOTO_SHAPE = (240, 320)
_CUTS_OF_A_PHOTO = 3
_VALIDATION_SEED = 1_000_003


@dataclasses.dataclass(frozen=True)
class DrawnSettings:
    """The synthetic pairs: how many, and their content. They are rendered once and cached under `folder`."""

    num_pairs: int = 4096
    num_validation: int = 64
    seed: int = 0
    photographs: bool = True  # those of installed packages; their names are part of the cache key
    folder: str = "recordings"
    pairs: FlowPairSettings = dataclasses.field(default_factory=FlowPairSettings)

    def __post_init__(self) -> None:
        for name, minimum in (("num_pairs", 0), ("num_validation", _BATCH)):
            value = getattr(self, name)
            if value % _BATCH or value < minimum:
                raise ValueError(f"{name} is {value}; expected a multiple of {_BATCH}, {minimum} or more.")


@dataclasses.dataclass(frozen=True)
class FlowDataSettings:
    """The training data of a flow network, and how pairs are cropped and augmented."""

    drawn: DrawnSettings = dataclasses.field(default_factory=DrawnSettings)
    sequences: tuple[str, ...] = ()  # recordings, videos, folders of images, FlyingChairs; used without labels
    sequence_fraction: float = 0.5  # fraction of the samples that is from sequences; the others are synthetic
    variation: AugmentationSettings = dataclasses.field(default_factory=AugmentationSettings)
    teacher: str | None = None  # a flow by name; its estimates are then the only training signal
    cuts_per_sequence: int = 24  # pairs of the synthetic pairs' size for which the teacher estimates the flow
    workers: int = 0  # processes that read and augment pairs

    def __post_init__(self) -> None:
        if self.cuts_per_sequence < 1:
            raise ValueError(f"cuts_per_sequence is {self.cuts_per_sequence}; expected at least 1.")
        if not 0 < self.sequence_fraction <= 1:
            raise ValueError(
                f"sequence_fraction is {self.sequence_fraction}; expected a fraction above 0 and at most 1."
            )
        if self.drawn.num_pairs < 1 and not self.sequences:
            raise ValueError(
                "Nothing to learn from: found drawn.num_pairs=0 and no sequences; expected one of the two."
            )


def installed_photographs() -> list[str]:
    """Names of the photographs that installed packages contain."""
    return [name for name in PHOTOGRAPHS if photograph(name) is not None]


def photograph_stack(names: Sequence[str], seed: int) -> UInt8[np.ndarray, "count 240 320 3"] | None:
    """Crops of these photographs at random scales; None without any name."""
    rng = np.random.default_rng(seed)
    height, width = _PHOTO_SHAPE
    cuts = []
    for name in names:
        levels = photograph(name)
        assert levels is not None
        picture = (255 * levels[0] ** np.float32(1 / 2.2)).astype(np.uint8)
        min_scale = max(height / picture.shape[0], width / picture.shape[1])
        for _ in range(_CUTS_OF_A_PHOTO):
            scale = min_scale * rng.uniform(1.0, 1.6)
            size = (max(width, round(picture.shape[1] * scale)), max(height, round(picture.shape[0] * scale)))
            resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
            top, left = rng.integers(0, size[1] - height + 1), rng.integers(0, size[0] - width + 1)
            cuts.append(resized[top : top + height, left : left + width])
    return np.stack(cuts) if cuts else None


def _photographs(settings: DrawnSettings) -> UInt8[np.ndarray, "count 240 320 3"] | None:
    return photograph_stack(installed_photographs() if settings.photographs else [], settings.seed)


def drawn_pairs(settings: DrawnSettings, *, progress: bool = True) -> LazyArray:
    """The drawn pairs (pair, 2, height, width, 3), uint8; rendered if they are not cached yet."""
    about = {**dataclasses.asdict(settings), "photographs": installed_photographs() if settings.photographs else []}
    del about["folder"], about["num_validation"]
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:12]
    target = Path(settings.folder) / f"flow-pairs-{settings.num_pairs}-{digest}.zarr"
    return cached_array(target, lambda path: _draw(settings, path, about, progress))


def _draw(settings: DrawnSettings, path: Path, about: dict, progress: bool) -> None:
    photos = _photographs(settings)

    def rows(first: int) -> Iterator[np.ndarray]:
        for start in range(first, settings.num_pairs, _BATCH):
            yield to_bytes(_batch(settings, photos, settings.seed, start))

    write_rows(
        path,
        rows,
        shape=(settings.num_pairs, 2, settings.pairs.height, settings.pairs.width, 3),
        dtype="uint8",
        shard=_SHARD,
        attributes={"about": about},
        description="render flow pairs",
        progress=progress,
    )


def _batch(settings: DrawnSettings, photos: np.ndarray | None, seed: int, start: int) -> FlowPair:
    key = jax.random.fold_in(jax.random.key(seed), start)
    return flow_pairs(settings.pairs, _BATCH, None if photos is None else jnp.asarray(photos), key=key)


def to_bytes(pairs: FlowPair) -> UInt8[np.ndarray, "pair 2 height width 3"]:
    """Both images of stacked pairs as bytes."""
    both = np.stack([np.asarray(pairs.first), np.asarray(pairs.second)], axis=1)
    return np.rint(255 * both).astype(np.uint8)


def validation_pairs(settings: DrawnSettings) -> FlowPair:
    """Synthetic pairs with their flow; their seed is never used for training."""
    photos = _photographs(settings)
    parts = [_batch(settings, photos, _VALIDATION_SEED, start) for start in range(0, settings.num_validation, _BATCH)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def open_images(path: str, cache: Path) -> LazyArray | FlyingChairs:
    """The images of `data.sequences`: a sequence (`open_sequence`), or the training pairs of a FlyingChairs folder, whose
    flow is not read. Raises the errors of both.
    """
    folder = Path(path)
    return FlyingChairs(folder, "training") if is_flying_chairs(folder) else open_sequence(path, cache)


def successive(images: LazyArray | FlyingChairs, count: int) -> Iterator[UInt8[np.ndarray, "2 height width 3"]]:
    """At most `count` pairs of an image and the next, evenly spaced; of FlyingChairs, of its pairs."""
    pairs = _pairs(images, (1,))
    for number in np.unique(np.linspace(0, len(pairs) - 1, count).astype(int)).tolist():
        yield pairs[number]


def _pairs(images: LazyArray | FlyingChairs, gaps: Sequence[int]) -> PairSource | StackedPairs:
    """All pairs of a sequence that are one of `gaps` frames apart; of FlyingChairs its pairs."""
    return StackedPairs(images) if isinstance(images, FlyingChairs) else PairSource(images, gaps)


def flow_dataset(
    settings: FlowDataSettings, *, seed: int, progress: bool = True, shard: tuple[int, int] = (0, 1)
) -> Stream:
    """The endless stream of augmented pairs that the settings describe, or a shard of it; with the teacher's flow, if any."""
    sequences = [open_images(path, Path(settings.drawn.folder)) for path in settings.sequences]
    lengths = [sequence.shape[0] for sequence in sequences]
    sequences_weight = settings.sequence_fraction if settings.drawn.num_pairs else 1.0
    sources: list[PairSource | StackedPairs | TeacherPairs] = []
    for number, sequence in enumerate(sequences):
        if settings.teacher is None:
            sources.append(_pairs(sequence, settings.variation.gaps))
        else:
            cuts = _cuts(sequence, settings, seed + number)
            sources.append(_with_teacher(cuts, settings, settings.teacher, progress))
    weights = [sequences_weight * length / sum(lengths) for length in lengths]
    if (settings.drawn.num_pairs and sequences_weight < 1) or not sources:
        pairs = drawn_pairs(settings.drawn, progress=progress)
        sources.append(
            StackedPairs(pairs)
            if settings.teacher is None
            else _with_teacher(pairs, settings, settings.teacher, progress)
        )
        weights.append(1 - sequences_weight if sequences else 1.0)
    return pair_dataset(sources, weights, settings.variation, seed=seed, workers=settings.workers, shard=shard)


def _cuts(images: LazyArray | FlyingChairs, settings: FlowDataSettings, seed: int) -> np.ndarray:
    """Crops of the synthetic pairs' size."""
    size = settings.drawn.pairs.height, settings.drawn.pairs.width
    if isinstance(images, FlyingChairs):
        return cut_stored_pairs(images, settings.cuts_per_sequence, size, seed=seed)
    return cut_pairs(images, settings.cuts_per_sequence, size, settings.variation.gaps, seed=seed)


def _with_teacher(
    pairs: LazyArray | np.ndarray, settings: FlowDataSettings, teacher: str, progress: bool
) -> TeacherPairs:
    return TeacherPairs(pairs, teacher_flow(pairs, teacher, Path(settings.drawn.folder), progress=progress))
