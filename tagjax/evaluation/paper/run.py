"""Draw figures of the papers from suites."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ...core.files import write_atomic
from ...core.json_text import parse_json
from ...core.progress import OnProgress, unobserved
from ...core.results import write_json
from ...core.settings import from_mapping
from ...sim.suites import Item
from .settings import PaperConfig
from .sources import MissingRecordingsError, Sources, described
from .table import FIGURES, PaperFigure, chosen

PAGE, LIST = "figures.md", "figures.json"
CURVES = "Curves are over frames since the first motion; bands are 95 % intervals of the mean, by recording (none with a single recording)."
"""What holds for all figures with curves; the page begins with it."""


@dataclasses.dataclass(frozen=True)
class Drawn:
    """One figure of a run: the files (None if it was left out), the recordings, and what is seen or why it is missing."""

    name: str
    title: str
    picture: str | None
    numbers: str | None
    recordings: str
    seen: str


def run_paper(config: PaperConfig, folder: Path, *, on_progress: OnProgress = unobserved) -> list[Drawn]:
    """Draw the chosen figures into `folder`, each a PNG with a CSV of its numbers, and return them.

    `figures.md` shows all figures that the folder holds, also those of runs before; `figures.json` lists them. `on_progress`
    counts the figures. With `all` and without simulation a figure whose recordings are missing is left out with the reason.
    Raises `ConfigError` where a figure that is named has no recording.
    """
    names = chosen(config.figures())
    drawn: list[Drawn] = []

    def report(text: str) -> None:
        name = names[min(len(drawn), len(names) - 1)]
        on_progress("figures", len(drawn), len(names), f"figure {name}: {text}")

    sources = Sources(config, folder, report, on_progress)
    for name in names:
        report("recordings")
        try:
            drawn.append(draw(sources, name, folder))
        except MissingRecordingsError as error:
            if "all" not in config.figures():
                raise
            drawn.append(Drawn(name, FIGURES[name].title, None, None, "", f"not drawn: {error}"))
        known = {one.name: one for one in (*drawn_before(folder), *drawn)}
        listed = [known[name] for name in FIGURES if name in known]
        write_json(folder / LIST, [dataclasses.asdict(one) for one in listed])
        write_atomic(folder / PAGE, page(listed))
    on_progress("figures", len(drawn), len(names))
    return drawn


def drawn_before(folder: Path) -> list[Drawn]:
    """The figures that a folder lists and holds; none where its list is missing or damaged."""
    try:
        rows = parse_json((folder / LIST).read_bytes())
        found = [from_mapping(Drawn, row) for row in rows]
    except (OSError, ValueError, TypeError):
        return []
    return [one for one in found if one.name in FIGURES and one.picture and (folder / Path(one.picture).name).exists()]


def draw(sources: Sources, name: str, folder: Path) -> Drawn:
    """Draw one figure. Raises `MissingRecordingsError` where a suite has none of its recordings."""
    figure, items = FIGURES[name], items_of(sources, FIGURES[name])
    path = folder / f"{file_name(name)}.png"
    seen = figure.draw(sources, items, path)
    return Drawn(name, figure.title, path.name, path.with_suffix(".csv").name, described(items), seen)


def items_of(sources: Sources, figure: PaperFigure) -> list[Item]:
    """The figure's recordings, suite by suite."""
    return [item for own in figure.recordings for item in sources.items(own.suite, own.variants, one=own.one)]


def file_name(name: str) -> str:
    """The stem of a figure's files."""
    return f"tagattention_{int(name):02d}" if name.isdigit() else name


def page(drawn: list[Drawn]) -> str:
    """A page in Markdown with every figure, its caption, what is seen and what the paper reports."""
    parts = [f"{CURVES}\n\n"]
    for one in drawn:
        figure = FIGURES[one.name]
        parts.append(f"## {one.title}\n\n")
        if one.picture is None:
            parts.append(f"{one.seen}\n\n")
            continue
        parts.append(f"![{one.title}]({one.picture})\n\n{figure.caption}\n\n")
        parts.append(
            f"{one.recordings}; [numbers]({one.numbers}).\n\n" if one.recordings else f"[Numbers]({one.numbers}).\n\n"
        )
        parts.append(f"- Here: {one.seen}\n- The paper: {figure.reported}\n\n")
    return "".join(parts).rstrip("\n") + "\n"
