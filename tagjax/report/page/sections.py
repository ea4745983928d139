"""The sections of a report's page."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.names import short_name
from ..video import read_video
from .charts import Line, fraction_bar, line_chart, round_up, timeline
from .contents import Contents
from .html import Html, data_uri, element, table, together
from .pictures import jpeg
from .states import IDENTIFIED, STATES, WRONG, Case, TagFrames, lost_iou, worst_cases

NUM_WORST = 6

_MEASURES = (
    ("iou", "box IoU", "mean overlap of boxes, 0 without a detection"),
    ("cle_px", "centre error, px", "in pixels of a 512 pixel wide picture, over detections"),
    ("identification", "identified", "fraction of frames with the detection on the right object"),
    ("p_d", "detected", "fraction of frames with a detection"),
    ("mask_j", "mask IoU", "mean overlap of masks, 0 without a detection"),
    ("hota", "HOTA", "detection and association together"),
)


def number(value: Any) -> str:
    """A score as text; "-" where it is unknown."""
    if not isinstance(value, int | float):
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.2f}" if abs(value) < 10 else f"{value:.1f}"


def headline(contents: Contents) -> Html:
    """The scores of the first tracer in large figures, and those of all tracers in a table."""
    tracer, scores = contents.tracers[0], contents.summary[contents.tracers[0]]
    recordings = contents.recordings()
    tags = sum(len(contents.tags[tracer][name]) for name in recordings)
    frames = sum(len(one[0].frame) for one in contents.tags[tracer].values())
    about = f"{_count(len(recordings), 'recording')}, {_count(tags, 'tag')}, {_count(frames, 'frame')}"
    counted = scores["all"].get("num_frames") or 0
    if not counted:
        text = (
            f"Tracer: {tracer}. {about}. No frame has a truth to compare with, so there are detections and no scores."
        )
        return together(element("p", text, class_="lead"))
    figures = []
    for name, label, meaning in _MEASURES[:4]:
        interval = scores.get("intervals", {}).get(name)
        between = element("small", f"{number(interval[0])} to {number(interval[1])}") if interval else None
        figures.append(
            element("div", element("dt", label), element("dd", number(scores["all"].get(name)), between), title=meaning)
        )
    text = (
        f"Tracer: {tracer}. {about}. Scores are over {_count(counted, 'frame')} of tags: from a tag's first motion on, while its "
        "whole object is visible."
    )
    parts = [element("p", text, class_="lead"), element("dl", *figures, class_="figures")]
    if len(contents.tracers) > 1:
        rows = [
            [name, *(number(contents.summary[name]["all"].get(measure)) for measure, _, _ in _MEASURES)]
            for name in contents.tracers
        ]
        heads = [label for _, label, _ in _MEASURES]
        parts.append(table(["tracer", *heads], rows, caption="All tracers", number_columns=len(heads)))
    if scores.get("intervals"):
        parts.append(element("p", "Small figures are 95 % intervals of the mean by recording.", class_="note"))
    return together(*parts)


def worst(contents: Contents) -> Html | None:
    """The tags with the lowest scores of the first tracer, each with the picture in the middle of its longest failure."""
    tracer = contents.tracers[0]
    cases = worst_cases([(name, contents.tags[tracer][name]) for name in contents.recordings()], NUM_WORST)
    cards = []
    for case in cases:
        states = case.tag.states()
        counts = case.tag.valid if case.tag.label else np.ones(len(states), bool)
        lines = ", ".join(
            f"{state.name} {int(np.sum(counts & (states == place)))}"
            for place, state in enumerate(STATES)
            if np.any(counts & (states == place))
        )
        video = contents.video(case.recording, tracer)
        picture = None
        if video is not None:
            image = _frame(video, case.frame - int(case.tag.frame[0]))
            alt = f"overlay of frame {case.frame}"
            picture = element("img", src=data_uri("image/jpeg", jpeg(image, 480)), alt=alt)
        measure = "box IoU" if case.tag.label else "detected"
        text = [
            element("h3", f"{short_name(case.tag.epc)}: {measure} {case.score:.2f}"),
            element("p", f"{case.recording}, tag {case.tag.epc}"),
            element(
                "p",
                f"{_failure(case)}. Of {_count(int(counts.sum()), 'frame')}: {lines}.",
            ),
        ]
        go = element(
            "button",
            f"Go to frame {case.frame}",
            type="button",
            class_="go",
            data_recording=case.recording,
            data_frame=case.frame,
        )
        cards.append(element("li", picture, *text, go))
    if not cards:
        return element("p", "No tag that counts failed at any frame.")
    return element("ol", *cards, class_="cards")


def _failure(case: Case) -> str:
    """What failed for longest, and when."""
    first, last = case.failed
    when = f"at frame {first}" if first == last else f"in frames {first} to {last}"
    return f"Longest failure: {'box IoU below 0.5' if case.tag.label else 'no detection'} {when}"


def _frame(video: Path, place: int) -> np.ndarray:
    """A video's picture by its place; the last one where it is shorter."""
    images = list(itertools.islice(read_video(video), place + 1))
    return images[-1]


