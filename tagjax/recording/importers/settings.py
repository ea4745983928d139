"""Settings of `experiments.import_recording`, and the import itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...core.errors import RecordingError
from ...radio.reader import ReaderSettings
from ..reads import TagReads
from ..recording import ClockAudit, Recording
from ..store import save_recording
from ..virtual_tags import attach_virtual_tags, load_tracks_csv
from .registration import estimate_folder_correction
from .rgbd.bags import Topics
from .rgbd.formats import FORMATS, SourceOptions, open_source, recognise
from .rgbd.streaming import stream_recording
from .rgbd.times import start_time_ns
from .rgbd_folder import import_jpg_mat, import_tum
from .tables import ImportReport, import_table


@dataclasses.dataclass(frozen=True)
class ImportSettings:
    """A video, a table of reads, or both; and the folder of the new recording."""

    video: str | None = None  # file or folder; rgbd/formats.py lists the formats
    video_format: str = "auto"  # auto, or a name of rgbd.formats.FORMATS
    camera: str | None = None  # camera file (JSON or YAML), where it is not beside the video
    start: Any = None  # time of the first frame (ISO, or seconds since 1970), for videos without times of day
    max_gap_s: float | None = None  # between a colour picture and its depth; null: the camera file's, or 0.02
    topics: Topics = dataclasses.field(default_factory=Topics)  # bag: the topics, where they are not found
    calibration: str | None = None  # jpg_mat: .mat with cam_params
    correction: Any = None  # jpg_mat: residual correction of the calibration: null | 7 numbers | estimate
    masks: str | None = None  # jpg_mat: folder of label images
    fps: float = 30.0  # jpg_mat: frame rate, since the folder has no times
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
    """Import the data that `settings` name; returns the recording and a report, line by line.

    The recording is None for a table alone, and for a video that is streamed (all but tum and jpg_mat) without `out`.

    The recording is checked and, if `out` is given, saved. Raises `RecordingError` for data that cannot be imported.
    """
    if settings.video is None and settings.reads is None:
        raise RecordingError("Nothing to import: give video=<folder>, reads=<table>, or both.")
    report: list[str] = []
    table = None
    if settings.reads is not None:
        reads, audit, table_report = import_table(
            settings.reads,
            format=settings.format,
            hop_table_hz=settings.hop_table_hz,
            carrier_hz=settings.carrier_hz,
            clock=settings.clock,
        )
        table = (reads, audit)
        report += _table_lines(table_report, reads)
    if settings.video is None:
        return None, report
    path = Path(settings.video)
    chosen = settings.video_format
    if chosen == "auto" or not path.exists():
        chosen = recognise(path, settings.camera)
    if chosen not in FORMATS:
        raise RecordingError(f"video_format={chosen}: expected auto, {', '.join(FORMATS)}.")

    def complete(video: Recording) -> Recording:
        return _complete(settings, video, table, report)

    if chosen in ("tum", "jpg_mat"):
        recording = complete(_lazy_video(settings, path, chosen, report))
        if settings.out is not None:
            save_recording(recording, settings.out, progress=True)
    else:
        if settings.correction is not None:
            raise RecordingError(
                "correction is for a folder of .jpg and .mat; state the registration in the camera file."
            )
        recording = _streamed(settings, path, chosen, complete, report)
    if settings.out is not None:
        report.append(f"saved as {settings.out}")
    return recording, report


def _complete(
    settings: ImportSettings,
    video: Recording,
    table: tuple[TagReads, ClockAudit | None] | None,
    report: list[str],
) -> Recording:
    """The video with antennas and reads, checked and described."""
    recording = dataclasses.replace(video, antennas_m=np.asarray(settings.antennas_m, float))
    if table is not None:
        recording = dataclasses.replace(recording, reads=table[0], clock=table[1])
    if settings.tracks is not None:
        tracks = load_tracks_csv(settings.tracks, recording.frame_time_s())
        recording = attach_virtual_tags(recording, tracks, settings.reader, seed=settings.seed)
        report.append(f"virtual tags on {len(tracks)} tracks, {recording.reads.num_reads} reads")
    recording.check()
    report.append(
        f"{recording.num_frames} frames of {recording.intrinsics.width} x {recording.intrinsics.height}, "
        f"{recording.frame_rate_hz:.1f} frames/s; {recording.source}"
    )
    return recording


def _streamed(
    settings: ImportSettings, path: Path, chosen: str, complete: Callable[[Recording], Recording], report: list[str]
) -> Recording | None:
    """A video written frame by frame to `out`; without `out` its first lines are described."""
    source = open_source(path, chosen, SourceOptions(settings.camera, settings.start, settings.topics))
    report += source.lines()
    if settings.out is None:
        report.append("nothing was written: give out=<new>.zarr")
        return None
    return stream_recording(
        source,
        Path(settings.out),
        complete,
        start_ns=start_time_ns(settings.start) if chosen != "video" else None,
        max_gap_s=settings.max_gap_s,
        progress=True,
    )


def _lazy_video(settings: ImportSettings, folder: Path, chosen: str, report: list[str]) -> Recording:
    """A folder whose frames are decoded when they are saved."""
    if not folder.is_dir():
        raise RecordingError(f"video={folder}: no such folder.")
    if chosen == "tum":
        if settings.correction is not None:
            raise RecordingError("correction is for a folder of .jpg and .mat; TUM RGB-D is registered already.")
        return import_tum(folder)
    if settings.calibration is None:
        raise RecordingError("A folder of .jpg and .mat needs its calibration: give calibration=<file.mat>.")
    given = _correction(settings.correction)
    plain = import_jpg_mat(folder, settings.calibration, fps=settings.fps, masks=settings.masks)
    if given is None:
        return plain
    if given == "estimate":
        found = estimate_folder_correction(folder, settings.calibration)
        report.append(found.line())
        correction, origin = found.correction, "estimated"
    else:
        correction, origin = given, "given"
    corrected = import_jpg_mat(
        folder, settings.calibration, fps=settings.fps, correction=correction, masks=settings.masks
    )
    # The numbers in full, so that the same recording can be imported again without an estimate.
    numbers = ", ".join(f"{value:.8g}" for value in correction)
    return dataclasses.replace(corrected, source=f"{corrected.source}; correction = [{numbers}] ({origin})")


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
