"""The tracer on segments in training: what is learned, its gradients, its weights files, and a whole run."""

from __future__ import annotations

import dataclasses
import json
import operator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from jax.extend.core import jaxprs_in_params
from test_joint import _in_double
from test_segment_tracer import clip_of, scene

from tagjax.core.constrained import static_settings
from tagjax.core.settings import from_mapping
from tagjax.evaluation.run import EvaluateConfig, run_evaluation
from tagjax.recording import Recording
from tagjax.recording.store import save_recording
from tagjax.tagattention.learned import load_parameters, save_parameters
from tagjax.tagattention.segments import (
    CarryingBody,
    Detection,
    RigidMotion,
    Segmenter,
    SegmentTracker,
    TagAttention,
    connection,
)
from tagjax.tagattention.tracer_settings import learned_tracer, make_tracer
from tagjax.tracing.tracer import trace
from tagjax.training.config import TrainConfig
from tagjax.training.objective import TERM_NAMES, ObjectiveSettings, objective_inputs
from tagjax.training.run import run_training
from tagjax.training.step import _clip_gradient, clip_gradient, clip_loss

CONF = yaml.safe_load((Path(__file__).parents[1] / "conf/tracer/tagattention.yaml").read_text())
KEY = jax.random.PRNGKey(0)
OBJECTIVE = ObjectiveSettings(
    memory=1.0, span_frames=6, skip_frames=6, max_reads=128, num_channels=4, future_stride=1, calibration=0.0
)
LEARNED = {
    "reader": {
        "slope_per_dbm",
        "intercept",
        "floor_rad",
        "spread_rad",
        "still_spread_rad",
        "moving_m_s",
        "drift_m",
        "outlier",
    },
    "travel": {"reach_m", "noise_m", "noise_fraction", "travel_per_m", "heal_s"},
    "dwell": {"memory_s"},
    "competition": {"together"},
    "whole": {"travel_m_s", "share"},
    "body.rigid": {"noise_m", "noise_fraction", "travel_per_m", "other_fraction", "most", "least", "shrink_m2"},
    "body": {
        *("temperature_nats", "fit_nats", "evidence_nats", "most_against", "prior", "neighbour_m", "neighbours"),
        *("extent", "moving_m_s", "memory_s"),
    },
    "hidden": {"margin_nats", "reach_m", "drift_m_s", "stop_s"},
    "detection": {
        *("temperature_nats", "stationary", "free", "free_recent", "level"),
        *("moves_nats", "moves_level", "fresh_s"),
    },
}
UNSEEN = {
    *("hidden.drift_m_s", "hidden.stop_s"),  # nothing is hidden in the scene
    *(f"detection.{name}" for name in LEARNED["detection"]),  # of the confidence, which `calibration` alone reads
}
"""Parameters that contrast and coverage do not depend on, in a scene in which nothing is hidden."""


def _tracer(**body: Any) -> TagAttention:
    return TagAttention(segments=SegmentTracker(segmenter=Segmenter(num_segments=512)), body=CarryingBody(**body))


