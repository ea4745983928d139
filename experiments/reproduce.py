"""Make a table of results from its recipe: measure it, write it as JSON and into the pages that show it.

python -m experiments.reproduce table=handheld
python -m experiments.reproduce table=handheld render=true   # the Markdown again, from the JSON
python -m experiments.reproduce check=true                   # which tables are stale, and why

Interrupted, it goes on when it is started again.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
from hydra import compose
from hydra.errors import MissingConfigException
from omegaconf import DictConfig, OmegaConf

from .compare import suites_named
from .errors import in_a_line
from .help import answer_help
from .progress import counting_bar
from .train import CONFIGS, resolved

ROOT = Path(CONFIGS).parent


def every_recipe() -> list[Any]:
    """The settings of every recipe in `conf/table`."""
    return [OmegaConf.to_container(OmegaConf.load(path)) for path in sorted((Path(CONFIGS) / "table").glob("*.yaml"))]


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="reproduce")
def main(config: DictConfig) -> None:
    from rich.console import Console

    from tagjax.core.settings import from_mapping
    from tagjax.evaluation.reproduce.markdown import rendered, write_pages
    from tagjax.evaluation.reproduce.recipe import Recipe
    from tagjax.evaluation.reproduce.status import status

    values, console = resolved(config), Console(soft_wrap=True, highlight=False, markup=False)
    named = values.get("table")
    with in_a_line("reproduce", MissingConfigException):
        recipes = [from_mapping(Recipe, one, where="table") for one in ([named] if named else every_recipe())]
        if values["check"]:
            found = [line for recipe in recipes for line in status(recipe, ROOT)]
            console.print(*found or ["Every table is up to date."], sep="\n")
            raise SystemExit(1 if found else 0)
        if values["render"]:
            written = [f"written: {path}" for recipe in recipes for path in write_pages(recipe, ROOT)]
            console.print(*written or ["Every page shows its tables."], sep="\n")
            return
        if not named:
            raise ValueError(f"found no table; expected table=<name>, one of {', '.join(one.name for one in recipes)}.")

        from tagjax.evaluation.reproduce.make import make_table

        recipe = recipes[0]
        with counting_bar(console, shown=values["progress"]) as bar:
            task = bar.add_task(recipe.name, total=None)
            table = make_table(
                recipe,
                ROOT,
                suites=suites_named(recipe.suites()),
                tracers={name: resolved(compose(f"tracer/{name}").tracer) for name in recipe.tracers()},
                recordings=Path(values["out"]),
                finished=Path(values["finished"]),
                workers=values["workers"],
                on_progress=lambda what, done, total: bar.update(task, description=what, completed=done, total=total),
            )
    console.print(rendered(table))


if __name__ == "__main__":
    answer_help(__doc__, "reproduce")
    main()
