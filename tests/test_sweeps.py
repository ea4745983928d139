"""Sweeps: every launcher and sweeper by its documented command, a killed sweep, grids, and what wandb is given."""

from __future__ import annotations

import csv
import dataclasses
import importlib.util
import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic_clips as synthetic
import yaml

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.sweep import (
    Line,
    SweepConfig,
    learned_ways,
    point_name,
    read_lines,
    run_sweep,
    table,
    write_sweep,
)
from tagjax.report.study import Trial, importance_bars, parallel_coordinates
from tagjax.tagattention import TagAttention
from tagjax.tagattention.tracer_settings import make_tracer, with_values
from tagjax.training.logging import Logger, LoggerSettings

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    return synthetic.stored(tmp_path_factory.mktemp("recordings"), 16)


def _environment() -> dict[str, str]:
    return {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "PYTHONPATH": str(ROOT),  # workers of the launchers start elsewhere
    }


def _run(command: list[str]) -> str:
    done = subprocess.run(command, cwd=ROOT, env=_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-3000:]
    return done.stdout


def _evaluate(recordings: list[str], sweep: Path, *more: str) -> list[str]:
    return [
        *(sys.executable, "-m", "experiments.evaluate", "-m", "tracer=tagattention_literal", "progress=false"),
        *(f"recordings=[{recordings[0]}]", "clips.stride=4", "frames=[0,8]", "tracer.cell=4", "scores.num_pictures=1"),
        *("tracer.v0_m_s=0.01,0.1", f"hydra.sweep.dir={sweep}", *more),
    ]


def _needs(module: str, extra: str):
    try:
        found = importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # no plugin at all
        found = False
    return pytest.mark.skipif(not found, reason=f"needs the {extra} extra: pip install -e '.[{extra}]'")


LAUNCHERS = [
    pytest.param([], id="basic"),
    pytest.param(
        ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
        marks=_needs("hydra_plugins.hydra_joblib_launcher", "sweep"),
        id="joblib",
    ),
    pytest.param(
        ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=10"],
        marks=_needs("hydra_plugins.hydra_submitit_launcher", "sweep"),
        id="submitit",
    ),
    pytest.param(
        ["hydra/launcher=ray", "+hydra.launcher.ray.init.num_cpus=2"],
        marks=_needs("hydra_plugins.hydra_ray_launcher", "sweep-ray"),
        id="ray",
    ),
]


@pytest.mark.ci
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_every_launcher_runs_a_sweep(recordings: list[str], tmp_path: Path, launcher: list[str]) -> None:
    _run(_evaluate(recordings, tmp_path, *launcher))
    for job, v0_m_s in enumerate((0.01, 0.1)):
        assert "iou" in json.loads((tmp_path / str(job) / "metrics.json").read_text())["untrained"]["all"]
        assert f"v0_m_s: {v0_m_s}" in (tmp_path / str(job) / "config.yaml").read_text()


def _states(storage: Path) -> list[tuple[int, str]]:
    if not storage.exists():
        return []
    try:
        with sqlite3.connect(f"file:{storage}?mode=ro", uri=True) as base:
            return base.execute("select number, state from trials order by number").fetchall()
    except sqlite3.Error:
        return []  # not yet made


