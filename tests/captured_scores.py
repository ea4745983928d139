"""What the way through sockets costs: a simulated recording, captured from an emulated reader, traced and scored beside itself.

python tests/captured_scores.py recordings/single_static/train/single_static-bottle-train-0.zarr llrp r700

The reader's clock is 200 ppm too fast and the network is held up for up to 20 ms. The captured recording has no
ground truth. It has the same frames as the recording that was played, so it is scored with that one's truth.
"""

from __future__ import annotations

import collections
import dataclasses
import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tagjax.core.settings import from_mapping
from tagjax.metrics.boxes import box_iou
from tagjax.metrics.recordings import score_traces
from tagjax.recording import Recording, TagReads
from tagjax.recording.capture.record import record
from tagjax.recording.capture.settings import RecordConfig
from tagjax.recording.store import open_recording
from tagjax.tagattention.tracer_settings import make_tracer, tracer_clips
from tagjax.tracing.clips import clip_loader
from tagjax.tracing.recordings import trace_recording

ROOT = Path(__file__).parents[1]
NETWORK = {"drift_ppm": 200.0, "jitter_s": 0.02}
_PHASE_STEPS = 4096  # a turn, of the reader's reports


def capture(played: Path, out: Path, reader: str) -> dict[str, Any]:
    """Record `played` through an emulated reader on loopback; the summary of `experiments.record`."""
    values = {"recording": str(played), "reader": reader, "emulate": True, "emulator": NETWORK, "out": str(out)}
    return record(from_mapping(RecordConfig, values))


def with_truth_of(captured: Recording, played: Recording) -> Recording:
    """The captured recording with the truth of what was played. Raises `ValueError` where frames are missing."""
    if captured.num_frames != played.num_frames:
        raise ValueError(f"{captured.num_frames} frames were captured of {played.num_frames}; expected all.")
    return dataclasses.replace(captured, truth=played.truth)


def _identity(reads: TagReads) -> collections.Counter[tuple[Any, ...]]:
    phase = np.rint(reads.phase_rad * (_PHASE_STEPS / (2 * np.pi))).astype(int) % _PHASE_STEPS
    carrier = np.rint(reads.carrier_hz / 1e3).astype(int)
    return collections.Counter(
        zip(reads.epc.tolist(), reads.antenna.tolist(), carrier.tolist(), phase.tolist(), strict=True)
    )


def lost_and_added(played: Recording, captured: Recording) -> tuple[int, int]:
    """Reads that are missing, and reads that were not played or came twice."""
    one, other = _identity(played.reads), _identity(captured.reads)
    return (one - other).total(), (other - one).total()


def clock_error_s(played: Recording, captured: Recording) -> float:
    """Largest error of the time between a read and the first frame, where all reads were captured; a constant is no error."""
    order = np.argsort(captured.reads.reader_time_ns, kind="stable")
    since = [
        one.reads.time_ns - one.time_ns[0]
        for one in (played, dataclasses.replace(captured, reads=captured.reads[order]))
    ]
    apart = since[1] - since[0]
    return float(np.abs(apart - np.median(apart)).max()) * 1e-9


def compare(played: Recording, captured: Recording, settings: Mapping[str, Any]) -> dict[str, float]:
    """Scores of both recordings with one tracer, of settings as under conf/tracer, and how well its boxes overlap.

    The overlap is over the tag-frames at which the tracer gives a box in both; `boxes_in_one_only` counts the others.
    """
    tracer, clips = make_tracer(settings), tracer_clips(settings)
    traces, scores = [], []
    for one in (played, with_truth_of(captured, played)):
        found = list(trace_recording(tracer, one, clip_loader(clips), epcs=played.reads.epcs))
        traces.append([np.asarray(trace.box_px) for _, trace in found])
        scores.append(score_traces(found, one, played.reads.epcs, stride=clips.stride).scores().means)
    first, second = (np.concatenate(boxes) for boxes in traces)
    found_in = [np.isfinite(boxes).all(axis=1) for boxes in (first, second)]
    return {
        "iou": scores[0]["iou"].result(),
        "iou_captured": scores[1]["iou"].result(),
        "identification": scores[0]["identification"].result(),
        "identification_captured": scores[1]["identification"].result(),
        "box_overlap": float(np.nanmean(box_iou(first, second))),
        "boxes_in_one_only": int(np.sum(found_in[0] != found_in[1])),
        "tag_frames": len(first),
    }


def main() -> None:
    """Print a line of JSON for each reader."""
    if len(sys.argv) < 3:
        raise SystemExit(__doc__)
    path, readers = Path(sys.argv[1]), sys.argv[2:]
    settings = yaml.safe_load((ROOT / "conf" / "tracer" / "tagattention.yaml").read_text())
    played = open_recording(path)
    for reader in readers:
        with tempfile.TemporaryDirectory() as folder:
            summary = capture(path, Path(folder) / "a.zarr", reader)
            captured = open_recording(Path(folder) / "a.zarr")
            lost, added = lost_and_added(played, captured)
            counts = {
                "reads": summary["reads"],
                "lost": lost,
                "added": added,
                "dropped_frames": summary["dropped_frames"],
            }
            error_ms = round(1e3 * clock_error_s(played, captured), 3) if not (lost or added) else None
            scores = {name: round(value, 4) for name, value in compare(played, captured, settings).items()}
        print(json.dumps({"reader": reader, **counts, "clock_error_ms": error_ms, **scores}), flush=True)


if __name__ == "__main__":
    main()
