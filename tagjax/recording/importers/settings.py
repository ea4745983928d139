"""What `experiments.import_recording` can be told, and the import itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...core.errors import RecordingError
from ...radio.reader import ReaderSettings
from ..recording import Recording
from ..store import save_recording
from ..virtual_tags import attach_virtual_tags, load_tracks_csv
from .registration import estimate_folder_correction
from .rgbd_folder import import_jpg_mat, import_tum
from .tables import ImportReport, import_table


@dataclasses.dataclass(frozen=True)
class ImportSettings:
    """A video, a table of reads, or both; and where the recording goes."""

    video: str | None = None
    video_format: str = "auto"  # tum | jpg_mat | auto
    calibration: str | None = None  # jpg_mat: .mat with cam_params
    correction: Any = None  # jpg_mat: residual correction of the calibration: null | 7 numbers | estimate
    masks: str | None = None  # jpg_mat: folder of label pictures
    fps: float = 30.0  # jpg_mat: its folder holds no times
    reads: str | None = None
    format: str = "auto"
    hop_table_hz: tuple[float, ...] | None = None
    carrier_hz: float | None = None
    clock: Any = "auto"  # auto | reader | arrival | seconds to add to the reader's clock
    antennas_m: tuple[tuple[float, ...], ...] = ((0.0, 0.0, 0.0),)
    tracks: str | None = None  # a virtual tag on each of these tracks
    seed: int = 0
    reader: ReaderSettings = dataclasses.field(default_factory=ReaderSettings)  # of the virtual tags
    out: str | None = None


def import_recording(settings: ImportSettings) -> tuple[Recording | None, list[str]]:
    """Import what `settings` name; the recording (None for a table alone) and what is to be said of it.

    The recording is checked and, if `out` is given, saved. Raises `RecordingError`.
    """
    if settings.video is None and settings.reads is None:
        raise RecordingError("Nothing to import: give video=<folder>, reads=<table>, or both.")
    said: list[str] = []
    table = None
    if settings.reads is not None:
        reads, audit, report = import_table(
            settings.reads,
            format=settings.format,
            hop_table_hz=settings.hop_table_hz,
            carrier_hz=settings.carrier_hz,
            clock=settings.clock,
        )
        table = (reads, audit)
        said += _table_lines(report, reads)
    if settings.video is None:
        return None, said
    recording = _video(settings, said)
    recording = dataclasses.replace(recording, antennas_m=np.asarray(settings.antennas_m, float))
    if table is not None:
        recording = dataclasses.replace(recording, reads=table[0], clock=table[1])
    if settings.tracks is not None:
        tracks = load_tracks_csv(settings.tracks, recording.frame_time_s())
        recording = attach_virtual_tags(recording, tracks, settings.reader, seed=settings.seed)
        said.append(f"virtual tags on {len(tracks)} tracks, {recording.reads.num_reads} reads")
    recording.check()
    said.append(
        f"{recording.num_frames} frames of {recording.intrinsics.width} x {recording.intrinsics.height}, "
        f"{recording.frame_rate_hz:.1f} frames/s; {recording.source}"
    )
    if settings.out is not None:
        save_recording(recording, settings.out, progress=True)
        said.append(f"saved as {settings.out}")
    return recording, said


def _video(settings: ImportSettings, said: list[str]) -> Recording:
    assert settings.video is not None
    folder = Path(settings.video)
    if not folder.is_dir():
        raise RecordingError(f"video={folder}: no such folder.")
    chosen = settings.video_format
    if chosen == "auto":
        chosen = "tum" if (folder / "rgb.txt").is_file() else "jpg_mat"
    if chosen == "tum":
        if settings.correction is not None:
            raise RecordingError("correction is for a folder of .jpg and .mat; TUM RGB-D is registered already.")
        return import_tum(folder)
    if chosen != "jpg_mat":
        raise RecordingError(f"video_format={chosen}: expected auto, tum or jpg_mat.")
    if settings.calibration is None:
        raise RecordingError("A folder of .jpg and .mat needs its calibration: give calibration=<file.mat>.")
    given = _correction(settings.correction)
    plain = import_jpg_mat(folder, settings.calibration, fps=settings.fps, masks=settings.masks)
    if given is None:
        return plain
    if given == "estimate":
        found = estimate_folder_correction(folder, settings.calibration)
        said.append(found.line())
        correction, how = found.correction, "estimated"
    else:
        correction, how = given, "given"
    corrected = import_jpg_mat(
        folder, settings.calibration, fps=settings.fps, correction=correction, masks=settings.masks
    )
    # Told in full, so that the same recording can be made again without estimating.
    numbers = ", ".join(f"{value:.8g}" for value in correction)
    return dataclasses.replace(corrected, source=f"{corrected.source}; correction = [{numbers}] ({how})")


def _correction(value: Any) -> Literal["estimate"] | tuple[float, ...] | None:
    if value is None or value == "estimate":
        return value
    wrong = RecordingError(f"correction={value!r}: expected null, estimate or 7 numbers (dTx dTy dTz fx* fy* cx+ cy+).")
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 7:
        raise wrong
    try:
        numbers = tuple(float(number) for number in value)
    except (TypeError, ValueError):
        raise wrong from None
    if not np.all(np.isfinite(numbers)):
        raise wrong
    return numbers


def _table_lines(report: ImportReport, reads) -> list[str]:
    lines = report.lines()
    for epc in reads.epcs:
        own = reads.select(epc)
        span_s = max(1e-9, (own.time_ns[-1] - own.time_ns[0]) * 1e-9)
        lines.append(f"{epc}: {own.num_reads} reads in {span_s:.1f} s ({own.num_reads / span_s:.1f}/s)")
    return lines
