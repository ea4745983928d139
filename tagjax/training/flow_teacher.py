"""A teacher's flow of stacked pairs, estimated once and cached, as the only training signal of a student network.

The teacher is any flow by name, for example a slow and accurate one; the student is a network that runs at video rate.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from ..core.array_cache import cached_array, write_rows
from ..core.types import LazyArray
from ..flow.registry import flow_key, make_flow
from ..recording import RecordingError

_SHARD = 64
_NUM_CANDIDATES = 4
"""Candidate positions for each crop: the one with the largest change is taken, because most of an image is static."""


def cut_pairs(
    sequence: LazyArray, count: int, size: tuple[int, int], gaps: Sequence[int], *, seed: int
) -> UInt8[np.ndarray, "count 2 height width 3"]:
    """`count` crops of (height, width) `size` from random pairs of a sequence's images that are one of `gaps` frames apart.

    Raises `RecordingError` if the images are smaller than `size` or too few.
    """
    pictures = sequence.shape[0]
    _check_size(sequence.shape[1:3], size)
    possible = [gap for gap in gaps if gap < pictures]
    if not possible:
        raise RecordingError(f"No two of {pictures} pictures are {' or '.join(map(str, gaps))} frames apart.")
    rng = np.random.default_rng(seed)
    cuts = []
    for _ in range(count):
        gap = int(rng.choice(possible))
        frame = int(rng.integers(0, pictures - gap))
        both = np.stack([np.asarray(sequence[frame]), np.asarray(sequence[frame + gap])])
        cuts.append(_changing_crop(both, size, rng))
    return np.stack(cuts)


def cut_stored_pairs(
    pairs: LazyArray, count: int, size: tuple[int, int], *, seed: int
) -> UInt8[np.ndarray, "count 2 height width 3"]:
    """`cut_pairs` of stored pairs (pair, 2, height, width, 3), such as FlyingChairs: `count` crops of random ones."""
    _check_size(pairs.shape[2:4], size)
    rng = np.random.default_rng(seed)
    numbers = rng.integers(0, pairs.shape[0], count)
    return np.stack([_changing_crop(np.asarray(pairs[int(number)]), size, rng) for number in numbers])


def _check_size(pictures: tuple[int, ...], size: tuple[int, int]) -> None:
    if size[0] > pictures[0] or size[1] > pictures[1]:
        raise RecordingError(
            f"Pictures of {pictures[1]} x {pictures[0]} pixels; cuts for a student take {size[1]} x {size[0]}. "
            "Make data.drawn.pairs.height and width smaller."
        )


def _changing_crop(
    both: UInt8[np.ndarray, "2 _ _ 3"], size: tuple[int, int], rng: np.random.Generator
) -> UInt8[np.ndarray, "2 height width 3"]:
    """The candidate crop of a pair with the largest change."""
    (_, height, width, _), (rows, columns) = both.shape, size
    places = zip(
        rng.integers(0, height - rows + 1, _NUM_CANDIDATES),
        rng.integers(0, width - columns + 1, _NUM_CANDIDATES),
        strict=True,
    )
    candidates = [both[:, top : top + rows, left : left + columns] for top, left in places]
    return max(candidates, key=lambda crop: float(np.mean(np.abs(crop[0].astype(np.float32) - crop[1]))))


def teacher_flow(
    pairs: LazyArray | UInt8[np.ndarray, "pair 2 height width 3"], teacher: str, folder: Path, *, progress: bool = True
) -> LazyArray:
    """The teacher's flow (pair, height, width, 2) from the first to the second image of each pair, half precision.

    Estimated once and cached in `folder`, under the digest of the pairs and the teacher's key. Raises the errors of
    `make_flow`.
    """
    target = folder / f"flow-of-{_digest(pairs)}-{flow_key(teacher)}.zarr"
    return cached_array(target, lambda path: _write_teacher_flow(pairs, teacher, path, progress))


def _write_teacher_flow(pairs: LazyArray | np.ndarray, teacher: str, path: Path, progress: bool) -> None:
    flow = make_flow(teacher)
    count, _, height, width, _ = pairs.shape

    def rows(begin: int) -> Iterator[np.ndarray]:
        for number in range(begin, count):
            first, second = np.asarray(pairs[number])
            yield np.asarray(flow(first, second)).astype(np.float16)[None]

    write_rows(
        path,
        rows,
        shape=(count, height, width, 2),
        dtype="float16",
        shard=_SHARD,
        attributes={"teacher": teacher},
        description=f"flow by {teacher}",
        progress=progress,
    )


def _digest(pairs: LazyArray | np.ndarray) -> str:
    digest = hashlib.sha256(repr(tuple(pairs.shape)).encode())
    for start in range(0, pairs.shape[0], _SHARD):
        digest.update(np.ascontiguousarray(pairs[start : start + _SHARD]).tobytes())
    return digest.hexdigest()[:12]
