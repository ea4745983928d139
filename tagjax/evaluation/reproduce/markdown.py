"""A table as Markdown between the markers of its pages. The text is a function of the table's JSON alone."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...core.files import write_atomic
from .recipe import COUNTS, TableRecipe
from .table import command, read_table, table_path


def rendered(table: Mapping[str, Any]) -> str:
    """The table, and below it its command, revision, date and machine, what it runs, and the sources of values recorded by hand."""
    columns = table["columns"]
    lines = ["| | " + " | ".join(column["heading"] for column in columns) + " |", "|" + "---|" * (len(columns) + 1)]
    for row in table["rows"]:
        mark = " \\*" if row["kind"] == "recorded" else ""
        cells = [_cell(row["cells"][column["name"]], column) for column in columns]
        lines.append("| " + " | ".join([_escaped(row["label"]) + mark, *cells]) + " |")
    notes = [_made_by(table)]
    if any(column["interval"] for column in columns):
        interval = table["interval"]
        notes.append(
            f"Square brackets: {interval['level']:.0%} interval by recording ({interval['num_resamples']:,} bootstrap resamples)."
        )
    if commands := table.get("commands"):
        notes.append(f"It runs {', '.join(f'`{line}`' for line in commands.values())}.")
    notes += _recorded_notes(table)
    return "\n".join(lines) + "\n\n" + " ".join(notes)


def not_made(name: str) -> str:
    """The text between the markers of a table that has not been made."""
    return f"*This table has not been made yet: `{command(name)}`.*"


def replaced(text: str, name: str, body: str) -> str:
    """The text of a page with `body` between a table's markers. Raises `ValueError` where they are missing or repeated."""
    head, _, tail = _parts(text, name)
    return f"{head}\n{body}\n{tail}"


def pages(recipe: TableRecipe, root: Path) -> dict[Path, tuple[str, str]]:
    """The present text of each page of a table, and the text according to its JSON. Raises `ValueError` for missing markers."""
    table = read_table(table_path(root, recipe.name))
    body = not_made(recipe.name) if table is None else rendered(table)
    texts = {}
    for name in recipe.pages:
        path = root / name
        try:
            before = path.read_text(encoding="utf-8")
            texts[path] = before, replaced(before, recipe.name, body)
        except (OSError, ValueError) as error:
            raise ValueError(f"{path}: {error}") from error
    return texts


def differing(recipe: TableRecipe, root: Path) -> list[Path]:
    """The pages whose table is not that of the JSON."""
    return [path for path, (before, after) in pages(recipe, root).items() if before != after]


def write_pages(recipe: TableRecipe, root: Path) -> list[Path]:
    """Write the table of the JSON into its pages; returns the pages that changed."""
    changed = []
    for path, (before, after) in pages(recipe, root).items():
        if before != after:
            write_atomic(path, after)
            changed.append(path)
    return changed


def _parts(text: str, name: str) -> tuple[str, str, str]:
    begin, end = f"<!-- table: {name} -->", "<!-- /table -->"
    if text.count(begin) != 1:
        raise ValueError(f"found the marker {begin} {text.count(begin)} times; expected it once, on a line of its own.")
    head, _, rest = text.partition(begin)
    body, found, tail = rest.partition(end)
    if not found or "<!-- table: " in body:
        raise ValueError(f"found no {end} after {begin}; put it below the table, on a line of its own.")
    return head + begin, body, end + tail


def _cell(cell: Mapping[str, Any] | None, column: Mapping[str, Any]) -> str:
    if cell is None:
        return ""
    if cell["kind"] == "text":
        return _escaped(cell["text"])
    if cell["kind"] == "recorded":
        return _escaped(cell["text"] if cell["paper"] is None else f"{cell['text']} ({cell['paper']})")
    parts = []
    for number, measure in enumerate(column["measures"]):
        if measure in COUNTS:
            parts.append(f"{cell[measure]:,}")
            continue
        value = cell["values"][measure]
        text = _number(measure, value["value"], value)
        if number == 0 and column["interval"] and value["low"] is not None:
            text += f" [{_plain_number(measure, value['low'])}, {_plain_number(measure, value['high'])}]"
        parts.append(text)
    return " / ".join(parts)


def _number(measure: str, value: float | None, whole: Mapping[str, Any]) -> str:
    if value is None:
        return "-"
    if measure == "locked":
        return f"{whole['total']:.0f} of {whole['count']}"
    return _plain_number(measure, value) + (" px" if measure == "cle_px" else "")


def _plain_number(measure: str, value: float) -> str:
    if measure == "cle_px":
        return f"{value:.1f}" if value < 9.95 else f"{value:.0f}"
    if measure == "p_fa":  # small: hundredths would hide it
        return f"{100 * value:.1f} %"
    return f"{value:.2f}"


def _made_by(table: Mapping[str, Any]) -> str:
    revision, machine = table["revision"], table["machine"]
    commit = "unknown" if revision["commit"] is None else f"`{revision['commit'][:10]}`"
    changed = " with uncommitted changes" if revision["dirty"] else ""
    on = f"{machine['cores']} cores ({machine['processor']}), jax {machine['jax']}"
    made = f"Made by `{table['command']}`, revision {commit}{changed}, {table['date_utc'][:10]}, on {on}."
    traced = Counter(one.get("revision") for scores in table["recordings"].values() for one in scores)
    if older := sorted((found, num) for found, num in traced.items() if found not in (None, revision["commit"])):
        num, whole = sum(num for _, num in older), sum(traced.values())
        commits = ", ".join(f"`{found[:10]}`" for found, _ in older)
        if num == whole:
            made += f" Its recordings were traced at {commits}."
        else:
            made += (
                f" {num} of its {whole} recordings were traced at {commits}; of each row another scores the same now."
            )
    return made


def _recorded_notes(table: Mapping[str, Any]) -> list[str]:
    """One sentence with the revisions and dates of rows recorded by hand."""
    sources = dict.fromkeys(
        f"revision `{cell['revision'][:10]}`, {cell['date']}"
        for row in table["rows"]
        for cell in row["cells"].values()
        if cell is not None and cell["kind"] == "recorded" and cell["paper"] is None
    )
    if not sources:
        return []
    where = f"conf/table/{table['name']}.yaml"
    return [f"\\* Recorded by hand, not made by this command: {'; '.join(sources)}; the commands are in `{where}`."]


def _escaped(text: str) -> str:
    """A cell's text with escaped bars, which would start another cell."""
    return re.sub(r"(?<!\\)\|", r"\\|", text)
