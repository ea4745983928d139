"""A run folder from elsewhere: its config.yaml calls nothing, reads no environment, and is refused in one line."""

import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from experiments.run_folder import read_configuration
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.run import EvaluateConfig, run_evaluation
from tests.composed import settings

TRACER = {"_target_": "tagjax.tagattention.TagAttention", "cell": 4}
ADAM = {"_target_": "optax.adam", "learning_rate": 0.01}

CALLS = {
    "another module": {"tracer": {"_target_": "os.system", "command": "touch {marker}"}},
    "a function of tagjax that runs a command": {
        "tracer": {"_target_": "tagjax.evaluation.timing.in_own_process", "command": ["touch", "{marker}"]}
    },
    "a function that writes": {
        "tracer": {"_target_": "tagjax.core.files.write_atomic", "path": "{marker}", "content": ""}
    },
    "a module's import": {"tracer": {"_target_": "tagjax.core.files.os.mkdir", "path": "{marker}"}},
    "in the optimiser": {
        "optimizer": {"_target_": "tagjax.core.files.write_atomic", "path": "{marker}", "content": ""}
    },
    "in a schedule": {
        "optimizer": {
            **ADAM,
            "learning_rate": {"_target_": "tagjax.core.files.write_atomic", "path": "{marker}", "content": ""},
        }
    },
    "nested in the tracer": {
        "tracer": {**TRACER, "cell": {"_target_": "tagjax.core.files.write_atomic", "path": "{marker}", "content": ""}}
    },
    "in a baseline": {
        "baselines": {"x": {"_target_": "tagjax.core.files.write_atomic", "path": "{marker}", "content": ""}}
    },
}


def _filled(value, marker):
    if isinstance(value, dict):
        return {key: _filled(one, marker) for key, one in value.items()}
    if isinstance(value, list):
        return [_filled(one, marker) for one in value]
    return value.replace("{marker}", marker) if isinstance(value, str) else value


@pytest.mark.parametrize("call", CALLS)
def test_a_run_folder_calls_nothing_but_the_classes_of_each_place(call, tmp_path):
    marker = tmp_path / "written"
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    values = _filled({"tracer": TRACER, "optimizer": ADAM, **CALLS[call]}, str(marker))
    OmegaConf.save(OmegaConf.create(values), run / "config.yaml")
    config = from_mapping(EvaluateConfig, {"run": str(run), "recordings": ["nowhere.zarr"]})
    with pytest.raises(ValueError, match=r"run|_target_|heckpoint") as refusal:
        run_evaluation(config, tmp_path / "out", run_values=read_configuration(run / "config.yaml"))
    assert not marker.exists()
    if call != "in a baseline":  # there the missing checkpoint is found first
        assert isinstance(refusal.value, ConfigError)
        assert "_target_" in str(refusal.value)


TEXTS = {
    "the environment": "a: ${oc.env:HOME}",
    "another key": "a: 1\nb: ${a}",
    "in a list": "a: [1, '${oc.env:HOME}']",
    "in a key": "${oc.env:HOME}: 1",
    "an alias": "a: &x [1]\nb: *x",
    "aliases of aliases": "a: &a [x,x]\nb: &b [*a,*a]\nc: [*b,*b]",
    "a Python object": "a: !!python/object/apply:os.system ['true']",
    "deep nesting": "a: " + "[" * 20000 + "]" * 20000,
    "no mapping": "- 1\n- 2",
    "numbers as keys": "1: 2",
    "nothing": "",
    "no YAML": "a: [1, 2",
    "binary": "\x00\x01",
    "many bytes": "a: " + "x" * 64_000,
    "60,000 open brackets": "a: " + "[" * 60_000,
    "60,000 open braces": "a: " + "{" * 60_000,
    "a list in a list 30,000 times": "- " * 30_000,
    "40 levels": "a: " + "[" * 40 + "]" * 40,
    "a tag of a date": "a: !!timestamp 2001-01-01",
    "a tag of bytes": "a: !!binary aGk=",
    "a tag of a set": "a: !!set {x, y}",
    "a tag of a text": "a: !!str 1",
    "a tag that nobody knows": "a: !x 1",
    "a tag without a name": "a: ! 1",
    "a tag of pairs": "a: !!omap [x: 1]",
    "an integer without digits": "a: 0b_",
    "a date that is none": "a: 2001-99-99",
    "an integer of 5000 digits": "a: " + "1" * 5000,
    "a merge of a number": "a: {<<: 1}",
    "a list as a key": "a: {[1]: 2}",
}


@pytest.mark.parametrize("kind", TEXTS)
def test_a_configuration_that_no_command_wrote_is_refused_in_one_line(kind, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(TEXTS[kind])
    start = time.perf_counter()
    with pytest.raises(ValueError, match=r"expected the config\.yaml of a run folder") as refusal:
        read_configuration(path)
    assert time.perf_counter() - start < 2
    message = str(refusal.value)
    assert "\n" not in message
    assert len(message) < 1000
    assert str(Path.home()) not in message.replace(str(path), "")


def test_a_configuration_that_a_command_wrote_is_read_as_it_was(tmp_path):
    from experiments.command import write_config
    from tests.composed import composed

    values = composed("train")
    values = {key: value for key, value in values.items() if key not in ("paths", "num_trials", "hydra")}
    write_config(values, tmp_path)
    assert read_configuration(tmp_path / "config.yaml") == values
    assert settings is not None


def test_a_missing_configuration(tmp_path):
    with pytest.raises(ValueError, match="No such file"):
        read_configuration(tmp_path / "config.yaml")
