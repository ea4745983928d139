"""Learning from hindsight: pieces hold what the tracer sees, and the loss is that of the smoother's masks."""

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
import safetensors.numpy
from jaxtyping import Array
from test_segment_tracer import EPCS, scene

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.metrics.locking import first_motion
from tagjax.recording import Recording, RecordingError, TagReads
from tagjax.recording.store import save_recording
from tagjax.tagattention.segments import Segmenter, SegmentTracker, TagAttention
from tagjax.tagattention.segments.dwell import DwellEvidence
from tagjax.tracing.clips import ClipSettings, clip_loader
from tagjax.tracing.recordings import TraceSettings, trace_recording
from tagjax.training.config import TrainConfig
from tagjax.training.fading import faded
from tagjax.training.hindsight import HindsightSettings, Piece, PieceFiles, segment_pieces
from tagjax.training.hindsight.objective import hindsight_sums
from tagjax.training.hindsight.pieces import frame_of
from tagjax.training.run import run_training
from tagjax.training.step import clip_gradient, known_mean

SETTINGS = HindsightSettings()
LOAD = clip_loader(ClipSettings(stride=1, flow="zero"))
TRACER = TagAttention(segments=SegmentTracker(segmenter=Segmenter(num_segments=256)))
KEY = jax.random.PRNGKey(0)


@pytest.fixture(scope="module")
def piece() -> Piece:
    (one,) = segment_pieces(scene(70), TRACER, LOAD, epcs=list(EPCS))
    return one


@eqx.filter_jit
def _associated(tracer: TagAttention, piece_frames: Any, camera: Any) -> tuple[Any, Any, Any]:
    def step(state: Any, frame: Any) -> tuple[Any, Any]:
        state, out = tracer.associate(camera, state, frame.found, frame_of(frame, camera.antennas_m.shape[0]))
        return state, (out.membership, out.place, out.confidence)

    num_tags, window = piece_frames.present.shape[1], piece_frames.radio.relative_m.shape[-1]
    state = tracer.no_reads(num_tags, camera.antennas_m.shape[0], window, piece_frames.time_s[0])
    return jax.lax.scan(step, state, piece_frames)[1]


def test_a_piece_holds_all_that_tracing_sees(piece: Piece) -> None:
    _, _, confidence = _associated(TRACER, piece.frames, piece.camera)
    traced = [out.confidence for _, out in trace_recording(TRACER, scene(70), LOAD, epcs=list(EPCS))]
    np.testing.assert_allclose(confidence[: piece.num_frames], np.stack(traced), atol=1e-6)


def test_targets_are_the_smoothers_masks(piece: Piece) -> None:
    settings = TraceSettings(smooth=True)
    last = [out for _, out in trace_recording(TRACER, scene(70), LOAD, epcs=list(EPCS), settings=settings)][50]
    np.testing.assert_allclose(piece.frames.confidence[50], last.confidence, atol=1e-6)
    frames = piece.frames
    inside = np.asarray(frames.target[50]) @ np.asarray(frames.found.area[50])
    np.testing.assert_allclose(inside, np.sum(np.asarray(last.mask) > 0.5, axis=(1, 2)), rtol=0.05)
    assert frames.target.shape == (96, 2, 256)
    assert not np.any(frames.present[70:])
    assert np.all(np.diff(frames.time_s) > 0)