@pytest.mark.ci
@_needs("hydra_plugins.hydra_optuna_sweeper", "sweep")
def test_a_killed_optuna_sweep_goes_on(recordings: list[str], tmp_path: Path) -> None:
    storage = tmp_path / "optuna.db"
    command = [
        *(sys.executable, "-m", "experiments.train", "-m", "experiment=clips", "hparams_search=optuna_clips"),
        "logger=disabled",
        *(f"data.recordings=[{recordings[0]}]", f"data.validation=[{recordings[1]}]", "tracer=tagattention_literal"),
        *("data.clips.stride=4", "data.clips.length=8", "tracer.cell=4", "tracer.softness=1.0", "~baselines"),
        *("loop.num_steps=1", "loop.checkpoint_every=1", "loop.validate_every=1", "loop.progress=false"),
        *("objective.span_frames=4", "objective.skip_frames=3", "objective.max_reads=64", "objective.num_channels=4"),
        *("scores.num_pictures=1", "scores.from_s=0.3", f"hydra.sweep.dir={tmp_path / 'sweep'}/${{now:%f}}"),
        *(f"hydra.sweeper.storage=sqlite:///{storage}", "num_trials=4"),
    ]
    with subprocess.Popen(command, cwd=ROOT, env=_environment(), stdout=subprocess.DEVNULL) as process:
        # Killed within the third trial.
        while [state for _, state in _states(storage)] != ["COMPLETE", "COMPLETE", "RUNNING"]:
            assert process.poll() is None, "the sweep ended before it could be killed"
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait()
    with sqlite3.connect(storage) as base:
        kept = base.execute("select trial_id, value from trial_values order by trial_id").fetchall()
    assert len(kept) == 2
    _run(command)
    assert [state for _, state in _states(storage)] == ["COMPLETE", "COMPLETE", "RUNNING", "COMPLETE", "COMPLETE"]
    with sqlite3.connect(storage) as base:
        values = base.execute("select trial_id, value from trial_values order by trial_id").fetchall()
    assert values[:2] == kept
    _run(command)  # nothing is left to do
    assert len(_states(storage)) == 5
    tables = list(tmp_path.rglob("trials.md"))
    assert len(tables) == 2  # of the launches that came to their end, each with all trials that finished
    for one in tables:
        assert len(one.read_text().splitlines()) == 2 + 4
        assert (one.parent / "parallel.png").is_file()


@pytest.mark.filterwarnings("ignore")  # Optuna's and SQLAlchemy's own
@pytest.mark.ci
@_needs("hydra_plugins.hydra_optuna_sweeper", "sweep")
def test_finished_trials_count_and_running_ones_do_not(tmp_path: Path) -> None:
    import optuna  # pyright: ignore[reportMissingImports]  # of the sweep extra

    from experiments.hparams_search import trials_left

    storage, folder = f"sqlite:///{tmp_path / 'new' / 'optuna.db'}", tmp_path / "sweep"
    assert trials_left(3, storage, "one", str(folder)) == 3
    study = optuna.create_study(study_name="one", storage=storage)
    study.tell(study.ask(), 0.5)
    study.tell(study.ask(), state=optuna.trial.TrialState.FAIL)
    study.ask()  # killed
    assert trials_left(3, storage, "one", str(folder)) == 2
    assert trials_left(3, storage, "other", str(folder)) == 3
    assert not folder.exists()
    assert trials_left(1, storage, "one", str(folder)) == 0
    assert folder.is_dir()


