"""TagVision's camera: the plane and the picture, calibration, corners of drawn boards, the command."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from checkerboards import draw_board

from tagjax.baselines.tagvision import PlaneCamera, load_calibration, save_calibration
from tagjax.baselines.tagvision.calibration import camera_pose
from tagjax.baselines.tagvision.experiment.simulated_calibration import (
    PAPER_CAMERA,
    CalibrationSettings,
    board_views,
    overhead,
    simulate_calibration,
    transform_error_m,
)
from tagjax.baselines.tagvision.picture_folder import (
    CalibrateSettings,
    PosePicture,
    calibrate_folder,
    read_picture,
    write_calibration,
    write_corners,
)
from tagjax.image.checkerboard import Board, CalibrationError, calibrate, find_corners
from tagjax.recording import Intrinsics

ROOT = Path(__file__).parents[1]


def _tilted(intrinsics: Intrinsics = PAPER_CAMERA) -> PlaneCamera:
    camera = overhead(intrinsics, (0.1, -0.2, 2.0))
    tilt, _ = cv2.Rodrigues(np.array([0.3, -0.2, 0.4]))
    return PlaneCamera(intrinsics, tilt @ camera.rotation, tilt @ camera.translation_m)


def test_plane_and_picture_are_inverse() -> None:
    camera = _tilted()
    rng = np.random.default_rng(7)
    for height in (0.0, 0.25):
        points = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.full(50, height)])
        np.testing.assert_allclose(camera.to_plane(camera.to_picture(points), height), points, atol=1e-6)
        np.testing.assert_allclose(camera.to_world(camera.to_camera(points)), points, atol=1e-12)
    ideal = dataclasses.replace(camera, intrinsics=dataclasses.replace(camera.intrinsics, distortion=()))
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    homography = cv2.getPerspectiveTransform(
        ideal.to_picture(corners).astype(np.float32), corners[:, :2].astype(np.float32)
    )
    pixels = rng.uniform(100, 600, (20, 2))
    by_matrix = cv2.perspectiveTransform(pixels[None], homography)[0]
    np.testing.assert_allclose(ideal.to_plane(pixels)[:, :2], by_matrix, atol=1e-4)


def test_points_behind_the_camera_are_nan() -> None:
    camera = _tilted()
    assert np.all(np.isnan(camera.to_plane(np.array([[300.0, 300.0]]), 3.0)))
    assert np.all(np.isnan(camera.to_picture(np.array([[0.0, 0.0, 9.0]]))))
    assert camera.to_plane(np.empty((0, 2))).shape == (0, 3)
    assert camera.to_picture(np.empty((0, 3))).shape == (0, 2)
    with pytest.raises(ValueError, match="no rotation"):
        PlaneCamera(camera.intrinsics, -np.eye(3), np.zeros(3))


def test_a_pixels_size_is_height_over_focal_length() -> None:
    plain = dataclasses.replace(PAPER_CAMERA, distortion=())
    camera = overhead(plain, (0.0, 0.0, 2.0))
    assert camera.metres_per_pixel(np.array([[100.0, 50.0]]), 0.5)[0] == pytest.approx(1.5 / 1000, rel=1e-6)


def test_calibration_finds_the_camera() -> None:
    settings = CalibrationSettings(corner_noise_px=0.0)
    rng = np.random.default_rng(8)
    found = calibrate(board_views(PAPER_CAMERA, settings, rng), settings.board, 1280, 720)
    for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        assert getattr(found.intrinsics, name) == pytest.approx(getattr(PAPER_CAMERA, name), abs=0.05)
    np.testing.assert_allclose(found.intrinsics.distortion, PAPER_CAMERA.distortion, atol=2e-3)
    assert found.reprojection_px < 1e-2
    noisy = board_views(PAPER_CAMERA, dataclasses.replace(settings, corner_noise_px=0.1), rng)
    # Two coordinates of 0.1 px each.
    assert calibrate(noisy, settings.board, 1280, 720).reprojection_px == pytest.approx(0.1 * np.sqrt(2), rel=0.15)


def test_transform_error_is_below_the_papers() -> None:
    true, area = overhead(PAPER_CAMERA, (0.02, 0.03, 2.0)), (-0.6, -1.0, 0.6, 1.0)
    errors = []
    for seed in range(5):
        settings = CalibrationSettings(seed=seed)
        found = simulate_calibration(true, area, settings)
        errors.append(transform_error_m(found, true, area, pixel_noise_px=0.1, seed=seed).mean() * 1e3)
    assert np.mean(errors) <= 1.56
    assert max(errors) <= 1.56
    exact = transform_error_m(true, true, area)
    assert exact.max() < 1e-6


def test_calibration_refuses_unusable_views() -> None:
    settings = CalibrationSettings(corner_noise_px=0.0)
    views = board_views(PAPER_CAMERA, settings, np.random.default_rng(9))
    board = settings.board
    with pytest.raises(CalibrationError, match="2 pictures show the board"):
        calibrate(views[:2], board, 1280, 720)
    with pytest.raises(CalibrationError, match="23 corners; expected 24"):
        calibrate([view[:-1] for view in views], board, 1280, 720)
    with pytest.raises(CalibrationError, match="all within 640 x 480"):
        calibrate(views, board, 640, 480)
    flat = overhead(dataclasses.replace(PAPER_CAMERA, distortion=()), (0.0, 0.0, 1.0))
    parallel = [flat.to_picture(board.corners_m() + 0.05 * k * np.array([1.0, 0.6, 0.0])) for k in range(5)]
    with pytest.raises(CalibrationError, match=r"all parallel .* not of 7 x 5 squares"):
        calibrate(parallel, board, 1280, 720)
    with pytest.raises(CalibrationError, match="finite"):
        calibrate([np.full_like(view, np.nan) for view in views], board, 1280, 720)
    with pytest.raises(ValueError, match="num_radial is 1"):
        calibrate(views, board, 1280, 720, num_radial=1)
    with pytest.raises(ValueError, match="expected at least 3 each way and different numbers"):
        Board(6, 6)
    line = np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)])
    with pytest.raises(CalibrationError, match="in line"):
        camera_pose(line, line[:, :2], PAPER_CAMERA)
    with pytest.raises(CalibrationError, match="Found 3 points"):
        camera_pose(board.corners_m()[:3], views[0][:3], PAPER_CAMERA)
    points = board.corners_m()
    seen = overhead(PAPER_CAMERA, (0.0, 0.0, 1.0)).to_picture(points)
    with pytest.raises(CalibrationError, match="below the plane"):
        camera_pose(points * [1.0, -1.0, 1.0], seen, PAPER_CAMERA)


SMALL_CAMERA = Intrinsics(400.0, 400.0, 159.5, 119.5, 320, 240, (-0.15, 0.05, 0.0, 0.0, 0.0))


def _held(seed: int) -> PlaneCamera:
    rng = np.random.default_rng(seed)
    turn, _ = cv2.Rodrigues(np.array([np.pi, 0.0, 0.0]))
    tilt, _ = cv2.Rodrigues(np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.3, 0.3)]))
    middle = Board().corners_m().mean(axis=0)
    rotation = tilt @ turn
    return PlaneCamera(SMALL_CAMERA, rotation, np.array([*rng.uniform(-0.03, 0.03, 2), 0.62]) - rotation @ middle)


def test_corners_of_a_drawn_board_are_found_to_a_tenth_of_a_pixel() -> None:
    rng, board, errors = np.random.default_rng(10), Board(), []
    for seed in range(3):
        camera = _held(seed)
        found = find_corners(draw_board(camera, board, rng), board)
        assert found is not None
        true = camera.to_picture(board.corners_m())
        # A board of odd sides looks the same from either end.
        ends = [np.linalg.norm(found[::way] - true, axis=1) for way in (1, -1)]
        errors.append(min(ends, key=np.mean))
    assert np.sqrt(np.mean(np.square(errors))) < 0.1 * np.sqrt(2)
    assert find_corners(np.full((240, 320), 128, np.uint8), board) is None


@pytest.mark.ci
def test_a_folder_of_pictures_is_calibrated(tmp_path: Path) -> None:
    rng, board = np.random.default_rng(11), Board()
    folder = tmp_path / "pictures"
    folder.mkdir()
    for seed in range(6):
        cv2.imwrite(str(folder / f"{seed}.png"), draw_board(_held(seed), board, rng))
    cv2.imwrite(str(folder / "empty.png"), np.full((240, 320, 3), 200, np.uint8))
    above = overhead(SMALL_CAMERA, (0.15, -0.1, 0.9))
    poses = []
    for number, origin in enumerate([(0.0, 0.0), (0.12, -0.06)]):
        cv2.imwrite(str(tmp_path / f"table{number}.png"), draw_board(above, board, rng, origin))
        poses.append(PosePicture(str(tmp_path / f"table{number}.png"), origin))
    found = calibrate_folder(CalibrateSettings(str(folder), poses=tuple(poses)))
    assert found.without_board == ("empty.png",)
    assert found.camera.reprojection_px < 0.15
    assert found.camera.intrinsics.fx_px == pytest.approx(400, rel=0.02)
    assert found.plane is not None
    np.testing.assert_allclose(found.plane.position_m, above.position_m, atol=0.03)
    area = (0.0, -0.2, 0.3, 0.0)
    assert transform_error_m(found.plane, above, area).mean() < 1.56e-3
    assert any("empty.png" in line for line in found.summary())
    assert any("reprojection error" in line for line in found.summary())
    assert [Path(seen.picture).name for seen in found.boards] == ["table0.png", "table1.png"]
    assert not any("doubtful" in line for line in found.summary())
    write_calibration(found, tmp_path / "camera.json")
    read = load_calibration(tmp_path / "camera.json")
    np.testing.assert_allclose(read.rotation, found.plane.rotation)
    assert read.intrinsics == found.camera.intrinsics

    drawn = read_picture(write_corners(found, tmp_path / "camera.json"))
    assert (tmp_path / "camera_corners.png").is_file()
    for number, seen in enumerate(found.boards):
        x, y = np.rint(seen.corners_px[0] * 800 / 320).astype(int) + np.array([808 * number, 0])
        ring = drawn[max(y - 14, 0) : y + 15, x - 14 : x + 15].astype(int)
        assert np.sum(np.abs(ring - np.array([230, 0, 200])).max(axis=-1) < 30) > 20, seen.picture
        assert np.any(np.abs(drawn[:, 808 * number :][:, :800].astype(int) - np.array([220, 40, 40])).max(axis=-1) < 9)

    away = dataclasses.replace(poses[1], origin_m=(0.25, -0.06))
    doubtful = calibrate_folder(CalibrateSettings(str(folder), poses=(poses[0], away))).summary()
    assert sum("table" in line and "origin_m and turn_deg right, the board's size" in line for line in doubtful) == 2

    settings = CalibrateSettings(str(folder), board=Board(9, 5))
    with pytest.raises(CalibrationError, match="none of 7 pictures shows a board of 9 x 5 squares"):
        calibrate_folder(settings)
    write_calibration(dataclasses.replace(found, plane=None), tmp_path / "camera.json")
    with pytest.raises(ValueError, match=r"found intrinsics only.*poses=\[\{picture"):
        load_calibration(tmp_path / "camera.json")


@pytest.mark.ci
def test_the_command_reports_the_result_or_the_error(tmp_path: Path) -> None:
    rng, run = np.random.default_rng(12), [sys.executable, "-m", "experiments.calibrate_camera"]
    for seed in range(4):
        cv2.imwrite(str(tmp_path / f"{seed}.png"), draw_board(_held(seed), Board(), rng))
    given = [f"pictures={tmp_path}", f"out={tmp_path / 'new' / 'camera.json'}", f"hydra.run.dir={tmp_path / 'run'}"]
    done = subprocess.run([*run, *given], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "reprojection error" in done.stdout
    assert (tmp_path / "new" / "camera_corners.png").is_file()
    assert json.loads((tmp_path / "new" / "camera.json").read_text())["intrinsics_reprojection_px"] < 0.15
    failed = subprocess.run([*run, given[2]], capture_output=True, text=True, cwd=ROOT)
    assert failed.returncode == 1
    assert "expected pictures=<folder" in failed.stderr


def test_folders_that_cannot_be_calibrated_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CalibrationError, match="its folder cannot be made"):
        calibrate_folder(CalibrateSettings(str(tmp_path), out=str(tmp_path / "file" / "camera.json")))
    with pytest.raises(CalibrationError, match="is a folder; expected a file"):
        calibrate_folder(CalibrateSettings(str(tmp_path), out=str(tmp_path)))
    with pytest.raises(CalibrationError, match="no such folder"):
        calibrate_folder(CalibrateSettings(str(tmp_path / "missing")))
    with pytest.raises(CalibrationError, match="no picture in it"):
        calibrate_folder(CalibrateSettings(str(tmp_path)))
    (tmp_path / "broken.png").write_bytes(b"nothing")
    with pytest.raises(CalibrationError, match="no readable picture"):
        calibrate_folder(CalibrateSettings(str(tmp_path)))
    cv2.imwrite(str(tmp_path / "broken.png"), np.zeros((20, 30, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "other.png"), np.zeros((30, 20, 3), np.uint8))
    with pytest.raises(CalibrationError, match=r"30 x 20 \(broken.png\), 20 x 30"):
        calibrate_folder(CalibrateSettings(str(tmp_path)))


def test_a_calibration_file_is_read_back_or_refused(tmp_path: Path) -> None:
    camera, path = _tilted(), tmp_path / "camera.json"
    save_calibration(camera, path, source="a test")
    again = load_calibration(path)
    np.testing.assert_allclose(again.rotation, camera.rotation)
    assert again.intrinsics == camera.intrinsics
    with pytest.raises(ValueError, match="no readable calibration"):
        load_calibration(tmp_path / "none.json")
    values = json.loads(path.read_text())
    path.write_text(json.dumps({**values, "format": "other"}))
    with pytest.raises(ValueError, match="no calibration of format"):
        load_calibration(path)
    path.write_text(json.dumps({**values, "rotation": [[1, 0, 0]] * 3}))
    with pytest.raises(ValueError, match="damaged"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("fx_px", 0),
        ("fx_px", None),
        ("fy_px", float("nan")),
        ("cx_px", "640"),
        ("cy_px", float("inf")),
        ("width", -3),
        ("height", 720.5),
        ("distortion", [0.1]),
        ("distortion", "abcd"),
        ("distortion", [0.1, 0.0, 0.0, None, 0.0]),
        ("distortion", 7),
        ("translation_m", [0.0, 1.0]),
        ("translation_m", [0.0, 1.0, "2"]),
        ("translation_m", [0.0, 1.0, float("inf")]),
        ("translation_m", None),
        ("rotation", [[1, 0], [0, 1]]),
        ("rotation", [[1, 0, 0], [0, 1], [0, 0, 1]]),
        ("rotation", "eye"),
        ("intrinsics", [1, 2]),
        ("reprojection_px", "small"),
        ("reprojection_px", 10**400),
        ("fx_px", 10**400),
    ],
)
def test_a_damaged_calibration_file_is_refused_by_name(tmp_path: Path, name: str, value: object) -> None:
    path = tmp_path / "camera.json"
    save_calibration(_tilted(), path)
    values = json.loads(path.read_text())
    (values if name in values else values["intrinsics"])[name] = value
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match=r"camera\.json: damaged calibration"):
        load_calibration(path)
