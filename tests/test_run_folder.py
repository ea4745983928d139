"""A run resumes with the configuration that it was started with, or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from experiments.run_folder import keep_configuration

VALUES = {"seed": 0, "tracer": {"cell": 6}, "loop": {"num_steps": 4}, "optimizer": {"decay_steps": 4}, "resume": True}


def _started(folder: Path) -> Path:
    keep_configuration(folder, VALUES)
    (folder / "checkpoints" / "4").mkdir(parents=True)
    return folder


def test_the_length_may_change_and_the_file_holds_it(tmp_path: Path) -> None:
    longer = {**VALUES, "loop": {"num_steps": 9}, "optimizer": {"decay_steps": 9}}
    keep_configuration(_started(tmp_path), longer)
    assert OmegaConf.load(tmp_path / "config.yaml") == longer
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["config.yaml"]


def test_another_configuration_is_refused_by_name_and_changes_nothing(tmp_path: Path) -> None:
    for other, message in (
        ({**VALUES, "seed": 3}, "seed was 0 and is now 3"),
        ({**VALUES, "tracer": {"cell": 8}}, "tracer.cell was 6 and is now 8"),
        ({**VALUES, "joint": {"weight": 1.0}}, "joint was None and is now"),
    ):
        with pytest.raises(ValueError, match=f"with another configuration: {message}"):
            keep_configuration(_started(tmp_path) if not list(tmp_path.iterdir()) else tmp_path, other)
        assert OmegaConf.load(tmp_path / "config.yaml") == VALUES


def test_the_optimiser_changes_only_with_retune(tmp_path: Path) -> None:
    started = {
        **VALUES,
        "optimizer": {"_target_": "optax.adam", "learning_rate": 0.01},
        "clip_norm": 1,
        "joint": {"clip_norm": 1.0},
    }
    slower = {**started, "optimizer": {"_target_": "optax.adam", "learning_rate": 0.001}, "clip_norm": 0.1}
    folder = _started(tmp_path)
    OmegaConf.save(OmegaConf.create(started), folder / "config.yaml")
    with pytest.raises(ValueError, match=r"clip_norm was 1 and is now 0\.1.*retune=true allows"):
        keep_configuration(folder, slower)
    # Another kind of optimiser, or a schedule for a number, would have another state than the checkpoints hold.
    schedule = {"_target_": "optax.adam", "learning_rate": {"_target_": "optax.cosine_decay_schedule"}}
    for kind, message in (
        ({"_target_": "optax.sgd", "learning_rate": 0.01}, r"optax\.adam"),
        (schedule, r"learning_rate was 0\.01"),
    ):
        with pytest.raises(ValueError, match=message):
            keep_configuration(folder, {**slower, "retune": True, "optimizer": kind})
    assert OmegaConf.load(tmp_path / "config.yaml") == started
    slower["joint"] = {"clip_norm": 0.5}
    with pytest.raises(ValueError, match="seed was 0 and is now 3"):
        keep_configuration(folder, {**slower, "retune": True, "seed": 3})
    keep_configuration(folder, {**slower, "retune": True})
    assert OmegaConf.load(tmp_path / "config.yaml") == {**slower, "retune": True}


def test_a_run_that_may_not_resume_keeps_its_file(tmp_path: Path) -> None:
    keep_configuration(_started(tmp_path), {**VALUES, "resume": False, "seed": 5})
    assert OmegaConf.load(tmp_path / "config.yaml") == VALUES


def test_a_folder_without_a_checkpoint_gets_a_new_run(tmp_path: Path) -> None:
    keep_configuration(tmp_path, VALUES)
    keep_configuration(tmp_path, {**VALUES, "seed": 5})
    assert OmegaConf.load(tmp_path / "config.yaml").seed == 5
