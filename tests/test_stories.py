"""Stories and their films: who holds what when, what hides what, and reads that fit the truth."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.recording import Recording
from tagjax.rf.coherence import coherence, phase_residual
from tagjax.sim.objects import bounds
from tagjax.sim.record import CaptureSettings, film
from tagjax.sim.stories import STORIES, tell
from tagjax.sim.world import STEP_S, rotation_matrix, tag_path

SMALL = CaptureSettings(width=64, frame_rate_hz=5.0, jitter_s=0.0)


def _tell(name: str, duration_s: float = 3.0, seed: int = 1, **settings):
    return tell(name, np.random.default_rng(seed), duration_s, settings)


def _object(filmed, number: int):
    return filmed.world.bodies[filmed.world.tags[number].body]


@pytest.fixture(scope="module")
def told():
    return _tell("handheld", kinds=("box", "toy"), still_s=0.3)


@pytest.fixture(scope="module")
def two(told) -> Recording:
    return film(told, dataclasses.replace(SMALL, flow=True), seed=7, name="two")


@pytest.mark.parametrize("name", STORIES)
def test_every_story_is_a_world_that_can_be(name):
    filmed = _tell(name)
    filmed.world.check()
    epcs = [tag.epc for tag in filmed.world.tags]
    assert epcs
    assert len(set(epcs)) == len(epcs)
    labels = [body.label for body in filmed.world.bodies if body.label]
    assert sorted(labels) == list(range(1, len(filmed.world.names) + 1))
    again = _tell(name)
    for one, other in zip(filmed.world.bodies, again.world.bodies, strict=True):
        np.testing.assert_array_equal(one.poses.position_m, other.poses.position_m)


def test_unknown_stories_and_settings_are_refused():
    with pytest.raises(ValueError, match="Unknown story 'juggle'; known are handheld"):
        _tell("juggle")
    with pytest.raises(ValueError, match="unknown setting colour; known are room, kinds"):
        _tell("handheld", colour=3)
    with pytest.raises(ValueError, match="positive duration"):
        _tell("handheld", 0.0)
    with pytest.raises(ValueError, match="before one object"):
        _tell("handheld", passing=True, kinds=("box", "toy"))


@pytest.mark.parametrize("speed_m_s", [0.5, 2.5])
def test_the_object_is_still_then_moves_as_fast_as_asked(speed_m_s):
    filmed = _tell("handheld", 6.0, kinds=("bottle",), still_s=2.0, speed_m_s=speed_m_s)
    path = _object(filmed, 0).poses.position_m
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / STEP_S
    assert speed[: int(1.7 / STEP_S)].max() < 0.02
    # An arm that cannot reach as far as its wave goes is clamped, and then slower.
    assert 0.7 * speed_m_s < speed.max() < 1.25 * speed_m_s


def test_look_alikes_look_alike_and_others_do_not():
    filmed = _tell("handheld", kinds=("bottle", "toy", "box", "bottle"), lookalikes=("bottle",))
    one, other = _object(filmed, 0), _object(filmed, 3)
    assert one.name == other.name == "bottle"
    assert one.shapes == other.shapes
    plain = _tell("handheld", kinds=("bottle", "bottle"))
    assert _object(plain, 0).shapes != _object(plain, 1).shapes


def test_objects_in_one_grip_are_one_rigid_thing():
    filmed = _tell("handheld", kinds=("bottle", "box"), one_grip=True)
    one, other = _object(filmed, 0).poses, _object(filmed, 1).poses
    apart = np.einsum("tji,tj->ti", rotation_matrix(one.quaternion), other.position_m - one.position_m)
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-9)
    assert 0.03 < np.linalg.norm(apart[0]) < 0.4


def test_a_handed_over_object_goes_from_one_to_the_other_without_a_jump():
    filmed = _tell("handover", 6.0)
    path = _object(filmed, 0).poses.position_m
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() / STEP_S < 4.0
    people = {}
    for body in filmed.world.bodies:
        if body.role == "person":
            people.setdefault(body.name, []).append(body.poses.position_m)
    away = [np.linalg.norm(np.mean(parts, axis=0)[:, :2] - path[:, :2], axis=1) for parts in people.values()]
    assert away[0][0] < away[1][0]
    assert away[1][-1] < away[0][-1]


def test_what_is_put_down_stays_and_the_hand_goes():
    filmed = _tell("put_down", 6.0)
    path = _object(filmed, 0).poses.position_m
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / STEP_S
    assert speed[:340].max() > 0.5
    assert speed.max() < 4.0
    np.testing.assert_array_equal(path[-1], path[380])
    stand = next(body for body in filmed.world.bodies if body.name == "stand")
    # It stands on the stand: bottom on top.
    bottom = path[-1, 2] - _half_height(filmed)
    assert bottom == pytest.approx(2 * stand.shapes[0].size_m[2], abs=1e-6)
    hands = [body.poses.position_m for body in filmed.world.bodies if body.role == "person"]
    nearest = np.min([np.linalg.norm(hand - path, axis=1) for hand in hands], axis=0)
    assert nearest[-1] > nearest[330] + 0.1


def _half_height(filmed) -> float:
    low, high = bounds(_object(filmed, 0).shapes)
    return float(high[2] - low[2]) / 2


def test_the_notebook_hides_the_object_and_lets_it_be_seen_again():
    filmed = _tell("handheld", 6.0, kinds=("bottle",), passing=True)
    seen = film(filmed, dataclasses.replace(SMALL, width=128), seed=1, name="passing")
    assert seen.truth is not None
    area = np.sum(np.asarray(seen.truth.labels) == 1, axis=(1, 2))
    time_s = seen.frame_time_s()
    before, during = area[time_s < 2.5].mean(), area[(time_s > 4.0) & (time_s < 4.6)].mean()
    after = area[time_s > 5.6].mean()
    assert before > 20
    assert during < 0.3 * before
    assert after > 0.5 * before


def test_still_tags_are_read_but_not_labelled():
    filmed = _tell("handheld", num_still_tags=5)
    assert len(filmed.world.tags) == 6
    labelled = [tag.epc for tag in filmed.world.tags if filmed.world.bodies[tag.body].label]
    assert len(labelled) == 1
    recording = film(filmed, SMALL, seed=3, name="still")
    assert recording.truth is not None
    assert set(recording.truth.tag_to_label) == set(labelled)
    assert len(recording.reads.epcs) >= 3  # far ones are too weak


def test_tracks_are_as_far_apart_as_asked():
    filmed = _tell("tabletop", num_objects=2, tracks="parallel", spacing_m=0.164)
    one, other = (_object(filmed, number).poses.position_m for number in (0, 1))
    np.testing.assert_allclose(np.abs(one[:, 0] - other[:, 0]), 0.164, atol=1e-9)
    np.testing.assert_allclose(one[:, 1], other[:, 1], atol=1e-9)


def test_a_film_is_a_recording_with_its_truth(two):
    two.check()
    truth = two.truth
    assert truth is not None
    labels = np.asarray(truth.labels)
    assert set(np.unique(labels)) <= {0, 1, 2}
    for epc, label in truth.tag_to_label.items():
        # The tag lies on the object: its projection is within a few pixels of the mask.
        k, place = two.intrinsics, truth.tag_position_m[epc]
        x = k.fx_px * place[:, 0] / place[:, 2] + k.cx_px
        y = k.fy_px * place[:, 1] / place[:, 2] + k.cy_px
        box = truth.boxes_px[:, label - 1]
        shown = np.isfinite(box[:, 0])
        assert shown.mean() > 0.8
        inside = (x > box[:, 0] - 3) & (x < box[:, 2] + 3) & (y > box[:, 1] - 3) & (y < box[:, 3] + 3)
        assert inside[shown].all()
        np.testing.assert_allclose(truth.tag_range_m[epc], np.linalg.norm(place - two.antennas_m[0], axis=1))
        assert np.all((truth.line_of_sight[epc] >= 0) & (truth.line_of_sight[epc] <= 1))
    assert truth.flow_px.shape == truth.backward_flow_px.shape == (two.num_frames, *two.image_shape, 2)
    assert np.isnan(np.asarray(truth.flow_px[-1])).all()
    assert np.isnan(np.asarray(truth.backward_flow_px[0])).all()


def test_reads_are_coherent_with_the_true_range_and_not_with_another(told, two):
    """Held against the path at every hundredth of a second: frames are too far apart for a waving hand."""
    antenna = np.asarray(told.antennas_m[0])
    time_s = np.arange(told.world.num_steps) * STEP_S
    ranges = {tag.epc: np.linalg.norm(tag_path(told.world, tag) - antenna, axis=1) for tag in told.world.tags}
    epcs = list(ranges)
    for number, epc in enumerate(epcs):
        reads = two.reads.select(epc)
        read_s = (reads.time_ns - two.time_ns[0]) * 1e-9
        channel = jnp.asarray(np.unique(reads.carrier_hz, return_inverse=True)[1], jnp.int32)

        def score(range_m, reads=reads, read_s=read_s, channel=channel):
            distance = np.interp(read_s, time_s, range_m) - range_m[0]
            residual = phase_residual(
                jnp.asarray(reads.phase_rad, jnp.float32),
                jnp.asarray(reads.carrier_hz, jnp.float32),
                jnp.asarray(distance, jnp.float32),
            )
            weight = jnp.ones(len(distance))
            return float(coherence(residual, weight, channel, num_channels=60, multiple=2))

        own, other = score(ranges[epc]), score(ranges[epcs[1 - number]])
        assert own > other
        if np.median(reads.rssi_dbm) > -60:  # a tag in a fade hears its reflections as well
            assert own > 0.95
            assert own > other + 0.2


def test_the_same_seed_films_the_same_bytes():
    one, other = (film(_tell("tabletop", 1.0), SMALL, seed=5, name="x") for _ in range(2))
    np.testing.assert_array_equal(one.colour, other.colour)
    np.testing.assert_array_equal(one.depth, other.depth)
    np.testing.assert_array_equal(one.reads.phase_rad, other.reads.phase_rad)
    another = film(_tell("tabletop", 1.0), SMALL, seed=6, name="x")
    assert not np.array_equal(one.colour, another.colour)


def test_two_objects_in_one_place_are_refused(told):
    first = _object(told, 0)
    twin = dataclasses.replace(first, name="twin", label=9)
    world = dataclasses.replace(told.world, bodies=(*told.world.bodies, twin))
    with pytest.raises(ValueError, match="box and twin start 0 mm apart"):
        world.check()
    lost = dataclasses.replace(told.world.tags[0], position_m=(9.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="leaves the room"):
        dataclasses.replace(told.world, tags=(lost,)).check()
    with pytest.raises(ValueError, match="A world of 0 steps"):
        dataclasses.replace(told.world, num_steps=0).check()


def test_impossible_films_are_refused():
    filmed = _tell("tabletop", 1.0)
    with pytest.raises(ValueError, match="500 frames asked for; the world lasts for 6"):
        film(filmed, SMALL, seed=1, name="x", num_frames=500)
    with pytest.raises(ValueError, match="0 frames asked for"):
        film(filmed, SMALL, seed=1, name="x", num_frames=0)
    with pytest.raises(ValueError, match="Unknown sensor 'lidar'; known are kinect_v2"):
        CaptureSettings(sensor="lidar")
    with pytest.raises(ValueError, match="Unknown illumination"):
        CaptureSettings(illumination="noon")
