"""Make a table of results from its recipe: measure it, write it as JSON and into its pages.

python -m experiments.reproduce table=suites               # interrupted, it resumes when it is started again
python -m experiments.reproduce table=forerunners          # runs the commands that measure its cells
python -m experiments.reproduce table=suites confirm=1     # up to date again after a change that alters no score
python -m experiments.reproduce table=suites render=true   # the Markdown again, from the JSON
python -m experiments.reproduce check=true                 # which tables are stale, and why
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra import compose
from omegaconf import OmegaConf

from .command import CONF, plain_values, resumable_command
from .suites import suites_named

ROOT = CONF.parent


def recipe_settings() -> list[Any]:
    """The settings of every recipe in conf/table."""
    return [OmegaConf.to_container(OmegaConf.load(path)) for path in sorted((CONF / "table").glob("*.yaml"))]


def tracer_settings(name: str) -> dict[str, Any]:
    """The settings of a tracer, or of `blobs`, by name. Raises `ValueError` for any other name."""
    if name not in (known := [*sorted(path.stem for path in (CONF / "tracer").glob("*.yaml")), "blobs"]):
        raise ValueError(f"tracer: found {name}; expected one of {', '.join(known)}.")
    group = "system" if name == "blobs" else "tracer"
    return plain_values(compose(f"{group}/{name}")[group])


def run_command(command: Any, recordings: Path, folder: Path) -> Any:
    """The result of a command of `experiments`, which it prints last. Raises `ValueError` where the command fails."""
    line = [sys.executable, "-m", f"experiments.{command.command}", *command.overrides]
    settings = ["progress=false", f"paths.recordings_dir={recordings.absolute()}", f"hydra.run.dir={folder}"]
    done = subprocess.run([*line, *settings], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr or done.stdout).strip().splitlines()[-1:]
        raise ValueError(f"{command.line}: exit status {done.returncode}. {' '.join(last)}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def _commands_table(recipe: Any, values: Mapping[str, Any], folder: Path, report: Any) -> dict[str, Any]:
    """Make a table of what other commands measure. Recordings of its suites that are missing are simulated first."""
    from tagjax.core.settings import ConfigError, from_mapping
    from tagjax.evaluation.reproduce.commands import make_command_table
    from tagjax.sim.suites import Suite, make_suite

    if values["confirm"] is not None:
        raise ConfigError(f"confirm is {values['confirm']}; expected null: {recipe.name} has no scores by recording.")
    recordings = Path(values["recordings_dir"])
    for name, settings in suites_named(recipe.suites()).items():
        suite = from_mapping(Suite, settings, where=f"suite {name}")
        make_suite(suite, recordings, workers=values["workers"], on_progress=report)

    def run(name: str, command: Any) -> Any:
        return run_command(command, recordings, folder / name)

    return make_command_table(recipe, ROOT, run, finished=Path(values["finished_dir"]), on_progress=report)


@resumable_command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.evaluation.reproduce.commands import CommandRecipe, recipe_from
    from tagjax.evaluation.reproduce.markdown import rendered, write_pages
    from tagjax.evaluation.reproduce.status import status

    if not (ROOT / "docs").is_dir():
        raise ValueError(f"found no folder docs in {ROOT}; expected a clone of the repository, with its pages.")
    chosen, console = values.get("table"), Console(soft_wrap=True, highlight=False, markup=False)
    recipes = [recipe_from(one) for one in ([chosen] if chosen else recipe_settings())]
    if values["check"]:
        found = [line for recipe in recipes for line in status(recipe, ROOT)]
        console.print(*found or ["Every table is up to date."], sep="\n")
        raise SystemExit(1 if found else 0)
    if values["render"]:
        written = [f"written: {path}" for recipe in recipes for path in write_pages(recipe, ROOT)]
        console.print(*written or ["Every page shows its tables."], sep="\n")
        return
    if not chosen:
        raise ValueError(f"found no table; expected table=<name>, one of {', '.join(one.name for one in recipes)}.")
    from tagjax.evaluation.reproduce.make import make_table  # needs the sim extra

    recipe = recipes[0]
    with progress_lines(shown=values["progress"], console=console) as report:
        if isinstance(recipe, CommandRecipe):
            table = _commands_table(recipe, values, folder, report)
        else:
            table = make_table(
                recipe,
                ROOT,
                suites=suites_named(recipe.suites()),
                tracers={name: tracer_settings(name) for name in recipe.tracers()},
                recordings=Path(values["recordings_dir"]),
                finished=Path(values["finished_dir"]),
                workers=values["workers"],
                confirm=values["confirm"],
                on_progress=report,
            )
    console.print(rendered(table))


if __name__ == "__main__":
    main()
