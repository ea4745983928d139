"""The check of a recording as text for the terminal, and as one self-contained HTML page."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core.files import write_atomic
from ..core.names import short_name
from ..recording.limits import Limits, Line
from ..recording.limits.tags import TagLimits
from .page.charts import Line as Curve
from .page.charts import line_chart
from .page.document import document
from .page.html import Html, element, table, together

CHECK_PAGE = "check.html"
"""File name of the page, in the run folder."""

_MARKS = {"good": "●", "limits": "◐", "bad": "✕", "not measured": "○"}
_STYLE = """
.verdict { white-space: nowrap; font-weight: 600; }
.verdict i { font-style: normal; display: inline-block; width: 1.4rem; }
.verdict.good { color: var(--c3); } .verdict.limits { color: var(--c0); } .verdict.bad { color: var(--c2); }
.verdict.unknown { color: var(--soft); }
.lines th, .lines td { padding: .5rem .8rem .5rem 0; vertical-align: top; white-space: normal; }
.lines small { display: block; color: var(--soft); }
.lines td:nth-child(3) { min-width: 14rem; } .lines td:nth-child(4) { min-width: 18rem; }
.lines td:nth-child(5) { min-width: 12rem; }
@media (max-width: 50rem) {
  .lines thead { position: absolute; left: -999px; }
  .lines tr, .lines th, .lines td, .lines td:nth-child(n) { display: block; min-width: 0; padding: .15rem 0; border: 0; }
  .lines tr { border-top: 1px solid var(--edge); padding: .5rem 0; }
  .lines tbody th { font-weight: 600; }
}
"""
_BIN_S = 0.5
_MAX_TAGS = 8
_MAX_BINS = 300


def summary(limits: Limits) -> str:
    """One sentence: what limits the recording."""
    bad = [line.title for line in limits.limiting if line.verdict == "bad"]
    some = [line.title for line in limits.limiting if line.verdict == "limits"]
    if not limits.limiting:
        return "Nothing that was measured limits this recording."
    parts = [f"{word}: {'; '.join(titles)}" for word, titles in (("Bad", bad), ("Limits", some)) if titles]
    return f"{'. '.join(parts)}."


def check_text(limits: Limits) -> str:
    """The lines as text: verdict, value and threshold, and what to change where a verdict is not good."""
    rows = [_about(limits), summary(limits), ""]
    for line in limits.lines:
        rows.append(f"{_MARKS[line.verdict]} {line.verdict:<12} {line.title}: {line.found}")
        if line.verdict != "good":
            rows += [f"    {line.threshold}", f"    {line.source}", f"    To do: {line.change}"]
    return "\n".join(rows)


def write_check_page(limits: Limits, path: Path) -> Path:
    """Write the page and return its path. It needs no other file; names are escaped."""
    write_atomic(path, check_html(limits))
    return path


def check_html(limits: Limits) -> str:
    """The page's HTML: the lines, the tags, and charts over time."""
    title = f"Check of {limits.name}"
    body = together(
        element("p", _about(limits), class_="note"),
        element("p", element("strong", summary(limits)), class_="lead"),
        element("section", element("h2", "What limits it"), _lines(limits.lines), aria_label="What limits it"),
        element("section", element("h2", "Tags"), _tags(limits.tags), aria_label="Tags"),
        element("section", element("h2", "Over time"), _charts(limits), aria_label="Over time"),
    )
    whole = together(element("header", element("h1", title)), element("main", body))
    return document(title, whole, style=_STYLE)


def _about(limits: Limits) -> str:
    return (
        f"{limits.name}: {limits.duration_s:.1f} s, {limits.num_frames} frames, {limits.num_reads} reads of all tags, "
        f"{len(limits.tags)} tag{'' if len(limits.tags) == 1 else 's'} checked"
    )


