"""Moving blobs without pixel fusion: detection, tracks, evidence of phases, assignment, and the whole tracer."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
import synthetic_clips as synthetic

from tagjax.baselines import host_trace
from tagjax.baselines.blobs import BlobSettings, BlobTracer
from tagjax.baselines.blobs.detection import Blob, connected_parts, foreground
from tagjax.baselines.blobs.matching import coherent_evidence
from tagjax.baselines.blobs.tracks import Track, follow
from tagjax.metrics.recordings import ScoreSettings, score_traces

SETTINGS = BlobSettings()
HEIGHT, WIDTH, FOCAL_PX = 96, 128, 100.0
C_M_S = 299_792_458.0


def _rays() -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    return np.stack([(x - WIDTH / 2) / FOCAL_PX, (y - HEIGHT / 2) / FOCAL_PX, np.ones_like(x)], axis=-1)


def _depth(*boxes: tuple[slice, slice, float], wall_m: float = 4.0) -> np.ndarray:
    depth = np.full((HEIGHT, WIDTH), wall_m, np.float32)
    for rows, columns, depth_m in boxes:
        depth[rows, columns] = depth_m
    return depth


NEAR = slice(30, 60), slice(20, 50), 1.5
FAR = slice(30, 60), slice(50, 80), 2.5  # its left edge touches the right edge of NEAR in the picture


def _parts(depth_m: np.ndarray, moving: np.ndarray | None = None, *, edge_m: float = 0.3) -> list[Blob]:
    moving = depth_m < 4.0 if moving is None else moving
    return connected_parts(moving, depth_m, _rays(), edge_m, SETTINGS.min_area_m2)


# Detection


def _watch(depths: list[np.ndarray], colours: list[np.ndarray] | None = None) -> list[np.ndarray]:
    background, found = None, []
    for number, depth in enumerate(depths):
        colour = np.full((HEIGHT, WIDTH, 3), 90, np.uint8) if colours is None else colours[number]
        moving, background = foreground(background, colour, depth, 1 / 30, SETTINGS)
        found.append(moving)
    return found


def test_what_comes_nearer_than_the_background_is_foreground() -> None:
    found = _watch([_depth()] * 20 + [_depth(NEAR)])
    assert not any(one.any() for one in found[:20])
    np.testing.assert_array_equal(found[-1], _depth(NEAR) < 4.0)


def test_depth_noise_and_shadows_are_no_foreground() -> None:
    rng = np.random.default_rng(1)
    noisy = [_depth() + rng.normal(0, 0.01, (HEIGHT, WIDTH)).astype(np.float32) for _ in range(20)]
    assert max(one.mean() for one in _watch(noisy)) < 1e-3
    light = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    shadow = light.copy()
    shadow[20:50, 20:50] = 60
    assert not _watch([_depth()] * 2, [light, shadow])[-1].any()
    # Where there is no depth, colour is all there is.
    blind = _depth((slice(0, HEIGHT), slice(0, WIDTH), 0.0))
    assert _watch([blind] * 2, [light, shadow])[-1][25:45, 25:45].all()


def test_a_place_that_is_left_is_background_at_once() -> None:
    found = _watch([_depth(NEAR)] * 5 + [_depth()] * 2 + [_depth(NEAR)])
    assert not found[5].any()
    assert found[-1].any()


def test_two_boxes_that_touch_in_the_picture_are_two_blobs() -> None:
    near, far = sorted(_parts(_depth(NEAR, FAR)), key=lambda blob: blob.centre_m[2])
    for blob, (rows, columns, depth_m) in ((near, NEAR), (far, FAR)):
        middle = np.array([(columns.start + columns.stop - 1) / 2, (rows.start + rows.stop - 1) / 2])
        want = np.append((middle - [WIDTH / 2, HEIGHT / 2]) / FOCAL_PX, 1.0) * depth_m
        # The pixels at a step in depth belong to neither, which moves the centre by half a pixel.
        np.testing.assert_allclose(blob.centre_m, want, atol=1.0 * depth_m / FOCAL_PX)
        full = blob.full_mask((HEIGHT, WIDTH))
        assert full.sum() > 0.8 * 30 * 30
        assert full[rows, columns].sum() == full.sum()
    assert len(_parts(_depth(NEAR, FAR), edge_m=1.5)) == 1


def test_blobs_have_a_minimum_area_on_the_surface() -> None:
    assert _parts(_depth()) == []
    side = 6
    assert side**2 * (1.0 / FOCAL_PX) ** 2 > SETTINGS.min_area_m2 > side**2 * (0.5 / FOCAL_PX) ** 2
    for depth_m, number in ((1.0, 1), (0.5, 0)):
        assert len(_parts(_depth((slice(10, 10 + side), slice(10, 10 + side), depth_m)))) == number


def test_foreground_without_depth_takes_the_nearest() -> None:
    depth = _depth(NEAR)
    moving = depth < 4.0
    depth[40:45, 30:35] = 0.0
    (blob,) = _parts(depth, moving)
    assert blob.full_mask((HEIGHT, WIDTH))[40:45, 30:35].all()
    assert blob.centre_m[2] == pytest.approx(1.5)


# Tracks


def _blob(centre_m: np.ndarray) -> Blob:
    return Blob(np.asarray(centre_m, float), np.ones((2, 2), bool), (0, 0))


def test_a_track_is_a_kalman_filter_of_constant_velocity() -> None:
    """Against the textbook's matrices in six dimensions."""
    rng = np.random.default_rng(3)
    q, r, elapsed = 1.2, 0.02, 0.04
    move = np.kron(np.array([[1, elapsed], [0, 1]]), np.eye(3))
    push = np.kron(np.array([[elapsed**3 / 3, elapsed**2 / 2], [elapsed**2 / 2, elapsed]]) * q, np.eye(3))
    look = np.hstack([np.eye(3), np.zeros((3, 3))])
    state, covariance = np.concatenate([[0.1, 0.2, 2.0], np.zeros(3)]), np.kron(np.diag([r**2, 1.0]), np.eye(3))
    track = Track(0, 0.0, 0.0, state[:3], state[3:], np.diag([r**2, 1.0]), None)
    for number in range(20):
        centre = state[:3] + rng.normal(0, 0.1, 3)
        state, covariance = move @ state, move @ covariance @ move.T + push
        gain = covariance @ look.T @ np.linalg.inv(look @ covariance @ look.T + r**2 * np.eye(3))
        state, covariance = state + gain @ (centre - look @ state), (np.eye(6) - gain @ look) @ covariance
        track = track.predicted(elapsed, q).measured(_blob(centre), number * elapsed, r)
        np.testing.assert_allclose(np.concatenate([track.position_m, track.velocity_m_s]), state, atol=1e-9)
        np.testing.assert_allclose(np.kron(track.covariance, np.eye(3)), covariance, atol=1e-9)


