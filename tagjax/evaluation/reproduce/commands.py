"""Tables of what other commands measure: each command is run, and its result fills the cells.

A command's result is the JSON that it prints last. A cell is a text in which `{command/path:format}` stands for a value of it:
`{tagvision/calibration/one_place/transform_error_mm:.2f} mm`. The path leads through objects by name, and through lists by number, or by the
values that the wanted object has (`{compare/suite=multi_4,system=blobs/iou:.2f}`). An estimate is shown with its interval. The recipe names commands from a fixed list;
nothing else in it is executed.
"""

from __future__ import annotations

import dataclasses
import shlex
import string
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from ...core.progress import OnProgress, unobserved
from ...core.results import to_json_values
from ...core.settings import ConfigError, from_mapping
from .finished import store, stored
from .markdown import write_pages
from .recipe import Recipe, TableRecipe
from .table import begin, table_path, write_table

Name = Literal["tagvision", "tagview", "goller", "compare", "reads_ceiling", "error_budget", "evaluate_flow"]


@dataclasses.dataclass(frozen=True)
class Command:
    """A command of `experiments` with its arguments, and the suites that it needs but does not simulate itself."""

    command: Name
    overrides: tuple[str, ...] = ()
    suites: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        wrong = [one for one in self.overrides if one.startswith(("hydra", "+hydra", "-")) or "=" not in one]
        if wrong:
            raise ConfigError(f"overrides: found {', '.join(wrong)}; expected key=value, without settings of Hydra.")

    @property
    def line(self) -> str:
        """As it is typed."""
        return shlex.join(["python", "-m", f"experiments.{self.command}", *self.overrides])


RunCommand = Callable[[str, Command], Any]
"""Runs a command, of which the recipe's name comes first, and returns its result. Raises `ValueError` where it fails."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A row: texts by the name of the column."""

    label: str
    cells: Mapping[str, str]


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandRecipe(TableRecipe):
    """Everything that determines a table of commands' results, except for the files in `depends`."""

    commands: Mapping[str, Command]  # by the name that cells have for it
    columns: Mapping[str, str]  # headings
    rows: tuple[Row, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        for row in self.rows:
            where = f"row {row.label!r}"
            self._check(where, row.cells, self.columns)
            for text in row.cells.values():
                self._check(where, [path[0] for _, path, _ in _parts(text) if path], self.commands)

    def suites(self) -> list[str]:
        """Names of the suites that are simulated before the commands are run."""
        return list(dict.fromkeys(suite for one in self.commands.values() for suite in one.suites))


def recipe_from(settings: Mapping[str, Any]) -> Recipe | CommandRecipe:
    """The recipe with these settings, of commands where it names some. Raises `ConfigError` for settings that are wrong."""
    return from_mapping(CommandRecipe if "commands" in settings else Recipe, settings, where="table")


def make_command_table(
    recipe: CommandRecipe, root: Path, run: RunCommand, *, finished: Path, on_progress: OnProgress = unobserved
) -> dict[str, Any]:
    """Run the commands, write the table to docs/tables below `root` and into its pages, and return it.

    Results are stored in `finished`: after an interruption only commands without one are run. Raises `ValueError` where a
    command fails, and for a cell that names a value which the results do not have.
    """
    begun = begin(recipe, root)
    results = {}
    for number, (name, command) in enumerate(recipe.commands.items()):
        on_progress("command", number, len(recipe.commands), command.line)
        results[name] = _result(name, command, run, begun["depends"], finished)
    on_progress("command", len(recipe.commands), len(recipe.commands))
    columns = [
        {"name": name, "heading": heading, "measures": [], "interval": False}
        for name, heading in recipe.columns.items()
    ]
    rows = [{"label": row.label, "kind": "command", "cells": _cells(row, recipe, results)} for row in recipe.rows]
    lines = {name: command.line for name, command in recipe.commands.items()}
    table = {**begun, "columns": columns, "rows": rows, "recordings": {}, "commands": lines}
    write_table(table_path(root, recipe.name), table)
    write_pages(recipe, root)
    return table


def _result(name: str, command: Command, run: RunCommand, code: Mapping[str, str], finished: Path) -> Any:
    """The command's result, stored or measured."""
    follows_from = {"command": command.line, "code": dict(code)}
    result = stored(finished, follows_from, lambda kept: kept)
    if result is None:
        result = to_json_values(run(name, command))
        store(finished, follows_from, result)
    return result


def _cells(row: Row, recipe: CommandRecipe, results: Mapping[str, Any]) -> dict[str, Any]:
    cells: dict[str, Any] = dict.fromkeys(recipe.columns)
    for name, text in row.cells.items():
        try:
            cells[name] = {"kind": "text", "text": filled_in(text, results)}
        except ValueError as error:
            raise ValueError(f"row {row.label!r}, {name}: {error}") from error
    return cells


def filled_in(text: str, results: Mapping[str, Any]) -> str:
    """The text with values in place of `{command/path:format}`; a number between 0 and 1 as a percentage with `:.0%`."""
    filled = []
    for before, path, form in _parts(text):
        filled.append(before)
        if path:
            filled.append(_shown(_at(results, path), form, path))
    return "".join(filled)


def _shown(value: Any, form: str, path: Sequence[str]) -> str:
    """A value, or an estimate with its interval, in a format."""
    if isinstance(value, Mapping):
        interval = [_shown(value[name], form, path) for name in ("low", "high") if value[name] is not None]
        return _shown(value["value"], form, path) + (f" [{', '.join(interval)}]" if interval else "")
    try:
        shown = format(value, form)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{'/'.join(path)}: found {value!r}, which has no format {form!r}.") from error
    return f"{shown[:-1]} %" if form.endswith("%") else shown


def _parts(text: str) -> Iterator[tuple[str, list[str], str]]:
    """The text in parts: what stands before a value, the value's path, which is empty at the end, and its format."""
    try:
        for before, field, form, _ in string.Formatter().parse(text):
            yield before, [] if field is None else field.split("/"), form or ""
    except ValueError as error:
        raise ConfigError(f"{text!r}: {error}; expected values in braces, as in {{tagvision/paper:.2f}}.") from error


def _at(results: Any, path: Sequence[str]) -> Any:
    """The value, or the estimate, to which the path leads."""
    found = results
    for number, step in enumerate(path):
        try:
            found = _below(found, step)
        except (KeyError, IndexError, ValueError, TypeError) as error:
            raise ValueError(
                f"{'/'.join(path)}: found no {step} in {'/'.join(path[:number]) or 'the results'}; expected {_choice(found)}."
            ) from error
    if isinstance(found, list) or (isinstance(found, Mapping) and not {"value", "low", "high"} <= found.keys()):
        raise ValueError(f"{'/'.join(path)}: found several values; expected the path of one.")
    return found


def _choice(found: Any) -> str:
    """What can be named in it."""
    if isinstance(found, Mapping):
        return f"one of: {', '.join(map(str, found))[:300]}"
    return (
        f"one of {len(found)}, by number or values"
        if isinstance(found, list)
        else f"no further step, for it is {found!r}"
    )


def _below(found: Any, step: str) -> Any:
    if isinstance(found, Mapping):
        return found[step]
    if not isinstance(found, list):
        raise TypeError(step)
    if "=" not in step:
        return found[int(step)]
    wanted = dict(part.split("=", 1) for part in step.split(","))
    (only,) = (one for one in found if all(str(one[name]) == value for name, value in wanted.items()))
    return only
