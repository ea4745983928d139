"""Recordings on disk or on the net: Zarr v3, one chunk a frame, zstd; opened lazily, checked for missing parts."""

from __future__ import annotations

import dataclasses
import os
import shutil
import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from rich.progress import Progress
from zarr.codecs import ZstdCodec

from .._types import LazyArray
from ..recording import ClockAudit, Intrinsics, Recording, RecordingError, TagReads, Truth

FORMAT = "tagjax-recording"
VERSION = 1

_FRAME_ARRAYS = ("colour", "depth")
_TRUTH_ARRAYS = ("labels", "flow_px", "occluded")


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
        os.replace(partial, path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_recording(recording: Recording, root: zarr.Group, *, progress: bool = False) -> None:
    """Write a recording into an open Zarr group; its attributes, which make it readable, come last."""
    frames: list[tuple[str, LazyArray]] = [("colour", recording.colour), ("depth", recording.depth)]
    truth = recording.truth
    if truth is not None:
        frames += [(f"truth/{name}", array) for name in _TRUTH_ARRAYS if (array := getattr(truth, name)) is not None]
    with Progress(disable=not progress, transient=True) as bar:
        for name, source in frames:
            target = _create(root, name, tuple(source.shape), source.dtype, per_frame=True)
            for t in bar.track(range(source.shape[0]), description=f"{recording.name}: {name}"):
                target[t] = np.asarray(source[t])
    _write(root, "time_ns", recording.time_ns)
    _write(root, "antennas_m", np.asarray(recording.antennas_m, np.float64))
    names = np.empty(0, str)
    for field in dataclasses.fields(TagReads):
        column = getattr(recording.reads, field.name)
        if field.name == "epc":
            names, index = np.unique(np.asarray(column, dtype=str), return_inverse=True)
            _write(root, "reads/epc", index.astype(np.int32))
        elif isinstance(column, np.ndarray):
            _write(root, f"reads/{field.name}", column)
    attributes: dict[str, Any] = {
        "name": recording.name,
        "source": recording.source,
        "intrinsics": dataclasses.asdict(recording.intrinsics),
        "depth_kind": recording.depth_kind,
        "clock": None if recording.clock is None else dataclasses.asdict(recording.clock),
        "reads": {
            name: getattr(recording.reads, name)
            for name in ("hop_table_hz", "phase_period_rad", "phase_sign", "pi_flips")
        },
        "epcs": [str(name) for name in names],
        "num_reads": recording.reads.num_reads,
        "truth": None,
    }
    if truth is not None:
        if truth.boxes_px is not None:
            _write(root, "truth/boxes_px", truth.boxes_px)
        parts = {name: list(getattr(truth, name)) for name in ("tag_range_m", "tag_position_m", "visible")}
        for name, keys in parts.items():
            for number, key in enumerate(keys):
                _write(root, f"truth/{name}/{number}", np.asarray(getattr(truth, name)[key]))
        attributes["truth"] = {"tag_to_label": dict(truth.tag_to_label), **parts}
    root.attrs.update({**attributes, "format": FORMAT, "version": VERSION})


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
    except Exception as error:
        raise RecordingError(
            f"{path}: no readable Zarr v3 group ({type(error).__name__}: {error}). Was the copy cut short?"
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
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f"{path}: damaged: {error}. Copy or import it again.") from error
    if check:
        recording.check()
    return recording


def _read(root: zarr.Group, attributes: dict[str, Any], path: str, writable: bool) -> Recording:
    def array(name: str) -> Any:
        found = root.get(name)
        if not isinstance(found, zarr.Array):
            raise RecordingError(f"{path}: array {name!r} is missing. Was the copy cut short? Copy it again.")
        present = found.nchunks_initialized
        if present != found.nchunks:
            raise RecordingError(
                f"{path}: array {name!r} has {present} of {found.nchunks} chunks; the recording is truncated. Copy it again."
            )
        return found

    columns = {}
    for field in dataclasses.fields(TagReads):
        if f"reads/{field.name}" in root:
            columns[field.name] = np.asarray(array(f"reads/{field.name}")[:])
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
        told = attributes["truth"]
        names: dict[str, dict[Any, np.ndarray]] = {}
        for name in ("tag_range_m", "tag_position_m", "visible"):
            names[name] = {key: np.asarray(array(f"truth/{name}/{number}")[:]) for number, key in enumerate(told[name])}
        truth = Truth(
            **{name: array(f"truth/{name}") for name in _TRUTH_ARRAYS if f"truth/{name}" in root},  # type: ignore[arg-type]
            boxes_px=np.asarray(array("truth/boxes_px")[:]) if "truth/boxes_px" in root else None,
            tag_to_label=told["tag_to_label"],
            **names,  # type: ignore[arg-type]
        )
    intrinsics = dict(attributes["intrinsics"])
    intrinsics["distortion"] = tuple(intrinsics["distortion"])
    return Recording(
        colour=array("colour"),
        depth=array("depth"),
        time_ns=np.asarray(array("time_ns")[:]),
        intrinsics=Intrinsics(**intrinsics),
        reads=reads,
        antennas_m=np.asarray(array("antennas_m")[:]),
        depth_kind=attributes["depth_kind"],
        truth=truth,
        clock=None if attributes["clock"] is None else ClockAudit(**attributes["clock"]),
        name=attributes["name"],
        source=attributes["source"],
        store=root if writable else None,
    )


def _create(root: zarr.Group, name: str, shape: tuple[int, ...], dtype: Any, *, per_frame: bool) -> zarr.Array:
    chunks = (1, *shape[1:]) if per_frame else tuple(max(1, size) for size in shape)
    # Empty chunks are written too: a chunk that is not there is a chunk that was lost.
    return root.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        compressors=[ZstdCodec(level=3)],
        config={"write_empty_chunks": True},
    )


def _write(root: zarr.Group, name: str, values: np.ndarray) -> None:
    target = _create(root, name, values.shape, values.dtype, per_frame=False)
    if values.size:
        target[...] = values


def write_frames(root: zarr.Group, name: str, frames: Iterable[np.ndarray], shape: tuple[int, ...], dtype: Any) -> None:
    """Write an array frame by frame under `name`, replacing one that is there."""
    if name in root:
        del root[name]
    target = _create(root, name, shape, dtype, per_frame=True)
    for t, frame in enumerate(frames):
        target[t] = frame
