"""Figures of reads: TagAttention's Figs. 2 and 3, TagVision's Fig. 5."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ...baselines.tagvision.phase_score import theory_rad
from ...core.numerics import SPEED_OF_LIGHT_M_S
from ...core.results import write_csv
from ...metrics.locking import first_motion
from ...radio.published import published_distance, unwrap_slots
from ...radio.unwrap import unwrap_paper
from ...recording import Recording
from ...report.paper import signals
from ...sim.radio.planar import PlanarSettings
from ...sim.suites import Item
from ...tracing.range_windows import phase_reads
from .sources import Sources

_SHOWN_S = 3.0
_ZOOM_S = 0.7


def phase_unwrapping(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 2: one tag's phases as received and unwrapped, and its distance before and after smoothing."""
    recording = sources.recording(items[0])
    epc = recording.reads.epcs[0]
    begin_s = _motion_s(recording, epc) - 0.3
    reads = phase_reads(recording.reads, epc, int(recording.time_ns[0]))
    valid = np.asarray(reads.valid)
    read_s = np.asarray(reads.time_s)[valid]
    raw = np.asarray(unwrap_slots(reads, slots=False))[valid]
    distances = {
        "unwrapped": raw,
        "smoothed read by read": np.asarray(unwrap_paper(reads))[valid],
        "smoothed by slots": np.asarray(unwrap_slots(reads))[valid],
    }
    part = (read_s >= begin_s) & (read_s <= begin_s + _SHOWN_S)
    frame_s, truth_m = recording.frame_time_s(), _true_change_m(recording, epc, float(read_s[part][0]))
    shown = (frame_s >= read_s[part][0]) & (frame_s <= read_s[part][-1])
    scale = 4 * np.pi * np.asarray(reads.carrier_hz)[valid] / SPEED_OF_LIGHT_M_S
    phase = np.asarray(reads.phase_rad)[valid]
    unwrapped = phase[part][0] + (scale * (raw - raw[part][0]))[part]
    own = {name: (value - value[part][0])[part] for name, value in distances.items()}
    signals.phase_figure(path, read_s[part], phase[part], unwrapped, own, frame_s[shown], truth_m[shown])
    true_at_reads = np.interp(read_s[part], frame_s, truth_m)
    write_csv(
        path.with_suffix(".csv"),
        ("time_s", "phase_rad", "unwrapped_rad", *(f"{name.replace(' ', '_')}_m" for name in own), "true_m"),
        _rows(read_s[part], phase[part], unwrapped, *own.values(), true_at_reads),
    )
    errors = {name: 1e3 * float(np.sqrt(np.mean((value - true_at_reads) ** 2))) for name, value in own.items()}
    listed = ", ".join(f"{name} {error:.0f} mm" for name, error in errors.items())
    return f"Root mean square error over the shown {part.sum()} reads: {listed}."


