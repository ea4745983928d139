"""TagVision: blobs, tracks, and the whole system on a small drawn recording."""

from __future__ import annotations

import dataclasses

import cv2
import jax
import numpy as np
import pytest
import tagvision_scenes as scenes

from tagjax.baselines import Detection, HostCamera, host_frames, host_trace, trace_from_detections
from tagjax.baselines.tagvision import TagVisionSettings, TagVisionTracer
from tagjax.baselines.tagvision.detection import BlobSettings, backward_flow, find_blobs
from tagjax.baselines.tagvision.experiment.simulated_calibration import PAPER_CAMERA, overhead
from tagjax.baselines.tagvision.matching import MatchSettings
from tagjax.baselines.tagvision.tracks import Tracks, TrackSettings, track_blobs
from tagjax.metrics import recordings as evaluate
from tagjax.recording import Recording, RecordingError, TagReads

QUICK = MatchSettings(num_rounds=20)


# blobs and tracks


def _blobs(first: np.ndarray, second: np.ndarray, settings: BlobSettings, elapsed_s: float = 0.06):
    before, now = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (first, second))
    flow = backward_flow(now, before, settings.flow)
    return find_blobs(second, flow, cv2.absdiff(now, before), elapsed_s, scenes.OVER, 0.0, settings)


STILL = np.array([[-0.6, 0.3], [0.5, -0.4]])


@pytest.mark.parametrize("flow", ["farneback", "dis", "lucas_kanade"])
def test_moving_discs_are_blobs(flow: str) -> None:
    rng = np.random.default_rng(14)
    step = np.array([[0.05, 0.02], [-0.03, 0.05]])
    found = _blobs(scenes.picture(STILL, rng), scenes.picture(STILL + step, rng), BlobSettings(flow=flow))
    centres = scenes.OVER.to_picture(np.column_stack([STILL + step, np.zeros(2)]))
    assert len(found) == 2
    for blob in found:
        number = int(np.argmin(np.linalg.norm(centres - blob.centre_px, axis=1)))
        assert np.linalg.norm(centres[number] - blob.centre_px) < 0.6
        assert blob.area_px == pytest.approx(np.pi * (scenes.RADIUS_M * 64) ** 2, rel=0.2)
        moved = step[number] * [64, -64]
        np.testing.assert_allclose(blob.flow_px, moved, atol=1.0)
        assert blob.full_mask((scenes.HEIGHT, scenes.WIDTH)).sum() == blob.area_px
    assert _blobs(scenes.picture(STILL, rng), scenes.picture(STILL, rng), BlobSettings(flow=flow)) == []


def test_blobs_have_a_size_and_a_speed() -> None:
    rng = np.random.default_rng(15)
    pictures = scenes.picture(STILL, rng), scenes.picture(STILL + 0.05, rng)
    area = np.pi * scenes.RADIUS_M**2
    assert len(_blobs(*pictures, BlobSettings())) == 2
    assert _blobs(*pictures, BlobSettings(min_area_m2=2 * area, max_area_m2=1.0)) == []
    assert _blobs(*pictures, BlobSettings(min_area_m2=0.001, max_area_m2=0.5 * area)) == []
    assert _blobs(*pictures, BlobSettings(max_speed_m_s=0.5)) == []
    assert _blobs(*pictures, BlobSettings(min_speed_m_s=2.0)) == []
    with pytest.raises(ValueError, match="min_area_m2"):
        BlobSettings(min_area_m2=1.0)


def test_shadows_are_removed_from_blobs() -> None:
    rng = np.random.default_rng(16)
    step = np.array([0.05, 0.02])
    before, now = (scenes.picture(STILL + shift, rng, shadow_px=6.0) for shift in (0 * step, step))
    centres = scenes.OVER.to_picture(np.column_stack([STILL + step, np.zeros(2)]))

    def error(settings: BlobSettings) -> float:
        found = _blobs(before, now, settings)
        return max(min(float(np.linalg.norm(blob.centre_px - c)) for blob in found) for c in centres)

    assert error(BlobSettings()) < 0.6
    assert error(BlobSettings(remove_shadows=False, max_area_m2=0.5)) > 1.0


