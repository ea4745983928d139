"""What is wrong with a table: stale since which change, or not what its pages show."""

from __future__ import annotations

from pathlib import Path

from .markdown import differing
from .provenance import changes, dependencies
from .recipe import Recipe
from .table import command, read_table, table_path

_SHOWN = 5
"""So many changed files are named; of more, only the number is given."""


def stale(recipe: Recipe, root: Path) -> list[str]:
    """Why a table is to be made again: it was never made, or which files changed since. Empty for one that is up to date."""
    table = read_table(table_path(root, recipe.name))
    if table is None:
        return ["not made yet"]
    return changes(table["depends"], dependencies(root, recipe.depends))


def status(recipe: Recipe, root: Path) -> list[str]:
    """What is wrong with a table and what to do, a line each; empty where nothing is."""
    found = []
    if reasons := stale(recipe, root):
        more = f" and {len(reasons) - _SHOWN} more" if len(reasons) > _SHOWN else ""
        found.append(f"{recipe.name} is stale: {', '.join(reasons[:_SHOWN])}{more}. Run `{command(recipe.name)}`.")
    found += [
        f"{recipe.name}: {path.relative_to(root)} does not show the table of its JSON. "
        f"Run `{command(recipe.name)} render=true`."
        for path in differing(recipe, root)
    ]
    return found
