"""Results of the experiment on real tracks as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...core.results import markdown_table
from .real_tags import SCORES


def markdown(rows: Sequence[dict[str, Any]], methods: Sequence[str]) -> str:
    """One row for each scene and window length."""
    cells = [
        [
            row["scene"],
            f"{row['window_s']:g}",
            row["num_windows"],
            f"{row['candidates']:.1f}",
            f"{row['chance']:.2f}",
            *(f"{row['accuracy'][name]:.2f}" for name in methods),
        ]
        for row in rows
    ]
    return markdown_table(["scene", "window (s)", "windows", "candidates", "chance", *methods], cells) + "\n"


def real_tags_markdown(real: Mapping[str, Any]) -> str:
    """The correlation of each recording's tag with each track, and the accuracy by windows."""
    if not real:
        return ""
    lines = [
        "",
        "Real tags: correlation of the measured speeds with each track's speed towards the antenna, over the whole recording,",
        "at the clock offset of the highest correlation. The position of the antenna (of a UWB tag, the origin of its",
        "distances) is estimated from the other recordings.",
        "",
    ]
    rows = []
    for one in real["real_tags_whole"]:
        places = [", ".join(f"{value:.2f}" for value in one[name]) for name in ("antenna_m", "own_antenna_m")]
        for number, each in enumerate(one["candidates"]):
            first = [one["recording"], *places] if number == 0 else ["", "", ""]
            where = f"...{each['track'][-4:]}" + ("" if each["own"] else ", of another recording")
            where += " (carries it)" if each["carrier"] else ""
            cells = [*first, where, f"{each['correlation']:.2f}", f"{each['lag_s']:.1f}", f"{each['slope']:.2f}"]
            rows.append(cells)
    header = [
        "recording",
        "antenna from the others (m)",
        "from its own track",
        "track",
        "correlation",
        "clock offset (s)",
    ]
    lines += [
        markdown_table([*header, "measured / track's speed"], rows),
        "",
        "Fraction of windows in which the carrier scores highest, at the clock offset of its whole track. The data hold speeds",
        "without scale and no phases: coherence, TagVision and Eq. 4 do not apply. Goller et al. need RSSI at several antennas.",
        "",
        "",
    ]
    return "\n".join(lines) + markdown(real["real_tags"], SCORES)