def _rough(num_frames: int = 40, *, depth_m: float = 0.004, phase_rad: float = 0.1) -> Recording:
    """The scene with errors of motion and phase of these standard deviations."""
    one, rng = scene(num_frames), np.random.default_rng(0)
    depth = np.asarray(one.depth)
    coarse = rng.normal(0, depth_m, (num_frames, depth.shape[1] // 8, depth.shape[2] // 8))
    depth = depth + np.kron(coarse, np.ones((1, 8, 8))) * (depth < 3.7)
    phase = (np.asarray(one.reads.phase_rad) + rng.normal(0, phase_rad, one.reads.num_reads)) % (2 * np.pi)
    return dataclasses.replace(
        one, depth=depth.astype(np.float32), reads=dataclasses.replace(one.reads, phase_rad=phase)
    )


@pytest.fixture(scope="module")
def clip():
    """A clip with errors so large that nothing is certain: where something is, most gradients vanish."""
    return clip_of(_rough(depth_m=0.012, phase_rad=0.35), 0, 24)


def test_exactly_the_named_parameters_are_learned() -> None:
    tracer = TagAttention()
    names = {f"{part}.{name}" for part, inner in LEARNED.items() for name in inner}
    assert set(tracer.physical()) == names
    assert len(jax.tree.leaves(eqx.filter(tracer, eqx.is_inexact_array))) == len(names)
    static = static_settings(tracer)
    assert static["segments.background.confirm_s"] == 1.5
    assert static["body.rigid.lags_s"] == [0.17, 0.33, 0.67]
    assert static["detection.threshold"] == 0.4
    assert static["attention"] is None
    assert not set(static) & names


@pytest.mark.parametrize("memory", [0.0, 0.5, 1.0])
def test_training_traces_what_the_tracer_traces(clip, memory: float) -> None:
    settings = dataclasses.replace(OBJECTIVE, memory=memory)
    wrapped = eqx.filter_jit(lambda one, camera, frames: objective_inputs(one, camera, frames, settings).trace)
    found, expected = (f(_tracer(), clip.camera, clip.frames) for f in (wrapped, eqx.filter_jit(trace)))
    # Programs that are compiled apart round otherwise; what is lost or not a number shows as a mask of another object.
    np.testing.assert_allclose(found.mask, expected.mask, atol=1e-3)
    np.testing.assert_allclose(found.confidence, expected.confidence, atol=1e-3)
    assert float(jnp.max(expected.mask)) > 0.9


@pytest.mark.ci
@pytest.mark.parametrize("cut", [False, True])
def test_parameters_have_the_gradients_of_central_differences(clip, cut: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """With `cut` the body leaves out what is not connected with its place.

    The objects are millimetres wide, and the errors of their depth centimetres. Within 8 cm all segments of an object are
    neighbours of all others, so that which is the middle of the place would be decided by rounding. Without the cut it does
    not matter; with it fewer are neighbours, of which some pairs are always just about to be.
    """
    names = ["reader.spread_rad", "body.rigid.noise_m", "body.rigid.most", "body.prior", "dwell.memory_s"]
    if cut:
        body = {"neighbour_m": 0.02}
    else:
        body = {}
        names.append("body.neighbour_m")
        monkeypatch.setattr(connection, "GAP", 100.0)
    # Bounds that no sum of two lags meets exactly: at a kink both differences and gradients are between two values.
    with jax.enable_x64(True):
        tracer = _in_double(_tracer(rigid=RigidMotion(most=1.9, least=3.7), **body))
        camera, frames = _in_double(clip.camera), _in_double(clip.frames)
        every_term = dataclasses.replace(OBJECTIVE, area=0.5, compactness=0.5, steadiness=0.5, calibration=0.2)
        assert set(every_term.weights()) == set(TERM_NAMES)
        gradient, logged = clip_gradient(tracer, camera, frames, KEY, every_term)
        assert np.isfinite(float(logged["loss"]))
        for name in (*names, "detection.level"):
            of = operator.attrgetter(name)
            leaf = lambda m, of=of: getattr(of(m), "unconstrained", of(m))  # noqa: E731
            ends = [eqx.tree_at(leaf, tracer, leaf(tracer) + step) for step in (1e-6, -1e-6)]
            high, low = (float(clip_loss(one, camera, frames, KEY, every_term)["loss"]) for one in ends)
            assert float(leaf(gradient)) == pytest.approx((high - low) / 2e-6, rel=1e-3, abs=1e-8), name
            assert abs(high - low) > 1e-11, name


def test_every_parameter_has_a_finite_gradient_and_only_these_have_none(clip) -> None:
    gradient, logged = clip_gradient(_tracer(), clip.camera, clip.frames, KEY, OBJECTIVE)
    assert np.isfinite(float(logged["loss"]))
    names = list(_tracer().physical())
    leaves = [float(leaf) for leaf in jax.tree.leaves(gradient)]
    assert np.isfinite(leaves).all()
    by_name = dict(zip(names, leaves, strict=True))
    zero = {name for name, value in by_name.items() if value == 0.0}
    assert UNSEEN <= zero <= UNSEEN | {"body.most_against", "body.evidence_nats"}  # whose effect may vanish in float32


@pytest.mark.ci
def test_every_parameter_of_the_confidence_has_a_gradient_of_its_calibration() -> None:
    judged = dataclasses.replace(OBJECTIVE, contrast=0.0, coverage=0.0, calibration=1.0)
    # A temperature and a freshness at which no confidence is 0 or 1.
    unsure = Detection(temperature_nats=50.0, fresh_s=0.05)
    tracer, certain = eqx.tree_at(lambda t: t.detection, _tracer(), unsure), clip_of(_rough(), 0, 24)
    gradient, _ = clip_gradient(tracer, certain.camera, certain.frames, KEY, judged)
    values = (float(leaf) for leaf in jax.tree.leaves(gradient))
    by_name = dict(zip(_tracer().physical(), values, strict=True))
    assert np.isfinite(list(by_name.values())).all()
    assert all(by_name[f"detection.{name}"] != 0 for name in LEARNED["detection"])


def _scans(jaxpr: Any) -> list[Any]:
    """The scans of a program that lie in no other scan."""
    found = []
    for equation in jaxpr.eqns:
        if equation.primitive.name == "scan":
            found.append(equation)
            continue
        found += [scan for inner in jaxprs_in_params(equation.params) for scan in _scans(inner)]
    return found


def _primitives(jaxpr: Any) -> set[str]:
    below = [_primitives(inner) for equation in jaxpr.eqns for inner in jaxprs_in_params(equation.params)]
    return {equation.primitive.name for equation in jaxpr.eqns}.union(*below)


def test_the_backward_pass_stores_labels_and_computes_none_again(clip) -> None:
    tracer, (height, width) = _tracer(), clip.camera.rays.shape[:2]
    arrays, static = eqx.partition(tracer, eqx.is_array)
    program = jax.make_jaxpr(
        lambda a, camera, frames: _clip_gradient(eqx.combine(a, static), camera, frames, KEY, OBJECTIVE)[0]
    )(arrays, clip.camera, clip.frames)
    forward, backward = [scan for scan in _scans(program.jaxpr) if scan.params["length"] == 24]
    assert (forward.params["reverse"], backward.params["reverse"]) == (False, True)
    outputs = [one.aval for one in forward.outvars[forward.params["num_carry"] :]]
    pictures = [one for one in outputs if one.shape[-2:] == (height, width)]
    assert sorted(one.dtype.name for one in pictures) == ["float32", "int32"]  # the masks, and labels
    assert "floor" in _primitives(forward.params["jaxpr"].jaxpr)  # bilinear taps
    assert "floor" not in _primitives(backward.params["jaxpr"].jaxpr)


def _stirred() -> TagAttention:
    rng = np.random.default_rng(1)
    stir = lambda leaf: leaf + jnp.asarray(rng.normal() * 0.2, leaf.dtype) if eqx.is_inexact_array(leaf) else leaf  # noqa: E731
    return jax.tree.map(stir, TagAttention())


def _changed(settings: dict[str, Any], name: str, value: Any) -> dict[str, Any]:
    """Nested settings with another value at a dotted name."""
    first, _, rest = name.partition(".")
    return {**settings, first: _changed(settings[first], rest, value) if rest else value}


def test_weights_have_dotted_names_and_come_back(tmp_path: Path) -> None:
    path, stirred = tmp_path / "weights.json", _stirred()
    save_parameters(path, stirred, CONF, {"stride": 2})
    content = json.loads(path.read_text())
    assert set(content["parameters"]) == set(stirred.physical())
    assert content["static"]["segments.segmenter.side_m"] == 0.05
    for back in (make_tracer(CONF, str(path)), learned_tracer(str(path))[0]):
        assert isinstance(back, TagAttention)
        assert back.physical() == pytest.approx(stirred.physical(), rel=1e-5)
        assert jax.tree.structure(back) == jax.tree.structure(stirred)
    close = _changed(CONF, "segments.segmenter.side_m", 0.05 * (1 + 1e-7))
    assert isinstance(make_tracer(close, str(path)), TagAttention)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("segments.segmenter.side_m", 0.04, r"found tracer\.segments\.segmenter\.side_m=0\.04; expected .*side_m=0\.05"),
        ("body.rigid.lags_s", [0.2, 0.4], r"tracer\.body\.rigid\.lags_s=\[0\.2, 0\.4\]; expected .*\[0\.17, 0\.33, 0\.67\]"),
        ("reader.modulo_pi", False, r"found tracer\.reader\.modulo_pi=False; expected .*True"),
        ("hidden", None, r"found tracer\.hidden=null; expected tracer\.hidden=not null"),
        ("attention", {}, r"found tracer\.attention=not null; expected tracer\.attention=null"),
        ("body.prior", -2.0, r"found tracer\.body\.prior=-2\.0; expected -1\.0.*Leave out body\.prior"),
    ],
)  # fmt: skip
def test_other_settings_than_those_of_the_training_are_refused(
    tmp_path: Path, name: str, value: Any, message: str
) -> None:
    path = tmp_path / "weights.json"
    save_parameters(path, _stirred(), CONF, {})
    with pytest.raises(ValueError, match=message) as error:
        make_tracer(_changed(CONF, name, value), str(path))
    assert str(path) in str(error.value)


def test_a_parameter_that_learning_left_unchanged_may_have_any_value(tmp_path: Path) -> None:
    path = tmp_path / "weights.json"
    save_parameters(path, TagAttention(), CONF, {})
    found = make_tracer(_changed(CONF, "detection.level", -3.0), str(path))
    assert isinstance(found, TagAttention)
    assert found.physical()["detection.level"] == -3.0


def test_the_weights_of_another_tracer_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.json"
    save_parameters(path, TagAttention(), {**CONF, "_target_": "tagjax.tagattention.Other"}, {})
    with pytest.raises(
        ValueError, match=r"found parameters of the tracer tagjax\.tagattention\.Other; expected those of"
    ):
        make_tracer(CONF, str(path))
    save_parameters(path, TagAttention(), CONF, {})
    without = eqx.tree_at(lambda t: t.hidden, TagAttention(), None)
    with pytest.raises(ValueError, match=r"unknown \['hidden\.drift_m_s'"):
        load_parameters(without, path, CONF)


@pytest.mark.ci
def test_a_run_is_trained_saved_and_evaluated(tmp_path: Path) -> None:
    one = _rough()
    save_recording(one, tmp_path / "scene.zarr")
    save_recording(dataclasses.replace(one, name="again"), tmp_path / "again.zarr")
    segments = {"segmenter": {"num_segments": 512}}
    values = {
        "tracer": {"_target_": CONF["_target_"], "segments": segments},
        "optimizer": {"_target_": "optax.adam", "learning_rate": 0.03},
        "data": {
            "recordings": [str(tmp_path / "scene.zarr")],
            "validation": [str(tmp_path / "again.zarr")],
            "clips": {"stride": 1, "length": 24, "flow": "zero"},
        },
        "objective": {"span_frames": 6, "skip_frames": 6, "max_reads": 64, "num_channels": 4, "future_stride": 1},
        "loop": {"num_steps": 1, "checkpoint_every": 1, "validate_every": 1, "progress": False},
        "logger": {"mode": "disabled"},
        "scores": {"num_pictures": 1, "from_s": 0.5},
    }
    run = tmp_path / "run"
    score = run_training(from_mapping(TrainConfig, values), run)
    assert score > 0.3
    row = json.loads((run / "metrics.jsonl").read_text().splitlines()[0])
    began = make_tracer(values["tracer"])
    assert isinstance(began, TagAttention)
    assert np.isfinite(row["loss"])
    assert row["skipped"] == 0
    assert row["parameter/body.rigid.noise_m"] == pytest.approx(began.physical()["body.rigid.noise_m"], rel=0.031)
    assert row["parameter/body.rigid.noise_m"] != began.physical()["body.rigid.noise_m"]
    of_run = run_evaluation(
        EvaluateConfig(run=str(run), checkpoint=1, progress=False), tmp_path / "a", run_values=values
    )
    of_file = run_evaluation(
        EvaluateConfig(
            weights=str(run / "weights.json"), recordings=(str(tmp_path / "again.zarr"),), progress=False,
            scores=values["scores"],
        ),
        tmp_path / "b",
    )  # fmt: skip
    for summary in (of_run, of_file):
        assert summary["learned"]["all"]["iou"] == pytest.approx(score, abs=0.01)