@pytest.mark.ci
def test_labels_teach_from_the_first_motion_on_and_only_what_is_seen() -> None:
    one = scene(40)
    truth = one.truth
    assert truth is not None
    assert truth.labels is not None
    labels = np.array(truth.labels)
    labels[30:][labels[30:] == next(iter(EPCS.values()))] = 0  # out of the picture
    began = {epc: first_motion(truth, epc, one.frame_time_s()) or 0 for epc in EPCS}
    truth = dataclasses.replace(truth, labels=labels)
    (piece,) = segment_pieces(
        dataclasses.replace(one, truth=truth), TRACER, LOAD, epcs=list(EPCS), num_frames=64, teacher="labels"
    )
    frames = piece.frames
    inside = np.einsum("ntk,nk->nt", frames.target, frames.found.area)[:40]
    for tag, (epc, label) in enumerate(EPCS.items()):
        np.testing.assert_allclose(inside[:, tag], np.sum(labels == label, axis=(1, 2)), rtol=0.05)
        seen = np.any(labels == label, axis=(1, 2))
        expected = np.where(~seen, 0.0, np.where(np.arange(40) < began[epc], 0.5, 1.0))
        np.testing.assert_array_equal(frames.confidence[:40, tag], expected)
    assert not np.all(frames.confidence[:40, 0] == 1.0)
    none = dataclasses.replace(one, truth=None)
    with pytest.raises(RecordingError, match=r"found no true mask of .*; expected labels of every tag"):
        list(segment_pieces(none, TRACER, LOAD, epcs=list(EPCS), teacher="labels"))


def test_the_loss_is_that_of_the_masks(piece: Piece) -> None:
    frames, area = piece.frames, np.asarray(piece.frames.found.area)
    membership, place, confidence = (np.asarray(each) for each in _associated(TRACER, frames, piece.camera))
    target, sure = np.asarray(frames.target), np.asarray(frames.confidence)
    missed, surprise, wrong, claimed, num_there = [], [], [], [], 0
    for time in range(piece.num_frames):
        for tag in range(2):
            both = np.sum(membership[time, tag] * target[time, tag] * area[time])
            either = np.sum((membership[time, tag] + target[time, tag]) * area[time]) - both
            if sure[time, tag] > 0.9 and np.sum(target[time, tag] * area[time]) > 0:
                missed.append(1 - both / either)
                surprise.append(-np.log(0.1 + 0.9 * np.sum(place[time, tag] * target[time, tag])))
                wrong.append((confidence[time, tag] - (both / either > 0.3)) ** 2)
                num_there += 1
            elif sure[time, tag] < 0.1:
                claimed.append(confidence[time, tag])
                wrong.append(claimed[-1] ** 2)
    found = eqx.filter_jit(hindsight_sums)(TRACER, piece.camera, frames, SETTINGS)
    expected = [np.sum(missed), np.sum(surprise), np.sum(wrong), np.sum(claimed), num_there, len(claimed)]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert num_there > 60
    loss, logged = SETTINGS.terms(TRACER, piece.camera, frames)
    np.testing.assert_allclose(loss["hindsight"], np.mean(missed) + np.mean(wrong), rtol=1e-4)
    np.testing.assert_allclose(logged["overlap"], 1 - np.mean(missed), rtol=1e-4)
    np.testing.assert_allclose(logged["place_nats"], np.mean(surprise), rtol=1e-4)


def test_the_gradient_of_the_place_is_that_of_finite_differences(piece: Piece) -> None:
    """By the reader's noise, the evidence's memory and the place's temperature, through all frames."""
    frames = jax.tree.map(lambda leaf: leaf[:48], piece.frames)
    # Competition and what is hidden take some of their inputs as given.
    tracer = dataclasses.replace(TRACER, dwell=DwellEvidence(memory_s=0.5), competition=None, hidden=None)
    settings = dataclasses.replace(SETTINGS, learn="place")

    def learned(one: TagAttention) -> list[Array]:
        assert one.dwell is not None
        assert one.body is not None
        stages = one.reader.spread_rad, one.reader.intercept, one.dwell.memory_s, one.body.temperature_nats
        return [leaf for stage in stages for leaf in jax.tree.leaves(stage)]

    @jax.jit
    def loss(values: Array) -> Array:
        return settings.terms(eqx.tree_at(learned, tracer, list(values)), piece.camera, frames)[0]["hindsight"]

    begin = jnp.stack(learned(tracer))
    slope, step = jax.jit(jax.grad(loss))(begin), 0.01 * jnp.eye(4)
    differences = np.array([(loss(begin + one) - loss(begin - one)) / 0.02 for one in step])
    assert np.all(np.abs(differences) > 5e-4)
    np.testing.assert_allclose(slope, differences, rtol=0.02)