def synchronisation(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 3: the times of frames and reads, and a tag's distance at the reads and at the frames."""
    recording = sources.recording(items[0])
    names = {epc: f"tag {number}" for number, epc in enumerate(recording.reads.epcs, 1)}
    epc = max(names, key=lambda one: recording.reads.select(one).num_reads)
    begin_s = _motion_s(recording, epc) + 0.5
    frame_s = recording.frame_time_s()
    shown = (frame_s >= begin_s) & (frame_s <= begin_s + _ZOOM_S)
    read_s: dict[str, np.ndarray] = {}
    distance = np.zeros(0)
    reads = phase_reads(recording.reads, epc, int(recording.time_ns[0]))
    for one in names:
        own = phase_reads(recording.reads, one, int(recording.time_ns[0]))
        stamps = np.asarray(own.time_s)[np.asarray(own.valid)]
        part = (stamps >= begin_s) & (stamps <= begin_s + _ZOOM_S)
        read_s[names[one]] = stamps[part]
        if one == epc:
            distance = np.asarray(unwrap_slots(own))[np.asarray(own.valid)][part]
    at_frames, known = published_distance(reads, jnp.asarray(frame_s, jnp.float32))
    at_frames = np.where(np.asarray(known), np.asarray(at_frames), np.nan)
    truth_m = _true_change_m(recording, epc, begin_s)
    # The path has no origin of its own: it is laid over the truth by its mean over the shown frames.
    offset = float(np.nanmean((at_frames - truth_m)[shown]))
    signals.synchronisation_figure(
        path, read_s, names[epc], distance - offset, frame_s[shown], (at_frames - offset)[shown], truth_m[shown]
    )
    rows = [
        ("frame", f"{s:.4f}", f"{d:.6g}", f"{t:.6g}")
        for s, d, t in zip(frame_s[shown], (at_frames - offset)[shown], truth_m[shown], strict=True)
    ]
    rows += [("read", f"{s:.4f}", f"{d - offset:.6g}", None) for s, d in zip(read_s[names[epc]], distance, strict=True)]
    write_csv(path.with_suffix(".csv"), ("of", "time_s", "change_m", "true_m"), rows)
    error_mm = 1e3 * float(np.sqrt(np.nanmean((at_frames - offset - truth_m)[shown] ** 2)))
    counts = ", ".join(f"{name} {len(stamps)}" for name, stamps in read_s.items())
    return (
        f"{int(shown.sum())} frames and these numbers of reads: {counts}. At the frames the root mean square error of "
        f"{names[epc]} is {error_mm:.1f} mm."
    )


def constant_offset(sources: Sources, items: list[Item], path: Path) -> str:
    """TagVision, Fig. 5: a tag on a straight track past the antenna, with a constant offset of 3.2 rad, as the text has it."""
    settings, rng = PlanarSettings(), np.random.default_rng(0)
    time_s = np.arange(0.0, 20.0, 1 / 15)
    position = np.stack([np.full_like(time_s, 0.1), 0.07 * time_s - 0.7, np.zeros_like(time_s)], axis=-1)
    antenna = jnp.asarray((1.2, 0.0, 0.0), jnp.float32)
    carrier = jnp.full(len(time_s), settings.carrier_hz, jnp.float32)
    theory = np.asarray(theory_rad(jnp.asarray(position, jnp.float32), antenna, carrier), np.float64)
    measured = theory + 3.2 + settings.noise_rad * rng.normal(size=len(time_s))
    signals.offset_figure(path, time_s, measured, theory)
    both = (np.mod(measured, 2 * np.pi), np.mod(theory, 2 * np.pi))
    relative = [np.mod(one - one[0], 2 * np.pi) for one in (measured, theory)]
    headings = ("time_s", "measured_rad", "theory_rad", "measured_relative_rad", "theory_relative_rad")
    write_csv(path.with_suffix(".csv"), headings, _rows(time_s, *both, *relative))
    before, after = (np.angle(np.mean(np.exp(1j * (one[0] - one[1])))) for one in (both, relative))
    return (
        f"Mean difference of measured and theoretical phase: {float(np.mod(before, 2 * np.pi)):.2f} rad before, {float(after):.2f} rad "
        "after (the error of the first phase)."
    )


def _motion_s(recording: Recording, epc: str) -> float:
    """The time of a tag's first motion; 0 where it is unknown."""
    begin = None if recording.truth is None else first_motion(recording.truth, epc, recording.frame_time_s())
    return float(recording.frame_time_s()[begin]) if begin is not None else 0.0


def _true_change_m(recording: Recording, epc: str, since_s: float) -> np.ndarray:
    """The true change of a tag's range since a time, at the frames; NaN where the recording has no truth."""
    if recording.truth is None or epc not in recording.truth.tag_range_m:
        return np.full(recording.num_frames, np.nan)
    range_m = np.asarray(recording.truth.tag_range_m[epc], np.float64)
    return range_m - np.interp(since_s, recording.frame_time_s(), range_m)


def _rows(*columns: np.ndarray) -> list[tuple[str, ...]]:
    return [tuple(f"{float(value):.6g}" for value in row) for row in zip(*columns, strict=True)]
