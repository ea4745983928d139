"""Pictures for flow training: drawn pairs, made once and kept, and the sequences that a user names."""

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

from ..core.prepared import made_once, write_rows
from ..core.stream import Stream
from ..core.types import LazyArray
from ..flow.picture_pairs import PairSource, StackedPairs, TaughtPairs, VariationSettings, open_sequence, pair_dataset
from ..sim.flow_pairs import FlowPair, FlowPairSettings, flow_pairs
from ..sim.rendering.textures import PHOTOGRAPHS, photograph
from .flow_teacher import cut_pairs, taught_flow

_BATCH = 16
_SHARD = 128
_PHOTO_SHAPE = (240, 320)
_CUTS_OF_A_PHOTO = 3
_VALIDATION_SEED = 1_000_003


@dataclasses.dataclass(frozen=True)
class DrawnSettings:
    """The drawn pairs: how many, and what they show. They are made once and kept under `folder`."""

    num_pairs: int = 4096
    num_validation: int = 64
    seed: int = 0
    photographs: bool = True  # those of installed packages; which they are is part of the pairs' name
    folder: str = "recordings"
    pairs: FlowPairSettings = dataclasses.field(default_factory=FlowPairSettings)

    def __post_init__(self) -> None:
        for name, least in (("num_pairs", 0), ("num_validation", _BATCH)):
            found = getattr(self, name)
            if found % _BATCH or found < least:
                raise ValueError(f"{name} is {found}; expected a multiple of {_BATCH}, {least} or more.")


@dataclasses.dataclass(frozen=True)
class FlowDataSettings:
    """What flow is learned from, and how pairs are cut and varied."""

    drawn: DrawnSettings = dataclasses.field(default_factory=DrawnSettings)
    sequences: tuple[str, ...] = ()  # recordings, videos, folders of pictures: never labelled
    sequence_fraction: float = 0.5  # of the samples, all sequences together; the rest is drawn
    variation: VariationSettings = dataclasses.field(default_factory=VariationSettings)
    teacher: str | None = None  # a flow by name, whose word is all that is learned from
    cuts_per_sequence: int = 24  # pairs of the drawn ones' size that the teacher is asked for
    workers: int = 0  # processes that read and vary pairs

    def __post_init__(self) -> None:
        if self.cuts_per_sequence < 1:
            raise ValueError(f"cuts_per_sequence is {self.cuts_per_sequence}; expected at least 1.")
        if not 0 < self.sequence_fraction <= 1:
            raise ValueError(f"sequence_fraction is {self.sequence_fraction}; expected a share above 0 and at most 1.")
        if self.drawn.num_pairs < 1 and not self.sequences:
            raise ValueError("Nothing to learn from: drawn.num_pairs is 0 and no sequences are named.")


def installed_photographs() -> list[str]:
    """Names of the photographs that installed packages bring."""
    return [name for name in PHOTOGRAPHS if photograph(name) is not None]


def photograph_stack(names: Sequence[str], seed: int) -> UInt8[np.ndarray, "count 240 320 3"] | None:
    """Cuts of the named photographs at random scales; None without any name."""
    rng = np.random.default_rng(seed)
    height, width = _PHOTO_SHAPE
    cuts = []
    for name in names:
        levels = photograph(name)
        assert levels is not None
        picture = (255 * levels[0] ** np.float32(1 / 2.2)).astype(np.uint8)
        least = max(height / picture.shape[0], width / picture.shape[1])
        for _ in range(_CUTS_OF_A_PHOTO):
            scale = least * rng.uniform(1.0, 1.6)
            size = (max(width, round(picture.shape[1] * scale)), max(height, round(picture.shape[0] * scale)))
            resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
            top, left = rng.integers(0, size[1] - height + 1), rng.integers(0, size[0] - width + 1)
            cuts.append(resized[top : top + height, left : left + width])
    return np.stack(cuts) if cuts else None


def _photographs(settings: DrawnSettings) -> UInt8[np.ndarray, "count 240 320 3"] | None:
    return photograph_stack(installed_photographs() if settings.photographs else [], settings.seed)


def drawn_pairs(settings: DrawnSettings, *, progress: bool = True) -> LazyArray:
    """The drawn pairs (pair, 2, height, width, 3), uint8, of the folder; drawn if they are not there yet."""
    about = {**dataclasses.asdict(settings), "photographs": installed_photographs() if settings.photographs else []}
    del about["folder"], about["num_validation"]
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:12]
    target = Path(settings.folder) / f"flow-pairs-{settings.num_pairs}-{digest}.zarr"
    return made_once(target, lambda path: _draw(settings, path, about, progress))


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
        description="draw flow pairs",
        progress=progress,
    )


def _batch(settings: DrawnSettings, photos: np.ndarray | None, seed: int, start: int) -> FlowPair:
    key = jax.random.fold_in(jax.random.key(seed), start)
    return flow_pairs(settings.pairs, _BATCH, None if photos is None else jnp.asarray(photos), key=key)


def to_bytes(pairs: FlowPair) -> UInt8[np.ndarray, "pair 2 height width 3"]:
    """Both pictures of stacked pairs as bytes."""
    both = np.stack([np.asarray(pairs.first), np.asarray(pairs.second)], axis=1)
    return np.rint(255 * both).astype(np.uint8)


def validation_pairs(settings: DrawnSettings) -> FlowPair:
    """Drawn pairs with their flow, of another seed than any for training, whatever that is."""
    photos = _photographs(settings)
    parts = [_batch(settings, photos, _VALIDATION_SEED, start) for start in range(0, settings.num_validation, _BATCH)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def flow_dataset(
    settings: FlowDataSettings, *, seed: int, progress: bool = True, share: tuple[int, int] = (0, 1)
) -> Stream:
    """The endless stream of varied pairs that the settings describe, or a share of it; with the teacher's flow, if any."""
    sequences = [open_sequence(path, Path(settings.drawn.folder)) for path in settings.sequences]
    lengths = [sequence.shape[0] for sequence in sequences]
    whole = settings.sequence_fraction if settings.drawn.num_pairs else 1.0
    sources: list[PairSource | StackedPairs | TaughtPairs] = []
    for number, sequence in enumerate(sequences):
        if settings.teacher is None:
            sources.append(PairSource(sequence, settings.variation.gaps))
            continue
        size = settings.drawn.pairs.height, settings.drawn.pairs.width
        cuts = cut_pairs(sequence, settings.cuts_per_sequence, size, settings.variation.gaps, seed=seed + number)
        sources.append(_taught(cuts, settings, settings.teacher, progress))
    shares = [whole * length / sum(lengths) for length in lengths]
    if (settings.drawn.num_pairs and whole < 1) or not sources:
        pairs = drawn_pairs(settings.drawn, progress=progress)
        sources.append(
            StackedPairs(pairs) if settings.teacher is None else _taught(pairs, settings, settings.teacher, progress)
        )
        shares.append(1 - whole if sequences else 1.0)
    return pair_dataset(sources, shares, settings.variation, seed=seed, workers=settings.workers, share=share)


def _taught(pairs: LazyArray | np.ndarray, settings: FlowDataSettings, teacher: str, progress: bool) -> TaughtPairs:
    return TaughtPairs(pairs, taught_flow(pairs, teacher, Path(settings.drawn.folder), progress=progress))
