"""Contact sheets of suites: a row of frames for each recording, with the true outlines of labelled objects."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import matplotlib
import matplotlib.figure
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ..core.progress import OnProgress, unobserved
from ..recording import Recording, RecordingError
from ..recording.image_files import write_image
from ..recording.store import open_recording
from .radio.planar import PlanarTrials, open_planar
from .suites import PLANAR, Item, Suite, make_suite

_EDGE = 2
_TITLE = 18


def contact_sheet(
    recordings: Sequence[Recording], titles: Sequence[str], *, num_frames: int = 6, width: int = 192
) -> UInt8[np.ndarray, "rows columns 3"]:
    """One row per recording under its title: `num_frames` evenly spaced frames, each scaled to `width` pixels."""
    if not recordings or len(recordings) != len(titles):
        raise ValueError(
            f"{len(recordings)} recordings and {len(titles)} titles; expected one title for each of at least one recording."
        )
    rows = []
    for recording, title in zip(recordings, titles, strict=True):
        frames = np.linspace(0, recording.num_frames - 1, num_frames).round().astype(int)
        tiles = [_tile(recording, int(frame), width) for frame in frames]
        bar = np.full((_TITLE, tiles[0].shape[1] * num_frames, 3), 255, np.uint8)
        place = (4, _TITLE - 5)
        cv2.putText(bar, title, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (30, 30, 30), 1, cv2.LINE_AA)
        rows.append(np.concatenate([bar, np.concatenate(tiles, axis=1)], axis=0))
    widest = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(r, ((0, 0), (0, widest - r.shape[1]), (0, 0)), constant_values=255) for r in rows])


def _tile(recording: Recording, frame: int, width: int) -> np.ndarray:
    picture = np.ascontiguousarray(recording.colour[frame])
    height = round(picture.shape[0] * width / picture.shape[1])
    tile = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    truth = recording.truth
    if truth is not None and truth.labels is not None:
        labels = cv2.resize(np.asarray(truth.labels[frame]), (width, height), interpolation=cv2.INTER_NEAREST)
        colours = matplotlib.colormaps["tab10"]
        for label in np.unique(labels[(labels > 0) & (labels < 255)]):
            outline, _ = cv2.findContours((labels == label).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            colour = tuple(int(255 * c) for c in colours(int(label - 1) % 10)[:3])
            cv2.drawContours(tile, outline, -1, colour, 1)
    return np.pad(tile, ((_EDGE, _EDGE), (_EDGE, _EDGE), (0, 0)), constant_values=255)


def planar_sheet(trials: PlanarTrials) -> UInt8[np.ndarray, "rows columns 3"]:
    """The geometry of planar trials, and the phases of one round along the true line."""
    figure = matplotlib.figure.Figure(figsize=(9, 3.2), dpi=110, layout="constrained")
    plan, phases = figure.subplots(1, 2)
    low, high = 1e3 * trials.sample_m.min(), 1e3 * trials.sample_m.max()
    for line in trials.line_m[::5]:
        plan.plot([1e3 * line] * 2, [low, high], color="0.75", lw=0.8)
    true = 1e3 * trials.line_m[trials.true_line]
    plan.plot([true] * 2, [low, high], color="tab:red", lw=2, label="the tag's line")
    plan.plot(np.full(trials.sample_m.shape[1], true), 1e3 * trials.sample_m[0], ".", color="k", label="one round")
    plan.plot(*(1e3 * np.array(trials.antenna_m)), "^", color="tab:blue", ms=9, label="antenna")
    plan.set(xlabel="x, mm", ylabel="y, mm", title=f"every fifth of {len(trials.line_m)} lines")
    plan.legend(loc="upper center", fontsize=8)
    phases.plot(1e3 * trials.sample_m[0], trials.phase_rad[0], "k.")
    phases.set(xlabel="y of the sample, mm", ylabel="phase, rad", title="phases of one round")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_sheet(suite: Suite, folder: Path) -> Path:
    """Write the contact sheet of a suite made in `folder`: the first recording of each variant, as contact_sheet.png."""
    first: dict[str, Item] = {}
    for item in reversed(suite.items()):
        if item.path(folder).exists():
            first[item.variant.name] = item
    if not first:
        raise RecordingError(
            f"{folder / suite.name} holds no recording; expected at least one. Simulate the suite first."
        )
    chosen = [first[variant.name] for variant in suite.variants if variant.name in first]
    if suite.story == PLANAR:
        sheet = planar_sheet(open_planar(chosen[0].path(folder)))
    else:
        recordings = [open_recording(item.path(folder), check=False) for item in chosen]
        sheet = contact_sheet(recordings, [item.name for item in chosen])
    path = folder / suite.name / "contact_sheet.png"
    write_image(path, sheet)
    return path


def save_preview(
    suite: Suite, folder: Path, *, workers: int = 1, width: int = 960, on_progress: OnProgress = unobserved
) -> Path:
    """Write a suite's contact sheet as <folder>/<name>.jpg, at most `width` pixels wide, without its recordings.

    Six frames of the first recording of every variant are simulated for it and not kept.
    """
    with tempfile.TemporaryDirectory() as scratch:
        make_suite(suite.preview(), Path(scratch), workers=workers, on_progress=on_progress)
        sheet = cv2.imread(str(save_sheet(suite.preview(), Path(scratch))))
    assert sheet is not None
    shrink = min(1.0, width / sheet.shape[1])
    sheet = cv2.resize(sheet, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    path = folder / f"{suite.name}.jpg"
    write_image(path, sheet[..., ::-1], jpeg_quality=85)
    return path
