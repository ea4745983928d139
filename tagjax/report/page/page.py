"""The whole page: sections in the template, with style sheet and script inline."""

from __future__ import annotations

from pathlib import Path
from string import Template

from ...core.files import write_atomic
from ...core.progress import OnProgress, unobserved
from . import sections
from .contents import Contents, read_contents
from .document import document, template
from .html import Html, element, escaped, together
from .pictures import PageVideo, page_videos

PAGE = "report.html"
"""File name of the page, in the run folder."""

MAX_RECORDINGS = 40
"""Recordings with a section of their own, the worst ones; the table has all."""


def write_page(run: Path, path: Path | None = None, *, on_progress: OnProgress = unobserved) -> Path:
    """Write the page of a run folder and return its path, `report.html` in the folder by default.

    It is made from the folder's files alone: nothing is traced again. `on_progress` counts videos. Raises `ValueError`
    where the folder holds no report.
    """
    contents = read_contents(run)
    path = run / PAGE if path is None else path
    write_atomic(path, page_text(contents, path, on_progress))
    return path


def page_text(contents: Contents, path: Path, on_progress: OnProgress = unobserved) -> str:
    """The page's HTML; `path` is where it will lie, for links to videos that it cannot hold."""
    title = _title(contents)
    shown = contents.recordings()[:MAX_RECORDINGS]
    parts = [
        ("Result", "result", sections.headline(contents)),
        ("Worst cases", "worst", sections.worst(contents)),
        ("Recordings", "recordings", _recordings(contents, shown, path, on_progress)),
        ("Scores since the first motion", "curves", sections.motion(contents)),
        ("Where box IoU is lost", "budget", sections.budget(contents)),
        ("Scores of each recording", "table", sections.recordings_table(contents)),
        ("Training", "training", sections.training(contents)),
        ("How it was made", "made", sections.provenance(contents)),
    ]
    there = [(heading, name, body) for heading, name, body in parts if body is not None]
    links = [element("li", element("a", heading, href=f"#{name}")) for heading, name, _ in there]
    body = [
        element("section", element("h2", heading), content, id=name, aria_label=heading)
        for heading, name, content in there
    ]
    whole = Template(template("page.html")).substitute(
        title=escaped(title), links=together(*links), sections=together(*body)
    )
    return document(title, Html(whole), script=template("page.js"), media=True)


def _title(contents: Contents) -> str:
    recordings = contents.recordings()
    where = recordings[0] if len(recordings) == 1 else f"{len(recordings)} recordings"
    return f"Report on {where}"


def _recordings(contents: Contents, shown: list[str], path: Path, on_progress: OnProgress) -> Html:
    """A part that opens for each recording, the worst first."""
    videos = page_videos(contents, shown, on_progress)
    parts = [_recording(contents, name, place, videos, path) for place, name in enumerate(shown)]
    left = len(contents.recordings()) - len(shown)
    note = element("p", f"{left} more recordings are in the table below.", class_="note") if left else None
    return together(*parts, note)


def _recording(contents: Contents, name: str, place: int, videos: dict[tuple[str, str], PageVideo], path: Path) -> Html:
    tracers = [one for one in contents.tracers if name in contents.tags[one]]
    tags = contents.tags[tracers[0]][name]
    frames, times_s = tags[0].frame, tags[0].time_s
    score = contents.summary[tracers[0]]["recordings"].get(name, {}).get("all", {}).get("iou")
    summary = element(
        "summary",
        element("strong", name),
        " ",
        element("span", f"box IoU {score:.2f}" if isinstance(score, float) else "no truth"),
    )
    choice = None
    if len(tracers) > 1:
        buttons = [
            element(
                "label", element("input", type="radio", name=f"tracer-{place}", value=one, checked=number == 0), one
            )
            for number, one in enumerate(tracers)
        ]
        choice = element("fieldset", element("legend", "Tracer"), *buttons, class_="choice")
    slider = element(
        "div",
        element("button", "◀", type="button", class_="step", data_by="-1", aria_label="previous frame"),
        element(
            "input",
            type="range",
            min=int(frames[0]),
            max=int(frames[-1]),
            value=int(frames[0]),
            step=1,
            aria_label=f"frame of {name}",
        ),
        element("button", "▶", type="button", class_="step", data_by="1", aria_label="next frame"),
        element("button", "Play", type="button", class_="play", hidden=True),
        element("output", f"frame {frames[0]}"),
        class_="slider",
    )
    views = []
    for tracer in tracers:
        video = videos.get((name, tracer))
        views.append(sections.view(contents, name, tracer, None if video is None else video.element(path, len(frames))))
    return element(
        "details",
        summary,
        choice,
        slider,
        *views,
        open=place == 0,
        class_="recording",
        data_recording=name,
        data_first=int(frames[0]),
        data_last=int(frames[-1]),
        data_begin=f"{times_s[0]:.4f}",
        data_end=f"{times_s[-1]:.4f}",
    )