def budget(contents: Contents) -> Html | None:
    """Where box IoU is lost, for each tracer."""
    parts = []
    for tracer in contents.tracers:
        tags = [tag for tags in contents.tags[tracer].values() for tag in tags]
        lost = lost_iou(tags)
        if not lost:
            continue
        shown = [("box IoU", "kept", 1.0 - sum(lost.values()))]
        words = {IDENTIFIED: "right object, but the box differs", WRONG: "another object or the background"}
        shown += [
            (words.get(state, f"not detected: {state.name}"), state.style, loss)
            for state, loss in lost.items()
            if loss > 0.0005
        ]
        parts.append(together(element("h3", tracer), fraction_bar(shown)))
    if not parts:
        return None
    text = (
        "1 less the box IoU of each frame that counts, added up by what the tracer reported at that frame. "
        "The parts add up to 1. `python -m experiments.error_budget` measures instead which stage causes it."
    )
    return together(*parts, element("p", *_with_code(text), class_="note"))


def motion(contents: Contents) -> Html | None:
    """Mean scores against frames since the tags began to move, one line a tracer, with their bands by recording."""
    charts = []
    for score, title, top in (
        ("iou", "Box IoU", 1.0),
        ("cle_px", "Centre error, px of 512", None),
        ("identification", "Identified", 1.0),
    ):
        lines, longest = [], 0
        for place, tracer in enumerate(contents.tracers):
            values = np.array(contents.motion.get(tracer, {}).get(score, []), float).reshape(-1, 4)
            enough = 2 * values[:, 3] >= values[:, 3].max(initial=0.0)
            mean, low, high = np.where(enough[:, None], values[:, :3], np.nan).T
            if np.isfinite(mean).any():
                lines.append(Line(tracer, place, mean, low, high))
                longest = max(longest, len(mean))
        if lines:
            lines = [_padded(line, longest) for line in lines]
            frames = np.arange(longest, dtype=float)
            charts.append(_score_chart(title, frames, lines, x_label="frames since the tag's first motion", top=top))
    return element("div", *charts, class_="charts") if charts else None


def _score_chart(title: str, frames: np.ndarray, lines: Sequence[Line], *, top: float | None, **more: Any) -> Html:
    """A chart of a score. Without `top` a few large values do not flatten the others: they are drawn at the edge."""
    if top is None:
        top, cut = readable_top(np.concatenate([line.y for line in lines]))
        title += f", cut at {top:g}" if cut else ""
    return line_chart(title, frames, lines, top=top, **more)


def readable_top(values: Float[np.ndarray, " point"]) -> tuple[float | None, bool]:
    """The upper end of an axis, None for that of the data, and whether it cuts off the largest values.

    It cuts where the 90th percentile, or 10 if that is less, would fill less than a half of the axis.
    """
    values = values[np.isfinite(values)]
    if not len(values):
        return None, False
    most = round_up(max(10.0, float(np.percentile(values, 90))))
    return (most, True) if round_up(float(values.max())) > 2 * most else (None, False)