def test_tracks_keep_their_numbers_when_two_bodies_pass() -> None:
    tracks: tuple[Track, ...] = ()
    number = 0
    for frame in range(60):
        x = -0.6 + 0.02 * frame
        blobs = [_blob(np.array([x, 0.0, 2.0])), _blob(np.array([-x, 0.0, 2.3]))]
        order = [0, 1] if frame % 2 else [1, 0]
        tracks, number = follow(tracks, [blobs[one] for one in order], frame / 30, 1 / 30, number, SETTINGS)
    assert number == 2
    depth_of = {track.number: track.position_m[2] for track in tracks}
    assert sorted(depth_of.values()) == pytest.approx([2.0, 2.3], abs=0.01)
    assert depth_of[1] < depth_of[0]  # the first frame has the nearer one last


def test_a_track_that_is_not_seen_ends() -> None:
    tracks, number = follow((), [_blob(np.array([0.0, 0, 2]))], 0.0, 0.0, 0, SETTINGS)
    gone = SETTINGS.max_unseen_s
    tracks, number = follow(tracks, [], 0.9 * gone, 0.9 * gone, number, SETTINGS)
    assert len(tracks) == 1
    assert tracks[0].blob is None
    tracks, number = follow(tracks, [], 1.1 * gone, 0.2 * gone, number, SETTINGS)
    assert tracks == ()
    _, number = follow(tracks, [_blob(np.array([0.0, 0, 2]))], 1.2 * gone, 0.1 * gone, number, SETTINGS)
    assert number == 2


# Evidence


