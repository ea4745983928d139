"""The state of a table: stale because of which changes, or different from the text of its pages."""

from __future__ import annotations

from pathlib import Path

from .markdown import differing
from .provenance import changes, dependencies
from .recipe import TableRecipe
from .table import command, read_table, table_path

_MAX_LISTED = 5
"""Up to this many changed files are listed; of the others only the number is given."""


def stale(recipe: TableRecipe, root: Path) -> list[str]:
    """Why a table must be made again: it was never made, or which files changed. Empty for a table that is up to date."""
    table = read_table(table_path(root, recipe.name))
    if table is None:
        return ["not made yet"]
    return changes(table["depends"], dependencies(root, recipe.depends))


def status(recipe: TableRecipe, root: Path) -> list[str]:
    """Problems of a table and what to do, one line each; empty where there is none."""
    problems = []
    if reasons := stale(recipe, root):
        more = f" and {len(reasons) - _MAX_LISTED} more" if len(reasons) > _MAX_LISTED else ""
        problems.append(
            f"{recipe.name} is stale: {', '.join(reasons[:_MAX_LISTED])}{more}. Run `{command(recipe.name)}`."
        )
    problems += [
        f"{recipe.name}: {path.relative_to(root)} does not show the table of its JSON. "
        f"Run `{command(recipe.name)} render=true`."
        for path in differing(recipe, root)
    ]
    return problems