def _walk(num_frames: int) -> np.ndarray:
    """Three paths (frames, 3, 2): two that pass each other 0.33 m apart, one that stops on the way."""
    share = np.linspace(0, 1, num_frames)[:, None]
    one = np.array([-1.0, 0.17]) + share * np.array([2.0, 0.0])
    two = np.array([1.0, -0.16]) + share * np.array([-2.0, 0.0])
    three = np.array([-0.9, 0.75]) + np.clip(2.5 * share, 0, 1) * np.array([1.2, 0.0])
    return np.stack([one, two, three], axis=1)


def _followed(paths: np.ndarray, settings: TrackSettings | None = None) -> list[Tracks]:
    rng, state, states = np.random.default_rng(17), Tracks(), []
    pictures = [scenes.picture(positions, rng) for positions in paths]
    for number, picture in enumerate(pictures):
        blobs = _blobs(pictures[number - 2], picture, BlobSettings()) if number >= 2 else []
        state = track_blobs(state, picture, blobs, number / 30, settings or TrackSettings())
        states.append(state)
    return states


def test_tracks_keep_their_numbers_past_others_and_while_still() -> None:
    paths = _walk(60)
    states = _followed(paths)
    truth = np.stack([scenes.OVER.to_picture(np.column_stack([positions, np.zeros(3)])) for positions in paths])
    owners = []
    for number in (6, 25, 30, 35, 59):
        tracks = states[number].tracks
        assert len(tracks) == 3
        away = np.linalg.norm(np.array([t.centre_px for t in tracks])[None] - truth[number][:, None], axis=-1)
        assert np.all(away.min(axis=1) < 1.5)
        owners.append([tracks[i].number for i in away.argmin(axis=1)])
    assert all(one == owners[0] for one in owners)
    assert len(set(owners[0])) == 3
    # The third stands still since frame 24: no blob, but its colours support it.
    still = next(track for track in states[-1].tracks if track.number == owners[0][2])
    assert still.is_seen()
    assert still.blob_s < 1.2


def test_a_track_without_support_ends() -> None:
    paths = _walk(20)
    rng, states = np.random.default_rng(18), _followed(paths)
    state, empty = states[-1], scenes.picture(np.empty((0, 2)), rng)
    assert len(state.tracks) == 3
    settings = TrackSettings(max_unseen_s=0.2)
    for number in range(20, 25):
        state = track_blobs(state, empty, [], number / 30, settings)
        assert not any(track.is_seen() for track in state.tracks)
        assert not any(track.full_mask((scenes.HEIGHT, scenes.WIDTH)).any() for track in state.tracks)
    for number in range(25, 28):
        state = track_blobs(state, empty, [], number / 30, settings)
    assert state.tracks == ()
    assert state.next_number == states[-1].next_number


# the whole system


@pytest.fixture(scope="module")
def drawn() -> Recording:
    return scenes.drawn_recording()


SYSTEM = TagVisionSettings(match=dataclasses.replace(QUICK, pairing="interpolate"))


@pytest.fixture(scope="module")
def traces(drawn: Recording) -> list:
    return list(host_trace(TagVisionTracer(scenes.OVER, SYSTEM), drawn))


def test_the_system_detects_and_identifies_tagged_objects(drawn: Recording, traces: list) -> None:
    assert drawn.truth is not None
    late = [(number, trace) for number, trace in traces if number >= 40]
    for number, trace in late:
        for tag, epc in enumerate(scenes.EPCS):
            assert trace.detected[tag]
            true = np.asarray(drawn.truth.labels)[number] == drawn.truth.tag_to_label[epc]
            mask = trace.mask[tag] > 0.5
            assert np.sum(mask & true) / np.sum(mask | true) > 0.7
            rows, columns = np.nonzero(mask)
            assert trace.box_px[tag].tolist() == [columns.min(), rows.min(), columns.max(), rows.max()]
            np.testing.assert_allclose(trace.centre_px[tag], [columns.mean(), rows.mean()], atol=1e-3)
            true_m = drawn.truth.tag_position_m[epc][number]
            assert np.linalg.norm(trace.centre_m[tag] - true_m) < 0.04
            assert 0.5 < trace.confidence[tag] <= 1
    antenna = np.asarray(drawn.antennas_m[0])
    true_steps = np.diff(np.linalg.norm(drawn.truth.tag_position_m[scenes.EPCS[0]] - antenna, axis=1))[40:]
    steps = np.array([trace.step_m[0, 0] for number, trace in traces if number >= 41])
    assert np.corrcoef(steps, true_steps)[0, 1] > 0.7


