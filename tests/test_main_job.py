"""The main job through its own command lines: train on stored recordings, resume, evaluate the run, refuse bad ones."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import equinox as eqx
import numpy as np
import pytest
import synthetic_clips as synthetic
from omegaconf import OmegaConf

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.run import EvaluateConfig, run_evaluation
from tagjax.recording import RecordingError, TagReads
from tagjax.recording.loading import VirtualTagSettings, with_virtual_tags
from tagjax.recording.reads import join_reads
from tagjax.recording.store import save_recording
from tagjax.tagattention.tracer_settings import make_tracer, tracer_clips
from tagjax.training import run as run_module
from tagjax.training.config import TrainConfig
from tagjax.training.evaluate import parameters
from tagjax.training.loop import TrainingResult
from tagjax.training.run import run_training
from tagjax.training.state import TrainState

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Two stored recordings of the synthetic scene."""
    folder = tmp_path_factory.mktemp("recordings")
    paths = []
    for seed in range(2):
        path = folder / f"scene{seed}.zarr"
        save_recording(synthetic.enlarged(synthetic.recording(26, seed=seed, name=f"scene{seed}"), 4), path)
        paths.append(str(path))
    return paths


def _values(recordings: list[str]) -> dict:
    return {
        # Softened, the paper's tracer has parameters to learn, too; with it the test takes half as long.
        "tracer": {"_target_": "tagjax.tagattention.literal.TagAttentionLiteral", "cell": 4, "softness": 0.3},
        "optimizer": {"_target_": "optax.adam", "learning_rate": 0.03},
        "baselines": {"paper": {"_target_": "tagjax.tagattention.literal.TagAttentionLiteral", "cell": 4}},
        "data": {
            "recordings": recordings[:1],
            "validation": recordings[1:],
            "clips": {"stride": 4, "length": 10},
        },
        "objective": {"span_frames": 5, "skip_frames": 3, "max_reads": 64, "num_channels": 4, "future_stride": 1},
        "loop": {"num_steps": 2, "batch_size": 1, "checkpoint_every": 1, "validate_every": 2, "progress": False},
        "logger": {"mode": "disabled"},
        "scores": {"num_pictures": 2, "from_s": 0.5},
    }


def test_train_then_evaluate_the_run(recordings: list[str], tmp_path: Path) -> None:
    values = _values(recordings)
    score = run_training(from_mapping(TrainConfig, values), tmp_path)
    assert 0.0 <= score <= 1.0
    summary = json.loads((tmp_path / "metrics.json").read_text())
    assert set(summary) == {"learned", "untrained", "paper"}
    assert summary["learned"]["all"]["iou"] == pytest.approx(score)
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [1, 2, 2]
    assert "validation/own_coherence" in rows[-1]
    assert (tmp_path / "report" / "frames.csv").is_file()
    changed = json.loads((tmp_path / "parameters.json").read_text())
    assert changed["learned"] != changed["untrained"]

    gone = {**values, "data": {**values["data"], "recordings": ["gone.zarr"]}, "weights": "gone.json"}
    again = run_evaluation(
        from_mapping(EvaluateConfig, {"run": str(tmp_path), "progress": False}), tmp_path / "again", run_values=gone
    )
    assert set(again) == {"learned", "paper"}
    assert again["learned"]["all"].keys() == summary["learned"]["all"].keys()
    for name, value in summary["learned"]["all"].items():
        if isinstance(value, int | float):
            assert again["learned"]["all"][name] == pytest.approx(value), name
        else:
            assert again["learned"]["all"][name] == value, name
    part = from_mapping(
        EvaluateConfig,
        {
            "run": str(tmp_path),
            "recordings": recordings[1:],
            "frames": [0, 9],
            "baselines": {},
            "clips": {"flow": "zero"},
            "scores": {"from_s": 0.0},
            "progress": False,
        },
    )
    held_out = run_evaluation(part, tmp_path / "part", run_values=values)
    assert set(held_out) == {"learned"}
    with (tmp_path / "part" / "frames.csv").open() as file:
        assert len(file.readlines()) == 1 + 2 * 9


