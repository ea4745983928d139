"""Recordings on disk or on the net: Zarr v3, one chunk a frame, zstd; opened lazily, checked for missing parts."""

from __future__ import annotations

import dataclasses
import os
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from rich.progress import Progress
from zarr.codecs import ZstdCodec
from zarr.core.sync import sync

from ..core.camera import Intrinsics
from ..core.errors import RecordingError
from ..core.types import LazyArray
from .reads import TagReads
from .recording import ClockAudit, Recording, Truth

FORMAT = "tagjax-recording"
VERSION = 1

_TRUTH_ARRAYS = ("labels", "flow_px", "occluded", "backward_flow_px", "backward_occluded")
_TRUTH_TABLES = ("tag_range_m", "tag_position_m", "visible", "line_of_sight")
_READ_SETTINGS = ("hop_table_hz", "phase_period_rad", "phase_sign", "pi_flips")
_READ_COLUMNS = tuple(field.name for field in dataclasses.fields(TagReads) if field.name not in _READ_SETTINGS)


class StoredFrames:
    """A stored array, read when indexed; a frame that cannot be read raises `RecordingError` that names it."""

    def __init__(self, array: zarr.Array, where: str, name: str):
        self.array, self.name = array, name
        self._where = where
        self.shape: tuple[int, ...] = tuple(array.shape)
        self.dtype = np.dtype(array.dtype)

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[...], dtype)

    def __getitem__(self, index: Any, /) -> np.ndarray:
        try:
            values = np.asarray(self.array[index])
        except (IndexError, MemoryError):
            raise
        # Whatever the codecs, the file system or the network raise: the cause is named either way.
        except Exception as error:
            raise RecordingError(
                f"{self._where}: array {self.name!r}{self._unreadable(index)} cannot be read ({type(error).__name__}: "
                f"{error}); its file is damaged or out of reach. Copy the recording again, or look to the connection."
            ) from error
        # Zarr reads a chunk that is not there as zeros: where zeros come, the chunk must be.
        frames = self._frames(index)
        if values.size:
            for frame, part in zip(frames, values.reshape(len(frames), -1), strict=True):
                if not part.any() and not self._present(frame // self.array.chunks[0]):
                    raise RecordingError(
                        f"{self._where}: array {self.name!r}, frame {frame} is missing; the recording is truncated. "
                        "Copy it again."
                    )
        return values

    def _frames(self, index: Any) -> list[int]:
        first = index[0] if isinstance(index, tuple) and index else index
        return np.atleast_1d(np.arange(len(self))[first]).tolist()

    def _unreadable(self, index: Any) -> str:
        """Which frame cannot be read, for a message."""
        frames = self._frames(index)
        if self.array.nchunks == 1:
            return ""
        for frame in frames[:-1]:
            try:
                self.array[frame]
            except Exception:
                return f", frame {frame}"
        return f", frame {frames[-1]}"

    def _present(self, chunk: int) -> bool:
        key = self.array.metadata.encode_chunk_key((chunk, *(0 for _ in self.shape[1:])))
        try:
            return bool(sync((self.array.store_path / key).exists()))
        except Exception as error:
            raise RecordingError(
                f"{self._where}: array {self.name!r} is out of reach ({type(error).__name__}: {error}). Try again."
            ) from error


def save_recording(recording: Recording, path: str | Path, *, progress: bool = False) -> None:
    """Write a recording to a folder, frame by frame; the folder appears whole or not at all.

    A folder that is there already raises `RecordingError`.
    """
    path = Path(path)
    if path.exists():
        raise RecordingError(f"{path} exists. Remove it or choose another name.")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        root = zarr.open_group(str(partial), mode="w", zarr_format=3)
        write_recording(recording, root, progress=progress)
        try:
            os.replace(partial, path)
        except OSError as error:
            if not path.exists():
                raise
            raise RecordingError(f"{path} exists by now: another process wrote it meanwhile. Use that one.") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_recording(recording: Recording, root: zarr.Group, *, progress: bool = False) -> None:
    """Write a recording into an open Zarr group; its attributes, which make it readable, come last.

    Raises `RecordingError` for values that cannot be stored, before any frame is written.
    """
    frames, arrays, attributes = _parts(recording)
    with Progress(disable=not progress, transient=True) as bar:
        for name, source in frames.items():
            target = create_array(root, name, tuple(source.shape), source.dtype, per_frame=True)
            for t in bar.track(range(source.shape[0]), description=f"{recording.name}: {name}"):
                target[t] = np.asarray(source[t])
    for name, values in arrays.items():
        target = create_array(root, name, values.shape, values.dtype, per_frame=False)
        if values.size:
            target[...] = values
    root.attrs.update(attributes)


def _parts(recording: Recording) -> tuple[dict[str, LazyArray], dict[str, np.ndarray], dict[str, Any]]:
    """What is stored of a recording: arrays of frames, other arrays, attributes. All are checked to be storable."""
    reads, truth = recording.reads, recording.truth
    frames: dict[str, LazyArray] = {"colour": recording.colour, "depth": recording.depth}
    arrays = {"time_ns": np.asarray(recording.time_ns), "antennas_m": np.asarray(recording.antennas_m, np.float64)}
    names, index = np.unique(np.asarray(reads.epc, dtype=str), return_inverse=True)
    for name in _READ_COLUMNS:
        column = getattr(reads, name)
        if column is not None:
            arrays[f"reads/{name}"] = index.astype(np.int32) if name == "epc" else np.asarray(column)
    attributes: dict[str, Any] = {
        "name": recording.name,
        "source": recording.source,
        "intrinsics": dataclasses.asdict(recording.intrinsics),
        "depth_kind": recording.depth_kind,
        "clock": None if recording.clock is None else dataclasses.asdict(recording.clock),
        "reads": {name: getattr(reads, name) for name in _READ_SETTINGS},
        "epcs": [str(name) for name in names],
        "num_reads": reads.num_reads,
        "truth": None,
    }
    if truth is not None:
        frames |= {f"truth/{name}": array for name in _TRUTH_ARRAYS if (array := getattr(truth, name)) is not None}
        if truth.boxes_px is not None:
            arrays["truth/boxes_px"] = np.asarray(truth.boxes_px)
        tables = {name: list(getattr(truth, name)) for name in _TRUTH_TABLES}
        for name, keys in tables.items():
            for number, key in enumerate(keys):
                arrays[f"truth/{name}/{number}"] = np.asarray(getattr(truth, name)[key])
        attributes["truth"] = {"tag_to_label": dict(truth.tag_to_label), **tables}
    for name, array in (frames | arrays).items():
        if np.dtype(array.dtype).kind not in "biuf":
            raise RecordingError(
                f"{recording.name}: {name} holds {array.dtype}; expected numbers or truth values. Convert it before saving."
            )
    # The list of arrays tells one that was lost from one that never was.
    attributes |= {"arrays": sorted(frames | arrays), "format": FORMAT, "version": VERSION}
    return frames, arrays, {name: _plain(value, f"{recording.name}: {name}") for name, value in attributes.items()}


def _plain(value: Any, where: str) -> Any:
    """A value of attributes as JSON has it: NumPy's numbers and strings become Python's."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list | tuple):
        return [_plain(part, f"{where}[{number}]") for number, part in enumerate(value)]
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise RecordingError(f"{where} has the key {key!r}; expected names as keys. Make it a string.")
        return {str(key): _plain(part, f"{where}[{str(key)!r}]") for key, part in value.items()}
    raise RecordingError(
        f"{where} holds {value!r} ({type(value).__name__}); expected numbers, strings or lists of them. Convert it first."
    )


def open_recording(path: str | Path, *, check: bool = True) -> Recording:
    """Open a recording lazily from a folder or any fsspec address (memory://, s3://, https://).

    Frames are read when indexed. Raises `RecordingError` for what is no recording, one of another version, or one with
    parts missing.
    """
    remote = "://" in str(path)
    if not remote and not Path(path).is_dir():
        raise RecordingError(f"{path}: no such folder. Import or simulate a recording first.")
    writable = not remote and os.access(path, os.W_OK)
    try:
        root = zarr.open_group(str(path), mode="r+" if writable else "r", zarr_format=3)
        attributes = dict(root.attrs)
    except ImportError as error:
        raise RecordingError(
            f"{path}: a package for such addresses is missing ({error}). pip install 'tagjax[remote]' brings those for "
            "https; others bring their own (s3fs, gcsfs)."
        ) from error
    except Exception as error:
        raise RecordingError(
            f"{path}: no readable Zarr v3 group ({type(error).__name__}: {error}). Is the address right? Was the copy cut "
            "short?"
        ) from error
    if attributes.get("format") != FORMAT:
        raise RecordingError(
            f"{path}: a Zarr group, but no recording (format {attributes.get('format')!r}; expected {FORMAT!r}). A write "
            "that was cut short leaves no format either: write it again."
        )
    if attributes.get("version") != VERSION:
        raise RecordingError(
            f"{path}: version {attributes.get('version')!r}; this release reads {VERSION}. Import the source again."
        )
    try:
        recording = _read(root, attributes, str(path), writable)
    except RecordingError:
        raise
    except Exception as error:
        raise RecordingError(
            f"{path}: damaged or out of reach ({type(error).__name__}: {error}). Copy or import it again."
        ) from error
    if check:
        recording.check()
    return recording


def _read(root: zarr.Group, attributes: dict[str, Any], path: str, writable: bool) -> Recording:
    told = attributes.get("arrays")
    # A web server cannot list a folder, or only slowly: there a lost chunk is found when it is read.
    countable = not path.startswith(("http://", "https://"))

    def array(name: str) -> StoredFrames:
        try:
            found = root.get(name)
            present = found.nchunks_initialized if isinstance(found, zarr.Array) and countable else None
        except Exception as error:
            raise RecordingError(
                f"{path}: array {name!r} cannot be opened ({type(error).__name__}: {error}). Copy the recording again."
            ) from error
        if not isinstance(found, zarr.Array):
            raise RecordingError(f"{path}: array {name!r} is missing. Was the copy cut short? Copy it again.")
        if present is not None and present != found.nchunks:
            raise RecordingError(
                f"{path}: array {name!r} has {present} of {found.nchunks} chunks; the recording is truncated. Copy it again."
            )
        return StoredFrames(found, path, name)

    def has(name: str) -> bool:
        # Recordings of the first releases list no arrays: there an array is what is found.
        return name in told if told is not None else name in root

    columns = {name: array(f"reads/{name}")[...] for name in _READ_COLUMNS if has(f"reads/{name}")}
    columns["epc"] = (
        np.asarray(attributes["epcs"], dtype=str)[columns["epc"]] if attributes["epcs"] else np.empty(0, str)
    )
    stored = dict(attributes["reads"])
    stored["hop_table_hz"] = tuple(stored["hop_table_hz"])
    reads = TagReads(**columns, **stored)
    if reads.num_reads != attributes["num_reads"]:
        raise RecordingError(f"{path}: {reads.num_reads} reads; expected {attributes['num_reads']}. Copy it again.")
    truth = None
    if attributes["truth"] is not None:
        tables: dict[str, dict[Any, np.ndarray]] = {}
        for name in _TRUTH_TABLES:
            keys = attributes["truth"].get(name, ())  # line_of_sight came later
            tables[name] = {key: array(f"truth/{name}/{number}")[...] for number, key in enumerate(keys)}
        truth = Truth(
            **{name: array(f"truth/{name}") for name in _TRUTH_ARRAYS if has(f"truth/{name}")},  # type: ignore[arg-type]
            boxes_px=array("truth/boxes_px")[...] if has("truth/boxes_px") else None,
            tag_to_label=attributes["truth"]["tag_to_label"],
            **tables,  # type: ignore[arg-type]
        )
    intrinsics = dict(attributes["intrinsics"])
    intrinsics["distortion"] = tuple(intrinsics["distortion"])
    return Recording(
        colour=array("colour"),
        depth=array("depth"),
        time_ns=array("time_ns")[...],
        intrinsics=Intrinsics(**intrinsics),
        reads=reads,
        antennas_m=array("antennas_m")[...],
        depth_kind=attributes["depth_kind"],
        truth=truth,
        clock=None if attributes["clock"] is None else ClockAudit(**attributes["clock"]),
        name=attributes["name"],
        source=attributes["source"],
        store=root if writable else None,
    )


def create_array(root: zarr.Group, name: str, shape: tuple[int, ...], dtype: Any, *, per_frame: bool) -> zarr.Array:
    """A new array in a group, one chunk a frame or one for all."""
    chunks = (1, *shape[1:]) if per_frame else tuple(max(1, size) for size in shape)
    # Empty chunks are written too: a chunk that is not there is a chunk that was lost.
    return root.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        compressors=[ZstdCodec(level=3, checksum=True)],
        config={"write_empty_chunks": True},
    )
