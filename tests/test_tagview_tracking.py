"""Tagview's camera side and the whole system: boxes, SORT, detector, weights, tracer, evaluation."""

from __future__ import annotations

import dataclasses
import json

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from tagjax.baselines import HostCamera, HostFrame, host_trace
from tagjax.baselines.boxes import box_centre_px, box_iou, box_size_px, non_maximum_suppression
from tagjax.baselines.tagview import TagviewSettings, TagviewTracer, load_weights, save_weights
from tagjax.baselines.tagview.default_boxes import decode, default_boxes, encode, targets
from tagjax.baselines.tagview.detection import (
    AbstractDetector,
    BoxDetector,
    DetectorSettings,
    MotionDetector,
    make_detector,
)
from tagjax.baselines.tagview.experiment import TagviewExperiment, report_markdown, run_tagview
from tagjax.baselines.tagview.experiment.run import Matching
from tagjax.baselines.tagview.experiment.scoring import objects_of_traces, track_recording, visible_stretches
from tagjax.baselines.tagview.matching import MatchSettings
from tagjax.baselines.tagview.network import BoxNetwork
from tagjax.baselines.tagview.tracer import undistorted
from tagjax.baselines.tagview.tracks import BoxTracks, SortSettings, track_boxes
from tagjax.baselines.tagview.training import (
    LabelledFrame,
    TrainSettings,
    detection_loss,
    labelled_frames,
    measure_detector,
    train_detector,
)
from tagjax.recording import Intrinsics, Recording, RecordingError, TagReads, Truth

WAVELENGTH_M = 0.3276
CARRIER_HZ = 299_792_458.0 / WAVELENGTH_M


# Boxes


def test_overlap_and_suppression():
    boxes = np.array([[0.0, 0, 9, 9], [5, 0, 14, 9], [20, 20, 29, 29], [0, 0, -1, -1]])
    shared = box_iou(boxes, boxes)
    np.testing.assert_allclose(np.diag(shared), [1, 1, 1, 0])
    assert shared[0, 1] == pytest.approx(1 / 3)
    assert shared[0, 2] == 0
    np.testing.assert_array_equal(non_maximum_suppression(boxes[:3], np.array([0.5, 0.9, 0.7]), 0.3), [1, 2])
    np.testing.assert_array_equal(non_maximum_suppression(boxes[:3], np.array([0.5, 0.9, 0.7]), 0.4), [1, 2, 0])
    assert non_maximum_suppression(np.zeros((0, 4)), np.zeros(0), 0.3).shape == (0,)


def test_a_box_of_one_pixel_has_its_centre_on_it():
    box = np.array([[3.0, 5.0, 3.0, 5.0]])
    np.testing.assert_array_equal(box_centre_px(box), [[3.0, 5.0]])
    np.testing.assert_array_equal(box_size_px(box), [[1.0, 1.0]])


# SORT


def _square(x, y, side=10.0):
    half = (side - 1) / 2
    return np.array([x - half, y - half, x + half, y + half])


def test_tracks_follow_and_predict_constant_motion():
    state, settings = BoxTracks(), SortSettings()
    for frame in range(20):
        state = track_boxes(state, np.array([_square(20 + 3.0 * frame, 40 - 1.0 * frame)]), settings)
    (track,) = state.tracks
    assert track.number == 1
    assert track.confirmed
    np.testing.assert_allclose(track.mean[[0, 1, 4, 5]], [77.0, 21.0, 3.0, -1.0], atol=0.1)
    unseen = track_boxes(track_boxes(state, np.zeros((0, 4)), settings), np.zeros((0, 4)), settings)
    np.testing.assert_allclose(box_centre_px(unseen.tracks[0].box_px), [83.0, 19.0], atol=0.3)
    assert unseen.tracks[0].missed == 2
    assert state.tracks[0].missed == 0


