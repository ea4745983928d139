"""The end of a recording that was written as it went, or of one that was cut off: clocks are compared, lengths become final."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from ...core.errors import RecordingError
from ...core.files import remove, writing
from ..store import FORMAT, UNFINISHED
from .clocks import SensorTimes, sensor_times
from .writer import FRAME_TIMES, META, write_root

_MAX_DELAY_NS = 2_000_000_000
"""Delays of frames that differ by more are no delays: one of the clocks was set anew."""


@dataclasses.dataclass(frozen=True)
class Finished:
    """What a finished recording holds."""

    path: Path
    num_frames: int
    num_reads: int
    reads: SensorTimes | None  # None: it was finished before
    frames: SensorTimes | None


def finish_recording(path: str | Path) -> Finished:
    """Put the times of frames and reads on the host's clock, and give the folder the layout of any other recording.

    It may be killed at any moment, and called again: nothing happens where the recording is finished. Raises `RecordingError`
    for a folder that is no recording.
    """
    path = Path(path)
    document = _document(path)
    attributes = document["attributes"]
    metadata = document.get("consolidated_metadata", {}).get("metadata", {})
    if not attributes.get(UNFINISHED):
        with_frames = json.loads((path / "time_ns" / META).read_bytes())
        return Finished(path, with_frames["shape"][0], attributes["num_reads"], None, None)
    counts = {name: one["shape"][0] for name, one in metadata.items() if "shape" in one}
    with writing(path):
        arrays = {name: zarr.open_array(str(path / name), mode="r+", zarr_format=3) for name in counts}
        _cut_to_what_is_there(path, arrays, counts)
        frames, reads = _named("camera", _frame_times(arrays, counts)), _named("reader", _read_times(arrays, counts))
        arrays["time_ns"][: len(frames.time_ns)] = frames.time_ns
        arrays["reads/time_ns"][: len(reads.time_ns)] = reads.time_ns
        for name, array in arrays.items():  # what was written after the last commit goes
            array.resize((counts[name], *array.shape[1:]))
            _remove_chunks(path / name / "c", array, counts[name])
        attributes["num_reads"] = counts["reads/time_ns"]
        write_root(path, _final(attributes, frames, reads), None)
    return Finished(path, counts["time_ns"], counts["reads/time_ns"], reads, frames)


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads((path / META).read_bytes())
        good = document["attributes"]["format"] == FORMAT
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(
            f"{path}: no readable recording ({type(error).__name__}: {error}). Check the path."
        ) from error
    if not good:
        raise RecordingError(f"{path}: a Zarr group, but no recording. Check the path.")
    return document


def _cut_to_what_is_there(path: Path, arrays: dict[str, zarr.Array], counts: dict[str, int]) -> None:
    """Shorten the counts of frames and of reads to those whose chunks are all there: a power cut may have taken the last ones."""
    frames = [name for name in counts if not name.startswith(("reads/", "antennas_m"))]
    for group in (frames, [name for name in counts if name.startswith("reads/")]):
        whole = min(_num_whole(path / name, arrays[name], counts[name]) for name in group)
        counts |= dict.fromkeys(group, whole)


def _num_whole(folder: Path, array: zarr.Array, count: int) -> int:
    """How many of `count` rows or frames lie before the first chunk that is missing or empty."""
    size, rest = array.chunks[0], (0,) * (array.ndim - 1)
    for chunk in range(-(-count // size)):
        file = folder / array.metadata.encode_chunk_key((chunk, *rest))
        if not file.is_file() or file.stat().st_size == 0:
            return chunk * size
    return count


def _remove_chunks(folder: Path, array: zarr.Array, count: int) -> None:
    """Remove the chunks of frames that no commit has counted."""
    if array.ndim > 1 and folder.is_dir():
        for chunk in folder.iterdir():
            if int(chunk.name) >= count:
                remove(chunk)


def _values(arrays: dict[str, zarr.Array], counts: dict[str, int], name: str) -> np.ndarray:
    return np.asarray(arrays[name][: counts[name]])


def _frame_times(arrays: dict[str, zarr.Array], counts: dict[str, int]) -> SensorTimes:
    """Times of the frames: by the camera's clock where it has one that runs evenly, else of arrival."""
    stored, device_ns, arrival_ns = (_values(arrays, counts, name) for name in FRAME_TIMES)
    if np.array_equal(device_ns, arrival_ns):
        return SensorTimes(stored, None, "the camera reports no time of its own: times of arrival are used")
    found = sensor_times(device_ns, arrival_ns)
    if found.audit is not None and np.all(np.diff(found.time_ns) > 0):
        return found
    delay_ns = arrival_ns - device_ns
    if len(delay_ns) and np.all(np.diff(device_ns) > 0) and np.ptp(delay_ns) <= _MAX_DELAY_NS:
        # The host was too busy to know the offset well; its delays would still be worse between one frame and the next.
        spread_ms = 1e-6 * float(np.ptp(delay_ns))
        note = f"its clock is taken to differ from the host's by the smallest delay, because delays differ by {spread_ms:.0f} ms"
        return SensorTimes(device_ns + delay_ns.min(), None, note)
    return SensorTimes(stored, None, found.note or "the camera's times do not increase: times of arrival are used")


def _named(sensor: str, times: SensorTimes) -> SensorTimes:
    return dataclasses.replace(times, note=f"{sensor}: {times.note}") if times.note else times


def _read_times(arrays: dict[str, zarr.Array], counts: dict[str, int]) -> SensorTimes:
    reader_ns, arrival_ns = (_values(arrays, counts, f"reads/{name}") for name in ("reader_time_ns", "arrival_time_ns"))
    return sensor_times(reader_ns, arrival_ns)


def _final(attributes: dict[str, Any], frames: SensorTimes, reads: SensorTimes) -> dict[str, Any]:
    """The attributes of the finished recording."""
    capture = attributes["capture"] | {
        "camera_clock": None if frames.audit is None else dataclasses.asdict(frames.audit),
        "notes": [one for one in (frames.note, reads.note) if one],
    }
    final = {name: value for name, value in attributes.items() if name != UNFINISHED}
    final |= {"capture": capture, "clock": None if reads.audit is None else dataclasses.asdict(reads.audit)}
    if not attributes["reads"]["hop_table_hz"]:  # the reader reports carriers, and no channels
        final["arrays"] = [name for name in attributes["arrays"] if name != "reads/channel_index"]
    return final
