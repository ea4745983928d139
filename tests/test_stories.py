"""Stories and their recordings: objects in hands, occlusion, and reads that agree with the truth."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.radio.coherence import coherence, phase_residual
from tagjax.recording import Recording
from tagjax.sim.record import CaptureSettings, simulate_recording
from tagjax.sim.rendering.raycast import Raycaster
from tagjax.sim.rendering.sensors import kinect_v2_intrinsics
from tagjax.sim.rendering.viewpoint import look_at
from tagjax.sim.rendering.visibility import intervals, sampled_steps, surface_points, visible_fraction
from tagjax.sim.stories import STORIES, build_scenario
from tagjax.sim.world.bodies import STEP_S, Material, Shape, rotation_matrix, tag_path
from tagjax.sim.world.objects import bounds
from tagjax.sim.world.sightline import chord_m, is_free, line_of_sight

PLAIN = Material((0.5, 0.5, 0.5))

LONG_S = {"enter_leave": 12.0, "shop_handover": 19.0}
"""Durations of the stories that need more than 3 s."""

SMALL = CaptureSettings(width=64, frame_rate_hz=5.0, jitter_s=0.0)


def _build(name: str, duration_s: float = 3.0, seed: int = 1, **settings):
    return build_scenario(name, np.random.default_rng(seed), duration_s, settings)


def _object(scenario, number: int):
    return scenario.world.bodies[scenario.world.tags[number].body]


@pytest.fixture(scope="module")
def waved():
    return _build("handheld", kinds=("box", "toy"), stationary_s=0.3)


@pytest.fixture(scope="module")
def two(waved) -> Recording:
    return simulate_recording(waved, dataclasses.replace(SMALL, flow=True), seed=7, name="two")


@pytest.mark.parametrize("name", STORIES)
def test_every_story_gives_a_possible_world(name):
    scenario = _build(name, LONG_S.get(name, 3.0))
    scenario.world.check()
    epcs = [tag.epc for tag in scenario.world.tags]
    assert epcs
    assert len(set(epcs)) == len(epcs)
    named = {(body.name, body.label) for body in scenario.world.bodies if body.label}  # a person has many limbs
    assert sorted(label for _, label in named) == list(range(1, len(scenario.world.names) + 1))
    again = _build(name, LONG_S.get(name, 3.0))
    for one, other in zip(scenario.world.bodies, again.world.bodies, strict=True):
        np.testing.assert_array_equal(one.poses.position_m, other.poses.position_m)


def test_unknown_stories_and_settings_are_refused():
    with pytest.raises(ValueError, match="story is 'juggle'; expected one of handheld"):
        _build("juggle")
    with pytest.raises(ValueError, match="unknown setting colour; expected settings among room, kinds"):
        _build("handheld", colour=3)
    with pytest.raises(ValueError, match="positive duration"):
        _build("handheld", 0.0)
    with pytest.raises(ValueError, match="expected one kind"):
        _build("handheld", notebook_occluder=True, kinds=("box", "toy"))


@pytest.mark.parametrize("speed_m_s", [0.5, 2.5])
def test_the_object_is_stationary_then_moves_at_the_given_speed(speed_m_s):
    scenario = _build("handheld", 6.0, kinds=("bottle",), stationary_s=2.0, speed_m_s=speed_m_s)
    path = _object(scenario, 0).poses.position_m
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / STEP_S
    assert speed[: int(1.7 / STEP_S)].max() < 0.02
    # An arm that cannot reach as far as its wave goes is clamped, and then slower.
    assert 0.7 * speed_m_s < speed.max() < 1.25 * speed_m_s


def test_lookalikes_are_identical_and_others_differ():
    scenario = _build("handheld", kinds=("bottle", "toy", "box", "bottle"), lookalikes=("bottle",))
    one, other = _object(scenario, 0), _object(scenario, 3)
    assert one.name == other.name == "bottle"
    assert one.shapes == other.shapes
    plain = _build("handheld", kinds=("bottle", "bottle"))
    assert _object(plain, 0).shapes != _object(plain, 1).shapes


def test_objects_in_one_grip_are_one_rigid_body():
    scenario = _build("handheld", kinds=("bottle", "box"), one_grip=True)
    one, other = _object(scenario, 0).poses, _object(scenario, 1).poses
    apart = np.einsum("tji,tj->ti", rotation_matrix(one.quaternion), other.position_m - one.position_m)
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-9)
    assert 0.03 < np.linalg.norm(apart[0]) < 0.4


def test_a_handed_over_object_goes_from_one_to_the_other_without_a_jump():
    scenario = _build("handover", 6.0)
    path = _object(scenario, 0).poses.position_m
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() / STEP_S < 4.0
    people = {}
    for body in scenario.world.bodies:
        if body.role == "person":
            people.setdefault(body.name, []).append(body.poses.position_m)
    away = [np.linalg.norm(np.mean(parts, axis=0)[:, :2] - path[:, :2], axis=1) for parts in people.values()]
    assert away[0][0] < away[1][0]
    assert away[1][-1] < away[0][-1]


def test_an_object_put_down_stays_and_the_hand_leaves():
    scenario = _build("put_down", 6.0)
    path = _object(scenario, 0).poses.position_m
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / STEP_S
    assert speed[:340].max() > 0.5
    assert speed.max() < 4.0
    np.testing.assert_array_equal(path[-1], path[380])
    stand = next(body for body in scenario.world.bodies if body.name == "stand")
    # It stands on the stand: bottom on top.
    bottom = path[-1, 2] - _half_height(scenario)
    assert bottom == pytest.approx(2 * stand.shapes[0].size_m[2], abs=1e-6)
    hands = [body.poses.position_m for body in scenario.world.bodies if body.role == "person"]
    nearest = np.min([np.linalg.norm(hand - path, axis=1) for hand in hands], axis=0)
    assert nearest[-1] > nearest[330] + 0.1


def _half_height(scenario) -> float:
    low, high = bounds(_object(scenario, 0).shapes)
    return float(high[2] - low[2]) / 2


def test_the_notebook_occludes_the_object_for_a_while():
    scenario = _build("handheld", 6.0, kinds=("bottle",), notebook_occluder=True)
    seen = simulate_recording(scenario, dataclasses.replace(SMALL, width=128), seed=1, name="passing")
    assert seen.truth is not None
    area = np.sum(np.asarray(seen.truth.labels) == 1, axis=(1, 2))
    time_s = seen.frame_time_s()
    before, during = area[time_s < 2.5].mean(), area[(time_s > 4.0) & (time_s < 4.6)].mean()
    after = area[time_s > 5.6].mean()
    assert before > 20
    assert during < 0.3 * before
    assert after > 0.5 * before


def test_static_tags_are_read_but_not_labelled():
    scenario = _build("handheld", num_static_tags=5)
    assert len(scenario.world.tags) == 6
    labelled = [tag.epc for tag in scenario.world.tags if scenario.world.bodies[tag.body].label]
    assert len(labelled) == 1
    recording = simulate_recording(scenario, SMALL, seed=3, name="still")
    assert recording.truth is not None
    assert set(recording.truth.tag_to_label) == set(labelled)
    assert len(recording.reads.epcs) >= 3  # far ones are too weak


HELD = {"crowd": 12, "enter_leave": 2, "handheld": 1, "shop_exit": 1}
"""Stories and the number of their tags on objects that one person holds from first to last; in the others it is none."""


@pytest.mark.parametrize("name", STORIES)
def test_a_held_object_has_the_holder_whose_limbs_it_stays_with(name):
    world = _build(name, LONG_S.get(name, 3.0)).world
    held = [world.bodies[tag.body] for tag in world.tags if world.bodies[tag.body].holder]
    assert len(held) == HELD.get(name, 0)
    for body in held:
        limbs = [limb for limb in world.bodies if limb.name == body.holder and limb.role == "person"]
        # One limb of the holder, the hand, keeps its distance from the object.
        spread = [np.ptp(np.linalg.norm(limb.poses.position_m - body.poses.position_m, axis=1)) for limb in limbs]
        others = [
            np.ptp(np.linalg.norm(limb.poses.position_m - body.poses.position_m, axis=1))
            for limb in world.bodies
            if limb.role == "person" and limb.name != body.holder and limb.poses.moves
        ]
        assert min(spread) < 0.05
        assert not others or min(others) > 2 * min(spread)


def test_the_carriers_box_holds_the_person_and_all_that_the_person_holds():
    scenario = _build("crowd", num_people=2, objects_each=2)
    recording = simulate_recording(
        scenario, dataclasses.replace(SMALL, width=128), seed=2, name="carried", num_frames=8
    )
    truth, world = recording.truth, scenario.world
    assert truth is not None
    assert truth.boxes_px is not None
    assert set(truth.carrier_box_px) == {tag.epc for tag in world.tags}
    one, other, third, _ = (truth.carrier_box_px[tag.epc] for tag in world.tags)
    np.testing.assert_array_equal(one, other)  # one person's two hands
    assert np.nanmax(np.abs(one - third)) > 5
    larger = []
    for tag in world.tags:
        carrier_px, own_px = truth.carrier_box_px[tag.epc], truth.boxes_px[:, truth.tag_to_label[tag.epc] - 1]
        shown = np.isfinite(own_px[:, 0])
        assert (carrier_px[shown, :2] <= own_px[shown, :2]).all()
        assert (carrier_px[shown, 2:] >= own_px[shown, 2:]).all()
        size = [np.prod(box[shown, 2:] - box[shown, :2] + 1, axis=1) for box in (carrier_px, own_px)]
        larger += list(size[0] / size[1])
    assert len(larger) > 5
    assert np.median(larger) > 4


def test_tracks_are_at_the_given_distance():
    scenario = _build("tabletop", num_objects=2, tracks="parallel", spacing_m=0.164)
    one, other = (_object(scenario, number).poses.position_m for number in (0, 1))
    np.testing.assert_allclose(np.abs(one[:, 0] - other[:, 0]), 0.164, atol=1e-9)
    np.testing.assert_allclose(one[:, 1], other[:, 1], atol=1e-9)


def test_a_simulated_recording_has_its_truth(two):
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


def test_reads_are_coherent_with_the_true_range_and_not_with_another(waved, two):
    """Compared with the path at every hundredth of a second: frames are too far apart for a waving hand."""
    antenna = np.asarray(waved.antennas_m[0])
    time_s = np.arange(waved.world.num_steps) * STEP_S
    ranges = {tag.epc: np.linalg.norm(tag_path(waved.world, tag) - antenna, axis=1) for tag in waved.world.tags}
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
        if np.median(reads.rssi_dbm) > -60:  # in a fade, reflections matter
            assert own > 0.95
            assert own > other + 0.2


@pytest.mark.parametrize("shutter_s", [0.0, 0.02])
def test_shadows_can_be_disabled(waved, shutter_s):
    capture = dataclasses.replace(SMALL, frame_rate_hz=1.0, shutter_s=shutter_s)
    dark, lit = (
        simulate_recording(waved, dataclasses.replace(capture, shadows=shadows), seed=2, name="x", num_frames=2).colour[
            1
        ]
        for shadows in (True, False)
    )
    assert np.mean(np.asarray(lit, float) - np.asarray(dark, float)) > 1.0


def test_lines_are_free_where_they_cross_nothing(waved):
    rng = np.random.default_rng(0)
    low, high = np.array([0.0, -2.2, 0.0]), np.array([5.0, 2.2, 2.4])
    start, end = rng.uniform(low, high, (2, 2000, 3))
    steps = rng.integers(0, waved.world.num_steps, 2000)
    crossed = line_of_sight(waved.world, start, end, steps, exclude=(2,)).crossed.any(axis=1)
    free = is_free(waved.world, start, end, steps, exclude=(2,))
    assert 0.2 < free.mean() < 0.97
    np.testing.assert_array_equal(free, ~crossed)


@pytest.mark.parametrize("kind", ["box", "sphere", "capsule", "cylinder", "ellipsoid"])
def test_surface_points_lie_on_the_surface(kind):
    """Just outside of it on a line from the middle, and just inside."""
    shape = Shape(kind, (0.3, 0.2, 0.1), PLAIN, (0.5, -0.2, 1.0), (0.5, 0.5, -0.5, 0.5))
    points, middle = surface_points([shape]), np.array(shape.position_m)
    assert len(points) == 14
    for scale, meets in ((1.02, False), (0.98, True)):
        place = middle + scale * (points - middle)
        assert np.all((chord_m(shape, place, place + 1e-2 * (middle - points)) > 1e-4) == meets) or not meets
        beyond = chord_m(shape, middle + 1.02 * (points - middle), middle + 5.0 * (points - middle))
        assert beyond.max() < 1e-6
    assert chord_m(shape, np.broadcast_to(middle, points.shape), points) == pytest.approx(
        np.linalg.norm(points - middle, axis=1), abs=1e-6
    )


def test_visibility_by_geometry_agrees_with_ray_casting():
    """A notebook passes in front of a bottle: the visible fraction falls and rises with the pixels in its mask."""
    scenario = _build("handheld", 6.0, kinds=("bottle",), notebook_occluder=True)
    view = look_at(kinect_v2_intrinsics(256), scenario.camera_position_m, scenario.camera_look_at_m)
    raycaster, looks = Raycaster(scenario.world), sampled_steps(scenario.world, 0.1)
    fraction = visible_fraction(scenario.world, (scenario.world.tags[0].body,), view, looks)
    area = []
    for step in looks:
        raycaster.pose(int(step))
        area.append(np.sum(raycaster.labels(raycaster.cast(view)) == 1))
    area = np.array(area)
    assert looks[-1] == scenario.world.num_steps - 1
    assert np.all(area[fraction == 0] <= 2)
    assert np.all(area[fraction > 0.5] > 10)
    assert np.corrcoef(fraction, area)[0, 1] > 0.8
    # Turned to either side, up, down or round, the camera has it no longer in its picture.
    toward = np.mean(scenario.world.bodies[scenario.world.tags[0].body].poses.position_m[:20], axis=0) - view.position_m
    course, fall = np.arctan2(toward[1], toward[0]), np.arctan2(-toward[2], np.hypot(toward[0], toward[1]))
    for aside, down in ((0.0, 0.0), (0.9, 0.0), (-0.9, 0.0), (0.0, 0.8), (0.0, -0.8), (np.pi, -2 * fall)):
        yaw, dip = course + aside, fall + down
        ahead = np.array([np.cos(yaw) * np.cos(dip), np.sin(yaw) * np.cos(dip), -np.sin(dip)])
        turned = look_at(kinect_v2_intrinsics(256), view.position_m, view.position_m + ahead)
        seen = visible_fraction(scenario.world, (scenario.world.tags[0].body,), turned, looks[:3])
        assert seen.all() if aside == down == 0 else not seen.any()
    np.testing.assert_array_equal(intervals(np.array([1, 1, 0, 1, 0, 0, 1], bool)), [[0, 2], [3, 4], [6, 7]])
    assert len(intervals(np.zeros(4, bool))) == 0


def test_too_many_traces_or_people_are_refused():
    with pytest.raises(ValueError, match=r"leave train 1 4 traces in 1\.5 s; give more time"):
        _build("tabletop", 1.5, num_objects=2, num_traces=4)
    with pytest.raises(ValueError, match=r"No walk in and out within 3\.0 s for person 1 of 2"):
        _build("enter_leave", 3.0)
    with pytest.raises(ValueError, match="num_people is 3; expected 1 to 2"):
        _build("enter_leave", 15.0, num_people=3)


def test_static_tags_lie_near_the_antenna():
    scenario = _build("handheld", room="office", num_static_tags=12)
    antenna = np.array(scenario.antennas_m[0])
    away = [np.linalg.norm(tag_path(scenario.world, tag)[0] - antenna) for tag in scenario.world.tags[1:]]
    assert max(away) < 5.2


def test_ceiling_antennas_look_down():
    shop, meeting = _build("shop_exit"), _build("handheld")
    np.testing.assert_array_equal(shop.antenna_axes, [[0.0, 0.0, -1.0]] * 3)
    assert meeting.antenna_axes is None
    reads = simulate_recording(shop, dataclasses.replace(SMALL, frame_rate_hz=1.0), seed=1, name="down").reads
    up = dataclasses.replace(shop, antenna_axes=((0.0, 0.0, 1.0),) * 3)
    fewer = simulate_recording(up, dataclasses.replace(SMALL, frame_rate_hz=1.0), seed=1, name="up").reads
    assert fewer.num_reads < 0.7 * reads.num_reads


def test_the_same_seed_gives_the_same_bytes():
    one, other = (simulate_recording(_build("tabletop", 1.0), SMALL, seed=5, name="x") for _ in range(2))
    np.testing.assert_array_equal(one.colour, other.colour)
    np.testing.assert_array_equal(one.depth, other.depth)
    np.testing.assert_array_equal(one.reads.phase_rad, other.reads.phase_rad)
    another = simulate_recording(_build("tabletop", 1.0), SMALL, seed=6, name="x")
    assert not np.array_equal(one.colour, another.colour)


def test_two_objects_at_one_spot_are_refused(waved):
    first = _object(waved, 0)
    twin = dataclasses.replace(first, name="twin", label=9)
    world = dataclasses.replace(waved.world, bodies=(*waved.world.bodies, twin))
    with pytest.raises(ValueError, match="box and twin start 0 mm apart"):
        world.check()
    lost = dataclasses.replace(waved.world.tags[0], position_m=(9.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="leaves the room"):
        dataclasses.replace(waved.world, tags=(lost,)).check()
    with pytest.raises(ValueError, match="num_steps is 0; expected at least 1"):
        dataclasses.replace(waved.world, num_steps=0).check()


def test_impossible_captures_are_refused():
    scenario = _build("tabletop", 1.0)
    with pytest.raises(ValueError, match="num_frames is 500; expected 1 to 6"):
        simulate_recording(scenario, SMALL, seed=1, name="x", num_frames=500)
    with pytest.raises(ValueError, match="num_frames is 0"):
        simulate_recording(scenario, SMALL, seed=1, name="x", num_frames=0)
    with pytest.raises(ValueError, match="sensor is 'lidar'; expected one of kinect_v2"):
        CaptureSettings(sensor="lidar")
    with pytest.raises(ValueError, match="illumination is 'noon'"):
        CaptureSettings(illumination="noon")
