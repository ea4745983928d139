"""The files of a report in one folder: metrics.json, frames.csv, overlay pictures and curves."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE
from rich.table import Table

from ..core.names import plain_label, safe_file_name
from ..core.results import write_csv, write_json
from ..metrics.curves import motion_curves
from ..metrics.interval import estimates
from ..metrics.recordings import RecordingResult
from ..metrics.tags import Scores
from ..recording import Recording
from ..recording.image_files import write_image
from ..tracing.status import Status
from .overlay import picture_overlay

Results = Mapping[str, Sequence[RecordingResult]]
"""Results of each tracer, by name, one element a recording; the recordings are the same for all."""

_COLUMNS = (
    "iou",
    "carrier_iou",
    "cle_px",
    "mask_j",
    "identified",
    "confidence",
    "detected",
    "status",
    "visible",
    "valid",
    "since_motion",
    "reads",
    "rssi_dbm",
    "line_of_sight",
)


def summarise(results: Results) -> dict[str, Any]:
    """Plain JSON: for each tracer the scores of all with their 95 % intervals by recording, of each recording and of each tag."""
    summary: dict[str, Any] = {}
    for tracer, ones in results.items():
        total = Scores()
        recordings: dict[str, Any] = {}
        names = recording_names([one.recording for one in ones])
        for number, one in enumerate(ones):
            total = total.merge(one.scores())
            tags = {epc: scores.result() for epc, scores in one.tag_scores().items()}
            recordings[names[number]] = {"all": one.scores().result(), "tags": tags}
        whole = estimates([one.scores().means for one in ones])
        intervals = {name: [one.low, one.high] for name, one in whole.items() if one.low is not None}
        summary[tracer] = {"all": total.result(), "intervals": intervals, "recordings": recordings}
    return summary


def write_report(folder: Path, results: Results) -> dict[str, Any]:
    """Write the whole report and return its summary."""
    summary = summarise(results)
    write_json(folder / "metrics.json", summary)
    write_frames(folder / "frames.csv", results)
    for tracer, ones in results.items():
        names = recording_names([one.recording for one in ones])
        for number, one in enumerate(ones):
            write_overlays(overlay_folder(folder, names[number], tracer), one)
    write_curves(folder / "curves", results)
    write_motion_curves(folder, results)
    return summary


def write_frames(path: Path, results: Results) -> None:
    """One CSV row for each tracer, recording, tag and frame; of a tag whose object has no label (0), scores are NaN."""
    write_csv(path, ("tracer", "recording", "epc", "label", "frame", "time_s", *_COLUMNS), _frame_rows(results))


def _frame_rows(results: Results) -> Iterator[tuple[Any, ...]]:
    for tracer, ones in results.items():
        for name, one in zip(recording_names([one.recording for one in ones]), ones, strict=True):
            for epc, frames in (one.frames | one.unlabelled).items():
                offset = int(np.searchsorted(one.recording.frame_time_s(), frames.time_s[0]))
                for index, time_s in enumerate(frames.time_s):
                    written = [_written(column, getattr(frames, column)[index]) for column in _COLUMNS]
                    yield (tracer, name, epc, frames.label, offset + index, f"{time_s:.4f}", *written)


def _written(column: str, value: Any) -> str | int:
    if column == "status":
        return Status(int(value)).word
    return int(value) if isinstance(value, np.bool_ | np.integer) else f"{value:.6g}"


def write_overlays(folder: Path, result: RecordingResult) -> None:
    """One PNG for each kept frame; true boxes are thin and white. Tags that are not detected are listed with the reason."""
    for picture in result.pictures:
        write_image(folder / f"frame{picture.frame:06d}.png", picture_overlay(result.recording, picture))


def write_curves(folder: Path, results: Results) -> None:
    """One PNG for each tag: IoU and CLE against frame number, all tracers together."""
    try:
        from .curves import score_curves
    except ImportError:
        warnings.warn(
            "No curves were drawn: matplotlib is not installed. Install the viz extra: pip install 'tagjax[viz]'.",
            stacklevel=2,
        )
        return
    reference = next(iter(results.values()), ())
    names = recording_names([one.recording for one in reference])
    for number, one in enumerate(reference):
        for epc, frames in one.frames.items():
            lines = {}
            for tracer, ones in results.items():
                own = ones[number].frames[epc]
                lines[tracer] = {
                    "iou": np.where(own.detected, own.iou, 0.0),
                    "cle_px": np.where(own.detected & own.visible, own.cle_px, np.nan),
                }
            name = names[number]
            offset = int(np.searchsorted(one.recording.frame_time_s(), frames.time_s[0]))
            path = folder / f"{safe_file_name(f'{name}_{epc}')}.png"
            score_curves(path, lines, frames.valid, first_frame=offset, title=plain_label(f"{name}: {epc}"))


def write_motion_curves(folder: Path, results: Results) -> None:
    """Scores against frames since the first motion, means over recordings with their bands: a CSV, and a figure of it."""
    curves = {tracer: motion_curves([one.frames for one in ones]) for tracer, ones in results.items()}
    rows = [
        (tracer, frame, name, *(f"{value:.6g}" for value in values), number)
        for tracer, by_name in curves.items()
        for name, curve in by_name.items()
        for frame, (*values, number) in enumerate(zip(curve.mean, curve.low, curve.high, curve.num_tags, strict=True))
    ]
    write_csv(folder / "motion_curves.csv", ("tracer", "frame", "score", "mean", "low", "high", "num_tags"), rows)
    if not rows:
        return
    try:
        from .curves import band_curves
    except ImportError:
        return  # `write_curves` has warned
    band_curves(folder / "motion_curves.png", curves)


def score_table(summary: Mapping[str, Any], *, title: str = "") -> Table:
    """The scores over all tags, one row a tracer."""
    columns = {
        "iou": "IoU",
        "cle_px": "CLE px",
        "mask_j": "J",
        "identification": "ident.",
        "p_d": "P_D",
        "locked": "locked",
        "time_to_lock_s": "lock s",
        "num_frames": "frames",
    }
    if any(scores["all"].get("p_fa") is not None for scores in summary.values()):
        columns["p_fa"] = "P_FA"
    rows = [[_cell(scores["all"].get(name)) for name in columns] for scores in summary.values()]
    scored = any(scores["all"].get("num_frames") != 0 for scores in summary.values())
    caption = None if scored else "no frame has a truth to compare with: no scores"
    table = Table(title=title, caption=caption, box=SIMPLE, pad_edge=False, collapse_padding=True)
    table.add_column("tracer", no_wrap=True)
    for heading, *cells in zip(columns.values(), *rows, strict=True):
        table.add_column(heading, justify="right", no_wrap=True, min_width=max(map(len, (heading, *cells))))
    for tracer, row in zip(summary, rows, strict=True):
        table.add_row(tracer, *row)
    return table


def _cell(value: float | int | None) -> str:
    """Three significant digits; three decimal places below 1, so that columns stay narrow."""
    if value is None:
        return "-"
    if isinstance(value, int):
        return f"{value:d}"
    return f"{value:.3f}" if 0 < abs(value) < 1 else f"{value:.3g}"


def recording_names(recordings: Sequence[Recording]) -> list[str]:
    """The recordings' own names, numbered where several share one."""
    names = [one.name for one in recordings]
    return [name if names.count(name) == 1 else f"{name}-{number}" for number, name in enumerate(names)]


def overlay_folder(folder: Path, recording: str, tracer: str) -> Path:
    """Where a report keeps the overlay pictures and the video of a recording's name and a tracer."""
    return folder / "overlays" / safe_file_name(recording) / safe_file_name(tracer)
