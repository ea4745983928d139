"""`--help` of every command: what can be chosen can be chosen, and what explains a key is there."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from omegaconf import OmegaConf

from experiments.help import answer_help, help_text

CONF = Path(__file__).parents[1] / "conf"
COMMANDS = sorted(path.stem for path in CONF.glob("*.yaml"))
OPTUNA = any("optuna" in plugin.__module__ for plugin in Plugins.instance().discover(Sweeper))  # of the sweep extra


@pytest.mark.parametrize("name", COMMANDS)
def test_help_tells_purpose_groups_and_commented_keys(name: str) -> None:
    about = importlib.import_module(f"experiments.{name}").__doc__
    text = help_text(about or "", name)
    assert f"python -m experiments.{name}" in text
    keys = [key for key in OmegaConf.load(CONF / f"{name}.yaml") if key not in ("defaults", "hydra")]
    for key in keys:
        assert re.search(rf"^{key}:", text, re.MULTILINE), key
    assert "output_dir" not in text
    assert "defaults:" not in text
    for comment in re.findall(r"\S  (# .+)$", (CONF / f"{name}.yaml").read_text().split("\nhydra:")[0], re.MULTILINE):
        assert comment in text
    for group, _, choices in re.findall(r"^  ([\w@./]+)=(\S+)  \((.*)\)$", text, re.MULTILINE):
        for choice in choices.split(", ")[-1:]:
            if choice == "optuna" and not OPTUNA:
                continue
            with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
                compose(name, [f"{group}={choice}"])


def test_help_ends_the_command_only_when_asked(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.setattr(sys, "argv", ["train", "seed=1"])
    answer_help("About.", "train")
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(sys, "argv", ["train", "--help"])
    with pytest.raises(SystemExit) as ended:
        answer_help("About.", "train")
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("About.\n")
