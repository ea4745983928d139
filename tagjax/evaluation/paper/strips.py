"""Figures of results as pictures: TagAttention's Figs. 13, 15, 20 and 21."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.results import write_csv
from ...metrics.boxes import box_iou
from ...metrics.mean import MaskedMean
from ...metrics.recordings import Picture
from ...metrics.tags import FrameScores
from ...recording import Recording
from ...report.paper.strips import Cell, Row, strip_figure
from ...report.paper.style import around
from ...sim.suites import Item
from .settings import LEARNABLE, PUBLISHED
from .sources import Sources, System, items_by_variant
from .traced import Traced

_SINCE = (10, 25, 40, 60, 85)
_MULTI_SINCE = (5, 20, 35, 60, 85)
_SHORT = {LEARNABLE: "learnable", PUBLISHED: "published"}
_CLEAR, _GONE = 0.9, 0.1  # fractions of an object's usual area

Line = tuple[Any, ...]


def examples(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 13: both tracers in the meeting room and the office, and around the published tracer's sharpest fall."""
    rows: list[Row] = []
    lines: list[Line] = []
    falls: list[tuple[float, int, Item, Traced]] = []
    for item in items:
        recording = sources.recording(item)
        for name in (LEARNABLE, PUBLISHED):
            traced = sources.traced(sources.system(name), item)
            frames = _after_motion(traced, _SINCE)
            rows.append(_row(f"{_place(item)}\n{_SHORT[name]}", recording, traced, frames, lines, item, name))
            if name == PUBLISHED:
                falls.append((*_fall(traced), item, traced))
    depth, at, item, traced = max(falls, key=lambda one: one[0])
    last = traced.pictures[-1].frame
    frames = [min(max(at + step, 0), last) for step in (-2, 0, 2, 5, 10)]
    rows.append(_row("a sudden fall,\npublished", sources.recording(item), traced, frames, lines, item, PUBLISHED))
    strip_figure(path, rows)
    _write(path, lines)
    return (
        f"The last row: {item.name}, the sharpest fall of the published tracer's box IoU within these recordings, by {depth:.2f} at frame "
        f"{at} of the recording."
    )


