"""A traced recording in the Rerun viewer: pictures, masks, boxes, depth, reads and evidence on one timeline."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ..core.camera import working_stride
from ..core.names import short_name
from ..core.settings import ConfigError
from ..recording import Recording
from ..tracing.clips import subsampled_depth
from ..tracing.status import Status, status_or_detected
from ..tracing.tracer import Trace
from .motion_error import MotionError
from .overlay import PALETTE_RGB
from .stages import MOST_NATS, change_colours, log_odds

_TIME = "time"

_EXPLANATIONS = {
    "body": ("on its body", (0, 114, 178)),
    "stationary": ("stationary", (204, 121, 167)),
    "free": ("a path of its own", (150, 150, 150)),
    "best_segment": ("best segment", (230, 159, 0)),
}
"""The lines of a tag's evidence: fields of `Evidence` with their names and colours."""

_EDGES = {"low": -1.0, "high": 1.0}
"""Of a distance's band: names, and their numbers of standard deviations."""


def rerun() -> Any:
    """The module `rerun`. Raises `ConfigError` where it is not installed."""
    try:
        import rerun as module
    except ImportError as error:
        raise ConfigError(
            'the viewer needs rerun-sdk, which is not installed: pip install -c constraints.txt -e ".[viewer]"'
        ) from error
    return module


def log_recording(
    recording: Recording,
    traces: Iterator[tuple[int, Trace]],
    epcs: Sequence[str],
    antennas: Sequence[int],
    *,
    stride: int | None,
    depth: bool,
    out: Path | None,
    full_size: bool = False,
    quality: int = 70,
    band: MotionError | None = None,
) -> None:
    """Log every frame with its trace, frame by frame, to the file `out`, or to a viewer that is opened.

    `epcs` and `antennas` (counted from 1) are those of the traces. Times are seconds since the first frame. With `depth`
    each frame has its depth as well, which viewers show as points in space; without it a file is much smaller. Pictures have
    the working resolution, and log odds every second pixel of it; with `full_size` pictures have all pixels of the recording,
    and log odds those of the working resolution. Pictures are JPEG of this `quality`. `band` gives each distance its band.
    """
    rr = rerun()
    batches = None
    if out is not None:
        # By size alone: batched by time as well, a slow tracer leaves a chunk for each value, and the file is nearly twice as large.
        batches = rr.ChunkBatcherConfig()
        batches.flush_tick = datetime.timedelta(days=1)
    stream = rr.RecordingStream("tagjax", batcher_config=batches)
    stream.send_blueprint(_blueprint(epcs, depth=depth))
    if out is None:
        stream.spawn()
    else:
        stream.save(str(out))
    stride = working_stride(recording.intrinsics.width, stride)
    enlarged = stride if full_size else 1
    _log_scene(rr, stream, recording, epcs, antennas, stride, enlarged, banded=band is not None)
    _log_reads(rr, stream, recording, epcs, antennas)
    try:
        for number, trace in traces:
            time_s = float(recording.frame_time_s()[number])
            stream.set_time(_TIME, duration=time_s)
            _log_picture(rr, stream, recording, number, 1 if full_size else stride, quality)
            if depth and recording.depth_kind == "depth":
                metres = subsampled_depth(recording.depth_metres(slice(number, number + 1)), stride)[0]
                stream.log("/camera/depth", rr.DepthImage(np.round(1e3 * metres).astype(np.uint16), meter=1000.0))
            _log_boxes(rr, stream, recording, trace, epcs, enlarged)
            error_m = None if band is None else band.after(time_s, trace)
            _log_tags(rr, stream, recording, trace, epcs, antennas, error_m)
            _log_evidence(rr, stream, trace, epcs, 1 if full_size else 2)
    finally:
        stream.flush()
        stream.disconnect()


def _blueprint(epcs: Sequence[str], *, depth: bool) -> Any:
    """The panels. Below the picture stand space and log odds as tabs, of which the fuller one is open.

    The phases' legend serves the curves below too; more of them would cover the lines.
    """
    from rerun import blueprint as view

    space = view.Spatial3DView(origin="/", contents=["/camera/**", "/antennas", "/places/**"], name="space")
    log_odds = [
        view.Spatial2DView(origin=_of(epc, "log_odds"), name=f"log odds of {short_name(epc)}, nats") for epc in epcs
    ]
    evidence = [
        view.TimeSeriesView(origin=_of(epc, "evidence"), name=f"evidence for {short_name(epc)}, nats") for epc in epcs
    ]
    curves = [
        view.TimeSeriesView(origin=f"/{name}", name=title, plot_legend=view.PlotLegend(visible=name == "phase"))
        for name, title in (
            ("phase", "phase of the reads, rad"),
            ("distance", "distance to the antenna, m"),
            ("confidence", "confidence"),
        )
    ]
    return view.Blueprint(
        view.Horizontal(
            view.Vertical(
                view.Spatial2DView(origin="/camera/picture", name="picture"),
                view.Tabs(space, *log_odds, active_tab=0 if depth else 1),
            ),
            view.Vertical(*curves, view.Tabs(*evidence), view.TextLogView(origin="/status", name="status")),
        ),
        collapse_panels=True,
    )


