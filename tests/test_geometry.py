"""Pinhole geometry against closed forms and OpenCV."""

import dataclasses

import cv2
import numpy as np
import pytest

from tagjax.core.geometry import (
    backproject,
    pixel_rays,
    project,
    range_to_depth,
    register_depth,
    undistort,
    undistorted_positions,
)
from tagjax.flow.registry import make_flow
from tagjax.recording import Intrinsics

CAMERA = Intrinsics(53.0, 54.0, 31.2, 24.1, 64, 48)
RNG = np.random.default_rng(0)


def test_projecting_what_was_backprojected_is_the_identity():
    depth = RNG.uniform(1, 4, (48, 64)).astype(np.float32)
    pixels = project(backproject(depth, CAMERA).reshape(-1, 3), CAMERA).reshape(48, 64, 2)
    x, y = np.meshgrid(np.arange(64), np.arange(48))
    np.testing.assert_allclose(pixels[..., 0], x, atol=1e-4)
    np.testing.assert_allclose(pixels[..., 1], y, atol=1e-4)
    assert np.isnan(project(np.array([[0.0, 0.0, -1.0]]), CAMERA)).all()


def test_range_becomes_depth_off_the_optical_axis():
    depth = np.full((48, 64), 2.0, np.float32)
    distance = np.linalg.norm(backproject(depth, CAMERA), axis=-1)
    assert distance[0, 0] > 2.2
    np.testing.assert_allclose(range_to_depth(distance, CAMERA), depth, rtol=1e-6)


def test_scaled_intrinsics_are_those_of_the_thinned_picture():
    np.testing.assert_allclose(pixel_rays(CAMERA.scaled(3)), pixel_rays(CAMERA)[::3, ::3], atol=1e-6)


def test_registration_of_a_wall_moves_it_by_the_baseline():
    depth = np.full((48, 64), 2.0, np.float32)
    depth[10:20, 20:30] = 1.0
    moved = register_depth(depth, CAMERA, CAMERA, np.eye(3), np.array([0.1, 0.0, 0.0]))
    # The near patch shifts by fx * 0.1 / 1 = 5.3 px, the wall by half of that; what was behind is hidden.
    assert np.all(moved[11:19, 26:35] == 1.0)
    assert np.all(moved[11:19, 40:60] == 2.0)
    assert np.all(moved[:, 0] == 0)
    np.testing.assert_array_equal(register_depth(depth, CAMERA, CAMERA, np.eye(3), np.zeros(3)), depth)


def test_registration_turns_with_the_rotation():
    depth = np.full((48, 64), 2.0, np.float32)
    angle = 0.1
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    moved = register_depth(depth, CAMERA, CAMERA, turn, np.zeros(3))
    x, y = 40, 20
    ray = pixel_rays(CAMERA)[y, x].astype(float)
    normal = turn @ np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(moved[y, x], 2.0 / (normal @ ray), atol=0.02)


@pytest.mark.parametrize(
    "more", [(), (0.1, -0.08, 0.02), (0.1, -0.08, 0.02, 0.004, -0.003, 0.002, 0.001)], ids=["5", "8", "12"]
)
def test_positions_in_the_distorted_picture_are_those_of_opencv(more):
    camera = dataclasses.replace(CAMERA, distortion=(0.12, -0.2, 0.003, -0.002, 0.05, *more))
    maps = cv2.initUndistortRectifyMap(
        camera.matrix(), np.array(camera.distortion), np.eye(3), camera.matrix(), (64, 48), cv2.CV_32FC1
    )
    np.testing.assert_allclose(undistorted_positions(camera), np.stack(maps, axis=-1), atol=1e-3)
    if more:
        plain = undistorted_positions(dataclasses.replace(camera, distortion=camera.distortion[:5]))
        assert np.abs(plain - undistorted_positions(camera)).max() > 0.3


def test_a_tilted_sensor_is_refused():
    tilted = dataclasses.replace(CAMERA, distortion=(0.1,) + (0.0,) * 11 + (0.05, 0.0))
    with pytest.raises(ValueError, match="tilted sensor"):
        undistorted_positions(tilted)
    flat = dataclasses.replace(CAMERA, distortion=(0.1,) + (0.0,) * 13)
    assert np.isfinite(undistorted_positions(flat)).all()


def test_undistortion_agrees_with_opencv():
    camera = dataclasses.replace(CAMERA, distortion=(0.12, -0.2, 0.003, -0.002, 0.05))
    maps = cv2.initUndistortRectifyMap(
        camera.matrix(), np.array(camera.distortion), np.eye(3), camera.matrix(), (64, 48), cv2.CV_32FC1
    )
    np.testing.assert_allclose(undistorted_positions(camera), np.stack(maps, axis=-1), atol=1e-3)
    colour = cv2.GaussianBlur(RNG.integers(0, 255, (48, 64, 3)).astype(np.uint8), (0, 0), 3)
    depth = np.full((48, 64), 2.0, np.float32)
    picture, _, straight = undistort(colour, depth, camera)
    expected = cv2.undistort(colour, camera.matrix(), np.array(camera.distortion))
    assert np.abs(picture[4:-4, 4:-4].astype(int) - expected[4:-4, 4:-4]).max() <= 2
    assert straight.distortion == ()


def test_interpolated_pictures_are_rounded_not_cut():
    camera = Intrinsics(50.0, 50.0, 31.5, 23.5, 64, 48)
    depth = np.full((48, 64), 2.0, np.float32)
    white = np.full((48, 64, 3), 255, np.uint8)
    assert undistort(white, depth, camera)[0].min() == 255

    noise = RNG.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    bent = dataclasses.replace(camera, distortion=(0.05, 0.0, 0.0, 0.0, 0.0))
    straight, _, _ = undistort(noise, depth, bent)
    where = undistorted_positions(bent)[4:-4, 4:-4]
    left = np.floor(where).astype(int)
    part = where - left
    exact = np.zeros((40, 56, 3))
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - part[..., 0]) * np.abs(1 - dy - part[..., 1])
            exact += weight[..., None] * noise[left[..., 1] + dy, left[..., 0] + dx]
    assert np.abs(straight[4:-4, 4:-4] - exact).max() < 0.5 + 1e-3


@pytest.mark.parametrize("name", ["dis", "dis_live", "dis_fast", "dis_ultrafast", "farneback"])
def test_flow_baselines_see_a_shift(name):
    texture = cv2.GaussianBlur(RNG.integers(0, 255, (140, 180)).astype(np.uint8), (0, 0), 2)
    texture = np.rint((texture - texture.min()) * (255 / np.ptp(texture))).astype(np.uint8)
    before, after = texture[10:130, 10:170], texture[8:128, 7:167]
    flow = make_flow(name)(np.ascontiguousarray(before), np.ascontiguousarray(after))
    np.testing.assert_allclose(np.median(flow[20:-20, 20:-20], axis=(0, 1)), [3.0, 2.0], atol=0.2)
