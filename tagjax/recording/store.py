"""Recordings in local or remote storage: Zarr v3, one chunk per frame, zstd; opened lazily, checked for missing
parts."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from ..core.camera import Intrinsics
from ..core.errors import RecordingError
from ..core.files import atomic_path
from ..core.progress import tracked
from ..core.types import LazyArray
from .reads import TagReads
from .recording import ClockAudit, ClockPiece, Recording, SecondCamera, Truth
from .stored_frames import StoredFrames, create_array, num_chunks_present

FORMAT = "tagjax-recording"
VERSION = 1
BY_ARRIVAL = "arrival"
"""Attribute `reads_order` of a recording whose reads are stored as they arrived; they are sorted by time when it is opened."""

UNFINISHED = "unfinished"
"""Attribute of a recording that is still being written, or was cut off: nothing is written into it."""


_TRUTH_ARRAYS = ("labels", "flow_px", "occluded", "backward_flow_px", "backward_occluded")
_TRUTH_TABLES = ("tag_range_m", "tag_position_m", "visible", "line_of_sight", "carrier_box_px")
_SECOND = "second/colour"
READ_SETTINGS = ("hop_table_hz", "phase_period_rad", "phase_sign", "pi_flips")
READ_COLUMNS = tuple(field.name for field in dataclasses.fields(TagReads) if field.name not in READ_SETTINGS)


def save_recording(recording: Recording, path: str | Path, *, progress: bool = False) -> None:
    """Write a recording to a folder, frame by frame; the folder appears whole or not at all.

    Raises `RecordingError` for a folder that exists already and for values that cannot be stored.
    """
    path = Path(path)
    if path.exists():
        raise RecordingError(f"{path} exists. Remove it or choose another name.")
    try:
        with atomic_path(path) as partial:
            root = zarr.open_group(str(partial), mode="w", zarr_format=3)
            write_recording(recording, root, progress=progress)
    except OSError as error:
        if not path.exists():
            raise
        raise RecordingError(
            f"{path} exists by now: another process wrote it meanwhile. Use that recording."
        ) from error


def write_recording(recording: Recording, root: zarr.Group, *, progress: bool = False) -> None:
    """Write a recording into an open Zarr group; its attributes, which mark it as complete, are written last.

    Raises `RecordingError` for values that cannot be stored, before any frame is written.
    """
    frames, arrays, attributes = _parts(recording)
    for name, source in frames.items():
        target = create_array(root, name, tuple(source.shape), source.dtype, per_frame=True)
        for t in tracked(range(source.shape[0]), f"{recording.name}: {name}", shown=progress):
            target[t] = np.asarray(source[t])
    _write_rest(root, arrays, attributes)


def write_all_but_frames(recording: Recording, root: zarr.Group) -> None:
    """Write the rest of a recording into a Zarr group that holds its frames already; its attributes are written last.

    Raises `RecordingError` for values that cannot be stored.
    """
    _, arrays, attributes = _parts(recording)
    _write_rest(root, arrays, attributes)


def _write_rest(root: zarr.Group, arrays: Mapping[str, np.ndarray], attributes: dict[str, Any]) -> None:
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
    for name in READ_COLUMNS:
        column = getattr(reads, name)
        if column is not None:
            arrays[f"reads/{name}"] = index.astype(np.int32) if name == "epc" else np.asarray(column)
    attributes: dict[str, Any] = {
        "name": recording.name,
        "source": recording.source,
        "intrinsics": dataclasses.asdict(recording.intrinsics),
        "depth_kind": recording.depth_kind,
        "clock": None if recording.clock is None else dataclasses.asdict(recording.clock),
        "reads": {name: getattr(reads, name) for name in READ_SETTINGS},
        "epcs": [str(name) for name in names],
        "num_reads": reads.num_reads,
        "truth": None,
    }
    if recording.second is not None:
        frames[_SECOND] = recording.second.colour
        attributes["second"] = {"baseline_m": recording.second.baseline_m}
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
                f"{recording.name}: {name} holds {array.dtype}; expected numbers or booleans. Convert it before saving."
            )
    # The list of arrays distinguishes a lost array from one that never existed.
    attributes |= {"arrays": sorted(frames | arrays), "format": FORMAT, "version": VERSION}
    return frames, arrays, {name: _plain(value, f"{recording.name}: {name}") for name, value in attributes.items()}


def _plain(value: Any, where: str) -> Any:
    """An attribute's value in JSON types: NumPy's numbers and strings become Python's."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list | tuple):
        return [_plain(part, f"{where}[{number}]") for number, part in enumerate(value)]
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise RecordingError(f"{where} has the key {key!r}; expected strings as keys. Convert it first.")
        return {str(key): _plain(part, f"{where}[{str(key)!r}]") for key, part in value.items()}
    raise RecordingError(
        f"{where} holds {value!r} ({type(value).__name__}); expected numbers, strings or lists of them. Convert it first."
    )