def _log_scene(
    rr: Any,
    stream: Any,
    recording: Recording,
    epcs: Sequence[str],
    antennas: Sequence[int],
    stride: int,
    enlarged: int,
    *,
    banded: bool,
) -> None:
    """What does not change: names and colours of tags, the antennas, the camera."""
    classes = [(0, "no tag", (0, 0, 0, 0))]
    classes += [(tag + 1, epc, PALETTE_RGB[tag % len(PALETTE_RGB)]) for tag, epc in enumerate(epcs)]
    stream.log("/", rr.AnnotationContext(classes), static=True)
    stream.log("/", rr.ViewCoordinates.RDF, static=True)
    places = recording.antennas_m[np.asarray(antennas) - 1]
    names = [f"antenna {number}" for number in antennas]
    stream.log("/antennas", rr.Points3D(places, labels=names, radii=0.03, colors=(200, 200, 200)), static=True)
    working = recording.intrinsics.scaled(stride)
    for name, one in (("picture", recording.intrinsics if enlarged == stride else working), ("depth", working)):
        pinhole = rr.Pinhole(
            focal_length=(one.fx_px, one.fy_px),
            principal_point=(one.cx_px, one.cy_px),
            width=one.width,
            height=one.height,
            image_plane_distance=0.4,
        )
        stream.log(f"/camera/{name}", pinhole, static=True)
    for tag, epc in enumerate(epcs):
        colour = PALETTE_RGB[tag % len(PALETTE_RGB)]
        for name in ("distance", "confidence"):
            stream.log(_of(epc, name), rr.SeriesLines(colors=colour, names=short_name(epc)), static=True)
        for edge, sign in _EDGES.items() if banded else ():
            line = rr.SeriesLines(colors=colour, widths=0.5, names=f"{short_name(epc)} {sign:+.0f} sd of the motion")
            stream.log(f"{_of(epc, 'distance')}/{edge}", line, static=True)
        points = rr.SeriesPoints(colors=colour, names=short_name(epc), marker_sizes=3)
        stream.log(_of(epc, "phase"), points, static=True)
        stream.log(_of(epc, "rssi"), points, static=True)
        for name, (title, shade) in _EXPLANATIONS.items():
            stream.log(f"{_of(epc, 'evidence')}/{name}", rr.SeriesLines(colors=shade, names=title), static=True)
    stream.log("/log_odds", rr.AnnotationContext(_log_odds_classes()), static=True)


def _log_reads(rr: Any, stream: Any, recording: Recording, epcs: Sequence[str], antennas: Sequence[int]) -> None:
    """Each read at its own time."""
    for epc in epcs:
        reads = recording.reads.select(epc)
        reads = reads[np.isin(reads.antenna, np.asarray(antennas))]
        time_s = (reads.time_ns - recording.time_ns[0]) * 1e-9
        index = [rr.TimeColumn(_TIME, duration=time_s)]
        for name, values in (("phase", reads.phase_rad), ("rssi", reads.rssi_dbm)):
            stream.send_columns(
                _of(epc, name), indexes=index, columns=rr.Scalars.columns(scalars=np.asarray(values, float))
            )


def _log_picture(rr: Any, stream: Any, recording: Recording, number: int, stride: int, quality: int) -> None:
    """The colour picture, made smaller by `stride`."""
    bgr = np.asarray(recording.colour[number])[..., ::-1]
    if stride > 1:
        one = recording.intrinsics.scaled(stride)
        bgr = cv2.resize(np.ascontiguousarray(bgr), (one.width, one.height), interpolation=cv2.INTER_AREA)
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    _, encoded = cv2.imencode(".jpg", bgr, flags)
    stream.log("/camera/picture", rr.EncodedImage(contents=encoded.tobytes(), media_type="image/jpeg"))