def several(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 15: both tracers with two objects and with four, two of them alike: the first recording of each, numbers of all."""
    rows: list[Row] = []
    lines: list[Line] = []
    stated: list[str] = []
    for item, *more in items_by_variant(items).values():
        recording = sources.recording(item)
        for name in (LEARNABLE, PUBLISHED):
            traced = sources.traced(sources.system(name), item)
            frames = _after_motion(traced, _MULTI_SINCE)
            label = f"{len(traced.frames)} objects\n{_SHORT[name]}"
            rows.append(_row(label, recording, traced, frames, lines, item, name))
            own = [_identified(one.frames) for one in (traced, *_without_pictures(sources, name, more))]
            stated.append(f"{len(traced.frames)} objects, {_SHORT[name]} {_mean(np.concatenate(own)):.2f}")
    count = max(len(row.cells[0].masks) for row in rows)
    strip_figure(path, rows, names=[f"tag {number}" for number in range(1, count + 1)])
    _write(path, lines)
    return f"Fraction of frames since the first motion in which a tag's own object is identified: {'; '.join(stated)}."


def blocked(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 20: both tracers before, while and after something covers the object: the first recording, numbers of all."""
    rows: list[Row] = []
    lines: list[Line] = []
    stated: list[str] = []
    for name in (LEARNABLE, PUBLISHED):
        waits_s = []
        for item in items:
            recording = sources.recording(item)
            traced = sources.traced(sources.system(name), item, pictures=item is items[0], whole=True)
            epc, scores = next(iter(traced.frames.items()))
            frames, titles = _around_blockage(recording, epc)
            if item is items[0]:
                rows.append(_row(_SHORT[name], recording, traced, frames, lines, item, name, titles))
            waits_s.append(_recovery_s(scores, frames[-3], recording))
        soon = int(np.sum(np.array(waits_s) <= 1.0))
        stated.append(f"{_SHORT[name]} {soon} of {len(items)} ({_wait_text(waits_s[0])} in the one shown)")
    strip_figure(path, rows)
    _write(path, lines)
    return (
        f"Shown: {items[0].name}. Recordings in which the box IoU reaches 0.5 again within a second after the object is back in "
        f"view: {'; '.join(stated)}."
    )


def alike(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 21: two objects in one grip, read by one antenna (both tracers), and by two (the learnable one).

    The first recording of each, numbers of all.
    """
    learnable = sources.config.tracers[LEARNABLE]
    one, two = items_by_variant(items).values()
    runs = (
        ("published,\none antenna", sources.system(PUBLISHED), one),
        ("learnable,\none antenna", sources.system(LEARNABLE), one),
        ("learnable,\ntwo antennas", System("tagattention, two antennas", learnable, {"antennas": "all"}), two),
    )
    rows: list[Row] = []
    lines: list[Line] = []
    stated: list[str] = []
    for label, system, own in runs:
        means = []
        for item in own:
            traced, recording = sources.traced(system, item), sources.recording(item)
            means.append(_as_one(recording, traced))
            if item is own[0]:
                frames = _after_motion(traced, (20, 40, 60, 85))
                rows.append(_row(label, recording, traced, frames, lines, item, system.name))
        alone, both, same = (_mean(np.array(one)) for one in zip(*means, strict=True))
        plain = label.replace("\n", " ")
        stated.append(
            f"{plain}: box IoU {alone:.2f} with the tag's own object, {both:.2f} with both as one, {same:.2f} of the frames with "
            "one mask for both tags"
        )
    strip_figure(path, rows, names=("tag 1", "tag 2"))
    _write(path, lines)
    return f"From frame 40 after the first motion: {'; '.join(stated)}. Neither tracer compares RSSI with positions."


def _mean(values: np.ndarray) -> float:
    """Of those that are numbers; NaN where none is."""
    return MaskedMean.of(values, np.ones(values.shape, bool)).result()


def _without_pictures(sources: Sources, name: str, items: Sequence[Item]) -> list[Traced]:
    return [sources.traced(sources.system(name), item, pictures=False) for item in items]


def _place(item: Item) -> str:
    return {"single_static": "meeting room", "single_dynamic": "office"}.get(item.suite.name, item.suite.name)


def _after_motion(traced: Traced, since: Sequence[int]) -> list[int]:
    """Frames so long after the first motion of any tag, within the trace."""
    begin = min(int(np.argmax(one.since_motion >= 0)) for one in traced.frames.values())
    last = traced.pictures[-1].frame
    return [min(begin + one, last) for one in since]


def _row(
    label: str,
    recording: Recording,
    traced: Traced,
    frames: Sequence[int],
    lines: list[Line],
    item: Item,
    system: str,
    titles: Sequence[str] = (),
) -> Row:
    """A row of pictures; its numbers are appended to `lines`."""
    boxes = np.stack([_true_boxes(recording, traced, frame) for frame in frames])
    height, width = recording.image_shape
    begin = min(int(np.argmax(one.since_motion >= 0)) for one in traced.frames.values())
    pictures = {one.frame: one for one in traced.pictures}
    cells = []
    for place, frame in enumerate(frames):
        title = titles[place] if titles else f"frame {frame - begin}"
        picture = pictures[frame]
        scores = list(traced.frames.values())
        lines += [
            (item.name, system, epc, frame, frame - begin, int(one.detected[frame]), f"{one.box_iou[frame]:.4f}", f"{one.cle_px[frame]:.2f}")
            for epc, one in traced.frames.items()
        ]  # fmt: skip
        cells.append(_cell(recording, picture, boxes[place], title, _scores_text(scores, frame)))
    return Row(label, around(boxes, height, width, margin=0.7), cells)


def _cell(recording: Recording, picture: Picture, true_boxes: np.ndarray, title: str, below: str) -> Cell:
    colour = np.asarray(recording.colour[picture.frame])
    return Cell(
        colour, picture.masks, np.asarray(picture.boxes_px, np.float64), picture.detected, true_boxes, title, below
    )


def _scores_text(scores: Sequence[FrameScores], frame: int) -> str:
    """IoU and centre error of one tag, or the IoUs of several; a dash where a tag is not detected or not to be seen."""
    seen = [bool(np.isfinite(one.cle_px[frame])) for one in scores]
    if len(scores) == 1:
        (one,) = scores
        if not one.detected[frame]:
            return "not detected"
        return f"IoU {one.iou[frame]:.2f}, {one.cle_px[frame]:.0f} px" if seen[0] else "detected, not in view"
    known = [one.detected[frame] and there for one, there in zip(scores, seen, strict=True)]
    texts = [f"{one.iou[frame]:.2f}" if there else "-" for one, there in zip(scores, known, strict=True)]
    return f"IoU {' '.join(texts)}"


def _true_boxes(recording: Recording, traced: Traced, frame: int) -> np.ndarray:
    truth = recording.truth
    if truth is None or truth.boxes_px is None:
        return np.full((len(traced.frames), 4), np.nan)
    return np.stack([np.asarray(truth.boxes_px[frame, one.label - 1], np.float64) for one in traced.frames.values()])


def _fall(traced: Traced) -> tuple[float, int]:
    """The sharpest fall of box IoU over two frames from frame 20 after the first motion on, and the frame after it."""
    (one, *_) = traced.frames.values()
    iou = np.where(one.visible & (one.since_motion >= 20), np.nan_to_num(one.box_iou), np.nan)
    fall = iou[:-2] - iou[2:]
    if not np.isfinite(fall).any():
        return 0.0, len(iou) - 1
    at = int(np.nanargmax(fall))
    return float(fall[at]), at + 2


def _identified(frames: Mapping[str, FrameScores]) -> np.ndarray:
    """Of every tag's frames that count: whether its own object is identified."""
    return np.concatenate([(one.detected & (one.identified == one.label))[one.valid] for one in frames.values()])


def _around_blockage(recording: Recording, epc: str) -> tuple[list[int], list[str]]:
    """Frames before, partly, most and no longer covered, and 0.5 s and 1 s later, with their titles."""
    truth = recording.truth
    assert truth is not None, "suites have truth"
    assert truth.labels is not None, "suites have labels"
    area = np.array([np.sum(np.asarray(labels) == truth.tag_to_label[epc]) for labels in truth.labels], float)
    area /= max(float(np.median(area[area > 0])), 1.0) if np.any(area > 0) else 1.0
    least = int(np.argmin(area[5:-5])) + 5
    before = next((f for f in range(least, -1, -1) if area[f] >= _CLEAR), 0)
    half = next((f for f in range(before, least + 1) if area[f] <= 0.5), least)
    again = next((f for f in range(least, len(area)) if area[f] >= _CLEAR), len(area) - 1)
    rate = recording.frame_rate_hz if np.isfinite(recording.frame_rate_hz) else 30.0
    later = [min(again + round(rate * seconds), len(area) - 1) for seconds in (0.5, 1.0)]
    titles = [
        "before",
        f"{100 * area[half]:.0f} % in view",
        f"{100 * area[least]:.0f} % in view",
        "in view",
        "0.5 s later",
        "1 s later",
    ]
    return [before, half, least, again, *later], titles


def _recovery_s(one: FrameScores, again: int, recording: Recording) -> float:
    """The time from a frame to the first of three frames in a row with a box IoU of 0.5; infinite without them."""
    good, time_s = one.box_iou >= 0.5, recording.frame_time_s()
    found = (frame for frame in range(again, len(good) - 2) if good[frame : frame + 3].all())
    return next((float(time_s[frame] - time_s[again]) for frame in found), np.inf)


def _wait_text(wait_s: float) -> str:
    return f"after {wait_s:.1f} s" if np.isfinite(wait_s) else "not at all"


def _as_one(recording: Recording, traced: Traced) -> tuple[float, float, float]:
    """Mean box IoU with the tag's own object, with the box around both, and the fraction of frames with one mask for both.

    From frame 40 after the first motion on; masks are one where their IoU is above 0.5.
    """
    own, both, same = [], [], []
    tags = list(traced.frames.values())
    for index, picture in enumerate(traced.pictures):
        boxes = _true_boxes(recording, traced, picture.frame)
        if not np.isfinite(boxes).all() or any(one.since_motion[index] < 40 for one in tags):
            continue
        around_both = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
        order = [picture.epcs.index(epc) for epc in traced.frames]
        for tag, box in zip(order, boxes, strict=True):
            found = picture.detected[tag]
            own.append(float(box_iou(picture.boxes_px[tag], box)) if found else 0.0)
            both.append(float(box_iou(picture.boxes_px[tag], around_both)) if found else 0.0)
        first, second = (picture.masks[tag] for tag in order[:2])
        union = np.sum(first | second)
        same.append(float(union > 0 and np.sum(first & second) / union > 0.5))
    return tuple(float(np.mean(values)) if values else float("nan") for values in (own, both, same))  # type: ignore[return-value]


def _write(path: Path, lines: Sequence[Line]) -> None:
    headings = ("recording", "tracer", "epc", "frame", "frames_since_motion", "detected", "box_iou", "cle_px")
    write_csv(path.with_suffix(".csv"), headings, lines)
