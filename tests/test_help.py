"""`--help` of every command: each choice that it lists exists, and each key is there with its comment."""

from __future__ import annotations

import functools
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from composed import CONF
from hydra import compose, initialize_config_dir
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from omegaconf import OmegaConf

from experiments.help import command_help
from tagjax import cli

ROOT = Path(__file__).parents[1]
COMMANDS = sorted(path.stem for path in CONF.glob("*.yaml"))
OPTUNA = any("optuna" in plugin.__module__ for plugin in Plugins.instance().discover(Sweeper))  # of the sweep extra


@functools.cache
def _help(command: str, *overrides: str) -> str:
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3", job_name=command):
        config = compose(command, list(overrides), return_hydra_config=True)
        return command_help(CONF, _root_=config).replace("$$", "$")


def _keys(values: object, depth: int = 0) -> list[str]:
    if not isinstance(values, dict):
        return []
    return [line for key, value in values.items() for line in (f"{'  ' * depth}{key}:", *_keys(value, depth + 1))]


def test_every_command_is_a_console_command_of_the_wheel() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {f"tagjax-{name.replace('_', '-')}": f"tagjax.cli:{name}" for name in COMMANDS}
    assert all(callable(getattr(cli, name)) for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_purpose_groups_and_every_key(name: str) -> None:
    text = _help(name)
    assert text.startswith((importlib.import_module(f"experiments.{name}").__doc__ or "").strip()[:60])
    assert f"python -m experiments.{name}" in text
    keys = text[text.index("\nKeys (") :].splitlines()
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        values = OmegaConf.to_container(compose(name))
    for line in _keys(values):
        assert any(one == line or one.startswith(f"{line} ") for one in keys), line
    assert "job_logging" not in text
    for comment in re.findall(r"^\w+:.*\S  # (.+)$", (CONF / f"{name}.yaml").read_text().split("\nhydra:")[0], re.M):
        assert f"# {comment}" in text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_choice_that_is_listed_can_be_chosen(name: str) -> None:
    groups = re.findall(r"^  ([\w@./]+)=(\S+)  \((.+)\)$", _help(name), re.MULTILINE)
    assert {"paths", "hydra/launcher"} <= {group for group, _, _ in groups}
    for group, _, choices in groups:
        if group.startswith("hydra/") and name != COMMANDS[0]:
            continue  # Hydra's own groups are the same files for every command
        for choice in choices.split(", ")[-1:]:
            if not choice.startswith("optuna") or OPTUNA:
                with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
                    compose(name, [f"{group}={choice}"])


def test_comments_come_from_the_files_of_the_groups() -> None:
    text = _help("train", "experiment=contrast_only", "joint=pyramid")
    assert re.search(r"^  lock_s: 0\.33  # the time for which", text, re.MULTILINE)
    assert re.search(r"^  flow@joint\.flow=pyramid  \(flownet_c, .*, raft_small\)$", text, re.MULTILINE)
    assert re.search(r"^    min_motion: 0\.1  # a clip is drawn if", text, re.MULTILINE)
    assert "flow@joint.flow" not in _help("train")


def test_the_command_prints_it(tmp_path: Path) -> None:
    run = [sys.executable, "-m", "experiments.simulate", "--help", f"hydra.run.dir={tmp_path / 'run'}"]
    done = subprocess.run(run, capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.startswith("Simulate a suite")
    assert "recordings_dir: ${paths.recordings_dir}  # recordings go to" in done.stdout
    assert not (tmp_path / "run").exists()
