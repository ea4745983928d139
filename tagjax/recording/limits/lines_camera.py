"""The lines of clock and camera."""

from __future__ import annotations

import numpy as np

from ..recording import Recording
from .camera import CameraLimits
from .clock import Lag
from .line import Line, judged, limits_text, worst_verdict
from .thresholds import Thresholds

_MARGIN_NS = 500_000_000  # a reader starts and ends a little before or after the camera


def clock_line(recording: Recording, lag: Lag | None, thresholds: Thresholds) -> Line:
    """Reads against frames: the fit of the two clocks, the lag that a shake shows, and reads outside of the video."""
    limits, parts, found = thresholds.clock_s, [], []
    reads, first, last = recording.reads, recording.time_ns[0], recording.time_ns[-1]
    if lag is not None:
        parts.append(judged(abs(lag.lag_s), limits))
        way = "after" if lag.lag_s > 0 else "before"
        found.append(
            f"motion in the reads {abs(lag.lag_s):.2f} s {way} that in the pictures (correlation {lag.correlation:.2f})"
        )
    else:
        found.append("lag not measured (no motion by starts and stops that reads and pictures share)")
    if recording.clock is not None and recording.clock.pieces:
        width = max(high - low for low, high in (piece.offset_interval_s for piece in recording.clock.pieces))
        error = max(width, recording.clock.residual_ms * 1e-3)
        parts.append(judged(error, limits))
        found.append(f"reader's clock fitted to {1e3 * error:.1f} ms")
        if recording.clock.note:
            found.append(recording.clock.note)
    if reads.num_reads:
        outside = float(np.mean((reads.time_ns < first - _MARGIN_NS) | (reads.time_ns > last + _MARGIN_NS)))
        verdict = judged(outside, thresholds.reads_outside)
        parts += [verdict] if verdict != "good" or parts else []
        found.append(f"{outside:.0%} of the reads outside of the video's time")
    return Line(
        name="clock",
        title="Clock: reads against frames",
        verdict=worst_verdict(parts),
        found="; ".join(found),
        threshold=f"lag or uncertainty {limits_text(limits, ' s')}; reads outside "
        f"{limits_text(thresholds.reads_outside, ' %', 100.0)}",
        source="At 1 m/s a lag of 0.05 s is 5 cm, the side of one of the tracer's segments; 0.15 s is a hand's breadth.",
        change="Stamp both sensors on one host, or synchronise both clocks (NTP or PTP). Import with clock=<seconds to add to the "
        "reader's times>. To measure the lag, shake one tag before the camera, a second of motion and a second of rest, five times.",
    )


def camera_lines(camera: CameraLimits, thresholds: Thresholds) -> list[Line]:
    """Depth coverage, frame rate, dropped frames."""
    return [
        Line(
            name="depth",
            title="Depth coverage",
            verdict=judged(camera.depth_fraction, thresholds.depth_fraction),
            found=f"{camera.depth_fraction:.0%} of the pixels",
            threshold=limits_text(thresholds.depth_fraction, " %", 100.0),
            source="Simulated rooms with the noise and the holes of a Kinect v2 have 80 to 97 %. A pixel without depth has no "
            "range, and cannot agree with a tag.",
            change="Keep objects within the camera's range and sunlight, glass and black cloth out of view; register depth to the "
            "whole colour picture or crop that; use a wider depth mode.",
        ),
        Line(
            name="frame_rate",
            title="Frame rate",
            verdict=judged(camera.frame_rate_hz, thresholds.frame_rate_hz),
            found=f"{camera.frame_rate_hz:.1f} frames/s",
            threshold=limits_text(thresholds.frame_rate_hz, " frames/s"),
            source="tagjax is evaluated at 30 (hand-held objects) and 10 frames/s (walkers); real video of 7 frames/s can be traced. "
            "Below 5 a walking person moves by 20 cm a frame, which optical flow misses.",
            change="Lower the resolution (256 columns are used by default), write to a fast disk, do not compress while recording, "
            "and use USB 3.",
        ),
        Line(
            name="dropped_frames",
            title="Dropped frames",
            verdict=judged(camera.dropped_fraction, thresholds.dropped_fraction),
            found=f"{camera.dropped_fraction:.1%}; longest step {camera.longest_step_s:.2f} s",
            threshold=limits_text(thresholds.dropped_fraction, " %", 100.0),
            source="A dropped frame doubles the motion that optical flow has to find and is harmless alone; one in seven or more "
            "makes the effective frame rate that of the gaps.",
            change="Write frames in a thread of their own, to a fast disk; close other programs; leave exposure below the frame time.",
        ),
    ]