def test_the_filter_is_the_kalman_filter():
    """One prediction and update against the equations in information form."""
    settings = SortSettings()
    first = track_boxes(BoxTracks(), _square(50, 50)[None], settings)
    second = track_boxes(first, _square(53, 49, 11)[None], settings).tracks[0]
    p = np.diag([10.0, 10, 10, 10, 1e4, 1e4, 1e4])
    move = np.eye(7) + np.eye(7, k=4)
    p = move @ p @ move.T + np.diag([1, 1, 1, 1e-2, 0.25, 0.25, 1e-2])
    see, noise = np.eye(4, 7), np.diag([1.0, 1, 10, 10])
    posterior = np.linalg.inv(np.linalg.inv(p) + see.T @ np.linalg.inv(noise) @ see)
    prior = np.array([50.0, 50, 100, 1, 0, 0, 0])
    mean = posterior @ (np.linalg.inv(p) @ prior + see.T @ np.linalg.inv(noise) @ np.array([53.0, 49, 121, 1]))
    np.testing.assert_allclose(second.mean, mean, rtol=1e-6)
    np.testing.assert_allclose(second.covariance, posterior, rtol=1e-6, atol=1e-8)


def test_objects_that_pass_each_other_keep_their_numbers_and_hidden_ones_end():
    settings = SortSettings(max_missed=2)
    state = BoxTracks()
    for frame in range(12):
        boxes = [_square(10 + 4.0 * frame, 20), _square(60 - 4.0 * frame, 33)]
        state = track_boxes(state, np.array(boxes), settings)
    numbers = {track.number: track.mean[0] for track in state.tracks}
    assert numbers[1] > numbers[2]
    for _ in range(3):
        state = track_boxes(state, np.array([_square(12, 33)]), settings)
    assert {track.number for track in state.tracks} == {2}
    state = track_boxes(state, np.array([_square(12, 33), _square(90, 20)]), settings)
    assert max(track.number for track in state.tracks) == 3
    assert not state.tracks[-1].confirmed
    with pytest.raises(ValueError, match="min_iou"):
        SortSettings(min_iou=1.0)


# The detector


def test_offsets_are_inverted_and_every_object_has_a_target():
    defaults = default_boxes(32, 48)
    assert defaults.shape == (8 * 12 * 4, 4)
    np.testing.assert_allclose(box_centre_px(defaults)[0], [1.5, 1.5])
    truth = np.array([[4.0, 6.0, 16.0, 14.0], [30.0, 10.0, 46.0, 26.0]])
    np.testing.assert_allclose(decode(encode(truth, defaults[:2]), defaults[:2]), truth)
    label, offset = targets(truth, np.zeros((0, 4)), defaults)
    shared = box_iou(defaults, truth)
    for number in range(2):
        assert label[shared[:, number].argmax()] == 1
    np.testing.assert_allclose(decode(offset, defaults)[label == 1], truth[shared.argmax(1)][label == 1])
    assert not offset[label != 1].any()
    assert set(label[shared.max(1) < 0.39]) <= {0, 1}
    ignored, _ = targets(np.zeros((0, 4)), truth[:1], defaults)
    assert set(ignored) == {0, -1}


@pytest.mark.ci
def test_the_loss_counts_the_hardest_negatives_and_has_gradients():
    network = BoxNetwork((4, 6, 8), 1, key=jax.random.key(0))
    images = jax.random.uniform(jax.random.key(1), (2, 16, 16, 3))
    output = jax.jit(jax.vmap(network))(images)
    labels = jnp.zeros((2, 64), jnp.int32).at[0, 5].set(1).at[1, 7].set(-1)
    offsets = jnp.zeros((2, 64, 4)).at[0, 5].set(jnp.asarray([3.0, 0.1, -0.2, 0.0]))
    loss, gradient = eqx.filter_jit(eqx.filter_value_and_grad(detection_loss))(network, images, labels, offsets, 3.0)
    odds = np.array(output[0], np.float64)
    negative = np.sort(np.log1p(np.exp(odds[np.array(labels) == 0])))[::-1][:3]
    difference = np.abs(np.array(output[1][0, 5]) - np.array(offsets[0, 5]))
    smooth = np.where(difference < 1, 0.5 * difference**2, difference - 0.5)
    assert float(loss) == pytest.approx(np.log1p(np.exp(-odds[0, 5])) + negative.sum() + smooth.sum(), rel=1e-4)
    leaves = jax.tree.leaves(gradient)
    assert all(np.all(np.isfinite(leaf)) for leaf in leaves)
    assert any(np.any(np.asarray(leaf) != 0) for leaf in leaves)
    none = eqx.filter_jit(detection_loss)(network, images, jnp.zeros((2, 64), jnp.int32), jnp.zeros((2, 64, 4)), 3.0)
    assert np.isfinite(float(none))