@pytest.mark.ci
def test_place_and_masks_teach_all_but_detection_and_the_confidence_detection_alone(piece: Piece) -> None:
    learnable, static = eqx.partition(TRACER, eqx.is_inexact_array)

    def slopes(settings: HindsightSettings) -> tuple[list[Array], list[Array]]:
        """Of detection, and of all other stages."""

        def loss(values: Any) -> Any:
            return settings.terms(eqx.combine(values, static), piece.camera, piece.frames)[0]["hindsight"]

        found = jax.jit(jax.grad(loss))(learnable)
        return jax.tree.leaves(found.detection), jax.tree.leaves(eqx.tree_at(lambda one: one.detection, found, None))

    of_masks = slopes(dataclasses.replace(SETTINGS, learn="masks"))
    of_place = slopes(dataclasses.replace(SETTINGS, learn="place"))
    of_confidence = slopes(dataclasses.replace(SETTINGS, learn="confidence"))
    assert all(np.all(leaf == 0) for leaf in (*of_masks[0], *of_place[0], *of_confidence[1]))
    assert any(np.any(leaf != 0) for leaf in of_masks[1])
    assert any(np.any(leaf != 0) for leaf in of_place[1])
    assert any(np.any(leaf != 0) for leaf in of_confidence[0])
    together = slopes(SETTINGS)
    for one, other in zip((*together[0], *together[1]), (*of_confidence[0], *of_masks[1]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


@pytest.mark.ci
def test_only_the_named_parameters_learn(piece: Piece) -> None:
    settings = dataclasses.replace(SETTINGS, parameters=("reader.*", "body.temperature_nats"))
    gradient, _ = clip_gradient(TRACER, piece.camera, piece.frames, KEY, settings)
    moved = {jax.tree_util.keystr(path) for path, leaf in jax.tree_util.tree_leaves_with_path(gradient) if leaf != 0}
    assert moved
    assert ".body.temperature_nats.unconstrained" in moved
    assert all(name.startswith((".reader.", ".body.temperature_nats")) for name in moved)
    with pytest.raises(
        ConfigError, match=r"hindsight\.parameters: reader\.sprad is no parameter; .*reader\.spread_rad"
    ):
        dataclasses.replace(SETTINGS, parameters=("reader.sprad",)).learning(TRACER)


def test_padding_changes_nothing(piece: Piece) -> None:
    short = jax.tree.map(lambda leaf: leaf[: piece.num_frames], piece.frames)
    whole, alone = (eqx.filter_jit(hindsight_sums)(TRACER, piece.camera, f, SETTINGS) for f in (piece.frames, short))
    np.testing.assert_allclose(whole, alone, rtol=1e-5)


@pytest.mark.ci
def test_a_step_against_the_gradient_lowers_the_loss(piece: Piece) -> None:
    gradient, logged = clip_gradient(TRACER, piece.camera, piece.frames, KEY, SETTINGS)
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(gradient)]
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert np.sqrt(sum(np.sum(leaf**2) for leaf in leaves)) <= SETTINGS.clip_norm * (1 + 1e-5)
    learnable, static = eqx.partition(TRACER, eqx.is_inexact_array)
    moved = eqx.combine(jax.tree.map(lambda p, g: p - 0.02 * jnp.sign(g), learnable, gradient), static)
    after, _ = eqx.filter_jit(SETTINGS.terms)(moved, piece.camera, piece.frames)
    assert after["hindsight"] < logged["loss"]


@pytest.mark.ci
def test_long_recordings_are_cut_and_tags_padded() -> None:
    one = scene(70)
    third = dataclasses.replace(one.reads, epc=np.where(np.arange(one.reads.num_reads) % 9 == 0, "C", one.reads.epc))
    pieces = list(segment_pieces(dataclasses.replace(one, reads=third), TRACER, LOAD, epcs=[*EPCS, "C"], num_frames=30))
    assert [(p.start, p.num_frames) for p in pieces] == [(0, 23), (23, 23), (46, 24)]
    for each in pieces:
        assert each.frames.present.shape == (32, 4)
        np.testing.assert_array_equal(each.frames.present[0], [True, True, True, False])


def test_files_hold_the_pieces_and_are_made_once(piece: Piece, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = {"control": None, "clips": {"stride": 1}}

    def make(**changed: Any) -> PieceFiles:
        given = {"epcs": None, "num_frames": 256, "settings": seen, **changed}
        return PieceFiles(tmp_path / "pieces").made([scene(70)], TRACER, LOAD, **given)

    (back,) = make()
    assert (back.name, back.start, back.num_frames) == (piece.name, 0, 70)
    for one, other in zip(jax.tree.leaves(back.frames), jax.tree.leaves(piece.frames), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)

    def again(*_: Any, **__: Any) -> None:
        raise AssertionError("computed again")

    monkeypatch.setattr("tagjax.training.hindsight.files.segment_pieces", again)
    files = make()
    assert len(files) == 1
    assert files.num_sure(SETTINGS) > 60
    other = dataclasses.replace(scene(70), name="other")
    with pytest.raises(RecordingError, match=rf"found pieces of {piece.name}; expected those of other"):
        files.made([other], TRACER, LOAD, epcs=None, num_frames=256)
    with pytest.raises(
        RecordingError, match=r'made with control=null; expected control="foreign"\. Give the same settings'
    ):
        make(settings={**seen, "control": "foreign"})
    with pytest.raises(
        RecordingError, match=r'controls=false, teacher="smoother"; expected controls=true, teacher="labels"'
    ):
        make(teacher="labels", controls=True)
    index = tmp_path / "pieces" / "index.json"
    index.write_text(
        json.dumps([{"recording": one["recording"], "files": one["files"]} for one in json.loads(index.read_text())])
    )
    with pytest.raises(RecordingError, match=r"found pieces made with clips=null.*; expected clips="):
        make()
    files.remove()
    assert not (tmp_path / "pieces").exists()


def test_pieces_of_another_version_are_refused(piece: Piece, tmp_path: Path) -> None:
    files = PieceFiles(tmp_path / "pieces").made([scene(70)], TRACER, LOAD, epcs=None, num_frames=256)
    (path,) = (tmp_path / "pieces").glob("*.safetensors")
    with safetensors.safe_open(path, framework="numpy") as file:
        about, leaves = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    del leaves["found.area"]
    path.write_bytes(safetensors.numpy.save(leaves, about))
    with pytest.raises(RecordingError, match=r"found no found\.area; expected a piece of this version"):
        files[0]


def test_means_over_nothing_are_unknown_and_left_out_of_the_mean(piece: Piece) -> None:
    silent = dataclasses.replace(piece.frames, present=jnp.zeros_like(piece.frames.present))
    loss, logged = eqx.filter_jit(SETTINGS.terms)(TRACER, piece.camera, silent)
    assert float(loss["hindsight"]) == 0.0
    assert all(np.isnan(value) for value in logged.values())
    assert float(known_mean([logged["overlap"], jnp.asarray(0.25), jnp.asarray(0.75)])) == 0.5
    assert np.isnan(known_mean([logged["overlap"]]))


def test_gradients_fade_and_values_stay() -> None:
    state = {"a": jnp.array([1.5, -jnp.inf, jnp.nan, 0.1]), "n": jnp.array([3])}
    after = faded(state, 0.7)
    jax.tree.map(np.testing.assert_array_equal, after, state)
    slope = jax.grad(lambda x: jnp.sum(faded(faded({"x": x}, 0.5), 0.5)["x"] ** 2))(jnp.array([3.0, 0.0]))
    np.testing.assert_allclose(slope, [1.5, 0.0])


LEAST = {
    "tracer": {"_target_": "tagjax.tagattention.TagAttention", "segments": {"segmenter": {"num_segments": 256}}},
    "optimizer": {"_target_": "optax.rprop", "learning_rate": 0.02},
}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"hindsight": {}, "objective": {}}, "found both hindsight and objective; expected one"),
        (
            {"baselines": {"learned": {}, "peer": {}}},
            "baselines: found learned; expected other names than learned, untrained",
        ),
        ({"hindsight": {"sure": 0.3}}, r"hindsight: sure is 0\.3; expected a confidence from 0\.5 to 1"),
        ({"hindsight": {"clip_norm": 0}}, r"hindsight: clip_norm is 0(\.0)?; expected a positive norm"),
        ({"hindsight": {"piece_frames": 0}}, "hindsight: piece_frames is 0; expected at least 1"),
        (
            {"joint": {"flow": {}, "optimizer": {}}},
            r"hindsight\.learn=all does not reach the flow; expected hindsight\.learn=reads",
        ),
    ],
)
def test_settings_that_cannot_be_used_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_mapping(TrainConfig, {**LEAST, **given})