def test_its_traces_are_scored_by_the_same_code(drawn: Recording) -> None:
    settings = evaluate.ScoreSettings(from_s=1.0, num_pictures=1)
    names = drawn.resolve_epcs(None)
    traces = host_trace(TagVisionTracer(scenes.OVER, SYSTEM), drawn, epcs=names)
    result = evaluate.score_traces(traces, drawn, names, settings=settings)
    scores = result.scores().result()
    assert (scores["iou"] or 0) > 0.7
    assert (scores["identification"] or 0) > 0.95
    assert (scores["cle_px"] or 99) < 5


def test_later_frames_change_nothing(drawn: Recording, traces: list) -> None:
    part = list(host_trace(TagVisionTracer(scenes.OVER, SYSTEM), drawn, frames=(0, 35)))
    assert len(part) == 35
    for (number, one), (other, two) in zip(part, traces, strict=False):
        assert number == other
        for mine, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_steps_do_not_modify_the_given_state(drawn: Recording) -> None:
    tracer, setup = (
        TagVisionTracer(scenes.OVER, SYSTEM),
        HostCamera(scenes.FLAT, np.asarray(drawn.antennas_m), scenes.EPCS),
    )

    def sizes(state) -> tuple[int, ...]:
        return len(state.positions), len(state.read_time_s), len(state.tracks.tracks), len(state.pictures)

    state, kept = tracer.init(setup), []
    for frame in host_frames(drawn, scenes.EPCS, (0, 12)):
        kept.append((state, sizes(state)))
        state, _ = tracer.step(setup, state, frame)
    assert all(sizes(before) == size for before, size in kept)
    finished = tracer.finish(state)
    assert finished.pictures == ()
    assert finished.tracks is state.tracks


def test_memory_is_bounded(drawn: Recording) -> None:
    tracer = TagVisionTracer(scenes.OVER, dataclasses.replace(SYSTEM, memory_s=0.5))
    setup = HostCamera(scenes.FLAT, np.asarray(drawn.antennas_m), scenes.EPCS)
    state = tracer.init(setup)
    for frame in host_frames(drawn, scenes.EPCS, (0, 30)):
        state, _ = tracer.step(setup, state, frame)
    assert len(state.positions) <= 16
    newest_s = max(time_s for time_s, _ in state.positions)
    assert state.read_time_s.min() >= newest_s - 0.5
    assert len(state.pictures) <= 4


def test_frames_bring_every_read_once(drawn: Recording) -> None:
    frames = list(host_frames(drawn, scenes.EPCS[:1]))
    own = drawn.reads.select(scenes.EPCS[0])
    until = own.time_ns <= drawn.time_ns[-1]
    got = np.concatenate([frame.reads.time_ns for frame in frames])
    np.testing.assert_array_equal(got, own.time_ns[until])
    assert all(frame.read_time_s.size == 0 or frame.read_time_s[-1] <= frame.time_s + 1e-9 for frame in frames)
    late = next(iter(host_frames(drawn, scenes.EPCS[:1], (20, 22))))
    assert len(late.reads.time_ns) == sum(len(frame.reads.time_ns) for frame in frames[:21])
    with pytest.raises(RecordingError, match="frames 0 to 99"):
        next(host_frames(drawn, scenes.EPCS, (0, 99)))


def test_where_the_method_does_not_apply_the_reason_is_given(drawn: Recording) -> None:
    def reason(tracer: TagVisionTracer, recording: Recording = drawn) -> str:
        found = tracer.inapplicable(recording)
        assert found is not None
        return found

    assert TagVisionTracer(scenes.OVER).inapplicable(drawn) is None
    assert "no calibration" in reason(TagVisionTracer(None))
    assert "1280 x 720" in reason(TagVisionTracer(overhead(PAPER_CAMERA, (0.0, 0.0, 2.0))))
    assert "antenna 2 has no known position" in reason(TagVisionTracer(scenes.OVER, TagVisionSettings(antenna=2)))
    unknown = dataclasses.replace(drawn.reads, carrier_hz=np.full(drawn.reads.num_reads, np.nan))
    assert "known carrier" in reason(TagVisionTracer(scenes.OVER), drawn.with_reads(unknown))
    with pytest.raises(RecordingError, match="TagVisionTracer does not apply: no calibration"):
        next(host_trace(TagVisionTracer(None), drawn))
    with pytest.raises(RecordingError, match="no tag to trace"):
        next(host_trace(TagVisionTracer(scenes.OVER), drawn.with_reads(TagReads.empty())))


