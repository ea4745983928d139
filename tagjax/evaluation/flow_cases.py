"""Pairs of pictures for the evaluation of flows: synthetic ones, recordings, folders in Middlebury's format, FlyingChairs, and
videos.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from ..flow.flo_files import read_flo
from ..flow.flying_chairs import FlyingChairs
from ..flow.image_sequences import open_sequence
from ..flow.images import check_images
from ..recording import RecordingError
from ..recording.store import open_recording
from ..sim.flow_pairs import FlowPairSettings, flow_pairs

_BATCH = 8
_NAMES = ("frame10.png", "frame11.png", "flow10.flo")
"""Middlebury's: first picture, second picture, flow from the first to the second."""


@dataclasses.dataclass(frozen=True)
class FlowCase:
    """Two pictures, uint8 or floats from 0 to 1, and the true flow from the first to the second where it is known."""

    source: str  # its scene, recording or video
    label: str
    first: Shaped[np.ndarray, "height width 3"]
    second: Shaped[np.ndarray, "height width 3"]
    truth_px: Float[np.ndarray, "height width 2"] | None = None  # NaN where it is unknown
    occluded: Bool[np.ndarray, "height width"] | None = None


@dataclasses.dataclass(frozen=True)
class Material:
    """A number of cases, which `cases` computes one after the other."""

    name: str
    num_cases: int
    cases: Callable[[], Iterator[FlowCase]]


def drawn_material(
    settings: FlowPairSettings,
    num_pairs: int,
    *,
    seed: int,
    photographs: UInt8[np.ndarray, "count rows columns 3"] | None = None,
) -> Material:
    """Synthetic pairs with exact flow."""

    def cases() -> Iterator[FlowCase]:
        for start in range(0, num_pairs, _BATCH):
            # Whole batches, so that all pairs come from one compiled function and are the same for any number.
            key = jax.random.fold_in(jax.random.key(seed), start)
            drawn = jax.tree.map(np.asarray, flow_pairs(settings, _BATCH, photographs, key=key))
            for n in range(min(_BATCH, num_pairs - start)):
                first, second = (np.rint(255 * image[n]).astype(np.uint8) for image in (drawn.first, drawn.second))
                label = f"drawn-{start + n:03d}"
                yield FlowCase("drawn", label, first, second, drawn.forward_px[n], drawn.occluded_first[n])

    return Material("drawn pairs", num_pairs, cases)


def recording_material(paths: tuple[str, ...], *, every: int, max_pairs: int) -> Material:
    """Every `every`-th frame and the next of recordings, at most `max_pairs` of each; with their exact flow where they hold it."""
    recordings = [open_recording(path) for path in paths]
    names = _unique_names([recording.name for recording in recordings])
    frames = [_frames(recording.num_frames, every, max_pairs, recording.name) for recording in recordings]

    def cases() -> Iterator[FlowCase]:
        for name, recording, chosen in zip(names, recordings, frames, strict=True):
            truth = recording.truth
            for t in chosen:
                first, second = (np.asarray(recording.colour[k]) for k in (t, t + 1))
                flow = hidden = None
                if truth is not None and truth.flow_px is not None:
                    flow = np.asarray(truth.flow_px[t], np.float32)
                    hidden = None if truth.occluded is None else np.asarray(truth.occluded[t], bool)
                yield FlowCase(name, f"{name}-{t:04d}", first, second, flow, hidden)

    return Material("recordings", sum(map(len, frames)), cases)


def folder_material(path: str) -> Material:
    """Scenes of a folder, each a folder with frame10.png, frame11.png and, where it is known, flow10.flo.

    The folder may be a scene itself. Raises `RecordingError` where there is no scene.
    """
    root = Path(path)
    scenes = [root] if (root / _NAMES[0]).is_file() else sorted(p.parent for p in root.glob(f"*/{_NAMES[0]}"))
    if not scenes:
        raise RecordingError(
            f"{path}: no {_NAMES[0]}, here or in its subfolders; expected scenes in Middlebury's format."
        )

    def cases() -> Iterator[FlowCase]:
        for scene in scenes:
            first, second = (_picture(scene / name) for name in _NAMES[:2])
            truth = read_flo(scene / _NAMES[2]) if (scene / _NAMES[2]).is_file() else None
            if truth is not None and truth.shape[:2] != first.shape[:2]:
                raise RecordingError(
                    f"{scene}: found flow of {truth.shape[:2]} pixels; expected {first.shape[:2]}, the size of the picture."
                )
            yield FlowCase(scene.name, scene.name, first, second, truth)

    return Material(root.name, len(scenes), cases)


def chairs_material(path: str, *, max_pairs: int) -> Material:
    """The first `max_pairs` validation pairs of a FlyingChairs folder, or of all its pairs where it has no split.

    Raises the errors of `FlyingChairs`, and `RecordingError` for a pair without flow.
    """
    chairs = FlyingChairs(Path(path), "validation")
    chairs.check_flow()
    name = "FlyingChairs" if chairs.split_file is None else "FlyingChairs, validation"
    count = min(max_pairs, len(chairs.numbers))

    def cases() -> Iterator[FlowCase]:
        for index in range(count):
            first, second = chairs[index]
            yield FlowCase(name, f"chairs-{chairs.numbers[index]}", first, second, chairs.flow_px(index))

    return Material(name, count, cases)


def sequence_material(paths: tuple[str, ...], cache: Path, *, every: int, max_pairs: int) -> Material:
    """Every `every`-th picture and the next of videos and folders of pictures, at most `max_pairs` of each; without truth."""
    names = _unique_names([Path(path).stem for path in paths])
    sequences = [(name, open_sequence(path, cache)) for name, path in zip(names, paths, strict=True)]
    frames = [_frames(sequence.shape[0], every, max_pairs, name) for name, sequence in sequences]

    def cases() -> Iterator[FlowCase]:
        for (name, sequence), chosen in zip(sequences, frames, strict=True):
            for t in chosen:
                yield FlowCase(name, f"{name}-{t:04d}", np.asarray(sequence[t]), np.asarray(sequence[t + 1]))

    return Material("without truth", sum(map(len, frames)), cases)


def _unique_names(names: Sequence[str]) -> list[str]:
    """The names, numbered where several are equal."""
    return [name if names.count(name) == 1 else f"{name}-{number}" for number, name in enumerate(names)]


def _frames(count: int, every: int, max_pairs: int, name: str) -> range:
    if count < 2:
        raise RecordingError(f"{name} found {count} picture; expected at least two.")
    return range(0, count - 1, every)[:max_pairs]


def _picture(path: Path) -> np.ndarray:
    """RGB; 16 bits become floats from 0 to 1."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if picture is None:
        raise RecordingError(f"{path} is missing or not a readable picture.")
    picture = np.ascontiguousarray(picture[..., ::-1])
    return picture if picture.dtype == np.uint8 else check_images(picture, picture)[0]
