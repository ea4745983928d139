"""The likelihood of the reads, given the motion of the teacher's masks: its value, and that it teaches reader and flow."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_joint import _panned, _panning_network
from test_learning_from_hindsight import LEAST, LOAD, TRACER
from test_segment_tracer import EPCS, scene

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.flow.weights import load_network, save_weights
from tagjax.radio.reader_model import ReaderModel
from tagjax.recording import Recording, RecordingError
from tagjax.recording.store import save_recording
from tagjax.training.config import TrainConfig
from tagjax.training.hindsight import HindsightSettings, Piece, PieceFiles, PieceWindows, segment_pieces
from tagjax.training.hindsight.likelihood import FilmedFrames, moved_by_flow, read_nats
from tagjax.training.run import initial_state, run_training, validation_metrics

SURE = 0.9
READS = HindsightSettings(learn="reads")


@pytest.fixture(scope="module")
def piece() -> Piece:
    (one,) = segment_pieces(scene(70), TRACER, LOAD, epcs=list(EPCS))
    return one


def _sure(piece: Piece) -> jax.Array:
    return piece.frames.present & (piece.frames.confidence > SURE)


def _by_hand(reader: ReaderModel, piece: Piece, sure: np.ndarray, tag: int) -> tuple[float, int]:
    """The same, read by read, in double precision, for one antenna."""
    frames = jax.tree.map(np.asarray, piece.frames)
    found, arrivals = frames.found, frames.arrivals
    phasor, channel, nats, number = 0j, -1, 0.0, 0
    moved_m, since_s, multiple = 0.0, float(frames.time_s[0]), reader.multiple
    for time in range(len(frames.time_s)):
        weight = frames.target[time, tag] * np.where(found.known[time], found.area[time], 0)
        counts = sure[time, tag] and weight.sum() > 0
        step_m, depth_m = 0.0, 0.0
        if counts:
            step_m = float(weight @ found.increment_m[time, 0] / weight.sum())
            depth_m = float(weight @ found.centre_m[time, :, 2] / weight.sum())
        else:
            phasor = 0j
        span_s = max(float(frames.time_s[time]) - since_s, 1e-6)
        done = 0.0
        for read in np.flatnonzero(arrivals.valid[time] & (arrivals.tag[time] == tag)):
            part = np.clip((float(arrivals.time_s[time, read]) - since_s) / span_s, 0, 1)
            moved_m, done = moved_m + (part - done) * step_m, part
            carrier_hz = float(arrivals.carrier_hz[time, read])
            if arrivals.channel[time, read] != channel:
                phasor, channel = 0j, arrivals.channel[time, read]
            turn = multiple * 4 * np.pi * carrier_hz / 299_792_458.0
            error = float(reader.drift_m.value) * depth_m**2 * abs(moved_m)
            phasor *= np.exp(1j * turn * moved_m) / (1 + abs(phasor) * turn**2 * error)
            rssi = jnp.asarray(arrivals.rssi_dbm[time, read])
            own = float(reader.concentration(rssi, jnp.asarray(step_m / span_s)))
            read_phasor = own * np.exp(1j * multiple * float(arrivals.phase_rad[time, read]))
            both = np.log(np.i0(abs(phasor + read_phasor)))
            ratio = np.exp(both - np.log(np.i0(abs(phasor))) - np.log(np.i0(own)))
            outlier = float(reader.outlier.value)
            inlier = (1 - outlier) * ratio
            phasor += inlier / (inlier + outlier) * read_phasor
            moved_m = 0.0
            if counts:
                nats, number = nats + np.log(inlier + outlier), number + 1
        moved_m += (1 - done) * step_m
        if not counts:
            phasor = 0j
        since_s = float(frames.time_s[time])
    return float(nats), number


@pytest.mark.parametrize("gap", [False, True])
def test_nats_are_those_of_each_read_by_itself(piece: Piece, gap: bool) -> None:
    # Wide phases: NumPy's Bessel function overflows where they are sharp.
    reader = ReaderModel(spread_rad=0.15, still_spread_rad=0.1, drift_m=0.002, outlier=0.1)
    sure = np.array(_sure(piece))
    if gap:
        sure[40:44, 0] = False
    nats, number = eqx.filter_jit(read_nats)(reader, 1, piece.frames, jnp.asarray(sure))
    for tag in range(2):
        expected, count = _by_hand(reader, piece, sure, tag)
        assert count > 50
        assert float(number[tag]) == count
        np.testing.assert_allclose(nats[tag], expected, rtol=2e-3)


def test_true_motion_explains_the_reads_best(piece: Piece) -> None:
    def nats(factor: float) -> float:
        frames = eqx.tree_at(lambda f: f.found.increment_m, piece.frames, factor * piece.frames.found.increment_m)
        sums, number = eqx.filter_jit(read_nats)(TRACER.reader, 1, frames, _sure(piece))
        return float(jnp.sum(sums) / jnp.sum(number))

    found = {factor: nats(factor) for factor in (0.0, 0.8, 1.0, 1.2)}
    assert found[1.0] == max(found.values())
    assert found[0.0] == min(found.values())


def test_the_reader_learns_as_finite_differences_say(piece: Piece) -> None:
    learnable, static = eqx.partition(TRACER, eqx.is_inexact_array)

    @jax.jit
    def loss(values: Any) -> Any:
        return READS.terms(eqx.combine(values, static), piece.camera, piece.frames)[0]["hindsight"]

    slope = jax.jit(jax.grad(loss))(learnable)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope))
    of_others = eqx.tree_at(lambda one: one.reader, slope, None)
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(of_others))
    for name in ("spread_rad", "drift_m", "outlier"):
        where = lambda one, name=name: getattr(one.reader, name).unconstrained  # noqa: E731
        ends = [float(loss(eqx.tree_at(where, learnable, where(learnable) + by))) for by in (0.05, -0.05)]
        np.testing.assert_allclose(where(slope), (ends[0] - ends[1]) / 0.1, rtol=0.03, atol=2e-5)
        assert float(where(slope)) != 0


def test_a_tag_without_a_sure_mask_adds_nothing(piece: Piece) -> None:
    sums, number = read_nats(TRACER.reader, 1, piece.frames, jnp.zeros_like(_sure(piece)))
    np.testing.assert_array_equal(sums, 0)
    np.testing.assert_array_equal(number, 0)
    none = eqx.tree_at(lambda f: f.confidence, piece.frames, jnp.zeros_like(piece.frames.confidence))
    loss, logged = READS.terms(TRACER, piece.camera, none)
    assert float(loss["hindsight"]) == 0
    assert np.isnan(logged["nats"])


def test_flow_moves_the_segments_as_tracing_does(piece: Piece) -> None:
    """The piece was made with no flow; with flow the motion is another, and its slope is finite."""
    frames = piece.frames
    colour = jnp.zeros((len(frames.time_s), 4, 4, 3), jnp.uint8)
    filmed = FilmedFrames(frames, colour, jnp.zeros((*frames.depth_m.shape, 2)))
    moved = eqx.filter_jit(moved_by_flow)(TRACER.segments, piece.camera, filmed)
    body = np.asarray(frames.target[30:60]).max(axis=1) > 0.9
    both = body & np.asarray(frames.found.known[30:60] & moved.found.known[30:60])
    assert both.sum() > 100
    ours, traced = (np.moveaxis(np.asarray(one.found.increment_m[30:60]), 1, 2)[both] for one in (moved, frames))
    np.testing.assert_allclose(ours, traced, atol=1e-3)
    assert not np.any(moved.found.known[0, 1:])

    def loss(flow: Any) -> Any:
        return READS.terms(TRACER, piece.camera, dataclasses.replace(filmed, backward_px=flow))[0]["hindsight"]

    slope = jax.jit(jax.grad(loss))(filmed.backward_px + 0.3)
    assert np.all(np.isfinite(slope))
    assert np.any(np.asarray(slope) != 0)


def test_windows_hold_what_a_mask_is_sure_of_and_its_pictures(piece: Piece, tmp_path: Path) -> None:
    one = scene(70)
    files = PieceFiles(tmp_path / "pieces").made([one], TRACER, LOAD, epcs=None, num_frames=40)
    windows = PieceWindows.of(files, [one], length=10, sure=SURE)
    assert list(windows.places) == [(piece, start) for piece in (0, 1) for start in range(0, 30, 5)]
    assert len(PieceWindows.of(files, [one], length=10, sure=1.0)) == 0  # no mask is so sure
    assert len(PieceWindows.of(files, [one], length=40, sure=SURE)) == 0  # no piece is so long
    for place, window in zip(windows.places, windows, strict=True):
        first = files[place[0]].start + place[1]
        np.testing.assert_array_equal(window.frames.colour, np.asarray(one.colour[first : first + 10]))
        np.testing.assert_allclose(window.frames.piece.time_s, one.frame_time_s()[first : first + 10], rtol=1e-6)
        sure = np.asarray(window.frames.piece.confidence > SURE)
        assert sure.mean(axis=0).max() >= 0.5


SMALL = {
    "_target_": "tagjax.flow.pyramid.PyramidFlow",
    "widths": [8, 8],
    "radii": [1, 1],
    "decoder_widths": [[8], [8]],
}
JOINT = {
    "flow": SMALL,
    "optimizer": {"_target_": "optax.adam", "learning_rate": 1e-3},
    "init": None,
    "weight": 0.0,
}


def test_only_reads_teach_the_flow_from_hindsight() -> None:
    with pytest.raises(
        ConfigError, match=r"hindsight\.learn=all does not reach the flow; expected hindsight\.learn=reads"
    ):
        from_mapping(TrainConfig, {**LEAST, "joint": JOINT, "hindsight": {}})
    config = from_mapping(TrainConfig, {**LEAST, "joint": JOINT, "hindsight": {"learn": "reads"}})
    assert config.joint is not None
    assert not HindsightSettings(controls=0.1, learn="reads").needs_controls


def _config(recording: Path, **more: Any) -> TrainConfig:
    values = {
        **LEAST,
        "hindsight": {"learn": "reads"},
        "data": {"recordings": [str(recording)], "clips": {"stride": 4, "flow": "zero", "length": 6}},
        "loop": {"num_steps": 2, "checkpoint_every": 1, "progress": False},
        "logger": {"mode": "disabled"},
        **more,
    }
    return from_mapping(TrainConfig, values)


def _filmed(num_frames: int = 46) -> Recording:
    """The tiny scene with pictures that change, and surfaces that slope: on a flat one, the flow along it changes no distance."""
    whole = _panned(num_frames, rate_hz=15.0)
    depth = np.asarray(whole.depth)
    return dataclasses.replace(whole, depth=depth + np.linspace(0, 0.6, depth.shape[2], dtype=depth.dtype))


def test_validation_recordings_without_a_window_give_no_numbers(tmp_path: Path) -> None:
    """A mask may be sure nowhere in them: the run then ends without a score, not with an error."""
    config = _config(tmp_path / "a.zarr", joint=JOINT)
    none = PieceWindows.of(PieceFiles(tmp_path / "pieces"), [], length=6, sure=SURE)
    assert validation_metrics(initial_state(config)[0], none, config) == {}


@pytest.mark.ci
def test_a_run_teaches_the_flow_and_resumes_exactly(tmp_path: Path) -> None:
    save_recording(_filmed(), path := tmp_path / "a.zarr")
    # Flow that explains the pictures no better than none counts as none, and has no gradient: it begins with some.
    save_weights(start := tmp_path / "start.safetensors", _panning_network(), {"flow": SMALL})
    joint = {**JOINT, "init": str(start)}
    config = _config(path, joint=joint)
    run_training(config, tmp_path / "whole")
    run_training(_config(path, joint=joint, loop={"num_steps": 1, "progress": False}), tmp_path / "parts")
    run_training(config, tmp_path / "parts")
    whole, parts = (load_network(tmp_path / name / "flow.safetensors") for name in ("whole", "parts"))
    before = load_network(tmp_path / "whole" / "flow_untrained.safetensors")
    changed = []
    for one, other, first in zip(
        *(jax.tree.leaves(eqx.filter(n, eqx.is_array)) for n in (whole, parts, before)), strict=True
    ):
        np.testing.assert_array_equal(one, other)
        changed.append(bool(np.any(np.asarray(one) != np.asarray(first))))
    assert any(changed)
    rows = [json.loads(line) for line in (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()]
    assert max(row.get("gradient_norm/network", 0.0) for row in rows) > 0
    assert all("nats" in row for row in rows if "loss" in row)


@pytest.mark.ci
def test_windows_that_do_not_fit_are_reported_before_the_training(tmp_path: Path) -> None:
    save_recording(_filmed(), path := tmp_path / "a.zarr")
    clips = {"stride": 4, "flow": "zero", "length": 90}
    with pytest.raises(RecordingError, match=r"found no 90 frames in a row with a mask .* Give longer recordings"):
        run_training(_config(path, joint=JOINT, data={"recordings": [str(path)], "clips": clips}), tmp_path / "run")
