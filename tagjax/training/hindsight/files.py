"""Pieces of recordings in a folder: computed once, then read at every step, so that memory does not grow with them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
import safetensors.numpy

from ...core.array_file import named_arrays
from ...core.errors import RecordingError
from ...core.files import make_folder, remove, write_atomic
from ...core.progress import OnProgress, unobserved
from ...core.results import write_json
from ...radio.arrivals import Arrivals
from ...radio.reads import RadioWindow
from ...recording import Recording
from ...tagattention.segments import SegmentFrame, TagAttention
from ...tracing.clips import selected_tags
from ...tracing.tracer import Camera
from .control import ControlReads, control_of
from .objective import HindsightSettings
from .pieces import Piece, PieceFrames, segment_pieces
from .teachers import Teacher

_INDEX = "index.json"
_NESTED: Mapping[str, type] = {
    "found": SegmentFrame,
    "arrivals": Arrivals,
    "radio": RadioWindow,
    "control": ControlReads,
}


@dataclasses.dataclass(frozen=True)
class PieceFiles:
    """A folder with the pieces of some recordings, a sequence of `Piece` (0.4 MB a frame of 256x212)."""

    folder: Path

    def made(
        self,
        recordings: Sequence[Recording],
        tracer: TagAttention,
        load: Callable[..., Any],
        *,
        epcs: Sequence[str] | None,
        num_frames: int,
        teacher: Teacher = "smoother",
        controls: bool = False,
        settings: Mapping[str, Any] = MappingProxyType({}),
        on_progress: OnProgress = unobserved,
    ) -> PieceFiles:
        """The folder with the pieces of all recordings; those that it holds already are taken as they are.

        With `controls` each piece has control reads (`control_of`). `settings`, plain values, are those on which `recordings` and
        `load` depend. `on_progress` counts the recordings. Raises `RecordingError` where the folder holds pieces of other
        recordings, or made with other arguments.
        """
        make_folder(self.folder)
        held, asked = [one["recording"] for one in self._index()], [recording.name for recording in recordings]
        if held != asked[: len(held)]:
            raise RecordingError(
                f"{self.folder}: found pieces of {_listed(held)}; expected those of {_listed(asked)}, in this order. Give "
                "the same recordings, or another folder."
            )
        made_with = {**settings, "epcs": None if epcs is None else list(epcs), "num_frames": num_frames}
        made_with |= {"teacher": teacher, "controls": controls}
        self._check_made_with(made_with)
        stage = f"{self.folder.name} recordings: segments and masks"
        for recording in recordings[len(self._index()) :]:
            tags, names, index = selected_tags(recording, epcs), [], self._index()
            on_progress(stage, len(index), len(recordings), recording.name)
            control = control_of(recordings, len(index)) if controls else None
            for piece in segment_pieces(
                recording, tracer, load, epcs=tags, num_frames=num_frames, teacher=teacher, control=control
            ):
                names.append(f"{len(index):04d}-{len(names):03d}.safetensors")
                _write(self.folder / names[-1], piece)
            entry = {"recording": recording.name, "files": names, "made_with": made_with}
            write_json(self.folder / _INDEX, [*index, entry])
            on_progress(stage, len(index) + 1, len(recordings))
        return self

    def _check_made_with(self, made_with: Mapping[str, Any]) -> None:
        for one in self._index():
            found = one.get("made_with", {})  # none of a folder of before
            if other := sorted(name for name in {*found, *made_with} if found.get(name) != made_with.get(name)):
                raise RecordingError(
                    f"{self.folder}: found pieces made with {_values(other, found)}; expected {_values(other, made_with)}. "
                    "Give the same settings, or another folder."
                )

    def recording_of(self, index: int) -> int:
        """The number of the recording that a piece is of."""
        return [number for number, one in enumerate(self._index()) for _ in one["files"]][index]

    def num_sure(self, settings: HindsightSettings) -> int:
        """The number of tag-frames in which the teacher is sure of a mask."""
        return sum(int(np.sum(one.frames.present & (one.frames.confidence > settings.sure))) for one in self)

    def __len__(self) -> int:
        return len(self._files())

    def __getitem__(self, index: int) -> Piece:
        return _read(self.folder / self._files()[index])

    def __iter__(self) -> Iterator[Piece]:
        return (self[number] for number in range(len(self)))

    def remove(self) -> None:
        """Delete the folder."""
        if self.folder.exists():
            remove(self.folder)

    def _files(self) -> list[str]:
        """The names of all files."""
        return [name for one in self._index() for name in one["files"]]

    def _index(self) -> list[dict[str, Any]]:
        """Of each recording its name (`recording`), the names of its `files`, and what they were `made_with`."""
        path = self.folder / _INDEX
        return json.loads(path.read_text()) if path.exists() else []


def _listed(names: Sequence[str]) -> str:
    """The names, in so few words that an error can hold them."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _values(names: Sequence[str], values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={json.dumps(values.get(name))}" for name in names)


def _write(path: Path, piece: Piece) -> None:
    leaves = {name: np.ascontiguousarray(leaf) for name, leaf in named_arrays(piece.frames).items()}
    leaves |= {"camera.rays": np.asarray(piece.camera.rays), "camera.antennas_m": np.asarray(piece.camera.antennas_m)}
    if piece.frames.found.area.shape[-1] <= 2**15:
        leaves["found.labels"] = leaves["found.labels"].astype(np.int16)
    about = {"name": piece.name, "start": str(piece.start), "num_frames": str(piece.num_frames)}
    write_atomic(path, safetensors.numpy.save(leaves, about))


def _read(path: Path) -> Piece:
    with safetensors.safe_open(path, framework="numpy") as file:
        about = file.metadata()
        leaves = {name: jnp.asarray(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118
    leaves["found.labels"] = leaves["found.labels"].astype(jnp.int32)
    try:
        camera, frames = Camera(leaves["camera.rays"], leaves["camera.antennas_m"]), _built(PieceFrames, leaves)
    except KeyError as error:
        raise RecordingError(
            f"{path}: found no {error.args[0]}; expected a piece of this version. Give another folder for the pieces."
        ) from error
    return Piece(camera, frames, about["name"], int(about["start"]), int(about["num_frames"]))


def _kind(name: str) -> type:
    """The module that has this name in a piece. Raises `KeyError` for the name of an array."""
    try:
        return _NESTED[name.rpartition(".")[2]]
    except KeyError:
        raise KeyError(name) from None


def _built(kind: type, leaves: Mapping[str, Any], before: str = "") -> Any:
    """The module of this kind whose leaves have names that begin with `before`; None where there is none."""
    if not any(name.startswith(before) for name in leaves):
        return None
    names = [before + field.name for field in dataclasses.fields(kind)]
    built = [leaves[name] if name in leaves else _built(_kind(name), leaves, f"{name}.") for name in names]
    return kind(*built)