def _lines(lines: tuple[Line, ...]) -> Html:
    rows = [
        element(
            "tr",
            element("th", line.title, scope="row"),
            element("td", _verdict(line)),
            element("td", line.found),
            element("td", line.threshold, element("small", line.source)),
            element("td", line.change if line.verdict != "good" else ""),
        )
        for line in lines
    ]
    names = ("property", "verdict", "found", "thresholds and their source", "what to change")
    head = element("tr", *(element("th", name, scope="col") for name in names))
    whole = element("table", element("thead", head), element("tbody", *rows), class_="lines")
    return element("div", whole, class_="scroll", tabindex="0", role="region", aria_label="verdicts")


def _verdict(line: Line) -> Html:
    style = "unknown" if line.verdict == "not measured" else line.verdict
    mark = element("i", _MARKS[line.verdict], aria_hidden="true")
    return element("span", mark, line.verdict, class_=f"verdict {style}")


def _tags(tags: tuple[TagLimits, ...]) -> Html:
    header = ["EPC", "antenna", "reads", "reads/s", "longest gap, s", "noise, rad", "flips, %", "reads a dwell", "speed, m/s", "unambiguous to, m/s", "RSSI, dBm"]  # fmt: skip
    rows = [
        [
            tag.epc,
            tag.antenna,
            tag.num_reads,
            *(
                "-" if not np.isfinite(value) else f"{value:.{digits}f}"
                for value, digits in (
                    (tag.reads_per_s, 1),
                    (tag.longest_gap_s, 2),
                    (tag.pieces.noise_rad, 3),
                    (100 * tag.pieces.flip_probability, 1),
                    (tag.reads_per_dwell, 1),
                    (tag.speed_m_s, 2),
                    (tag.fastest_m_s, 2),
                    (tag.rssi_dbm, 1),
                )
            ),
        ]
        for tag in tags
    ]
    return table(header, rows, caption="of the antenna that read the tag most", number_columns=10)


def _charts(limits: Limits) -> Html:
    """Reads per second, range rate and RSSI of the first tags, and the times between frames, in bins of equal time."""
    width = max(_BIN_S, limits.duration_s / _MAX_BINS)
    edges = np.arange(max(1, int(np.ceil(limits.duration_s / width))) + 1) * width
    middle, shown = (edges[1:] + edges[:-1]) / 2, limits.tags[:_MAX_TAGS]

    def curves(time_and_value) -> list[Curve]:
        return [
            Curve(short_name(tag.epc), number, _binned(edges, *time_and_value(tag))) for number, tag in enumerate(shown)
        ]

    rates = [
        Curve(short_name(tag.epc), number, np.histogram(tag.time_s, edges)[0] / width)
        for number, tag in enumerate(shown)
    ]
    steps = Curve("frames", 6, _binned(edges, limits.frame_s[1:], 1e3 * limits.camera.step_s, np.max))
    label = "time, s"
    charts = [
        line_chart("Reads per second", middle, rates, x_label=label),
        line_chart(
            "Range rate, m/s",
            middle,
            curves(lambda tag: (tag.pieces.time_s, tag.pieces.speed_m_s)),
            x_label=label,
            bottom=None,
        ),
        line_chart(
            "RSSI, dBm", middle, curves(lambda tag: (tag.time_s, tag.rssi)), x_label=label, top=0.0, bottom=-80.0
        ),
        line_chart("Longest step between frames, ms", middle, [steps], x_label=label),
    ]
    left = len(limits.tags) - len(shown)
    note = element("p", f"{left} more tags are in the table above.", class_="note") if left else None
    return together(element("div", *charts, class_="charts"), note)


def _binned(edges: np.ndarray, time_s: np.ndarray, values: np.ndarray, of=np.mean) -> np.ndarray:
    """The mean (or another function) of the values of each bin; NaN where there is none."""
    place = np.digitize(time_s, edges) - 1
    known = np.isfinite(values)
    return np.array(
        [of(values[here]) if (here := known & (place == one)).any() else np.nan for one in range(len(edges) - 1)]
    )