def test_what_was_learned_is_kept_where_nothing_is_held_out(
    recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def moved(state: TrainState, *_: Any, **__: Any) -> TrainingResult[TrainState]:
        return TrainingResult(eqx.tree_at(lambda one: one.model, state, learned))

    values = _values(recordings)
    values["tracer"] = {"_target_": "tagjax.tagattention.TagAttention", "whole": None}
    values["data"]["validation"] = []
    learned = make_tracer({**values["tracer"], "dwell": {"memory_s": 3.0}})
    monkeypatch.setattr(run_module, "train", moved)
    assert math.isnan(run_training(from_mapping(TrainConfig, values), tmp_path))
    kept = make_tracer(values["tracer"], str(tmp_path / "weights.json"))
    assert parameters(kept) == pytest.approx(parameters(learned), rel=1e-6)
    assert set(json.loads((tmp_path / "parameters.json").read_text())) == {"learned", "untrained", "paper"}

    first = tmp_path / "weights.json"
    run_training(from_mapping(TrainConfig, {**values, "weights": str(first)}), tmp_path / "further")
    about, before = (json.loads(file.read_text())["about"] for file in (tmp_path / "further" / "weights.json", first))
    assert about["recipe"]["weights"] == str(first)
    assert about["began_with"] == before
    assert "began_with" not in before


def test_settings_stored_with_a_run_need_not_be_given_again() -> None:
    for more in ({"tracer": {"_target_": "tagjax.tagattention.TagAttention"}}, {"weights": "default"}):
        with pytest.raises(ConfigError, match="expected one of them, because a run has its own tracer"):
            from_mapping(EvaluateConfig, {"run": "runs/1", **more})
    with pytest.raises(ConfigError, match="found checkpoint=3 without run"):
        from_mapping(EvaluateConfig, {"checkpoint": 3})
    with pytest.raises(ConfigError, match="clips: unknown key 'strid'"):
        from_mapping(EvaluateConfig, {"clips": {"strid": 3}})


def test_processes_join_before_anything_asks_for_devices(
    recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Joined(Exception):  # noqa: N818
        pass

    def joins(settings: Any) -> Any:
        raise Joined

    def too_early(*_: Any) -> Any:
        raise AssertionError("built before the distributed runtime")

    monkeypatch.setattr(run_module, "distributed_runtime", joins)
    monkeypatch.setattr(run_module, "make_tracer", too_early)
    with pytest.raises(Joined):
        run_training(from_mapping(TrainConfig, _values(recordings)), tmp_path)


def test_smoothing_that_the_tracer_cannot_do_is_refused_before_the_work(recordings: list[str], tmp_path: Path) -> None:
    values = _values(recordings)
    values["scores"]["smooth"] = True
    with pytest.raises(ConfigError, match=r"scores\.smooth is true, which TagAttentionLiteral does not support"):
        run_training(from_mapping(TrainConfig, values), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.ci
def test_a_run_may_be_scored_smoothed(recordings: list[str], tmp_path: Path) -> None:
    values = _values(recordings)
    values["scores"]["smooth"] = True
    values["baselines"] = {"paper": values["tracer"]}
    values["tracer"] = {"_target_": "tagjax.tagattention.TagAttention", "whole": None}
    values["loop"]["num_steps"] = 1
    score = run_training(from_mapping(TrainConfig, values), tmp_path)
    summary = json.loads((tmp_path / "metrics.json").read_text())
    assert set(summary) == {"learned_smoothed", "untrained_smoothed", "paper"}
    assert summary["learned_smoothed"]["all"]["iou"] == pytest.approx(score)
    assert list((tmp_path / "report" / "overlays").glob("*/learned_smoothed/*.png"))


def test_the_same_recording_cannot_be_held_out(recordings: list[str], tmp_path: Path) -> None:
    values = _values(recordings)
    values["data"]["validation"] = values["data"]["recordings"]
    with pytest.raises(RecordingError, match=r"found in both data\.recordings and data\.validation"):
        run_training(from_mapping(TrainConfig, values), tmp_path)


def test_label_pictures_are_whole_and_of_the_frames_size(tmp_path: Path) -> None:
    recording = synthetic.recording(3)
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number:08d}.png"), recording.truth.labels[number])
    tracks = tmp_path / "tracks.csv"
    rows = [f"{frame + 1},1,0.0,0.0,2.0,2.0,1" for frame in range(3)]
    tracks.write_text("\n".join(["frame,person,x_m,y_m,z_m,range_m,visible", *rows]))
    settings = VirtualTagSettings(tracks=str(tracks), labels=str(tmp_path))
    labelled = with_virtual_tags(dataclasses.replace(recording, truth=None), settings)
    np.testing.assert_array_equal(labelled.truth.labels[:], recording.truth.labels[:])

    odd = dataclasses.replace(settings, reader={"foo": 1})
    with pytest.raises(ConfigError, match=r"virtual_tag\.reader: unknown key 'foo'; known keys are region, num_tags"):
        with_virtual_tags(dataclasses.replace(recording, truth=None), odd)

    second = tmp_path / "00000001.png"
    whole = second.read_bytes()
    second.write_bytes(whole[:-20])  # OpenCV reads this without a word
    with pytest.raises(RecordingError, match=r"00000001\.png: the image is truncated"):
        with_virtual_tags(recording, settings)
    cv2.imwrite(str(second), recording.truth.labels[1][:, :-1])
    with pytest.raises(RecordingError, match=r"00000001\.png: an image of \(24, 31\); expected \(24, 32\)"):
        with_virtual_tags(recording, settings)


@pytest.mark.ci
def test_command_lines(recordings: list[str], tmp_path: Path) -> None:
    run = tmp_path / "run"
    common = [sys.executable, "-m"]
    subprocess.run(
        [
            *common,
            "experiments.train",
            "debug=default",
            f"data.recordings=[{recordings[0]}]",
            f"data.validation=[{recordings[1]}]",
            "data.clips.stride=4",
            "tracer.segments.segmenter.num_segments=512",
            f"hydra.run.dir={run}",
        ],
        cwd=ROOT,
        check=True,
    )
    for name in ("config.yaml", "metrics.jsonl", "metrics.json", "checkpoints", "report"):
        assert (run / name).exists()
    done = subprocess.run(
        [
            *common,
            "experiments.evaluate",
            f"run={run}",
            f"recordings=[{recordings[1]}]",
            f"hydra.run.dir={tmp_path / 'evaluation'}",
        ],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    last = json.loads(done.stdout.strip().splitlines()[-1])
    assert last == json.loads((tmp_path / "evaluation" / "metrics.json").read_text())


def test_reads_of_unlike_conventions_are_not_joined() -> None:
    one = synthetic.recording(6).reads
    both = join_reads([one, one[:3]])
    assert both.num_reads == one.num_reads + 3
    assert (both.time_ns[1:] >= both.time_ns[:-1]).all()
    with pytest.raises(RecordingError, match="Convert them first"):
        join_reads([one, dataclasses.replace(TagReads.empty(), phase_sign=-1)])
    timed = dataclasses.replace(one, reader_time_ns=one.time_ns)
    assert join_reads([timed, one]).reader_time_ns is None  # unknown for half of the reads
    assert len(join_reads([timed, timed[:3]]).reader_time_ns) == one.num_reads + 3


@pytest.mark.parametrize("name", ["tagattention_literal", "tagattention_published"])
def test_configured_tracers_of_one_antenna_use_the_busiest(name: str) -> None:
    settings = OmegaConf.to_container(OmegaConf.load(ROOT / "conf" / "tracer" / f"{name}.yaml"))
    assert isinstance(settings, dict)
    assert tracer_clips(settings).antennas == "busiest"  # type: ignore[arg-type]
    assert tracer_clips({}).antennas == "all"
