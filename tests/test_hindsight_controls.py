"""Controls in learning from hindsight: what is detected with reads that belong to nothing in view is false."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic_clips import recording
from test_learning_from_hindsight import LEAST, LOAD, TRACER
from test_segment_tracer import EPCS, scene

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.recording import Recording
from tagjax.recording.controls import foreign_reads, shifted_reads
from tagjax.tracing.arrivals import frame_arrivals
from tagjax.tracing.tracer import Camera
from tagjax.training.config import TrainConfig
from tagjax.training.hindsight import HindsightSettings, Piece, PieceFiles, segment_pieces
from tagjax.training.hindsight.control import control_of, control_reads
from tagjax.training.hindsight.objective import control_sums, hindsight_sums
from tagjax.training.hindsight.pieces import frame_of

SETTINGS = HindsightSettings(learn="confidence", controls=0.25)
_sums = eqx.filter_jit(control_sums)


@pytest.fixture(scope="module")
def piece() -> Piece:
    one = scene(40)
    control = control_of([one], 0)
    (made,) = segment_pieces(one, TRACER, LOAD, epcs=list(EPCS), teacher="labels", control=control)
    return made


def _camera(antennas_m: np.ndarray) -> Camera:
    return Camera(jnp.ones((2, 2, 3)), jnp.asarray(antennas_m, jnp.float32))


def test_even_recordings_have_their_own_reads_later_and_odd_ones_those_of_the_next() -> None:
    a, b, c = (dataclasses.replace(recording(20 + number), name=f"{number}") for number in range(3))
    for number, expected in enumerate((shifted_reads(a), foreign_reads(b, c), shifted_reads(c))):
        found = control_of([a, b, c], number)
        np.testing.assert_array_equal(found.time_ns, expected.time_ns)
        np.testing.assert_array_equal(found.phase_rad, expected.phase_rad)
    np.testing.assert_array_equal(control_of([a, b], 1).phase_rad, foreign_reads(b, a).phase_rad)


def test_control_reads_have_the_antennas_of_the_camera_and_the_tags_that_there_is_room_for() -> None:
    one = recording(20)
    antenna = np.where(np.arange(one.reads.num_reads) % 3 == 0, 2, 1).astype(one.reads.antenna.dtype)
    places_m = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    one = dataclasses.replace(one, reads=dataclasses.replace(one.reads, antenna=antenna), antennas_m=places_m)
    first = sorted(set(one.reads.epc.tolist()))[0]
    found = control_reads(one, one.reads, _camera(places_m[1:]), 1)
    expected, _ = frame_arrivals(one.reads, [first], [2], one.time_ns, int(one.time_ns[0]), 64)
    jax.tree.map(np.testing.assert_array_equal, found.arrivals, expected)
    assert np.any(found.arrivals.valid)
    assert found.present.all()
    roomy = control_reads(one, one.reads, _camera(places_m[:1]), 4)
    np.testing.assert_array_equal(roomy.present, [[True, True, False, False]] * 20)


def test_without_reads_no_tag_is_present() -> None:
    one = recording(20)
    found = control_reads(one, one.reads[:0], _camera(np.asarray(one.antennas_m[:1])), 2)
    assert not found.present.any()
    assert not found.arrivals.valid.any()


def test_a_control_differs_from_its_piece_in_reads_and_in_what_they_should_give(piece: Piece) -> None:
    own, other = piece.frames, piece.frames.of_control()
    assert other.control is None
    for name in ("time_s", "depth_m", "found"):
        jax.tree.map(np.testing.assert_array_equal, getattr(own, name), getattr(other, name))
    later = frame_arrivals(shifted_reads(scene(40)), list(EPCS), [1], scene(40).time_ns, int(scene(40).time_ns[0]), 64)
    jax.tree.map(lambda leaf, whole: np.testing.assert_array_equal(leaf[:40], whole), other.arrivals, later[0])
    assert not np.array_equal(own.arrivals.phase_rad, other.arrivals.phase_rad)
    assert not np.any(other.target)
    assert not np.any(other.confidence)
    assert np.all(np.isinf(other.radio.std_m))  # no range of the own reads
    assert not np.any(other.present[40:])
    assert not np.any(other.arrivals.valid[40:])
    with pytest.raises(ValueError, match="found a piece without control reads"):
        other.of_control()


def _confidence(piece: Piece) -> np.ndarray:
    """Of the control, traced frame by frame as any other reads."""
    frames, camera = piece.frames.of_control(), piece.camera
    state = TRACER.no_reads(2, 1, frames.radio.relative_m.shape[-1], frames.time_s[0])
    step = lambda state, frame: TRACER.associate(camera, state, frame.found, frame_of(frame, 1))  # noqa: E731
    _, out = jax.jit(lambda: jax.lax.scan(step, state, frames))()
    return np.asarray(out.confidence)[:40]


def test_the_loss_of_a_control_is_the_mean_square_of_its_confidence(piece: Piece) -> None:
    confidence = _confidence(piece)
    assert np.max(confidence) > 0.01
    found = _sums(TRACER, piece.camera, piece.frames, SETTINGS)
    np.testing.assert_allclose(found, [np.sum(confidence**2), np.sum(confidence), 80], rtol=1e-4)


@pytest.mark.ci
def test_controls_count_as_the_fraction_of_reads_that_belong_to_nothing(piece: Piece) -> None:
    found = _sums(TRACER, piece.camera, piece.frames, SETTINGS)
    silent = dataclasses.replace(piece.frames, present=jnp.zeros_like(piece.frames.present))  # no own frame counts
    loss, logged = eqx.filter_jit(SETTINGS.terms)(TRACER, piece.camera, silent)
    np.testing.assert_allclose(loss["hindsight"], found.wrong / 80 / 3, rtol=1e-4)  # 1 of 4 to 3 of 4
    np.testing.assert_allclose(logged["false_confidence/control"], found.claimed / 80, rtol=1e-4)
    bare = dataclasses.replace(piece.frames, control=None)
    with pytest.raises(ValueError, match="control"):
        eqx.filter_eval_shape(SETTINGS.terms, TRACER, piece.camera, bare)
    without = dataclasses.replace(SETTINGS, controls=0.0)
    for frames in (bare, piece.frames):
        _, fewer = eqx.filter_eval_shape(without.terms, TRACER, piece.camera, frames)
        assert set(fewer) == {"overlap", "place_nats", "false_confidence"}


def test_a_control_teaches_detection_its_true_slope_and_nothing_else(piece: Piece) -> None:
    def wrong(tracer: Any) -> Any:
        return _sums(tracer, piece.camera, piece.frames, SETTINGS).wrong

    slopes = eqx.filter_jit(eqx.filter_grad(wrong))(TRACER)
    others = eqx.tree_at(lambda one: one.detection, slopes, None)
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(others))
    for name in ("level", "free_recent"):
        at = lambda one, name=name: getattr(one.detection, name)  # noqa: E731
        up, down = (wrong(eqx.tree_at(at, TRACER, at(TRACER) + step)) for step in (0.02, -0.02))
        assert at(slopes) < 0
        np.testing.assert_allclose(at(slopes), (up - down) / 0.04, rtol=0.02)


@pytest.mark.ci
def test_detection_has_the_slope_that_the_whole_tracer_gives_it(piece: Piece) -> None:
    learnable, static = eqx.partition(TRACER, eqx.is_inexact_array)

    def slopes(settings: HindsightSettings) -> Any:
        def wrong(values: Any) -> Any:
            return hindsight_sums(eqx.combine(values, static), piece.camera, piece.frames, settings).wrong

        return jax.jit(jax.grad(wrong))(learnable)

    found = [slopes(one) for one in (dataclasses.replace(SETTINGS, learn="all"), SETTINGS)]
    for one, other in zip(*(jax.tree.leaves(each.detection) for each in found), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)
    for each in found:
        others = eqx.tree_at(lambda one: one.detection, each, None)
        assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(others))


def test_files_hold_the_controls_and_are_the_same_each_time(piece: Piece, tmp_path: Path) -> None:
    recordings: list[Recording] = [scene(40), dataclasses.replace(scene(40), name="other")]

    def made(folder: str, controls: bool) -> PieceFiles:
        files = PieceFiles(tmp_path / folder)
        return files.made(recordings, TRACER, LOAD, epcs=None, num_frames=64, teacher="labels", controls=controls)

    first, again, bare = made("first", True), made("again", True), made("bare", False)
    for one, other in zip(first, again, strict=True):
        assert (one.name, one.start, one.num_frames) == (other.name, other.start, other.num_frames)
        jax.tree.map(np.testing.assert_array_equal, one.frames, other.frames)
    assert len(first) == len(again) == len(bare) == 2
    assert [one.frames.control for one in bare] == [None, None]
    jax.tree.map(np.testing.assert_array_equal, first[0].frames, piece.frames)
    foreign = first[1].frames.of_control()  # of the same scene: all reads but the first frame's are the own ones
    np.testing.assert_array_equal(foreign.arrivals.phase_rad, first[1].frames.arrivals.phase_rad)
    size = lambda files: sum(path.stat().st_size for path in files.folder.iterdir())  # noqa: E731
    assert size(first) < 1.2 * size(bare)  # segments are stored once


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"hindsight": {"learn": "body"}},
            r"hindsight\.learn: found 'body'; expected one of 'all', 'masks', 'place', 'confidence', 'reads'",
        ),
        ({"hindsight": {"controls": 1.0}}, r"hindsight: controls is 1\.0; expected a fraction from 0 to 1, 1 excluded"),
        (
            {"data": {"control": "shifted"}, "hindsight": {"controls": 0.1}},
            r"data\.control is shifted and hindsight\.controls is 0\.1; expected one of them",
        ),
    ],
)
def test_settings_that_cannot_be_used_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_mapping(TrainConfig, {**LEAST, **given})


def test_only_the_confidence_has_controls_and_a_run_on_controls_has_none_of_its_own() -> None:
    assert HindsightSettings(controls=0.1).needs_controls
    assert not HindsightSettings(controls=0.1, learn="masks").needs_controls
    given = {"data": {"control": "foreign"}, "hindsight": {"learn": "masks", "controls": 0.1}}
    assert from_mapping(TrainConfig, {**LEAST, **given}).hindsight == HindsightSettings(learn="masks", controls=0.1)
