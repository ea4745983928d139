"""Every command line of README, CONTRIBUTING and docs/ composes: no key, group or choice in them is misspelt or gone."""

from __future__ import annotations

import dataclasses
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Glob, Override
from omegaconf import OmegaConf

from tagjax.baselines.goller.experiment import GollerExperiment
from tagjax.baselines.tagview.experiment import TagviewExperiment
from tagjax.core.settings import from_mapping
from tagjax.evaluation.flow import FlowEvaluationSettings
from tagjax.evaluation.run import EvaluateConfig
from tagjax.recording.capture.settings import RecordConfig
from tagjax.sim.suites import SimulateConfig
from tagjax.training.config import TrainConfig
from tagjax.training.flow_config import TrainFlowConfig

ROOT = Path(__file__).parents[1]
SCHEMAS: dict[str, type] = {
    "evaluate": EvaluateConfig,
    "evaluate_flow": FlowEvaluationSettings,
    "goller": GollerExperiment,
    "record": RecordConfig,
    "simulate": SimulateConfig,
    "tagview": TagviewExperiment,
    "train": TrainConfig,
    "train_flow": TrainFlowConfig,
}
_COMMAND = re.compile(r"python -m experiments\.(\w+)([^`\n]*)")


def commands_in(text: str) -> list[tuple[str, tuple[str, ...]]]:
    """(experiment, arguments) of every command line, without comments and up to the first shell operator."""
    joined = re.sub(r"\\\n\s*", " ", text)
    found = []
    for name, rest in _COMMAND.findall(joined):
        filled = re.sub(r"<[^>]*>", "given", rest)
        words = shlex.split(filled, comments=True)
        end = next((i for i, word in enumerate(words) if word in ("&", "&&", "|", ">", "2>&1", ";")), len(words))
        found.append((name, tuple(words[:end])))
    return found


def _documented() -> list[Any]:
    files = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
    every = {command: path.name for path in files for command in commands_in(path.read_text())}
    return [pytest.param(*command, id=f"{path}:{' '.join(command[1])[:60]}") for command, path in every.items()]


def _one_of(override: Override) -> str:
    """The override with the first value of its sweep; unchanged if it is no sweep."""
    value = override.value()
    if isinstance(value, Glob):
        options = sorted(path.stem for path in (ROOT / "conf" / override.key_or_group).glob("*.yaml"))
        return f"{override.key_or_group}={options[0]}"
    if isinstance(value, ChoiceSweep):
        return f"{override.get_key_element()}={next(iter(override.sweep_string_iterator()))}"
    return str(override.input_line)


@pytest.mark.ci
@pytest.mark.parametrize(("name", "words"), _documented())
def test_a_documented_command_composes(name: str, words: tuple[str, ...]) -> None:
    assert (ROOT / "experiments" / f"{name}.py").is_file()
    plain = [word for word in words if not word.startswith("-")]
    if "hparams_search=optuna" in plain:  # its defaults name the sweeper's own
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="needs the sweep extra")
    parsed = OverridesParser.create().parse_overrides(plain)
    own = [one for one in parsed if not one.key_or_group.startswith("hydra")]  # launchers need their plugins
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        values = OmegaConf.to_container(compose(name, [_one_of(one) for one in own]), resolve=True)
    assert isinstance(values, dict)
    if name in SCHEMAS:  # other keys are read by the command itself
        known = {field.name for field in dataclasses.fields(SCHEMAS[name])}
        from_mapping(SCHEMAS[name], {str(key): value for key, value in values.items() if key in known})


def test_commands_are_found_with_their_arguments_and_without_comments() -> None:
    text = "x `python -m experiments.train seed=1` and\n```\npython -m experiments.evaluate run=<a run> \\\n  'a=[b]'  # why\n"
    assert commands_in(text) == [("train", ("seed=1",)), ("evaluate", ("run=given", "a=[b]"))]


def test_there_are_commands_of_most_experiments() -> None:
    named = {param.values[0] for param in _documented()}
    assert named >= set(SCHEMAS) | {
        "compare",
        "error_budget",
        "reads_ceiling",
        "tracks",
        "benchmark",
        "import_recording",
        "sweep_paper",
        "tagvision",
    }
