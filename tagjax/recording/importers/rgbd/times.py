"""Times of picture files: from their names, from a list, or from their order."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

from ....core.errors import RecordingError
from ...image_files import natural_sorted
from ..read_values import stamp_ns
from ..rows import Rejected, RowError, numbered, read_rows, text_lines
from .camera_file import CameraFile

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".npy")
"""Endings of picture files."""

_FACTOR_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_MAX_NS = 2**63 - 1
_NUMBER = re.compile(r"[0-9]+(\.[0-9]+)?")
_MAX_FRAME_NUMBER = 10_000_000  # names of larger numbers are times


def subfolder(base: Path, name: str, key: str) -> Path:
    """A folder inside of `base`. Raises `RecordingError` for a name that leads out of it, and for a missing folder."""
    if not name or Path(name).is_absolute() or ".." in Path(name).parts:
        raise RecordingError(f"{key} is {name!r}; expected a folder inside of {base}. Move it there.")
    if not (base / name).is_dir():
        raise RecordingError(f"{base / name}: no such folder; {key} names it. Correct the camera file.")
    return base / name


def picture_files(folder: Path, where: str | None = None, endings: Sequence[str] = PICTURES) -> list[Path]:
    """The pictures of a folder in natural order of their names. Raises `RecordingError`, which begins with `where`, if there is none."""
    found = natural_sorted(path for path in folder.iterdir() if path.suffix.lower() in endings and path.is_file())
    if not found:
        raise RecordingError(f"{where or folder}: no picture; expected files that end in {', '.join(endings)}.")
    return found


def timed_files(folder: Path, base: Path, camera: CameraFile) -> list[tuple[int, Path]]:
    """Time (ns) and path of each picture of `folder`, in order of time, as `camera.times` says where times are.

    `base` is the folder of the camera file, which a list's names start from. Raises `RecordingError` for names without a time,
    a list of which most rows are not valid, and two pictures of one time.
    """
    if camera.times == "frames":
        if camera.fps is None:
            raise RecordingError(
                f"{folder}: times is 'frames' without fps; expected the frame rate in the camera file (fps: 30)."
            )
        step = Decimal(10**9) / Decimal(repr(camera.fps))
        timed = [(int((step * number).to_integral_value()), path) for number, path in enumerate(picture_files(folder))]
    elif camera.times == "names":
        timed = _times_of_names(folder, camera.time_unit)
    else:
        timed = _times_of_list(folder, base, camera)
    timed.sort(key=lambda one: one[0])
    for (before, first), (after, second) in itertools.pairwise(timed):
        if before == after:
            raise RecordingError(
                f"{folder}: {first.name} and {second.name} have one time ({after * 1e-9:.9f} s); expected a time for each "
                "picture. Remove one of them."
            )
    return timed


def times_of_names(files: Sequence[Path], where: str, unit: str = "auto", *, advice: str) -> list[int]:
    """Nanoseconds of each picture's name in this unit. Raises `RecordingError`, with this advice, for names that are no times."""
    stems = [path.stem for path in files]
    for path in files:
        if not _NUMBER.fullmatch(path.stem):
            raise RecordingError(
                f"{where}: {path.name} names no time; expected seconds (1700000000.033) or whole milli-, micro- or nanoseconds. "
                f"{advice}"
            )
    if unit == "auto" and all(stem.isdigit() and int(stem) < _MAX_FRAME_NUMBER for stem in stems):
        raise RecordingError(
            f"{where}: names such as {stems[0]} and {stems[-1]} look like frame numbers; expected times. {advice}"
        )
    try:
        return [time_of(stem, unit) for stem in stems]
    except RowError as error:
        raise RecordingError(f"{where}: the names are no times ({error}). {advice}") from error


def _times_of_names(folder: Path, unit: str) -> list[tuple[int, Path]]:
    files = picture_files(folder)
    advice = (
        "Set times in the camera file: to a list of times and names, or to frames with fps. If they are times, set time_unit "
        "(s, ms, us or ns)."
    )
    return list(zip(times_of_names(files, str(folder), unit, advice=advice), files, strict=True))


def time_of(text: str, unit: str) -> int:
    """Nanoseconds of a time in this unit; `auto` takes ISO times and finds a number's unit by its size. Raises `RowError`."""
    if unit == "auto":
        found = stamp_ns(text)
    elif _NUMBER.fullmatch(text.strip()):
        found = int((Decimal(text.strip()) * _FACTOR_NS[unit]).to_integral_value())
    else:
        raise RowError("time is not a number")
    if not 0 <= found <= _MAX_NS:
        raise RowError("time is not between the years 1970 and 2262: wrong unit?")
    return found


def start_time_ns(start: Any) -> int | None:
    """Nanoseconds since 1970 of an ISO time or a number of seconds; None for None. Raises `RecordingError`."""
    if start is None:
        return None
    try:
        return stamp_ns(repr(start) if isinstance(start, float) else str(start))
    except RowError as error:
        raise RecordingError(
            f"start is {start!r} ({error}); expected the time of the first frame: 2025-06-01T12:00:00.250Z, or seconds since 1970."
        ) from error


def _times_of_list(folder: Path, base: Path, camera: CameraFile) -> list[tuple[int, Path]]:
    """The rows of a list that name pictures of `folder`: a time and a name, or a name and a time."""
    name = camera.times
    if Path(name).is_absolute() or ".." in Path(name).parts or not (base / name).is_file():
        raise RecordingError(
            f"times is {name!r}; expected names, frames, or a list of times and names that lies in {base}. Correct the camera file."
        )
    lines = [one for one in numbered(text_lines(base / name)) if not one[1].lstrip().startswith("#")]
    if lines and not any(mark.isdigit() for mark in lines[0][1]):  # a header
        lines = lines[1:]
    rejected = Rejected()

    def parse(text: str) -> tuple[int, Path]:
        mark = next((one for one in ",;\t" if one in text), None)
        parts = [part.strip() for part in text.split(mark) if part.strip()]
        if len(parts) != 2:
            raise RowError("the row is not a time and a name")
        stamp, file = parts if _is_time(parts[0]) else reversed(parts)
        path = Path(file)
        if path.is_absolute() or ".." in path.parts:
            raise RowError("the file is outside of the folder")
        if not _is_picture(base / path):
            raise RowError("the file is missing")
        return time_of(stamp, camera.time_unit), base / path

    rows = read_rows(lines, parse, rejected)
    rejected.check(base / name, len(lines), "a time and the name of a picture, separated by a comma or a space")
    own = [row for _, row in rows if row[1].parent == folder]
    if not own:
        raise RecordingError(
            f"{base / name}: no picture of {folder.name}; expected names such as {folder.name}/0001.png."
        )
    return own


def _is_time(text: str) -> bool:
    return Path(text).suffix.lower() not in PICTURES


def _is_picture(path: Path) -> bool:
    try:
        return path.suffix.lower() in PICTURES and path.is_file()
    except OSError:  # a name that is too long
        return False


def check_counts(where: str, found: Sequence[object], expected: int, what: str) -> None:
    """Raise `RecordingError` unless there is one of `found` for each of `expected` frames."""
    if len(found) != expected:
        raise RecordingError(
            f"{where}: {len(found)} {what} for {expected} frames; expected one for each (times: frames). Give a list of times, "
            "or times as names."
        )