def _pictures(count, seed=0, size=(48, 64)):
    """Bright blocks on dim noise."""
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(count):
        image = rng.integers(40, 80, (*size, 3)).astype(np.uint8)
        x, y = int(rng.integers(4, size[1] - 20)), int(rng.integers(4, size[0] - 16))
        image[y : y + 11, x : x + 13] = (230, 210, 220)
        frames.append(LabelledFrame(image, np.array([[x, y, x + 12, y + 10]], np.float64), np.zeros((0, 4))))
    return frames


@pytest.mark.ci
def test_training_lowers_the_loss_and_weights_are_read_back(tmp_path):
    settings = TrainSettings(
        num_steps=60, batch_size=4, crop_px=(32, 48), widths=(4, 8, 8), depth=1, learning_rate=0.01
    )
    seen = []
    network, recipe = train_detector(_pictures(20), settings, on_progress=lambda *one: seen.append(one))
    assert [one[:3] for one in seen] == [("train", step, 60) for step in range(61)]
    losses = [float(one[3].removeprefix("loss ")) for one in seen[1:]]
    assert recipe["steps_done"] == 60
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:10])
    about = {"network": {"widths": [4, 8, 8], "depth": 1}, "recipe": recipe}
    save_weights(tmp_path / "d.npz", network, about)
    again, stored = load_weights(tmp_path / "d.npz")
    assert stored["recipe"]["num_steps"] == 60
    # Files hold half precision: the network read is the one written, rounded to it.
    rounded = jax.tree.map(lambda leaf: leaf.astype(jnp.float16).astype(jnp.float32), network)
    for one, other in zip(jax.tree.leaves(rounded), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    written, read = (BoxDetector(one, DetectorSettings(width_px=64, min_score=0.05)) for one in (rounded, again))
    num_boxes = 0
    for picture in _pictures(5, seed=9):
        _, boxes, scores = written.detect(None, picture.image)
        _, boxes_read, scores_read = read.detect(None, picture.image)
        np.testing.assert_allclose(boxes_read, boxes, atol=1e-6)
        np.testing.assert_allclose(scores_read, scores, atol=1e-6)
        num_boxes += len(boxes)
    assert num_boxes > 0
    with pytest.raises(ValueError, match="No frame"):
        train_detector([], settings)


def test_foreign_weights_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no readable weights of a Tagview detector"):
        load_weights(tmp_path / "missing.safetensors")
    (tmp_path / "text.safetensors").write_text("hello")
    with pytest.raises(ValueError, match="no readable weights of a Tagview detector"):
        load_weights(tmp_path / "text.safetensors")
    safetensors.numpy.save_file({"a": np.ones(3)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="but no weights of a Tagview detector"):
        load_weights(tmp_path / "other.safetensors")
    network = BoxNetwork((4, 6, 8), 1, key=jax.random.key(0))
    save_weights(tmp_path / "small.safetensors", network, {"network": {"widths": [4, 6, 9], "depth": 1}})
    with pytest.raises(
        ValueError, match=r"float16 of shape \(3, 3, 6, 8\); this network has floats of shape \(3, 3, 6, 9\)"
    ):
        load_weights(tmp_path / "small.safetensors")
    broken = eqx.tree_at(lambda n: n.head.bias, network, jnp.full(20, jnp.nan))
    with pytest.raises(ValueError, match="not finite"):
        save_weights(tmp_path / "nan.safetensors", broken, {"network": {"widths": [4, 6, 8], "depth": 1}})
    with pytest.raises(ValueError, match="network"):
        save_weights(tmp_path / "bare.safetensors", network, {})


@pytest.mark.parametrize(
    "network",
    [
        {"widths": [4, 6], "depth": 1},
        {"widths": [4, 6, "8"], "depth": 1},
        {"widths": [0, 6, 8], "depth": 1},
        {"widths": [4, 6, 100_000], "depth": 1},
        {"widths": [4.0, 6, 8], "depth": 1},
        {"widths": None, "depth": 1},
        {"widths": [4, 6, 8], "depth": 0},
        {"widths": [4, 6, 8], "depth": 1_000_000},
        {"widths": [4, 6, 8], "depth": True},
        {"widths": [4, 6, 8]},
    ],
)
def test_a_file_with_invalid_network_settings_is_refused_before_the_network_is_built(tmp_path, network):
    save_weights(tmp_path / "odd.npz", BoxNetwork((4, 6, 8), 1, key=jax.random.key(0)), {"network": network})
    with pytest.raises(ValueError, match=r"odd\.npz: no valid settings of its network: .* depth of 1 to 32"):
        load_weights(tmp_path / "odd.npz")


def test_the_packaged_detector_is_small_and_holds_its_training():
    network, about = load_weights()
    assert about["training"]["steps_done"] > 0
    assert about["validation"]["num_objects"] > 0
    assert isinstance(make_detector(DetectorSettings()), BoxDetector)
    assert sum(leaf.size for leaf in jax.tree.leaves(network)) < 200_000


def test_each_object_is_detected_at_most_once():
    class Fixed(AbstractDetector):
        def init(self):
            return None

        def detect(self, state, image):
            return None, np.array([[0.0, 0, 9, 9], [1, 0, 10, 9], [40, 40, 49, 49]]), np.ones(3)

    frame = LabelledFrame(np.zeros((64, 64, 3), np.uint8), np.array([[0.0, 0, 9, 9]]), np.array([[40.0, 40, 48, 48]]))
    scores = measure_detector(Fixed(), [frame])
    assert scores["precision"] == 0.5
    assert scores["recall"] == 1.0
    assert scores["error_px"] == 0.0


def test_motion_against_a_still_background_is_detected():
    detector = MotionDetector(DetectorSettings(kind="motion", width_px=128))
    rng = np.random.default_rng(0)
    still = rng.integers(60, 90, (96, 128, 3)).astype(np.uint8)
    state, found = detector.init(), []
    for frame in range(30):
        image = still.copy()
        image[30:42, 10 + 3 * frame : 26 + 3 * frame] = 220
        state, boxes, scores = detector.detect(state, image)
        found.append(boxes)
        assert len(boxes) == len(scores)
    assert all(len(boxes) == 1 for boxes in found[10:])
    np.testing.assert_allclose(box_centre_px(found[-1])[0], [104.5, 35.5], atol=2.0)


# The lens


def test_undistortion_inverts_the_lens():
    lens = Intrinsics(200.0, 210.0, 64.0, 48.0, 128, 96, (-0.2, 0.05, 0.001, -0.002, 0.0))
    direction = np.array([[0.1, -0.05], [-0.25, 0.2], [0.0, 0.0]])
    points = np.concatenate([direction, np.ones((3, 1))], axis=1)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix(), np.array(lens.distortion))
    found = undistorted(pixels.reshape(-1, 2), np.array([True, True, False]), lens)
    np.testing.assert_allclose(found[:2], direction[:2], atol=1e-5)
    np.testing.assert_array_equal(found[2], [0.0, 0.0])


# The system

HEIGHT_M, FOCAL_PX, SIZE = 2.4, 90.0, (96, 128)


class Perfect(AbstractDetector):
    """Boxes of bright blocks, by threshold."""

    def init(self):
        return None

    def detect(self, state, image):
        _, _, stats, _ = cv2.connectedComponentsWithStats((image[..., 0] > 200).astype(np.uint8))
        last = stats[1:, :2] + stats[1:, 2:4] - 1
        boxes = np.concatenate([stats[1:, :2], last], axis=1)
        return None, boxes.astype(np.float64), np.ones(len(boxes))


def _recording(num=2, *, epcs=("A", "B"), frames=75, hidden=(), apart_m=0.05, name="ceiling_2-all-test-0"):
    """Blocks on circles below a camera, each with a tag; `hidden` frames do not show the first."""
    time = np.arange(frames) / 15
    phase0, rate = np.array([0.0, 2.0])[:num], np.array([1.1, -1.7])[:num]
    angle = phase0[:, None] + rate[:, None] * time
    centre = np.array([[-0.5, 0.0], [0.6, 0.3]])[:num]
    place = centre[:, None] + 0.4 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    pixels = np.round(place / HEIGHT_M * FOCAL_PX + [63.5, 47.5]).astype(int)
    place = (pixels - [63.5, 47.5]) * HEIGHT_M / FOCAL_PX
    colour = np.full((frames, *SIZE, 3), 50, np.uint8)
    boxes = np.full((frames, num, 4), np.nan, np.float32)
    for frame in range(frames):
        for thing in range(num):
            if thing == 0 and frame in hidden:
                continue
            x, y = pixels[thing, frame]
            colour[frame, y - 4 : y + 5, x - 4 : x + 5] = 230
            boxes[frame, thing] = (x - 4, y - 4, x + 4, y + 4)
    antenna = np.array([apart_m, 0.0, 0.0])
    rng, parts = np.random.default_rng(0), []
    for thing, epc in enumerate(epcs[:num]):
        own = np.sort(rng.uniform(0, time[-1], 250))
        at = np.stack([np.interp(own, time, column) for column in place[thing].T], axis=-1)
        range_m = np.linalg.norm(np.column_stack([at, np.full(250, HEIGHT_M)]) - antenna, axis=1)
        parts.append((own, [epc] * 250, range_m))
    when = np.concatenate([part[0] for part in parts] or [np.zeros(0)])
    order = np.argsort(when)
    range_m = np.concatenate([part[2] for part in parts] or [np.zeros(0)])[order]
    count = len(when)
    reads = TagReads(
        epc=np.array([epc for part in parts for epc in part[1]], dtype="<U4")[order] if count else np.empty(0, "<U4"),
        time_ns=(when[order] * 1e9).astype(np.int64) + 1,
        antenna=np.ones(count, np.int16),
        carrier_hz=np.full(count, CARRIER_HZ),
        phase_rad=np.mod(4 * np.pi / WAVELENGTH_M * range_m + 1.0, 2 * np.pi),
        rssi_dbm=(-60 - 40 * np.log10(range_m / HEIGHT_M)).astype(np.float32),
        doppler_hz=np.zeros(count, np.float32),
    )
    position = {epc: np.column_stack([place[thing], np.full(frames, HEIGHT_M)]) for thing, epc in enumerate(epcs[:num])}
    truth = Truth(boxes_px=boxes, tag_to_label={e: i + 1 for i, e in enumerate(epcs[:num])}, tag_position_m=position)
    return Recording(
        colour=colour,
        depth=np.full((frames, *SIZE), 2400, np.uint16),
        time_ns=(time * 1e9).astype(np.int64),
        intrinsics=Intrinsics(FOCAL_PX, FOCAL_PX, 63.5, 47.5, SIZE[1], SIZE[0]),
        reads=reads,
        antennas_m=antenna[None],
        truth=truth,
        name=name,
    )


def _tracer(**match):
    settings = TagviewSettings(
        detector=DetectorSettings(kind="motion"),
        match=MatchSettings(origin="antenna", min_relative_spread=0.1, **match),
    )
    return TagviewTracer(settings, detector=Perfect())


def test_the_tracer_detects_identifies_and_locates_every_tag():
    recording = _recording()
    traces = [trace for _, trace in host_trace(_tracer(), recording, epcs=["B", "A"])]
    last = traces[-1]
    assert np.asarray(last.detected).all()
    assert recording.truth is not None
    boxes = np.asarray(recording.truth.boxes_px)[-1][[1, 0]]
    np.testing.assert_allclose(last.box_px, boxes, atol=1.0)
    true_m = [recording.truth.tag_position_m[epc][-1] for epc in ("B", "A")]
    np.testing.assert_allclose(last.centre_m, true_m, atol=0.08)
    assert np.all(np.asarray(last.confidence) > 0.95)
    assert not np.asarray(traces[0].detected).any()
    ranges = [np.linalg.norm(recording.truth.tag_position_m["A"][i] - recording.antennas_m[0]) for i in (-2, -1)]
    assert float(last.step_m[1, 0]) == pytest.approx(ranges[1] - ranges[0], abs=0.012)


def test_a_known_height_locates_tags_independently_of_the_slope():
    recording = _recording()
    # With the phases of another carrier the fit estimates a higher ceiling.
    reads = dataclasses.replace(recording.reads, carrier_hz=np.full(recording.reads.num_reads, 0.8 * CARRIER_HZ))
    recording = dataclasses.replace(recording, reads=reads)
    assert recording.truth is not None
    true_m = np.array([recording.truth.tag_position_m[epc][-1] for epc in ("B", "A")])
    place_m = {}
    for height_m in (None, HEIGHT_M):
        settings = dataclasses.replace(_tracer().settings, height_m=height_m)
        *_, (_, last) = host_trace(TagviewTracer(settings, detector=Perfect()), recording, epcs=["B", "A"])
        assert np.asarray(last.detected).all()
        place_m[height_m] = np.asarray(last.centre_m)
    assert np.all(place_m[None][:, 2] > 1.1 * HEIGHT_M)
    np.testing.assert_allclose(place_m[HEIGHT_M], true_m, atol=0.03)
    with pytest.raises(ValueError, match=r"height_m is -1"):
        TagviewSettings(height_m=-1.0)


def test_a_step_does_not_modify_the_state():
    recording, tracer = _recording(), _tracer()
    camera = HostCamera(recording.intrinsics, np.asarray(recording.antennas_m), ("A", "B"))
    frame = HostFrame(0, 0.0, np.asarray(recording.colour[0]), TagReads.empty(), np.zeros(0))
    start = tracer.init(camera)
    after, _ = tracer.step(camera, start, frame)
    assert len(start.boxes) == 0
    again, _ = tracer.step(camera, start, frame)
    assert len(after.boxes) == len(again.boxes) == 1
    later, _ = tracer.step(camera, after, dataclasses.replace(frame, number=1, time_s=1e3))
    assert len(later.boxes) == 1  # the memory is bounded


def test_where_tagview_does_not_apply():
    recording = _recording()
    assert _tracer().inapplicable(recording) is None
    far = dataclasses.replace(recording, antennas_m=np.array([[0.0, 1.0, 0.0]]))
    assert "1.00 m from the camera" in str(_tracer().inapplicable(far))
    silent = recording.with_reads(TagReads.empty())
    assert "no read" in str(_tracer().inapplicable(silent))
    with pytest.raises(RecordingError, match="no tag"):
        list(host_trace(_tracer(), silent))
    with pytest.raises(RecordingError, match="does not apply"):
        list(host_trace(_tracer(), far))


def test_more_tags_than_objects_and_no_object_in_sight():
    recording = _recording()
    alone = dataclasses.replace(recording, colour=np.full_like(np.asarray(recording.colour), 50))
    assert not any(np.asarray(trace.detected).any() for _, trace in host_trace(_tracer(), alone))
    one = _recording(1)
    both = one.with_reads(recording.reads)
    *_, (_, last) = host_trace(_tracer(), both)
    np.testing.assert_array_equal(np.asarray(last.detected), [True, False])


def test_a_hidden_object_is_identified_again():
    recording = _recording(hidden=range(30, 42))
    tracer = TagviewTracer(dataclasses.replace(_tracer().settings, memory_s=1e9), detector=Perfect())
    seen = track_recording(tracer, recording)
    assert sorted(seen.object_of.tolist()) == [0, 0, 1]
    found, _ = tracer.identify(seen.camera, seen.state)
    np.testing.assert_array_equal(found.tag_of, seen.object_of)


def test_boxes_before_the_confirmation_belong_to_the_trace():
    recording = _recording(hidden=range(30, 42))
    tracer = TagviewTracer(dataclasses.replace(_tracer().settings, memory_s=1e9), detector=Perfect())
    seen = track_recording(tracer, recording)
    for thing, true_px in enumerate(seen.truth_px):
        own = np.isfinite(seen.box_px[seen.object_of == thing, :, 0]).any(axis=0)
        np.testing.assert_array_equal(own, np.isfinite(true_px[:, 0]))


# Evaluation


def test_stretches_and_owners():
    seen = np.ones(40, bool)
    seen[10:13] = False
    seen[20:27] = False
    seen[38] = False
    assert visible_stretches(seen, 5) == [(0, 20), (27, 40)]
    assert visible_stretches(seen, 14) == [(0, 20)]
    assert visible_stretches(np.zeros(4, bool), 1) == []
    truth = np.stack([np.tile(_square(20, 20), (6, 1)), np.tile(_square(60, 20), (6, 1))])
    truth[1, 3:] = np.nan
    boxes = np.stack([truth[0] + 1.0, np.tile(_square(60, 21), (6, 1)), np.tile(_square(90, 90), (6, 1))])
    boxes[0, :2] = np.nan
    np.testing.assert_array_equal(objects_of_traces(boxes, truth), [0, 1, -1])


def test_a_run_writes_its_report(tmp_path, monkeypatch):
    folder = tmp_path / "rec" / "ceiling_2" / "test"
    folder.mkdir(parents=True)
    (folder / "ceiling_2-all-test-0.zarr").mkdir()
    monkeypatch.setattr("tagjax.baselines.tagview.experiment.run.open_recording", lambda path: _recording())
    monkeypatch.setattr("tagjax.baselines.tagview.tracer.make_detector", lambda settings: Perfect())
    match = MatchSettings(origin="antenna", min_relative_spread=0.1)
    config = TagviewExperiment(
        recordings_dir=str(tmp_path / "rec"),
        suites=("ceiling_2",),
        matching={"tagview": Matching(match), "alone": Matching(dataclasses.replace(match, programme=False))},
    )
    metrics = run_tagview(config, tmp_path / "out")
    got = metrics["groups"]["ceiling_2"]["tagview"]
    assert (got["accuracy"], got["precision"], got["recall"]) == (1.0, 1.0, 1.0)
    assert got["tracking_error_px"] < 1.0
    assert metrics["pairs"]["r_squared"]["correct"][0] > 0.95
    assert json.loads((tmp_path / "out" / "metrics.json").read_text()) == json.loads(json.dumps(metrics))
    assert "(0.99)" in (tmp_path / "out" / "report.md").read_text() == report_markdown(metrics)
    for name in ("pairs.png", "accuracy.png", "tracks.png", "recordings.csv"):
        assert (tmp_path / "out" / name).stat().st_size > 0
    with pytest.raises(ValueError, match="no recording"):
        run_tagview(dataclasses.replace(config, suites=("ceiling_9",)), tmp_path / "none")
    with pytest.raises(ValueError, match="main"):
        TagviewExperiment(suites=("a",), matching={})


def test_frames_with_truth_are_labelled():
    recording = _recording(hidden=range(10))
    frames = labelled_frames(recording, stride=5)
    assert len(frames) == 15
    assert [len(frame.objects_px) for frame in frames[:3]] == [1, 1, 2]
    tiny = labelled_frames(recording, stride=5, min_side_px=12.0)
    assert [len(frame.ignored_px) for frame in tiny[:3]] == [1, 1, 2]
    with pytest.raises(ValueError, match="no true boxes"):
        labelled_frames(dataclasses.replace(recording, truth=None))