def _damaged(drawn: Recording, part: str) -> Recording:
    reads, phase = drawn.reads, drawn.reads.phase_rad.copy()
    phase[3] = np.nan
    changes: dict[str, dict] = {
        "unsorted": {"reads": reads[np.arange(reads.num_reads)[::-1]]},
        "phase": {"reads": dataclasses.replace(reads, phase_rad=phase)},
        "size": {"colour": drawn.colour[:, 1:]},
        "grey": {"colour": drawn.colour[..., 0]},
        "floats": {"colour": drawn.colour[:] / np.float32(255)},
        "antenna": {"antennas_m": np.full((1, 3), np.nan)},
        "backwards": {"time_ns": drawn.time_ns[::-1].copy()},
        "focal": {"intrinsics": dataclasses.replace(drawn.intrinsics, fx_px=float("nan"))},
    }
    return dataclasses.replace(drawn, **changes[part])


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("unsorted", "time goes back"),
        ("phase", "1 of .* values of phase_rad are not finite"),
        ("size", "colour is uint8 of shape .* from times and intrinsics"),
        ("grey", "height, width, RGB"),
        ("floats", "colour is float32"),
        ("antenna", "expected finite"),
        ("backwards", "strictly increasing times"),
        ("focal", "fx_px is nan"),
    ],
)
def test_a_damaged_recording_is_refused(drawn: Recording, part: str, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        next(host_trace(TagVisionTracer(scenes.OVER), _damaged(drawn, part)))


def test_depth_may_be_missing(drawn: Recording) -> None:
    blind = dataclasses.replace(drawn, depth=np.zeros_like(drawn.depth))
    assert next(host_trace(TagVisionTracer(scenes.OVER), blind))[0] == 0


def test_blobs_without_tags_and_tags_without_blobs() -> None:
    rng = np.random.default_rng(20)
    still = np.stack([scenes.picture(STILL, rng) for _ in range(12)])
    time_s, paths = scenes.curves(1, 12)
    reads, _ = scenes.make_reads({scenes.EPCS[0]: paths[0]}, time_s, scenes.ANTENNA, rate_hz=100)
    recording = Recording(
        colour=still,
        depth=np.full((12, scenes.HEIGHT, scenes.WIDTH), 2500, np.uint16),
        time_ns=np.rint(time_s * 1e9).astype(np.int64),
        intrinsics=scenes.FLAT,
        reads=reads,
        antennas_m=scenes.OVER.to_camera(scenes.ANTENNA[None]),
    )
    traces = list(host_trace(TagVisionTracer(scenes.OVER, SYSTEM), recording))
    assert len(traces) == 12
    for _, trace in traces:
        assert not trace.detected.any()
        assert not trace.mask.any()
        assert not trace.confidence.any()


def test_detections_become_a_trace() -> None:
    mask = np.zeros((6, 8), bool)
    mask[2:4, 3:7] = True
    empty = Detection(np.zeros((6, 8), bool), np.zeros(3), 0.9)
    boxed = Detection(mask, np.array([1.0, 2.0, 3.0]), 0.3, box_px=np.array([0.0, 1.0, 2.0, 3.0]), step_m=0.1)
    trace = trace_from_detections([Detection(mask, np.full(3, np.nan), 0.8), None, empty, boxed], (6, 8))
    assert trace.detected.tolist() == [True, False, False, True]
    assert trace.box_px[0].tolist() == [3, 2, 6, 3]
    assert trace.centre_px[0].tolist() == [4.5, 2.5]
    assert trace.box_px[3].tolist() == [0, 1, 2, 3]
    assert float(trace.confidence[2]) == 0.0
    assert float(trace.step_m[3, 0]) == pytest.approx(0.1)
    assert trace_from_detections([], (6, 8)).mask.shape == (0, 6, 8)
