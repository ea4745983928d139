"""A teacher's flow of stacked pairs, made once and kept, for a student that learns from nothing else.

The teacher is any flow by name, slow and exact for example; the student, a network that runs at video rate.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from ..core.prepared import made_once, write_rows
from ..core.types import LazyArray
from ..flow.named import flow_key, make_flow
from ..recording import RecordingError

_SHARD = 64
_LOOKS = 4
"""Places that are looked at for each cut: the one where most changes is taken, since mostly nothing moves."""


def cut_pairs(
    sequence: LazyArray, count: int, size: tuple[int, int], gaps: Sequence[int], *, seed: int
) -> UInt8[np.ndarray, "count 2 height width 3"]:
    """`count` cuts of (height, width) `size` from random pairs of a sequence's pictures that are one of `gaps` apart.

    Raises `RecordingError` for pictures smaller than that, and for too few.
    """
    pictures, height, width, _ = sequence.shape
    rows, columns = size
    if rows > height or columns > width:
        raise RecordingError(
            f"Pictures of {width} x {height} pixels; cuts for a student take {columns} x {rows}. "
            "Make data.drawn.pairs.height and width smaller."
        )
    near = [gap for gap in gaps if gap < pictures]
    if not near:
        raise RecordingError(f"No two of {pictures} pictures are {' or '.join(map(str, gaps))} frames apart.")
    rng = np.random.default_rng(seed)
    cuts = []
    for _ in range(count):
        gap = int(rng.choice(near))
        frame = int(rng.integers(0, pictures - gap))
        both = np.stack([np.asarray(sequence[frame]), np.asarray(sequence[frame + gap])])
        places = zip(
            rng.integers(0, height - rows + 1, _LOOKS), rng.integers(0, width - columns + 1, _LOOKS), strict=True
        )
        looks = [both[:, top : top + rows, left : left + columns] for top, left in places]
        cuts.append(max(looks, key=lambda look: float(np.mean(np.abs(look[0].astype(np.float32) - look[1])))))
    return np.stack(cuts)


def taught_flow(
    pairs: LazyArray | UInt8[np.ndarray, "pair 2 height width 3"], teacher: str, folder: Path, *, progress: bool = True
) -> LazyArray:
    """The teacher's flow (pair, height, width, 2) from first to second picture of each pair, half precision.

    Made once and kept in `folder`, under the digest of the pairs and the teacher's key. Errors as of `make_flow`.
    """
    target = folder / f"flow-of-{_digest(pairs)}-{flow_key(teacher)}.zarr"
    return made_once(target, lambda path: _teach(pairs, teacher, path, progress))


def _teach(pairs: LazyArray | np.ndarray, teacher: str, path: Path, progress: bool) -> None:
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
    found = hashlib.sha256(repr(tuple(pairs.shape)).encode())
    for start in range(0, pairs.shape[0], _SHARD):
        found.update(np.ascontiguousarray(pairs[start : start + _SHARD]).tobytes())
    return found.hexdigest()[:12]
