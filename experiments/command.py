"""The common part of every command: Hydra's configuration is converted to validated settings; errors end it in one line."""

from __future__ import annotations

import contextlib
import functools
import json
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from tagjax.core.folder_lock import locked_folder

from .errors import ending_in_one_line, errors_in_one_line
from .help import command_help
from .resumption import resumable

CONF = Path(__file__).resolve().parents[1] / "conf"
"""The folder of the configuration: beside `experiments` in a clone, and beside it in the installed package."""

T = TypeVar("T")

OmegaConf.register_new_resolver("command_help", functools.partial(command_help, CONF), replace=True)


def command(function: Callable[[dict[str, Any], Path], Any], *, resumes: bool = False) -> Callable[[], None]:
    """The entry point of a module `experiments/<name>.py`, configured by Hydra from conf/<name>.yaml.

    `function` receives the configuration as plain values and the run folder, whose lock it holds. A number that it returns
    is a sweep's objective. A command that can run in several processes (`distributed`) has them share the folder, so it takes
    the lock itself in the process that writes. If it `resumes` when it is started again in its folder, Ctrl-C and SIGTERM
    print the command for that.
    """
    name = Path(function.__code__.co_filename).stem

    @functools.wraps(function)
    def run(config: DictConfig) -> Any:
        with resumable(name) if resumes else contextlib.nullcontext(), errors_in_one_line(name):
            values, folder = plain_values(config), Path(HydraConfig.get().runtime.output_dir)
            with contextlib.nullcontext() if "distributed" in values else locked_folder(folder):
                return function(values, folder)

    configured = hydra.main(version_base="1.3", config_path=str(CONF), config_name=name)(run)

    @functools.wraps(function)
    def main() -> None:
        with ending_in_one_line(name):
            configured()

    return main


resumable_command = functools.partial(command, resumes=True)
"""`command`, for one that resumes when it is started again in its run folder."""


def plain_values(config: DictConfig) -> dict[str, Any]:
    """The resolved configuration as plain values, because the library depends neither on Hydra nor on OmegaConf.

    `paths` and `num_trials`, which are only referred to by other keys, are left out.
    """
    values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items() if key not in ("paths", "num_trials")}


def checked(schema: type[T], values: Mapping[str, Any], folder: Path) -> T:
    """The settings, validated; the values are then written to the run folder's config.yaml."""
    from tagjax.core.settings import from_mapping

    settings = from_mapping(schema, values)
    write_config(values, folder)
    return settings


def write_config(values: Mapping[str, Any], folder: Path) -> None:
    """Write config.yaml and run.json (command, versions, machine) into the run folder. Each appears whole or not at all."""
    from tagjax.core.files import atomic_path
    from tagjax.core.run_record import write_run_record

    with atomic_path(folder / "config.yaml") as partial:
        OmegaConf.save(OmegaConf.create(dict(values)), partial)
    if HydraConfig.initialized():
        job = HydraConfig.get()
        write_run_record(folder, shlex.join(["python", "-m", f"experiments.{job.job.name}", *job.overrides.task]))


def print_result(result: Any) -> None:
    """Print a result as JSON, the last line of a command's output."""
    from tagjax.core.results import to_json_values

    print(json.dumps(to_json_values(result), allow_nan=False))
