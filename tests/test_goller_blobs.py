"""Goller et al.: blob detection and tracking on drawn scenes."""

from __future__ import annotations

import dataclasses

import goller_scenes as scenes
import numpy as np
import pytest

from tagjax.baselines.goller.blob_location import BlobLocator
from tagjax.baselines.goller.detection import BlobSettings, empty_scene
from tagjax.baselines.goller.room import RoomFrame, find_room_frame
from tagjax.baselines.goller.slots import assign_slots
from tagjax.baselines.goller.tracks import Blob, BlobTracker
from tagjax.recording import Intrinsics, Recording


@pytest.fixture(scope="module")
def shop():
    return scenes.shop()


def _track(recording: Recording, settings: BlobSettings):
    tracker = BlobTracker(settings, find_room_frame(recording), recording.intrinsics)
    tracker.warm_up(empty_scene(recording))
    times = recording.frame_time_s()
    return [
        tracker.step(recording.colour[t], recording.depth_metres(t), float(times[t]))
        for t in range(recording.num_frames)
    ]


@pytest.mark.parametrize("position", ["centre", "depth"])
def test_a_walker_is_one_blob_without_its_shadow(shop, position):
    out = _track(shop, dataclasses.replace(scenes.LOOKING_DOWN.blobs, position=position))
    path = scenes.straight((4.6, 0.3), (-1.6, 0.3))
    identities = {blob.identity for blobs, _ in out for blob in blobs}
    assert len(identities) == 1
    observed = [t for t, (blobs, _) in enumerate(out) if blobs]
    # It is reported from 0.3 m of travel until it disappears.
    assert np.linalg.norm(path[observed[0]] - path[0]) < 0.55
    assert len(observed) > 55
    errors = [np.linalg.norm(out[t][0][0].position_m - path[t]) for t in observed if path[t, 0] > -1.2]
    assert np.mean(errors) < 0.1
    for t in observed[5:-12]:
        truth = np.asarray(shop.truth.labels[t]) == 1
        own = out[t][1] == out[t][0][0].identity
        assert (own & truth).sum() / (own | truth).sum() > 0.7


def test_a_camera_along_the_room_locates_people_by_their_feet_or_head():
    tilt = np.deg2rad(25.0)
    axes = np.array([[0.0, np.sin(tilt), np.cos(tilt)], [-1.0, 0.0, 0.0], [0.0, -np.cos(tilt), np.sin(tilt)]])
    lens = Intrinsics(120.0, 120.0, 79.5, 59.5, 160, 120)
    # The camera's centre, 2.5 m up, is the camera frame's origin.
    room_frame = RoomFrame(-axes.T @ np.array([-1.0, 0.0, 2.5]), axes)
    locator = BlobLocator(BlobSettings(), room_frame, lens)

    def pixel(room):
        point = room_frame.to_camera(np.array([room]))[0]
        return lens.fx_px * point[0] / point[2] + lens.cx_px, lens.fy_px * point[1] / point[2] + lens.cy_px

    nothing = np.zeros((120, 160))
    (u, foot), (_, head) = pixel([3.0, 0.2, 0.0]), pixel([3.0, 0.2, 1.7])
    box = np.array([round(u) - 8, round(head), round(u) + 8, round(foot)])
    position = locator.position(box, nothing > 0, nothing)
    assert position is not None
    np.testing.assert_allclose(position, [3.0, 0.2], atol=0.06)
    u, head = pixel([0.3, -0.2, 1.7])
    assert pixel([0.3, -0.2, 0.0])[1] > 120
    box = np.array([round(u) - 20, round(head), round(u) + 20, 119])
    position = locator.position(box, nothing > 0, nothing)
    assert position is not None
    np.testing.assert_allclose(position, [0.3, -0.2], atol=0.06)


