"""Windows of pieces with their pictures, from which a flow network learns what the reads say of the masks' motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ...recording import Recording
from ...tracing.tracer import Camera
from .files import PieceFiles
from .likelihood import FilmedFrames
from .pieces import PieceFrames, with_tags


@dataclasses.dataclass(frozen=True)
class Window:
    """Frames in a row, for a training step."""

    camera: Camera
    frames: FilmedFrames


@dataclasses.dataclass(frozen=True)
class PieceWindows:
    """A sequence of `Window`: all of `length` frames that begin on a multiple of half of it and in which a mask is sure.

    A mask is sure where the teacher's confidence is above `sure`, in half of the frames or more. `recordings` are those that
    the `files` were made of.
    """

    files: PieceFiles
    recordings: Sequence[Recording]
    places: Sequence[tuple[int, int]]  # piece, and first frame in it
    length: int
    num_tags: int  # places for tags, the same in all windows: for each number of them a program is compiled

    @staticmethod
    def of(files: PieceFiles, recordings: Sequence[Recording], *, length: int, sure: float) -> PieceWindows:
        """The windows; every piece is read once."""
        places, num_tags = [], 1
        for number, piece in enumerate(files):
            num_tags = max(num_tags, piece.frames.present.shape[1])
            seen = np.asarray(piece.frames.present & (piece.frames.confidence > sure))
            for start in range(0, piece.num_frames - length + 1, max(length // 2, 1)):
                if np.max(np.mean(seen[start : start + length], axis=0), initial=0.0) >= 0.5:
                    places.append((number, start))
        return PieceWindows(files, recordings, places, length, num_tags)

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: int) -> Window:
        number, start = self.places[index]
        piece = self.files[number]
        frames: PieceFrames = jax.tree.map(lambda leaf: leaf[start : start + self.length], piece.frames)
        first = piece.start + start
        colour = self.recordings[self.files.recording_of(number)].colour[first : first + self.length]
        no_flow = jnp.zeros((*frames.depth_m.shape, 2))
        frames = with_tags(frames, self.num_tags)
        return Window(piece.camera, FilmedFrames(frames, jnp.asarray(np.asarray(colour)), no_flow))

    def __iter__(self) -> Iterator[Window]:
        return (self[number] for number in range(len(self)))