def _reads(path_m: np.ndarray, seed: int, *, flips: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    num = len(path_m)
    channel = np.arange(num) // 9 % 5
    carrier = 902.75e6 + 3e6 * channel
    phase = 4 * np.pi * carrier / C_M_S * path_m + rng.uniform(0, 2 * np.pi, 5)[channel] + rng.normal(0, 0.2, num)
    return phase + np.pi * (rng.random(num) < 0.1) * flips, carrier, channel


def test_the_evidence_is_the_integrated_likelihood_ratio() -> None:
    """Against a sum over the channels' unknown offsets on a fine grid."""
    path = 2.0 + 0.3 * np.sin(np.arange(25) / 8)
    phase, carrier, channel = _reads(path, 2)
    std = 0.5
    k = 1 / (2 * std) ** 2
    offset = np.linspace(0, 2 * np.pi, 4001)[:-1]
    want = 0.0
    for number in np.unique(channel):
        own = channel == number
        moving, still = (
            np.mean(np.exp(k * np.sum(np.cos(2 * (phase[own] - travel)[:, None] - offset), axis=0)))
            for travel in (4 * np.pi * carrier[own] / C_M_S * path[own], np.zeros(own.sum()))
        )
        want += np.log(moving / still)
    (found,) = coherent_evidence(phase, carrier, channel, path[None], std)
    assert found == pytest.approx(want, rel=1e-9)
    one = coherent_evidence(phase[:1], carrier[:1], channel[:1], np.array([[1.0], [7.0]]), std)
    np.testing.assert_allclose(one, 0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_the_right_track_wins(seed: int) -> None:
    time = np.arange(120) / 40
    right, other = 2.0 + 0.2 * np.sin(4 * time), 2.0 + 0.2 * np.sin(4 * time + 1.5)
    phase, carrier, channel = _reads(right, seed)
    unknown = np.where(time < 1.5, right, np.nan)
    ranges = np.stack([right, other, np.full_like(right, 2.0), unknown, right + 1.0])
    evidence = coherent_evidence(phase, carrier, channel, ranges, 0.3)
    assert evidence[0] > SETTINGS.min_evidence
    assert evidence[0] > evidence[1] + 10
    assert evidence[2] == pytest.approx(0.0, abs=1e-6)
    assert 0 < evidence[3] < evidence[0]
    assert evidence[4] == pytest.approx(evidence[0], rel=0.05)  # a constant is no change of range
    turned = coherent_evidence(phase + np.pi * (np.arange(120) % 3 == 0), carrier, channel, ranges, 0.3)
    np.testing.assert_allclose(turned, evidence, atol=1e-6)


# The whole


def test_moving_boxes_are_found_and_told_apart() -> None:
    """The first frame is empty; the lens is so long that a box of 40 x 55 pixels covers little."""
    recording = synthetic.enlarged(synthetic.recording(60), 5)
    depth = np.array(recording.depth)
    depth[0] = 4.0
    recording = dataclasses.replace(recording, depth=depth)
    epcs = recording.resolve_epcs(None)
    traces = list(host_trace(BlobTracer(BlobSettings(min_area_m2=1e-6)), recording, epcs=epcs))
    scores = score_traces(iter(traces), recording, epcs, settings=ScoreSettings(num_pictures=0, from_s=1.5))
    result = scores.scores().result()
    assert result["identification"] == 1.0
    assert result["iou"] > 0.85  # the pixels at the edges belong to no blob
    assert [number for number, _ in traces] == list(range(60))
    assert all(np.isfinite(leaf).all() for _, trace in traces for leaf in jax.tree.leaves(trace))


def test_a_recording_without_depth_or_placed_antennas_is_refused() -> None:
    recording = synthetic.recording(10)
    blind = dataclasses.replace(recording, depth=np.zeros_like(np.asarray(recording.depth)))
    assert BlobTracer().inapplicable(blind) == "no depth"
    nowhere = dataclasses.replace(recording.reads, antenna=np.full(recording.reads.num_reads, 9))
    assert "antenna" in str(BlobTracer().inapplicable(recording.with_reads(nowhere)))
    assert BlobTracer().inapplicable(recording) is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"gate_m": 0.0}, "gate_m"),
        ({"memory_s": float("nan")}, "memory_s"),
        ({"nearer_fraction": 1.0}, "nearer_fraction"),
        ({"part_edge_m": 0.5}, "part_edge_m"),
    ],
)
def test_wrong_settings_are_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BlobSettings(**wrong)