def open_recording(path: str | Path, *, check: bool = True) -> Recording:
    """Open a recording lazily from a folder or any fsspec address (memory://, s3://, https://).

    Frames are read when indexed. Raises `RecordingError` for a folder that is no recording, a recording of another
    version, and one with missing parts.
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
            f"{path}: a package for such addresses is missing ({error}). pip install 'tagjax[remote]' installs those for "
            "https; other protocols need their own (s3fs, gcsfs)."
        ) from error
    except Exception as error:
        raise RecordingError(
            f"{path}: no readable Zarr v3 group ({type(error).__name__}: {error}). Check the address; copy the recording again if the "
            "copy was incomplete."
        ) from error
    if attributes.get("format") != FORMAT:
        raise RecordingError(
            f"{path}: a Zarr group, but no recording (format {attributes.get('format')!r}; expected {FORMAT!r}). An "
            "interrupted write leaves no format either: write it again."
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
            f"{path}: damaged or not accessible ({type(error).__name__}: {error}). Copy or import it again."
        ) from error
    if check:
        recording.check()
    return recording


def _read(root: zarr.Group, attributes: dict[str, Any], path: str, writable: bool) -> Recording:
    listed = attributes.get("arrays")
    # A web server cannot list a folder, or only slowly: there a missing chunk is found when it is read.
    countable = not path.startswith(("http://", "https://"))

    def array(name: str) -> StoredFrames:
        try:
            found = root.get(name)
            present = num_chunks_present(found) if isinstance(found, zarr.Array) and countable else None
        except Exception as error:
            raise RecordingError(
                f"{path}: array {name!r} cannot be opened ({type(error).__name__}: {error}). Copy the recording again."
            ) from error
        if not isinstance(found, zarr.Array):
            raise RecordingError(f"{path}: array {name!r} is missing. Copy the recording again.")
        if present is not None and present != found.nchunks:
            raise RecordingError(
                f"{path}: array {name!r} has {present} of {found.nchunks} chunks; the recording is truncated. Copy it again."
            )
        return StoredFrames(found, path, name)

    def has(name: str) -> bool:
        # Recordings of the first releases list no arrays: there the stored arrays count.
        return name in listed if listed is not None else name in root

    columns = {name: array(f"reads/{name}")[...] for name in READ_COLUMNS if has(f"reads/{name}")}
    columns["epc"] = _epcs(attributes["epcs"], columns["epc"], path)
    stored = dict(attributes["reads"])
    stored["hop_table_hz"] = tuple(stored["hop_table_hz"])
    reads = TagReads(**columns, **stored)
    if attributes.get("reads_order") == BY_ARRIVAL:
        reads = reads[np.argsort(reads.time_ns, kind="stable")]
    if reads.num_reads != attributes["num_reads"]:
        raise RecordingError(f"{path}: {reads.num_reads} reads; expected {attributes['num_reads']}. Copy it again.")
    truth = None
    if attributes["truth"] is not None:
        tables: dict[str, dict[Any, np.ndarray]] = {}
        for name in _TRUTH_TABLES:
            keys = attributes["truth"].get(name, ())  # older recordings have no line_of_sight and no carrier_box_px
            _check_unique(keys, f"truth.{name}", path)
            tables[name] = {key: array(f"truth/{name}/{number}")[...] for number, key in enumerate(keys)}
        truth = Truth(
            **{name: array(f"truth/{name}") for name in _TRUTH_ARRAYS if has(f"truth/{name}")},  # type: ignore[arg-type]
            boxes_px=array("truth/boxes_px")[...] if has("truth/boxes_px") else None,
            tag_to_label=attributes["truth"]["tag_to_label"],
            **tables,  # type: ignore[arg-type]
        )
    for text in ("name", "source"):
        if not isinstance(attributes[text], str):
            raise RecordingError(f"{path}: {text} is {attributes[text]!r}; expected a text. Copy or import it again.")
    second = attributes.get("second")  # only a recording of two cameras has it
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
        clock=None if attributes["clock"] is None else _clock(attributes["clock"], reads),
        name=attributes["name"],
        source=attributes["source"],
        store=root if writable and not attributes.get(UNFINISHED) else None,
        second=None if second is None else SecondCamera(array(_SECOND), second["baseline_m"]),
    )


def _epcs(names: Any, index: np.ndarray, path: str) -> np.ndarray:
    """The EPC of each read, str (num_reads,), from its index in the list of EPCs."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise RecordingError(f"{path}: epcs is {str(names)[:60]}; expected a list of texts. Copy or import it again.")
    _check_unique(names, "epcs", path)
    # A negative index would give another tag's name.
    if index.dtype.kind not in "iu" or (index.size and not 0 <= index.min() <= index.max() < len(names)):
        found = f"{index.min()} to {index.max()} ({index.dtype})" if index.size else str(index.dtype)
        raise RecordingError(
            f"{path}: reads/epc holds {found}; expected integers from 0 to {len(names) - 1}, the places in epcs. "
            "Copy or import it again."
        )
    return np.asarray(names, dtype=str)[index] if names else np.empty(0, str)


def _check_unique(names: Sequence[Any], what: str, path: str) -> None:
    repeated = {str(name) for name in names if names.count(name) > 1}
    if repeated:
        raise RecordingError(
            f"{path}: {what} lists {', '.join(sorted(repeated))} more than once; expected each name once."
        )


def _clock(stored: dict[str, Any], reads: TagReads) -> ClockAudit:
    if "pieces" not in stored:  # an older recording: one line for the whole table, without intervals
        reader_ns = reads.reader_time_ns
        piece = {
            "reference_ns": 0 if reader_ns is None or not len(reader_ns) else int(reader_ns.min()),
            "num_reads": stored["num_reads"],
            "offset_s": stored["offset_s"],
            "offset_interval_s": [stored["offset_s"]] * 2,
            "drift_ppm": stored["drift_ppm"],
            "drift_interval_ppm": None,
        }
        stored = {name: value for name, value in stored.items() if name not in ("offset_s", "drift_ppm")}
        stored |= {"pieces": [piece], "num_set_aside": 0}
    pieces = []
    for piece in stored["pieces"]:
        drift = piece["drift_interval_ppm"]
        intervals = {
            "offset_interval_s": tuple(piece["offset_interval_s"]),
            "drift_interval_ppm": drift and tuple(drift),
        }
        pieces.append(ClockPiece(**{**piece, **intervals}))
    return ClockAudit(**{**stored, "pieces": tuple(pieces)})
