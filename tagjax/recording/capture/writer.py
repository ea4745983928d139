"""A recording that is written as it goes: memory does not grow, and at any moment the folder is a recording that opens.

Frames are chunks of their own, reads chunks of 4,096 rows. They are written first. Then one file, the group's `zarr.json` with
the consolidated metadata of all arrays (Zarr v3), is replaced at once: it alone says how many frames and reads there are. A
process that is killed loses what came since the last such commit, and nothing else. A thread of its own then asks the disk to
keep the files, so that a slow disk holds up no sensor; what a power cut takes away before that, `finish_recording` cuts off.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from numcodecs.zstd import Zstd

from ...core.camera import Intrinsics
from ...core.errors import RecordingError
from ...core.files import make_folder, write_atomic, writing
from ...core.names import name_fault
from ..store import BY_ARRIVAL, FORMAT, UNFINISHED, VERSION
from ..stored_frames import ZSTD_LEVEL, create_array
from .reads import CapturedRead, ReaderEvent, ReaderInfo

META = "zarr.json"
ROWS = 4096  # of reads and of frame times, a chunk
_MAX_EVENTS = 200  # kept in the recording: the first ones

_COLUMNS = {
    "epc": np.int32,
    "time_ns": np.int64,
    "antenna": np.int16,
    "carrier_hz": np.float64,
    "phase_rad": np.float64,
    "rssi_dbm": np.float32,
    "doppler_hz": np.float32,
    "reader_time_ns": np.int64,
    "arrival_time_ns": np.int64,
    "channel_index": np.int16,
}
_ZSTD = Zstd(level=ZSTD_LEVEL, checksum=True)
FRAME_TIMES = ("time_ns", "capture/frame_device_time_ns", "capture/frame_arrival_time_ns")


@dataclasses.dataclass(frozen=True)
class VideoFormat:
    """What all frames have in common."""

    intrinsics: Intrinsics
    depth_dtype: Literal["uint16", "float32"] = "uint16"  # millimetres, or metres
    depth_kind: Literal["depth", "range"] = "depth"


class RecordingWriter:
    """Writes a recording into a new folder. It is used by one thread at a time.

    `commit` lets the folder show what was added; nothing else does. `close` commits, and waits for the disk. Afterwards
    `finish_recording` completes the folder. Raises `RecordingError` for a folder that exists or a name that cannot be one,
    and `WriteError` where the disk refuses.
    """

    def __init__(self, path: str | Path, video: VideoFormat, antennas_m: np.ndarray, *, name: str, source: str = ""):
        self.path, self.video, self.name, self.source = Path(path), video, name, source
        if self.path.exists():
            raise RecordingError(f"{self.path} exists. Remove it or choose another name.")
        if (fault := name_fault(name)) is not None:
            raise RecordingError(f"The recording's name: {fault}. Rename it.")
        self.num_frames = self.num_reads = self.num_events = 0
        self.info: ReaderInfo | None = None
        self.camera: dict[str, Any] = {}  # what the camera says of itself
        self._epcs: dict[str, int] = {}
        self._events: list[dict[str, Any]] = []
        self._frame_times: list[tuple[int, int, int]] = []
        self._reads: list[CapturedRead] = []
        self._last_time_ns = -1
        self._written: list[Path] = []  # and not yet flushed to the disk
        self._disk, self._flushing = ThreadPoolExecutor(1, "flushing"), None
        shape = (video.intrinsics.height, video.intrinsics.width)
        make_folder(self.path)
        with writing(self.path):
            root = zarr.open_group(str(self.path), mode="w", zarr_format=3)
            self._frames = {
                "colour": create_array(root, "colour", (0, *shape, 3), np.uint8, per_frame=True),
                "depth": create_array(root, "depth", (0, *shape), np.dtype(video.depth_dtype), per_frame=True),
            }
            self._rows = {name: _column(root, name, np.int64) for name in FRAME_TIMES}
            self._rows |= {f"reads/{name}": _column(root, f"reads/{name}", kind) for name, kind in _COLUMNS.items()}
            antennas = np.asarray(antennas_m, np.float64)
            create_array(root, "antennas_m", antennas.shape, np.float64, per_frame=False)[...] = antennas
        self._counts = dict.fromkeys([*self._frames, *self._rows], 0)
        self._metadata = _metadata(self.path, [*self._counts, "antennas_m"])
        self.commit()

    def add_frame(self, colour: np.ndarray, depth: np.ndarray, arrival_ns: int, device_ns: int | None = None) -> None:
        """Write a frame: colour (height, width, 3) uint8, depth (height, width). Its time is its arrival, until the end.

        Raises `RecordingError` for a frame of another size or type.
        """
        frame = {"colour": np.asarray(colour), "depth": np.asarray(depth)}
        for name, values in frame.items():
            array = self._frames[name]
            if values.shape != array.shape[1:] or values.dtype != array.dtype:
                raise RecordingError(
                    f"Frame {self.num_frames}: {name} is {values.dtype} of shape {values.shape}; expected {array.dtype} of "
                    f"shape {array.shape[1:]}, as the camera announced."
                )
        with writing(self.path):
            for name, values in frame.items():
                array = self._frames[name]
                chunk = self._chunk(name, array, (self.num_frames, *(0 for _ in array.shape[1:])))
                chunk.parent.mkdir(parents=True)
                # The bytes that Zarr itself would write, in a third of its time. No reader sees them before the commit.
                chunk.write_bytes(_ZSTD.encode(np.ascontiguousarray(values, values.dtype.newbyteorder("<"))))
                self._written.append(chunk)
        time_ns = max(arrival_ns, self._last_time_ns + 1)  # two frames never have one time
        self._last_time_ns = time_ns
        self._frame_times.append((time_ns, arrival_ns if device_ns is None else device_ns, arrival_ns))
        self.num_frames += 1

    def add_reads(self, reads: Sequence[CapturedRead]) -> None:
        """Add reads, in the order of their arrival."""
        self._reads.extend(reads)
        self.num_reads += len(reads)

    def add_event(self, event: ReaderEvent) -> None:
        """Keep an event in the recording's attributes; of many only the first ones."""
        self.num_events += 1
        if len(self._events) < _MAX_EVENTS:
            self._events.append(dataclasses.asdict(event))

    def commit(self) -> None:
        """Let the folder show what was added."""
        times, reads = self._frame_times, self._reads
        self._frame_times, self._reads = [], []
        with writing(self.path):
            if times:
                for name, values in zip(FRAME_TIMES, np.array(times, np.int64).T, strict=True):
                    self._append(name, values)
            if reads:
                for name, values in self._table(reads).items():
                    self._append(f"reads/{name}", values)
            self._counts |= dict.fromkeys(self._frames, self.num_frames)
            for name, count in self._counts.items():
                self._metadata[name]["shape"][0] = count
            write_root(self.path, self.attributes(), self._metadata)
            if self._flushing is None or self._flushing.done():
                self._flush()

    def close(self) -> None:
        """Commit what was added, and wait until the disk has it."""
        self.commit()
        with writing(self.path):
            self._flush()
            self._flush()
        self._disk.shutdown()

    def _flush(self) -> None:
        """Wait for the disk to have kept what it was asked to, and ask it to keep what was written since."""
        if self._flushing is not None:
            self._flushing.result()
        files, self._written = self._written, []
        self._flushing = self._disk.submit(_flush_files, [*files, self.path / META, self.path])

    def attributes(self) -> dict[str, Any]:
        """The attributes of the group, as of now."""
        hop_table_hz = () if self.info is None else self.info.hop_table_hz
        return {
            "name": self.name,
            "source": self.source,
            "intrinsics": dataclasses.asdict(self.video.intrinsics),
            "depth_kind": self.video.depth_kind,
            "clock": None,
            "reads": {
                "hop_table_hz": list(hop_table_hz),
                "phase_period_rad": 2 * np.pi,
                "phase_sign": 1,
                "pi_flips": None,
            },
            "epcs": list(self._epcs),
            "num_reads": self.num_reads,
            "truth": None,
            "capture": {
                "reader": None if self.info is None else dataclasses.asdict(self.info),
                "camera": self.camera,
                "events": self._events,
                "num_events": self.num_events,
            },
            "arrays": sorted([*self._counts, "antennas_m"]),
            "reads_order": BY_ARRIVAL,
            UNFINISHED: True,
            "format": FORMAT,
            "version": VERSION,
        }

    def _table(self, reads: Sequence[CapturedRead]) -> dict[str, np.ndarray]:
        """Columns of reads; `time_ns` is the time of arrival, until the clocks are compared at the end."""
        columns = {
            name: np.array([getattr(read, name) for read in reads], kind)
            for name, kind in _COLUMNS.items()
            if name not in ("epc", "time_ns")
        }
        columns["epc"] = np.array([self._epcs.setdefault(read.epc, len(self._epcs)) for read in reads], np.int32)
        columns["time_ns"] = columns["arrival_time_ns"]
        return columns

    def _append(self, name: str, values: np.ndarray) -> None:
        array, begin = self._rows[name], self._counts[name]
        end = begin + len(values)
        if end > array.shape[0]:
            array.resize((-(-end // ROWS) * ROWS,))
        array[begin:end] = values
        self._counts[name] = end
        self._written += [self._chunk(name, array, (chunk,)) for chunk in range(begin // ROWS, (end - 1) // ROWS + 1)]

    def _chunk(self, name: str, array: zarr.Array, place: tuple[int, ...]) -> Path:
        return self.path / name / array.metadata.encode_chunk_key(place)


def _column(root: zarr.Group, name: str, kind: Any) -> zarr.Array:
    """An array of rows that grows, with the compression of all others."""
    array = create_array(root, name, (ROWS,), kind, per_frame=False)
    array.resize((0,))
    return array


def _metadata(path: Path, arrays: Sequence[str]) -> dict[str, Any]:
    """The metadata of arrays, and of the groups that they lie in, as Zarr has written it."""
    groups = {name.split("/")[0] for name in arrays if "/" in name}
    return {name: json.loads((path / name / META).read_bytes()) for name in sorted({*arrays, *groups})}


def write_root(path: Path, attributes: dict[str, Any], metadata: dict[str, Any] | None) -> None:
    """Replace the group's metadata at once: attributes, and the metadata of all arrays (None: each array's own file counts)."""
    document: dict[str, Any] = {"attributes": _json(attributes), "zarr_format": 3, "node_type": "group"}
    if metadata is not None:
        document["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": metadata}
    write_atomic(path / META, json.dumps(document))


def _json(value: Any) -> Any:
    """The value in JSON types."""
    return json.loads(json.dumps(value, default=lambda one: one.item() if isinstance(one, np.generic) else list(one)))


def _flush_files(paths: Sequence[Path]) -> None:
    """Let the operating system write files, or the names in a folder, to the disk."""
    for path in paths:
        with contextlib.suppress(FileNotFoundError, PermissionError):
            number = os.open(path, os.O_RDONLY)
            try:
                os.fsync(number)
            finally:
                os.close(number)