def _padded(line: Line, length: int) -> Line:
    def longer(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else np.pad(values, (0, length - len(values)), constant_values=np.nan)

    y = longer(line.y)
    assert y is not None
    return Line(line.name, line.style, y, longer(line.low), longer(line.high))


def recordings_table(contents: Contents) -> Html:
    """The scores of the first tracer on each recording and each of its tags."""
    tracer, rows = contents.tracers[0], []
    scores = contents.summary[tracer]["recordings"]
    for name in contents.recordings():
        own = scores.get(name, {})
        rows.append([element("strong", name), *_measured(own.get("all", {}))])
        rows += [
            [
                element("span", short_name(tag.epc), title=tag.epc, class_="tag"),
                *_measured(own.get("tags", {}).get(tag.epc, {})),
            ]
            for tag in contents.tags[tracer][name]
        ]
    heads = ["frames", *(label for _, label, _ in _MEASURES[:5])]
    return table(
        ["recording, tag", *heads],
        rows,
        caption=f"Scores of {tracer}, worst recording first",
        number_columns=len(heads),
    )


def _measured(scores: Mapping[str, Any]) -> list[str]:
    return [number(scores.get("num_frames")), *(number(scores.get(name)) for name, _, _ in _MEASURES[:5])]


def view(contents: Contents, recording: str, tracer: str, video: Html | None) -> Html:
    """A tracer on a recording: video, timeline, curves of each tag, and stages."""
    tags = contents.tags[tracer][recording]
    beside = element("div", video, timeline(tags), class_="beside" if video else None)
    curves = element("div", *_curves(tags), class_="charts") if any(tag.label for tag in tags) else None
    return element("div", beside, curves, stages(contents, recording, tracer), class_="view", data_tracer=tracer)


def _curves(tags: Sequence[TagFrames]) -> list[Html]:
    frames = tags[0].frame.astype(float)
    drawn = []
    for title, values, top in (("Box IoU", "iou", 1.0), ("Centre error, px of 512", "cle_px", None)):
        lines = [
            Line(short_name(tag.epc), place, np.where(tag.valid, getattr(tag, values), np.nan))
            for place, tag in enumerate(tags)
            if tag.label
        ]
        drawn.append(_score_chart(title, frames, lines, x_label="frame (gap: does not count)", top=top, cursor=True))
    return drawn


def stages(contents: Contents, recording: str, tracer: str) -> Html | None:
    """The stages of one frame as pictures."""
    kept = contents.stages(recording, tracer)
    if kept is None:
        return None
    frame, shown = kept
    figures = [
        element(
            "figure",
            element("img", src=data_uri("image/jpeg", path.read_bytes()), alt=title),
            element("figcaption", element("b", title), f": {text}"),
        )
        for path, title, text in shown
    ]
    return together(element("h4", f"Stages at frame {frame}"), element("div", *figures, class_="stages"))


def training(contents: Contents) -> Html | None:
    """The loss of a training run, and what it learned."""
    parts = []
    log = [line for line in contents.training if isinstance(line.get("loss"), int | float)]
    if log:
        steps, loss = np.array([line["step"] for line in log], float), np.array([line["loss"] for line in log], float)
        chart = line_chart(
            "Loss",
            steps,
            [Line("loss", 0, loss)],
            x_label="step",
            bottom=float(min(loss.min(), 0.0)),
        )
        parts.append(element("div", chart, class_="charts"))
    if contents.parameters:
        tracers = list(contents.parameters)
        names = list(dict.fromkeys(name for values in contents.parameters.values() for name in values))
        rows = [
            [
                name,
                *(
                    f"{contents.parameters[one][name]:.4g}" if name in contents.parameters[one] else "-"
                    for one in tracers
                ),
            ]
            for name in names
        ]
        shown = table(
            ["parameter", *tracers], rows, caption="Parameters in physical units", number_columns=len(tracers)
        )
        parts.append(element("details", element("summary", "Parameters"), shown))
    return together(*parts) if parts else None


def provenance(contents: Contents) -> Html:
    """The command, the versions, the machine and the configuration."""
    record = contents.record
    parts: list[Html] = []
    if record.get("command"):
        parts += [element("h3", "Command"), element("pre", element("code", record["command"]), tabindex="0")]
    remade = shlex.join(["python", "-m", "experiments.report", f"run={contents.run}"])
    parts += [element("p", "This page again, from the files in the run folder: ", element("code", remade))]
    rows = [["date (UTC)", record.get("date_utc")], ["revision", record.get("revision")]]
    rows += list(map(list, dict(record.get("versions") or {}).items()))
    machine = dict(record.get("machine") or {})
    rows += [[name, machine.get(name)] for name in ("platform", "processor", "cores", "devices")]
    shown = [
        [name, ", ".join(value) if isinstance(value, list) else value] for name, value in rows if value is not None
    ]
    if shown:
        parts.append(
            element(
                "details",
                element("summary", "Versions and machine"),
                table(["what", "value"], shown, caption="Versions and machine"),
            )
        )
    if contents.configuration:
        text = element("pre", element("code", contents.configuration), tabindex="0")
        parts.append(element("details", element("summary", "Configuration (config.yaml)"), text))
    return together(*parts)


def _with_code(text: str) -> list[Any]:
    """Text with its parts between backquotes as code."""
    return [element("code", part) if place % 2 else part for place, part in enumerate(text.split("`"))]


def _count(count: int, what: str) -> str:
    return f"{count:,} {what}{'' if count == 1 else 's'}"