@pytest.mark.filterwarnings("ignore")  # Optuna's and SQLAlchemy's own
@pytest.mark.ci
@_needs("hydra_plugins.hydra_optuna_sweeper", "sweep")
def test_a_search_is_reported_by_what_it_finished(tmp_path: Path) -> None:
    import optuna  # pyright: ignore[reportMissingImports]  # of the sweep extra

    from tagjax.evaluation.study import write_study

    storage = f"sqlite:///{tmp_path / 'optuna.db'}"
    study = optuna.create_study(study_name="one", storage=storage, direction="minimize")
    assert not write_study(storage, "one", tmp_path / "none")
    assert not (tmp_path / "none").exists()

    def score(trial: Any) -> float:
        if trial.number == 3:
            raise optuna.TrialPruned
        rate, flow = trial.suggest_loguniform("rate", 1e-4, 1.0), trial.suggest_categorical("flow", ["dis", "zero"])
        return np.log10(rate) ** 2 + (0.01 if flow == "zero" else 0.0)

    study.optimize(score, n_trials=16)
    assert write_study(storage, "one", tmp_path)
    with (tmp_path / "trials.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 15
    assert [float(row["score"]) for row in rows] == sorted(float(row["score"]) for row in rows)
    assert rows[0]["trial"] == str(study.best_trial.number)
    assert float(rows[0]["rate"]) == pytest.approx(study.best_params["rate"])
    table = (tmp_path / "trials.md").read_text().splitlines()
    assert table[0] == "| trial | score | flow | rate |"
    assert len(table) == 2 + 10
    for name in ("parallel.png", "importance.png"):
        assert cv2.imread(str(tmp_path / name)).std() > 5


def test_trials_are_drawn_as_lines_across_their_parameters(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    some = [{"rate": 10 ** rng.uniform(-4, 0), "flow": word} for word in ("dis", "zero", "dis")]
    trials = [Trial(number, 0.1 * number, one) for number, one in enumerate([*some, {"rate": 0.1}])]
    parallel_coordinates(tmp_path / "all.png", trials, ["flow", "rate"], {"rate"})
    parallel_coordinates(tmp_path / "one.png", trials[:1], ["flow", "rate"], set())
    importance_bars(tmp_path / "importance.png", {"rate": 0.7, "flow": 0.3})
    for name in ("all.png", "one.png", "importance.png"):
        assert cv2.imread(str(tmp_path / name)).std() > 5


OBJECTIVE = """
import os
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig

from experiments.command import CONF
from experiments.hparams_search import sweep_score
from experiments import train  # registers the resolver of the search


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
def main(config):
    folder = Path(HydraConfig.get().runtime.output_dir)
    value = folder / "value"  # a run that is gone on with keeps its own
    if not value.exists():
        value.write_text(str(config.optimizer.learning_rate))
    ended = os.environ.get("ENDED")
    if ended == "stopped":  # as a run does after it has written a checkpoint
        raise KeyboardInterrupt
    return sweep_score(float("nan") if ended else float(value.read_text()))


main()
"""


def _sweep_objective(folder: Path, *more: str, ended: str = "") -> subprocess.CompletedProcess[str]:
    script = folder / "objective.py"
    script.write_text(OBJECTIVE)
    command = [sys.executable, str(script), "-m", f"hydra.sweep.dir={folder / 'sweep'}", *more]
    environment = {**_environment(), "ENDED": ended}
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "launcher",
    [[], LAUNCHERS[1].values[0]],
    ids=["basic", "joblib"],
)
@pytest.mark.ci
@_needs("hydra_plugins.hydra_optuna_sweeper", "sweep")
def test_a_search_s_trials_have_folders_of_their_own_and_may_fail(tmp_path: Path, launcher: list[str]) -> None:
    storage = tmp_path / "optuna.db"
    search = ["hparams_search=optuna", f"hydra.sweeper.storage=sqlite:///{storage}", *launcher]
    assert _sweep_objective(tmp_path, *search, "num_trials=1").returncode == 0
    failed = _sweep_objective(tmp_path, *search, "num_trials=2", ended="nan")
    assert failed.returncode == 0, failed.stderr[-2000:]
    assert _sweep_objective(tmp_path, *search, "num_trials=3").returncode == 0
    assert [state for _, state in _states(storage)] == ["COMPLETE", "FAIL", "COMPLETE", "COMPLETE"]
    with sqlite3.connect(storage) as base:
        values = dict(base.execute("select trial_id, value from trial_values"))
        query = "select trial_id, param_value from trial_params where param_name = 'optimizer.learning_rate'"
        asked = dict(base.execute(query))
    assert len(values) == 3
    assert values == {number: asked[number] for number in values}
    folders = [path for path in (tmp_path / "sweep").iterdir() if path.is_dir()]
    assert sorted(path.name.rpartition("_")[2] for path in folders) == ["0", "0", "0", "1"]
    assert len({path.name.rpartition("_")[0] for path in folders}) == 3  # one time for each launch


def test_a_stopped_run_ends_its_sweep(tmp_path: Path) -> None:
    stopped = _sweep_objective(tmp_path, "seed=0,1", ended="stopped")
    assert "KeyboardInterrupt" in stopped.stderr
    assert stopped.returncode not in (0, 1)
    assert (tmp_path / "sweep" / "0").is_dir()
    assert not (tmp_path / "sweep" / "1").exists()


@pytest.mark.ci
@_needs("hydra_plugins.hydra_optuna_sweeper", "sweep")
def test_a_search_without_held_out_recordings_is_refused(tmp_path: Path) -> None:
    storage = f"hydra.sweeper.storage=sqlite:///{tmp_path / 'optuna.db'}"
    refused = _sweep_objective(tmp_path, "hparams_search=optuna", storage, "data.recordings=[a.zarr]")
    assert refused.returncode == 1
    assert refused.stderr.rstrip().endswith("Give validation recordings: data.validation=[...].")
    assert not (tmp_path / "sweep").exists()


SUITE = {
    "name": "tiny",
    "about": "for a test",
    "paper": "none",
    "story": "handheld",
    "seed": 1,
    "duration_s": 3.0,
    "settings": {"stationary_s": 0.4},
    "counts": {"train": 0, "validation": 0, "test": 1},
    "variants": [{"name": "slow", "settings": {"speed_m_s": 0.5}}, {"name": "fast", "settings": {"speed_m_s": 2.5}}],
}
LEARNABLE = yaml.safe_load((Path(__file__).parents[1] / "conf/tracer/tagattention.yaml").read_text())
PAPER = {"_target_": "tagjax.tagattention.literal.TagAttentionLiteral", "cell": 4, "v0_m_s": 0.1, "alpha_m2": 5e-4}


def _config(folder: Path, **settings) -> SweepConfig:
    return SweepConfig(
        **{
            "suites": {"tiny": SUITE},
            "tracer": PAPER,
            "grid": {"v0_m_s": (0.01, 0.5)},
            "recordings_dir": str(folder),
            **settings,
        }
    )


@pytest.mark.ci
def test_a_grid_is_swept_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config(tmp_path / "recordings", smoke=True)
    lines = run_sweep(config, tmp_path / "sweep")
    assert [line.condition for line in lines] == ["tiny slow"] * 2 + ["tiny fast"] * 2
    assert [line.point["v0_m_s"] for line in lines] == [0.01, 0.5] * 2
    kept = (tmp_path / "sweep" / "lines.jsonl").read_text().splitlines()
    assert len(kept) == 4
    # Killed within the last line: that one is computed again, the others are not.
    (tmp_path / "sweep" / "lines.jsonl").write_text("\n".join(kept[:3]) + "\n" + kept[3][:20])
    found: list[str] = []
    from tagjax.evaluation import sweep

    asked: list[str] = []
    evaluate = sweep.evaluate_recording
    monkeypatch.setattr(sweep, "evaluate_recording", lambda *a, **k: asked.append("") or evaluate(*a, **k))
    again = run_sweep(
        config, tmp_path / "sweep", on_progress=lambda stage, done, total, now="": found.append(f"{done}/{total} {now}")
    )
    assert again == lines
    assert len(asked) == 1
    assert [one.split()[0] for one in found] == ["2/4", "3/4", "4/4"]
    for name in ("table.md", "table.csv", "sweep.png"):
        assert (tmp_path / "sweep" / name).stat().st_size > 50


def _line(point: dict, condition: str, iou: float, num_frames: int, curve: tuple = (0.0, 1.0)) -> Line:
    numbers = {"iou": iou, "num_frames": num_frames, "locked": 1.0}
    return Line(point_name(point) + condition + str(iou), condition, "one", point, numbers, curve)


def test_a_table_weighs_frames_within_and_conditions_alike(tmp_path: Path) -> None:
    low, high = {"v0_m_s": 0.01}, {"v0_m_s": 0.5}
    lines = [
        *(_line(low, "slow", 0.2, 10), _line(low, "slow", 0.8, 30), _line(low, "fast", 0.15, 100)),
        *(_line(high, "slow", 0.5, 40), _line(high, "fast", 0.9, 1)),
    ]
    rows = table(lines)
    assert [row["v0_m_s"] for row in rows] == [0.5, 0.01]
    assert rows[1]["slow: IoU"] == pytest.approx(0.65)
    assert rows[1]["IoU"] == pytest.approx(0.4)
    write_sweep(tmp_path, _config(tmp_path), lines)
    with (tmp_path / "table.csv").open() as file:
        assert [float(row["IoU"]) for row in csv.DictReader(file)] == pytest.approx([0.7, 0.4])
    assert cv2.imread(str(tmp_path / "sweep.png")).std() > 5
    many = {"v0_m_s": tuple(np.linspace(0, 1, 8).tolist())}
    write_sweep(tmp_path, _config(tmp_path, grid=many), [_line({"v0_m_s": v}, "a", v, 5) for v in many["v0_m_s"]])
    assert cv2.imread(str(tmp_path / "sweep.png")).std() > 5


def test_whole_numbers_and_words_of_a_grid_stay_what_they_are(tmp_path: Path) -> None:
    values = {"suites": {"tiny": SUITE}, "recordings_dir": str(tmp_path)}
    tracer = {
        "_target_": "tagjax.tagattention.TagAttention",
        "segments": {"segmenter": {"num_segments": 512, "reach": 2.0}},
        "reader": {"modulo_pi": True},
        "detection": {"threshold": 0.5},
    }
    grid = {
        "segments.segmenter.num_segments": [256, 512],
        "segments.segmenter.reach": [1.5, 2.0],
        "detection.threshold": [0.4],
        "reader.modulo_pi": [False],
    }
    config = from_mapping(SweepConfig, {**values, "tracer": tracer, "grid": grid})
    first = config.points()[0]
    assert [type(value) for value in first.values()] == [int, float, float, bool]
    assert point_name(first) == (
        "segments.segmenter.num_segments=256, segments.segmenter.reach=1.5, detection.threshold=0.4, reader.modulo_pi=False"
    )
    for point in config.points():
        made = make_tracer(with_values(config.tracer, point))
        assert isinstance(made, TagAttention)
        assert made.segments.segmenter.num_segments == point["segments.segmenter.num_segments"]
    assert tracer["segments"]["segmenter"]["num_segments"] == 512
    lines = [_line(point, "slow", 0.1 * number, 10) for number, point in enumerate(config.points())]
    write_sweep(tmp_path, config, lines)
    assert "| 512 | 1.5 | 0.4 | False | 0.200 |" in (tmp_path / "table.md").read_text()
    words = {"cell": (2, 3, 4, 5), "refine": (True, False)}
    config = _config(tmp_path, tracer={**PAPER, "refine": True}, grid=words)
    write_sweep(tmp_path, config, [_line(point, "slow", 0.1, 10) for point in config.points()])
    assert cv2.imread(str(tmp_path / "sweep.png")).std() > 5
    with pytest.raises(ConfigError, match="cell is 0; expected an integer"):
        run_sweep(_config(tmp_path, grid={"cell": (0,)}), tmp_path / "refused")  # before anything is simulated


def test_one_parameter_at_a_time_is_swept_around_the_tracers_own_values(tmp_path: Path) -> None:
    grid = {"v0_m_s": (0.01, 0.1, 0.5), "alpha_m2": (1e-4, 1e-3)}
    config = _config(tmp_path, grid=grid, one_at_a_time=True)
    own = {"v0_m_s": 0.1, "alpha_m2": 5e-4}
    others = [{**own, "v0_m_s": 0.01}, {**own, "v0_m_s": 0.5}, {**own, "alpha_m2": 1e-4}, {**own, "alpha_m2": 1e-3}]
    assert config.points() == [own, *others]

    def lines(*iou: float) -> list[Line]:
        return [
            dataclasses.replace(_line(point, "a", one + 0.01 * number, 10), recording=str(number))
            for point, one in zip(config.points(), iou, strict=True)
            for number in range(5)
        ]

    found = lines(0.4, 0.2, 0.5, 0.3, 0.4)
    first_of_best = found[10]
    found[10] = dataclasses.replace(first_of_best, numbers={**first_of_best.numbers, "iou": 0.4})
    rows = table(found)
    assert [row["v0_m_s"] for row in rows] == [0.5, 0.1, 0.1, 0.1, 0.01]
    best, own_values, last = rows[0]["against_best"], rows[1]["against_best"], rows[-1]["against_best"]
    assert (best.value, best.low, best.high) == (0.0, 0.0, 0.0)
    assert own_values.value == pytest.approx(np.mean([0.0, -0.1, -0.1, -0.1, -0.1]))
    assert own_values.low == pytest.approx(-0.1)
    assert -0.31 < last.low <= last.value <= last.high < 0

    run = tmp_path / "run"
    run.mkdir()
    learned = {"untrained": {**own, "beta": 0.8}, "learned": {**own, "v0_m_s": 0.3, "beta": 0.8}}
    (run / "parameters.json").write_text(json.dumps(learned))
    config = dataclasses.replace(config, runs=(str(run),))
    assert learned_ways(config) == {"v0_m_s": [(0.1, 0.3)], "alpha_m2": [(5e-4, 5e-4)]}
    write_sweep(tmp_path, config, found)
    assert "| 0.5 | 0.0005 | 0.5" in (tmp_path / "table.md").read_text()
    assert cv2.imread(str(tmp_path / "sweep.png")).std() > 5
    with pytest.raises(ConfigError, match=r"runs: found no .*none.parameters\.json; expected finished run folders"):
        run_sweep(dataclasses.replace(config, runs=(str(tmp_path / "none"),)), tmp_path / "refused")
    with pytest.raises(ConfigError, match="set one_at_a_time=true, or runs="):
        dataclasses.replace(config, one_at_a_time=False)
    (run / "parameters.json").write_text(json.dumps({"untrained": {"v0_m_s": 0.1}, "learned": {"v0_m_s": 0.1}}))
    with pytest.raises(ConfigError, match="has no parameter alpha_m2; expected runs with the same tracer"):
        learned_ways(config)


def test_lines_cut_short_are_taken_away(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    assert read_lines(path) == []
    whole = '{"key": "a", "condition": "c", "recording": "r", "point": {}, "numbers": {}, "iou": [0.5, null]}\n'
    path.write_text(whole + whole[:30])
    (line,) = read_lines(path)
    assert line.iou == (0.5, None)
    assert path.read_text() == whole


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"suites": {}}, "suites is empty"),
        ({"grid": {}}, "grid is empty"),
        ({"grid": {"v0_m_s": ()}}, "grid is empty"),
        ({"grid": {"gamma": (1.0,)}}, "found gamma; expected parameters of the tracer, some of alpha_m2, cell, v0_m_s"),
        (
            {"grid": {"dwell.memory": (1.0,)}, "tracer": LEARNABLE},
            r"found dwell\.memory; expected parameters of the tracer, some of .*dwell\.memory_s, .* \(conf/tracer has all\)",
        ),
        ({"splits": ("exam",)}, "splits: found exam; expected some of train"),
    ],
)
def test_sweeps_of_nothing_are_refused(tmp_path: Path, settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        _config(tmp_path, **settings)


def test_wandb_offline_holds_curves_and_overlays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WANDB_MODE", raising=False)
    report = tmp_path / "report"
    for path in (report / "curves" / "a.png", report / "overlays" / "scene" / "learned" / "frame000003.png"):
        path.parent.mkdir(parents=True)
        cv2.imwrite(str(path), np.full((8, 8, 3), 90, np.uint8))
    logger = Logger(tmp_path, LoggerSettings(mode="offline"), config={"seed": 0})
    logger.write(1, {"loss": 0.5})
    logger.report(report, {"iou": 0.25, "cle_px": None}, tracer="learned")
    logger.close()
    (run,) = (tmp_path / "wandb").glob("offline-run-*")
    media = {path.parent.relative_to(run).as_posix() for path in run.rglob("*.png")}
    assert media == {"files/media/images/report", "files/media/images/report/overlays"}
    words, stored, waited = (b"loss", b"report/overlays/scene", b"report/curves", b"iou"), b"", 0
    while not all(word in stored for word in words) and waited < 200:  # a process of its own writes it
        time.sleep(0.1)
        stored, waited = next(iter(run.glob("*.wandb"))).read_bytes(), waited + 1
    assert [word for word in words if word not in stored] == []
    assert json.loads((tmp_path / "metrics.jsonl").read_text()) == {"step": 1, "loss": 0.5}


def _wandb_that(monkeypatch: pytest.MonkeyPatch, init: Callable[..., Any]) -> None:
    import wandb

    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setattr(wandb, "init", init)


class _Broken:
    """A wandb run whose server has gone."""

    def __init__(self, **asked: Any):
        self.asked = asked
        self.summary: dict[str, float] = {}

    def log(self, *given: Any, **named: Any) -> None:
        raise RuntimeError("the service has gone\nat length")

    def finish(self) -> None:
        raise BrokenPipeError("no service")


def test_wandb_out_of_reach_or_lost_ends_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from wandb.errors import CommError

    def init(**asked: Any) -> _Broken:
        if asked["mode"] == "online":
            raise CommError("Run initialization has timed out after 90.0 sec.")
        return _Broken(**asked)

    _wandb_that(monkeypatch, init)
    with pytest.warns(UserWarning, match=r"cannot be reached: CommError: Run init.* 90\.0 sec\. Logging offline"):
        logger = Logger(tmp_path, LoggerSettings(mode="online"))
    with pytest.warns(
        UserWarning, match=r"could not log a step's numbers: RuntimeError: the service has gone\. The run"
    ):
        logger.write(1, {"loss": 0.5})
    picture = tmp_path / "report" / "curves" / "a.png"
    picture.parent.mkdir(parents=True)
    cv2.imwrite(str(picture), np.full((8, 8, 3), 90, np.uint8))
    with pytest.warns(UserWarning, match="could not log the report"):
        logger.report(tmp_path / "report", {"iou": 0.25}, tracer="learned")
    with pytest.warns(UserWarning, match="could not log the end of the run: BrokenPipeError: no service"):
        logger.close()
    assert json.loads((tmp_path / "metrics.jsonl").read_text()) == {"step": 1, "loss": 0.5}

    def never(**asked: Any) -> None:
        raise PermissionError("read-only")

    _wandb_that(monkeypatch, never)
    with pytest.warns(UserWarning, match=r"cannot start: PermissionError: read-only\. Only metrics\.jsonl"):
        Logger(tmp_path, LoggerSettings(mode="offline")).write(2, {"loss": 0.25})


def test_a_resumed_run_stays_one_wandb_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []
    _wandb_that(monkeypatch, lambda **given: asked.append(given))
    for mode, resume_step in (("online", 0), ("online", 4), ("offline", 8), ("online", 0)):
        Logger(tmp_path, LoggerSettings(mode=mode), resume_step=resume_step)
    ids = [one["id"] for one in asked]
    assert ids[0] == ids[1] == ids[2] != ids[3]  # the last begins anew
    assert [one["resume"] for one in asked] == ["allow", "allow", None, "allow"]


def test_an_unreachable_wandb_server_gives_an_offline_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import wandb

    monkeypatch.delenv("WANDB_MODE", raising=False)
    wandb.teardown()  # what it knows of the environment is from an earlier run
    for name, value in (("API_KEY", "0" * 40), ("BASE_URL", "http://127.0.0.1:9"), ("INIT_TIMEOUT", "2")):
        monkeypatch.setenv(f"WANDB_{name}", value)
    with pytest.warns(UserWarning, match="Weights & Biases cannot be reached: .* Logging offline") as found:
        logger = Logger(tmp_path, LoggerSettings(mode="online"))
    assert len([one for one in found if "Weights & Biases" in str(one.message)]) == 1
    logger.write(1, {"loss": 0.5})
    logger.close()
    wandb.teardown()
    named = (tmp_path / "wandb_id").read_text().strip()
    assert [path.name.rpartition("-")[2] for path in (tmp_path / "wandb").glob("offline-run-*")] == [named]
