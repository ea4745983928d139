"""Figures of scores by frame: TagAttention's Figs. 10, 12, 14, 16, 17 and 19."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ...core.results import write_csv
from ...metrics.curves import Curve, motion_curves
from ...report.paper.curves import NUM_FRAMES, Panel, score_figure
from ...sim.suites import Item
from ...tagattention.tracer_settings import with_values
from .settings import LEARNABLE, PUBLISHED
from .sources import Sources, System, items_by_variant

NAMES = {LEARNABLE: "TagAttention, learnable (this project)", PUBLISHED: "TagAttention as published"}
"""The tracers as legends name them."""

V0_M_S = (0.01, 0.1, 0.5)
"""The velocity thresholds of Fig. 17."""

_SETTLED = 40  # frames after the first motion from which on the mean is stated

Lines = dict[str, dict[str, Curve]]


def all_and_each(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 10: the mean of all recordings by both tracers, and the learnable tracer's by object."""
    lines = _both(sources, items)
    learnable = sources.system(LEARNABLE)
    each = {name: _curves(sources, learnable, own) for (_, name), own in items_by_variant(items).items()}
    panels = [Panel("mean of all", lines), Panel("learnable, by object", each, bands=False)]
    return _draw(path, panels, stated=panels[:1])


def one_panel(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 14: the mean of all tags by both tracers."""
    return _draw(path, [Panel("mean of all", _both(sources, items))])


def by_suite(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 12: a column of panels for each suite, both tracers in each."""
    names = dict.fromkeys(item.suite.name for item in items)
    panels = [
        Panel(name.replace("_", " "), _both(sources, [item for item in items if item.suite.name == name]))
        for name in names
    ]
    return _draw(path, panels)


def by_variant(sources: Sources, items: list[Item], path: Path) -> str:
    """Figs. 16 and 19: a column of panels for each variant of a suite, both tracers in each."""
    panels = [
        Panel(name.replace("m_s", " m/s"), _both(sources, own)) for (_, name), own in items_by_variant(items).items()
    ]
    return _draw(path, panels)


def by_threshold(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 17: the published tracer at three velocity thresholds, and the learnable one, which has none."""
    settings = sources.config.tracers[PUBLISHED]
    panels = []
    for (_, name), own in items_by_variant(items).items():
        lines: Lines = {"learnable (no threshold)": _curves(sources, sources.system(LEARNABLE), own)}
        for v0 in V0_M_S:
            system = System(f"published, v0 {v0:g} m/s", with_values(settings, {"v0_m_s": v0}))
            lines[f"as published with $v_0$ = {v0:g} m/s"] = _curves(sources, system, own)
        panels.append(Panel(f"{name} target", lines))
    return _draw(path, panels, scores=("iou",))


def _both(sources: Sources, items: Sequence[Item]) -> Lines:
    return {name: _curves(sources, sources.system(system), items) for system, name in NAMES.items()}


def _curves(sources: Sources, system: System, items: Sequence[Item]) -> dict[str, Curve]:
    return motion_curves([sources.scores(system, item) for item in items])


def _draw(
    path: Path,
    panels: Sequence[Panel],
    *,
    stated: Sequence[Panel] | None = None,
    scores: Sequence[str] = ("iou", "cle_px"),
) -> str:
    """Draw the panels and write their curves; a sentence with the mean IoU of each line from frame 40 on."""
    score_figure(path, panels, scores=scores)
    rows = [
        (panel.title, name, score, frame, f"{c.mean[frame]:.6g}", f"{c.low[frame]:.6g}", f"{c.high[frame]:.6g}", int(c.num_tags[frame]))
        for panel in panels
        for name, by_score in panel.lines.items()
        for score in scores
        for c in [by_score[score]]
        for frame in range(min(NUM_FRAMES + 1, len(c.mean)))
    ]  # fmt: skip
    headings = ("panel", "line", "score", "frames_since_motion", "mean", "low", "high", "num_tags")
    write_csv(path.with_suffix(".csv"), headings, rows)
    chosen = panels if stated is None else stated
    parts = [
        f"{panel.title}: " + ", ".join(f"{late_iou(lines):.2f} {_plain(name)}" for name, lines in panel.lines.items())
        for panel in chosen
    ]
    mean = f"Mean box IoU from frame {_SETTLED} to {NUM_FRAMES} after the first motion: {'; '.join(parts)}."
    return mean + _frames_that_count([next(iter(panel.lines.values()))["iou"] for panel in chosen])


def _frames_that_count(curves: Sequence[Curve]) -> str:
    """A sentence where in some of the frames that the mean is over no recording has a tag that counts; else nothing."""
    total = NUM_FRAMES + 1 - _SETTLED
    counted = [int(np.sum(one.num_tags[_SETTLED : NUM_FRAMES + 1] > 0)) for one in curves]
    if min(counted) == total:
        return ""
    return f" Some recording has its tag wholly in view in {', '.join(map(str, counted))} of these {total} frames."


def late_iou(curves: Mapping[str, Curve]) -> float:
    """The mean box IoU over tags and frames from the 40th to the 90th after the first motion; NaN without such a frame."""
    curve = curves["iou"]
    part = slice(_SETTLED, NUM_FRAMES + 1)
    count = curve.num_tags[part]
    if not count.sum():
        return float("nan")
    return float(np.nansum(np.where(count > 0, curve.mean[part], 0.0) * count) / count.sum())


def _plain(name: str) -> str:
    return (
        name.removeprefix("TagAttention, ")
        .removeprefix("TagAttention ")
        .replace(" (this project)", "")
        .replace("$", "")
        .replace("_0", "0")
    )
