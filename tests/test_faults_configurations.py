"""A run folder from elsewhere: its config.yaml calls nothing, reads no environment, and is refused in one line."""

import time
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from omegaconf import OmegaConf

from experiments.run_folder import read_configuration
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.run import EvaluateConfig, run_evaluation
from tagjax.training.optimizers import OPTIMIZERS, build_optimizer
from tests.composed import settings

TRACER = {"_target_": "tagjax.tagattention.TagAttention"}
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
        "tracer": {**TRACER, "dwell": {"_target_": "tagjax.core.files.write_atomic", "path": "{marker}", "content": ""}}
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


def _schedule(name, **arguments):
    return {"_target_": f"optax.{name}", **arguments}


NO_OPTIMIZERS = {
    "text": {"learning_rate": "x"},
    "list": {"learning_rate": [1, 2]},
    "mapping": {"learning_rate": {"a": 1}},
    "null": {"learning_rate": None},
    "infinite": {"learning_rate": float("inf")},
    "infinite in float32": {"learning_rate": 1e300},
    "huge integer": {"learning_rate": 10**400},
    "infinite step": {"learning_rate": 3e38, "b1": 0.9, "b2": 0.999, "eps": -0.5},
    "nan": {"learning_rate": 0.1, "b1": float("nan")},
    "eps as text": {"learning_rate": 0.1, "eps": "1e-8"},
    "text in a schedule": {
        "learning_rate": _schedule("linear_schedule", init_value="q", end_value=0, transition_steps=1)
    },
    "nan in a schedule": {"learning_rate": _schedule("constant_schedule", value=float("nan"))},
    "null in a schedule": {"learning_rate": _schedule("cosine_decay_schedule", init_value=0.1, decay_steps=None)},
    "no steps": {"learning_rate": _schedule("cosine_decay_schedule", init_value=0.1, decay_steps=0)},
    "a boundary that is no step": {
        "learning_rate": _schedule("piecewise_constant_schedule", init_value=0.1, boundaries_and_scales={"a": 1})
    },
    "a negative boundary": {
        "learning_rate": _schedule("piecewise_constant_schedule", init_value=0.1, boundaries_and_scales={-1: 1})
    },
    "a scale as text": {
        "learning_rate": _schedule("piecewise_constant_schedule", init_value=0.1, boundaries_and_scales={"3": "x"})
    },
    "boundaries as a number": {
        "learning_rate": _schedule("piecewise_constant_schedule", init_value=0.1, boundaries_and_scales=5)
    },
}


@pytest.mark.parametrize("kind", NO_OPTIMIZERS)
def test_numbers_of_an_optimiser_that_it_cannot_use_are_refused_in_one_line(kind):
    with pytest.raises(ConfigError, match=r"^optimizer") as refusal:
        build_optimizer({"_target_": "optax.adam", **NO_OPTIMIZERS[kind]})
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 500


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_every_optimiser_is_built_and_does_a_step(name):
    optimizer = build_optimizer({"_target_": name, "learning_rate": 0.1})
    one = jnp.ones((), jnp.float32)
    with jax.numpy_dtype_promotion("standard"):
        _, state = optimizer.update(one, optimizer.init(one), one)
        step, _ = optimizer.update(one, state, one)  # Rprop's first step is 0: it compares two gradients
    assert step != 0


def test_boundaries_of_a_schedule_may_be_texts():
    arguments = {"init_value": 0.5, "boundaries_and_scales": {"1": 0.5, 2: 0.1}}
    optimizer = build_optimizer(
        {"_target_": "optax.sgd", "learning_rate": _schedule("piecewise_constant_schedule", **arguments)}
    )
    one, steps = jnp.ones((), jnp.float32), []
    state = optimizer.init(one)
    with jax.numpy_dtype_promotion("standard"):
        for _ in range(4):
            step, state = optimizer.update(one, state, one)
            steps.append(float(step))
    assert steps == pytest.approx([-0.5, -0.25, -0.025, -0.025])
