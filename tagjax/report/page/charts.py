"""Charts as inline SVG, in colours of the page's style sheet, and timelines of tags."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ...core.names import short_name
from .html import Html, element, together
from .states import STATES, TagFrames, runs

_WIDTH, _HEIGHT = 440, 204
_LEFT, _RIGHT, _TOP, _BOTTOM = 40, 10, 8, 38
_TICKS = 4


@dataclasses.dataclass(frozen=True)
class Line:
    """A line of a chart, with its band where it has one; NaN makes a gap. `style` numbers its colour and dashes."""

    name: str
    style: int
    y: Float[np.ndarray, " point"]
    low: Float[np.ndarray, " point"] | None = None
    high: Float[np.ndarray, " point"] | None = None


def line_chart(
    title: str,
    x: Float[np.ndarray, " point"],
    lines: Sequence[Line],
    *,
    x_label: str,
    top: float | None = None,
    bottom: float | None = 0.0,
    cursor: bool = False,
) -> Html:
    """A figure with lines over common x, its legend below. `top` and `bottom` are the ends of the y axis, None: of the data.

    With `cursor` the page's script draws a line at the chosen frame: x are then numbers of frames.
    """
    known = np.concatenate([one for line in lines for one in (line.y, line.high) if one is not None] or [np.zeros(0)])
    known = known[np.isfinite(known)]
    high = top if top is not None else round_up(float(known.max(initial=0.0)))
    low = bottom if bottom is not None else float(np.floor(known.min(initial=0.0)))
    first, last = (float(x[0]), float(x[-1])) if len(x) else (0.0, 1.0)

    def across(value: float) -> float:
        return round(_LEFT + (value - first) / max(last - first, 1e-9) * (_WIDTH - _LEFT - _RIGHT), 1)

    def down(value: float) -> float:
        level = min(max((value - low) / max(high - low, 1e-9), 0.0), 1.0)
        return round(_HEIGHT - _BOTTOM - level * (_HEIGHT - _BOTTOM - _TOP), 1)

    drawn: list[Html] = []
    for number in range(_TICKS + 1):
        value = low + (high - low) * number / _TICKS
        drawn += [
            element("line", x1=_LEFT, x2=_WIDTH - _RIGHT, y1=down(value), y2=down(value), class_="grid"),
            element("text", f"{value:.3g}", x=_LEFT - 5, y=down(value) + 4, class_="tick end"),
        ]
    for value in _round_places(first, last):
        place = "end" if across(value) > _WIDTH - _RIGHT - 12 else "middle"
        drawn.append(element("text", f"{value:.0f}", x=across(value), y=_HEIGHT - _BOTTOM + 15, class_=f"tick {place}"))
    drawn.append(element("text", x_label, x=(_LEFT + _WIDTH) / 2, y=_HEIGHT - 4, class_="tick middle"))
    for line in lines:
        if line.low is not None and line.high is not None:
            drawn += [
                element(
                    "path",
                    d=_area(x[part], line.low[part], line.high[part], across, down),
                    class_=f"band s{line.style % 8}",
                )
                for part in _parts(np.isfinite(line.low) & np.isfinite(line.high))
            ]
    for line in lines:
        for part in _parts(np.isfinite(line.y)):
            points = " ".join(f"{across(a)},{down(b)}" for a, b in zip(x[part], line.y[part], strict=True))
            drawn.append(element("polyline", points=points, class_=f"curve s{line.style % 8}"))
    if cursor:
        drawn.append(element("line", x1=_LEFT, x2=_LEFT, y1=_TOP, y2=_HEIGHT - _BOTTOM, class_="cursor"))
    described = ", ".join(f"{line.name}: mean {np.nanmean(line.y):.3g}" for line in lines if np.isfinite(line.y).any())
    chart = element(
        "svg",
        *drawn,
        viewBox=f"0 0 {_WIDTH} {_HEIGHT}",
        role="img",
        aria_label=f"{title}. {described or 'No values'}.",
        class_="chart",
        data_left=_LEFT if cursor else None,
        data_right=_WIDTH - _RIGHT if cursor else None,
    )
    legend = element("ul", *(element("li", _sample(line.style), line.name) for line in lines), class_="legend")
    return element("figure", element("figcaption", title), chart, legend)


def _sample(style: int) -> Html:
    """A short piece of a line, for a legend."""
    piece = element("line", x1=0, x2=26, y1=5, y2=5, class_=f"curve s{style % 8}")
    return element("svg", piece, viewBox="0 0 26 10", class_="sample", aria_hidden="true")


def _parts(known: np.ndarray) -> list[slice]:
    """The parts of a line without gaps."""
    return [slice(start, start + length) for start, length, value in runs(known.astype(np.int64)) if value]


def _area(x: np.ndarray, low: np.ndarray, high: np.ndarray, across, down) -> str:
    there = [f"{across(a)},{down(b)}" for a, b in zip(x, high, strict=True)]
    back = [f"{across(a)},{down(b)}" for a, b in zip(x[::-1], low[::-1], strict=True)]
    return f"M{' L'.join(there + back)}Z"


def round_up(value: float) -> float:
    """The next of 1, 2, 4, 10, 20, 40, ..., so that four steps are round numbers."""
    if value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 4, 10) if step * power >= value))


def _round_places(first: float, last: float) -> list[float]:
    """Some six multiples of 1, 2, 5, 10, 20, ... within the limits."""
    step = next(one * 10.0**power for power in range(9) for one in (1, 2, 5) if 6 * one * 10.0**power >= last - first)
    return [number * step for number in range(math.ceil(first / step), math.floor(last / step) + 1)]


def timeline(tags: Sequence[TagFrames]) -> Html:
    """A bar a tag: its state at every frame, by colour and height, with the counts of its states in words."""
    rows = []
    for number, tag in enumerate(tags):
        states, count = tag.states(), len(tag.frame)
        bars = [
            element(
                "rect",
                element("title", f"frames {tag.frame[start]} to {tag.frame[start + length - 1]}: {STATES[state].name}"),
                x=start,
                width=length,
                y=round(1 - STATES[state].height, 3),
                height=STATES[state].height,
                class_=STATES[state].style,
            )
            for start, length, state in runs(states)
        ]
        said = ", ".join(
            f"{state.name} {int(np.sum(states == place))}"
            for place, state in enumerate(STATES)
            if np.any(states == place)
        )
        bar = element(
            "svg",
            *bars,
            viewBox=f"0 0 {count} 1",
            preserveAspectRatio="none",
            role="img",
            aria_label=f"{tag.epc}, of {count} frames: {said}",
        )
        name = element("span", _dot(number), short_name(tag.epc), class_="name", title=tag.epc)
        rows.append(
            element("div", name, element("div", bar, element("i", class_="cursor"), class_="bar"), class_="row")
        )
    used = {state for tag in tags for state in tag.states().tolist()}
    legend = [
        element("li", element("span", element("i", class_=state.style, style=f"height:{100 * state.height:.0f}%"), class_="key"), element("b", state.name), f" {state.meaning}")
        for place, state in enumerate(STATES)
        if place in used
    ]  # fmt: skip
    frames = tags[0].frame if tags else np.zeros(1, int)
    ends = element("div", element("span", f"frame {frames[0]}"), element("span", f"frame {frames[-1]}"), class_="ends")
    return element("div", *rows, ends, element("ul", *legend, class_="legend states"), class_="timeline")


def _dot(number: int) -> Html:
    """A dot in a tag's colour, as in the video."""
    return element("i", class_=f"dot s{number % 8}", aria_hidden="true")


def fraction_bar(parts: Sequence[tuple[str, str, float]]) -> Html:
    """Parts of a whole as one bar with a list: name, style and fraction of each."""
    begun, bars = 0.0, []
    for name, style, fraction in parts:
        bars.append(
            element(
                "rect",
                element("title", f"{name}: {fraction:.3f}"),
                x=round(begun, 4),
                width=round(fraction, 4),
                y=0,
                height=1,
                class_=style,
            )
        )
        begun += fraction
    said = ", ".join(f"{name} {fraction:.3f}" for name, _, fraction in parts)
    bar = element("svg", *bars, viewBox="0 0 1 1", preserveAspectRatio="none", role="img", aria_label=said)
    items = [
        element("li", element("span", element("i", class_=style, style="height:100%"), class_="key"), element("b", f"{fraction:.3f}"), f" {name}")
        for name, style, fraction in parts
    ]  # fmt: skip
    return together(element("div", bar, class_="bar whole"), element("ul", *items, class_="legend states"))