def _run(recordings: list[Path], folder: Path, **more: Any) -> float:
    values = {
        **LEAST,
        "data": {
            "recordings": [str(recordings[0])],
            "validation": [str(path) for path in recordings[1:]],
            "clips": {"stride": 1, "flow": "zero"},
        },
        "loop": {"num_steps": 3, "progress": False},
        "logger": {"mode": "disabled"},
        "scores": {"num_pictures": 1, "from_s": 0.5},
        **more,
    }
    return run_training(from_mapping(TrainConfig, values), folder)


def _stored(recording: Recording, path: Path) -> Path:
    save_recording(recording, path)
    return path


@pytest.mark.ci
def test_a_run_learns_and_resumes(tmp_path: Path) -> None:
    paths = [
        _stored(scene(46), tmp_path / "a.zarr"),
        _stored(dataclasses.replace(scene(46), name="b"), tmp_path / "b.zarr"),
    ]
    score = _run(paths, tmp_path / "whole")
    assert score > 0.3
    rows = [json.loads(line) for line in (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()]
    losses = [row["loss"] for row in rows if "loss" in row]
    assert losses[-1] < losses[0]
    assert "validation/overlap" in rows[-1]
    assert not (tmp_path / "whole" / "pieces").exists()
    _run(paths, tmp_path / "parts", loop={"num_steps": 1, "progress": False})
    assert _run(paths, tmp_path / "parts") == score
    whole, parts = (json.loads((tmp_path / name / "weights.json").read_text()) for name in ("whole", "parts"))
    assert whole["parameters"] == parts["parameters"]
    kept = {"hindsight": {"pieces": str(tmp_path / "kept")}}
    assert [_run(paths, tmp_path / name, **kept) for name in ("first", "second")] == [score, score]
    assert len(PieceFiles(tmp_path / "kept" / "training")) == 1


@pytest.mark.ci
def test_what_cannot_teach_is_reported_before_the_training(tmp_path: Path) -> None:
    one = scene(40)
    silent = dataclasses.replace(one, reads=_few(one.reads))
    with pytest.raises(RecordingError, match=r"hindsight: found no mask with a confidence above 0\.9 in any of 1 rec"):
        _run([_stored(silent, tmp_path / "silent.zarr")], tmp_path / "run")
    literal = {"_target_": "tagjax.tagattention.literal.TagAttentionLiteral", "softness": 0.3}
    with pytest.raises(
        ConfigError, match="TagAttentionLiteral has no smoother to learn from; expected tracer=tagattention"
    ):
        _run([_stored(one, tmp_path / "a.zarr")], tmp_path / "other", tracer=literal)


def _few(reads: TagReads) -> TagReads:
    """One read of each tag."""
    first = [int(np.flatnonzero(reads.epc == epc)[0]) for epc in EPCS]
    return reads[np.isin(np.arange(reads.num_reads), first)]