def test_the_empty_scene_shows_the_floor_where_people_are_for_half_of_the_time():
    num = 60
    walk = scenes.straight((4.6, 0.3), (-1.6, 0.3), num_frames=num)
    recording = scenes.drawn_shop({"a": walk}, {}, num_frames=num)
    clean = np.asarray(scenes.drawn_shop({}, {"x": (0.0, 0.0)}, num_frames=1, seed=9).colour)[0].astype(float)
    crowded = np.array(recording.colour)
    # What passes there has many colours; the floor is visible for less than half of the time.
    crowded[1::2, 40:60, 20:40] = np.random.default_rng(1).integers(0, 255, (num // 2, 20, 20, 3))
    crowded[:6, 40:60, 20:40] = 250
    for pictures in (recording.colour, crowded):
        found = empty_scene(dataclasses.replace(recording, colour=pictures)).astype(float)
        assert np.abs(found - clean).mean() < 3.0
        assert np.mean(np.abs(found - clean).max(axis=-1) > 20) < 0.005
    one = dataclasses.replace(recording, colour=crowded[:1], depth=recording.depth[:1], time_ns=recording.time_ns[:1])
    np.testing.assert_array_equal(empty_scene(one), crowded[0])


def test_people_who_pass_each_other_keep_their_identity():
    there, back = scenes.straight((4.4, 0.5), (0.2, 0.5)), scenes.straight((0.2, -0.5), (4.4, -0.5))
    recording = scenes.drawn_shop({"a": there}, {}, strangers=(back,))
    out = _track(recording, scenes.LOOKING_DOWN.blobs)
    identities = []
    for path in (there, back):
        near = [
            min(blobs, key=lambda blob: np.linalg.norm(blob.position_m - path[t])).identity
            for t, (blobs, _) in enumerate(out)
            if len(blobs) == 2
        ]
        assert len(set(near)) == 1
        identities.append(near[0])
    assert identities[0] != identities[1]


def test_still_people_and_objects_of_another_size_are_no_blobs(shop):
    still = scenes.drawn_shop({"a": np.broadcast_to([2.0, 0.0], (40, 2))}, {}, num_frames=40)
    empty = np.asarray(scenes.drawn_shop({}, {"x": (0.0, 0.0)}, num_frames=1).colour)[0]
    tracker = BlobTracker(scenes.LOOKING_DOWN.blobs, find_room_frame(still), scenes.LENS)
    tracker.warm_up(empty)
    assert not any(tracker.step(still.colour[t], still.depth_metres(t), t / scenes.RATE_HZ)[0] for t in range(40))
    assert not any(
        blobs for blobs, _ in _track(shop, dataclasses.replace(scenes.LOOKING_DOWN.blobs, area_m2=(1.0, 2.0)))
    )
    assert not any(
        blobs for blobs, _ in _track(shop, dataclasses.replace(scenes.LOOKING_DOWN.blobs, area_m2=(0.001, 0.01)))
    )


def test_no_blob_is_faster_than_the_limit(shop):
    out = _track(shop, dataclasses.replace(scenes.LOOKING_DOWN.blobs, max_speed_m_s=0.5, min_travel_m=0.2))
    places = np.array([blobs[0].position_m for blobs, _ in out if blobs])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.max() <= 0.5 / scenes.RATE_HZ + 1e-9
    assert steps.max() > 0.04


def test_settings_of_blobs_are_checked():
    with pytest.raises(ValueError, match="area_m2 is"):
        BlobSettings(area_m2=(1.0, 0.5))
    with pytest.raises(ValueError, match="background_frames is 0"):
        BlobSettings(background_frames=0)


def test_slots_keep_their_blob_and_count_dropped_ones():
    blob = lambda number: Blob(number, np.array([number, 0, number + 1, 2]), np.array([float(number), 0.0]))  # noqa: E731
    tracks = assign_slots([[blob(1), blob(2)], [blob(2), blob(3)], [blob(3), blob(2), blob(4)], []], 2)
    np.testing.assert_array_equal(tracks.identity, [[1, 2], [3, 2], [3, 2], [0, 0]])
    assert tracks.num_dropped == 1
    np.testing.assert_array_equal(tracks.box_px[1, 0], [3, 0, 4, 2])
    assert np.isnan(tracks.box_px[3]).all()
    np.testing.assert_array_equal(assign_slots([[blob(5)]], 2, previous=(0, 5)).identity, [[0, 5]])
    with pytest.raises(ValueError, match="num_slots is 0"):
        assign_slots([[]], 0)