def _log_boxes(rr: Any, stream: Any, recording: Recording, trace: Trace, epcs: Sequence[str], enlarged: int) -> None:
    """Masks and boxes of detected tags. A pixel of the working resolution is `enlarged` pixels of the picture wide."""
    numbers = np.flatnonzero(np.asarray(trace.detected))
    labels = np.zeros(trace.mask.shape[1:], np.uint8)
    for tag in numbers:
        labels[np.asarray(trace.mask[tag]) > 0.5] = tag + 1
    if enlarged > 1:
        labels = labels.repeat(enlarged, axis=0).repeat(enlarged, axis=1)
        labels = labels[: recording.intrinsics.height, : recording.intrinsics.width]
    stream.log("/camera/picture/masks", rr.SegmentationImage(labels, opacity=0.5))
    boxes = enlarged * (np.asarray(trace.box_px)[numbers] + (0, 0, 1, 1))  # to the far edges of the last pixels
    names = [f"{short_name(epcs[tag])} {trace.confidence[tag]:.2f}" for tag in numbers.tolist()]
    box = rr.Boxes2D(array=boxes, array_format=rr.Box2DFormat.XYXY, labels=names, class_ids=numbers + 1)
    stream.log("/camera/picture/boxes", box)


def _log_tags(
    rr: Any,
    stream: Any,
    recording: Recording,
    trace: Trace,
    epcs: Sequence[str],
    antennas: Sequence[int],
    error_m: Float[np.ndarray, " tag"] | None,
) -> None:
    """Each tag's confidence and status; of a detected one its place and its distance, with the edges `error_m` from it."""
    places, detected = np.asarray(trace.centre_m), np.asarray(trace.detected)
    for tag, epc in enumerate(epcs):
        stream.log(_of(epc, "confidence"), rr.Scalars(float(trace.confidence[tag])))
        metres = np.nan  # without a detection, so that no line crosses the gap
        if detected[tag]:
            colour = PALETTE_RGB[tag % len(PALETTE_RGB)]
            point = rr.Points3D([places[tag]], labels=[short_name(epc)], radii=0.04, colors=colour)
            stream.log(f"/places/{epc}", point)
            metres = float(np.linalg.norm(places[tag] - recording.antennas_m[antennas[0] - 1]))
        else:
            stream.log(f"/places/{epc}", rr.Clear(recursive=False))
        stream.log(_of(epc, "distance"), rr.Scalars(metres))
        if error_m is None:
            continue
        for edge, sign in _EDGES.items():
            stream.log(f"{_of(epc, 'distance')}/{edge}", rr.Scalars(metres + sign * float(error_m[tag])))
    status = status_or_detected(trace.status, trace.detected)
    words = ", ".join(f"{short_name(epc)} {Status(int(code)).text}" for epc, code in zip(epcs, status, strict=True))
    stream.log("/status", rr.TextLog(words))


def _log_evidence(rr: Any, stream: Any, trace: Trace, epcs: Sequence[str], stride: int) -> None:
    """The evidence for each explanation, where the tracer compares some, and log odds of the tag's object at every `stride`-th pixel."""
    for tag, epc in enumerate(epcs):
        if trace.evidence is not None:
            for name in _EXPLANATIONS:
                nats = float(getattr(trace.evidence, name)[tag])
                stream.log(f"{_of(epc, 'evidence')}/{name}", rr.Scalars(nats))
        mask = np.asarray(trace.mask[tag])[::stride, ::stride]
        stream.log(_of(epc, "log_odds"), rr.SegmentationImage(log_odds_classes(mask)))


def log_odds_classes(mask: Float[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width"]:
    """The class of each pixel: its log odds in whole nats, 1 for -7 to 16 for 8 and more; 0 below, and where the soft mask is 0.

    What is not followed has no class of its own: in noisy pictures it alternates with hopeless pixels from one to the next,
    which made files five times as large.
    """
    return np.nan_to_num(np.rint(log_odds(mask)) + MOST_NATS).astype(np.uint8)


def _log_odds_classes() -> list[tuple[int, str, tuple[int, int, int]]]:
    """Number, name and colour of each class: blue against the object, white for even odds, orange for it."""
    nats = np.arange(1 - MOST_NATS, MOST_NATS + 1)
    colours = change_colours(nats[None].astype(float), float(MOST_NATS))[0].tolist()
    named = {MOST_NATS: f"+{MOST_NATS} nats or more"}
    rows = [
        (number + 1, named.get(one, f"{one:+d} nats"), tuple(colours[number]))
        for number, one in enumerate(nats.tolist())
    ]
    return [(0, f"-{MOST_NATS} nats or less, or not followed", (0, 0, 0)), *rows]


def _of(epc: str, name: str) -> str:
    return f"/{name}/{epc}"
