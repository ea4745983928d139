"""Evaluation of several tracers on the same recordings, with a report."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from ..core.progress import OnProgress, progress_lines
from ..core.settings import ConfigError, changed
from ..metrics.recordings import RecordingResult, ScoreSettings, evaluate_recording
from ..recording import Recording
from ..report.report import overlay_folder, recording_names, write_report
from ..report.stages import stage_picture, write_stages
from ..report.video import overlay_video
from ..tracing.clips import ClipSettings, clip_loader, window_frames
from ..tracing.tracer import AbstractTracer


def parameters(tracer: AbstractTracer) -> dict[str, float]:
    """The tracer's scalar parameters by name, in physical units where the tracer has a method `physical`."""
    physical = getattr(tracer, "physical", None)
    if physical is not None:
        return dict(physical())
    return {name: float(leaf) for name, leaf in vars(tracer).items() if isinstance(leaf, jax.Array) and leaf.ndim == 0}


def smoothing_tracers(tracers: Mapping[str, AbstractTracer], settings: ScoreSettings) -> set[str]:
    """Names of the tracers that are smoothed offline: with `settings.smooth` all that support it.

    Raises `ConfigError` if `settings.smooth` is set and none supports it."""
    names = {name for name, tracer in tracers.items() if settings.supported_by(tracer).smooth}
    if settings.smooth and not names:
        kinds = ", ".join(type(tracer).__name__ for tracer in tracers.values())
        raise ConfigError(
            f"scores.smooth is true, which {kinds} does not support; expected TagAttention. Set scores.smooth=false."
        )
    return names


def evaluate_tracers(
    tracers: Mapping[str, AbstractTracer],
    recordings: Sequence[Recording],
    folder: Path,
    *,
    clips: ClipSettings,
    own_clips: Mapping[str, Mapping[str, Any]] | None = None,
    settings: ScoreSettings,
    epcs: Sequence[str] | None = None,
    frames: tuple[int, int] | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Run each tracer over each recording, write the report into `folder` and return its summary.

    `own_clips` holds by tracer the clip settings that differ from `clips`. With `settings.smooth` the tracers that support
    it are smoothed offline and get the suffix `_smoothed` in the report; the others run online. Raises `ConfigError` where
    no tracer supports it.
    """
    own = own_clips or {}
    chosen = {name: changed(clips, own.get(name, {}), where=f"clips of {name}") for name in tracers}
    smoothed = smoothing_tracers(tracers, settings)
    labels = {name: f"{name}_smoothed" if name in smoothed else name for name in tracers}
    work = [(name, number) for name in tracers for number in range(len(recordings))]
    results: dict[str, list[RecordingResult]] = {labels[name]: [] for name in tracers}
    names = recording_names(recordings)
    lengths = [recordings[number].num_frames if frames is None else frames[1] - frames[0] for _, number in work]
    with progress_lines(shown=progress) as report:
        done, total = itertools.count(1), sum(lengths)
        report("evaluate", 0, total)
        for name, number in work:
            recording, own = recordings[number], settings.supported_by(tracers[name])
            kept = overlay_folder(folder, names[number], labels[name])
            with overlay_video(kept, recording) if own.video else contextlib.nullcontext() as on_picture:
                result = evaluate_recording(
                    tracers[name],
                    recording,
                    clip_loader(chosen[name]),
                    stride=chosen[name].stride,
                    epcs=epcs,
                    settings=own,
                    frames=frames,
                    on_frame=_frame_counter(report, done, total, f"{labels[name]}: {names[number]}"),
                    on_picture=on_picture,
                )
            results[labels[name]].append(result)
            _write_stages(kept, result, chosen[name], 0 if frames is None else frames[0])
    return write_report(folder, results)


def _frame_counter(report: OnProgress, done: Iterator[int], total: int, now: str) -> Callable[[], None]:
    """Reports one more frame at each call."""
    return lambda: report("evaluate", next(done), total, now)


def _write_stages(folder: Path, result: RecordingResult, clips: ClipSettings, first: int) -> None:
    """Write the stages of one kept picture, with the inputs that the tracer had."""
    recording = result.recording
    window = clips.window if clips.window_s is None else window_frames(clips.window_s, recording.frame_rate_hz)
    picture = stage_picture(result.pictures, first + window - 1)
    if picture is not None:
        start = max(first, picture.frame - window + 1)
        clip = clip_loader(clips)(recording, start, picture.frame + 1, epcs=picture.epcs)
        write_stages(folder, recording, picture, clip.camera, clip.frames)
