"""Depth from two cameras: closed-form disparities, rectification, calibration from drawn boards, unusable input."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from checkerboards import draw_board
from composed import composed

from tagjax.baselines.tagvision import PlaneCamera
from tagjax.core.geometry import project
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.image.checkerboard import Board, CalibrationError
from tagjax.recording import Intrinsics, RecordingError
from tagjax.recording.store import open_recording
from tagjax.stereo.calibration import CalibrateStereoSettings, calibrate_pair, calibrate_stereo_folders
from tagjax.stereo.conversion import StereoSettings, stereo_recording
from tagjax.stereo.matching import MatchSettings, depth_of_disparity, depth_of_pair, disparity_of_pair
from tagjax.stereo.pair_check import check_pairs
from tagjax.stereo.pictures import open_pictures
from tagjax.stereo.rectification import rectify, row_difference_px
from tagjax.stereo.rig import StereoRig, read_rig, write_rig

WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 160, 60, 200.0, 0.1
CAMERA = Intrinsics(FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
LENS = Intrinsics(300.0, 302.0, 158.0, 121.0, 320, 240, (-0.15, 0.05, 0.0, 0.0, 0.0))
TURN = cv2.Rodrigues(np.array([0.01, -0.03, 0.02]))[0]
RIG = StereoRig(LENS, dataclasses.replace(LENS, fx_px=304.0, cx_px=161.0), TURN, np.array([-0.12, 0.004, -0.003]))
SETTINGS = MatchSettings(near_m=0.8, far_m=6.0)


def _texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth random pattern at any position: waves of 4 to 20 pixels."""
    rng, value = np.random.default_rng(3), np.zeros(np.broadcast(x, y).shape)
    for _ in range(24):
        turn, length, phase = rng.uniform(0, np.pi), rng.uniform(4, 20), rng.uniform(0, 2 * np.pi)
        value += np.sin(2 * np.pi * (x * np.cos(turn) + y * np.sin(turn)) / length + phase)
    grey = np.clip(128 + 25 * value, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def _plane(at_0: float, along_x: float = 0.0, along_y: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left and right pictures of a plane, and its disparity in the left one: linear in x and y, as 1 / z of a plane is."""
    x, y = np.meshgrid(np.arange(float(WIDTH)), np.arange(float(HEIGHT)))
    seen_by_right = (x + at_0 + along_y * y) / (1 - along_x)
    return _texture(x, y), _texture(seen_by_right, y), at_0 + along_x * x + along_y * y


@pytest.mark.parametrize("plane", [(8.0,), (12.3,), (9.0, 0.05, 0.0), (7.0, 0.02, 0.06)])
def test_disparity_of_a_plane_is_the_closed_form(plane: tuple[float, ...]) -> None:
    left, right, true = _plane(*plane)
    found = disparity_of_pair(left, right, FOCAL_PX, BASELINE_M, SETTINGS)
    # What the right camera cannot see has none; all else has, to a fraction of a pixel.
    seen = np.arange(WIDTH) - true > 2
    assert np.mean(found[seen] > 0) > 0.97
    assert np.mean(found[np.arange(WIDTH) - true < -1] > 0) < 0.05
    error = (found - true)[seen & (found > 0)]
    assert np.abs(np.median(error)) < 0.05
    assert np.quantile(np.abs(error), 0.95) < 0.35
    depth = depth_of_pair(left, right, CAMERA, BASELINE_M, SETTINGS)
    relative = depth[seen & (depth > 0)] / (1000 * FOCAL_PX * BASELINE_M / true[seen & (depth > 0)]) - 1
    assert np.quantile(np.abs(relative), 0.95) < 0.04


def test_depth_is_focal_length_times_baseline_over_disparity() -> None:
    disparity = np.array([[0.0, 10.0, 4.0, 1.0, 40.0]], np.float32)
    depth = depth_of_disparity(disparity, FOCAL_PX, BASELINE_M, SETTINGS)
    np.testing.assert_array_equal(depth, [[0, 2000, 5000, 0, 0]])  # none, then 20 m and 0.5 m out of range
    assert depth.dtype == np.uint16


def test_what_one_camera_sees_alone_and_blank_walls_have_no_depth() -> None:
    left, right, _ = _plane(5.0)
    near_left, near_right, _ = _plane(15.0)
    left[:, 70:110], right[:, 55:95] = near_left[:, 70:110], near_right[:, 55:95]
    found = disparity_of_pair(left, right, FOCAL_PX, BASELINE_M, SETTINGS)
    inner = slice(10, HEIGHT - 10)
    assert np.median(found[inner, 75:105]) == pytest.approx(15, abs=0.2)
    assert np.median(found[inner, 130:]) == pytest.approx(5, abs=0.2)
    # Ten columns beside the near plane are hidden from the right camera.
    assert np.mean(found[inner, 62:68] > 0) < 0.5
    flat = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    assert np.all(disparity_of_pair(flat, flat, FOCAL_PX, BASELINE_M, SETTINGS) == 0)


def test_settings_and_pictures_are_checked() -> None:
    first, count = SETTINGS.search_px(FOCAL_PX, BASELINE_M)
    assert first <= FOCAL_PX * BASELINE_M / 6.0
    assert first + count > FOCAL_PX * BASELINE_M / 0.8
    assert count % 16 == 0
    for wrong in ({"near_m": 3.0, "far_m": 2.0}, {"block_px": 4}, {"smoothness": 0.0}, {"uniqueness_percent": 100}):
        with pytest.raises(ConfigError, match=f"{next(iter(wrong))} is"):
            MatchSettings(**wrong)
    with pytest.raises(ConfigError, match="expected at most 1024"):
        MatchSettings(near_m=0.1).search_px(2000.0, 0.5)
    left, right, _ = _plane(8.0)
    with pytest.raises(ValueError, match=r"baseline_m is 0\.0"):
        disparity_of_pair(left, right, FOCAL_PX, 0.0, SETTINGS)


def test_swapped_moved_and_foreign_pictures_are_found() -> None:
    left, right, _ = _plane(8.0)
    sound = check_pairs([(left, right)], FOCAL_PX, BASELINE_M, SETTINGS)
    sound.raise_if_wrong("pair")
    assert sound.warning() is None
    with pytest.raises(RecordingError, match="cameras are swapped"):
        check_pairs([(right, left)], FOCAL_PX, BASELINE_M, SETTINGS).raise_if_wrong("pair")
    moved = check_pairs([(left, np.roll(right, 3, axis=0))], FOCAL_PX, BASELINE_M, SETTINGS)
    assert "moved by 3 rows" in str(moved.warning())
    noise = np.random.default_rng(0).integers(0, 255, left.shape, np.uint8)
    with pytest.raises(RecordingError, match="pixels match; expected at least 25%"):
        check_pairs([(left, noise)], FOCAL_PX, BASELINE_M, SETTINGS).raise_if_wrong("pair")


def _projected(points: np.ndarray, lens: Intrinsics, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    seen, _ = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], shift, lens.matrix(), np.array(lens.distortion))
    return seen.reshape(-1, 2)


def test_rectified_rows_agree_and_disparity_gives_depth() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 4.0], (200, 3))
    seen = [
        _projected(points, RIG.left, np.eye(3), np.zeros(3)),
        _projected(points, RIG.right, RIG.rotation, RIG.translation_m),
    ]
    found = rectify(RIG)
    assert found.baseline_m == pytest.approx(RIG.baseline_m, rel=1e-9)
    np.testing.assert_allclose(row_difference_px(RIG, found, *seen), 0, atol=1e-3)
    # The antenna positions of a recording turn in the same way as the points that its pixels show.
    turned = found.points(points)
    pixels = project(turned, found.camera)
    right = project(turned - np.array([found.baseline_m, 0, 0]), found.camera)
    matrix = found.camera.matrix()
    expected = [
        cv2.undistortPoints(one.reshape(-1, 1, 2), k.matrix(), np.array(k.distortion), R=turn, P=matrix)[:, 0]
        for one, k, turn in zip(seen, (RIG.left, RIG.right), (found.turn_left, found.turn_right), strict=True)
    ]
    np.testing.assert_allclose(pixels, expected[0], atol=2e-3)
    np.testing.assert_allclose(right, expected[1], atol=2e-3)
    plain = StereoRig(CAMERA, CAMERA, translation_m=np.array([-BASELINE_M, 0.0, 0.0]))
    ready = rectify(plain)
    assert ready.maps_left is None
    assert ready.camera == CAMERA


def test_a_pair_is_written_and_read(tmp_path: Path) -> None:
    write_rig(RIG, tmp_path / "stereo.json", reprojection_px=0.1, num_views=9)
    found = read_rig(tmp_path / "stereo.json")
    assert (found.left, found.right) == (RIG.left, RIG.right)
    np.testing.assert_array_equal(found.rotation, RIG.rotation)
    np.testing.assert_array_equal(found.translation_m, RIG.translation_m)
    short = {"left": {**dataclasses.asdict(CAMERA)}, "translation_m": [-0.1, 0, 0]}
    (tmp_path / "short.json").write_text(json.dumps(short))
    assert read_rig(tmp_path / "short.json").right == CAMERA


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"translation_m": [0.1, 0, 0]}, "to the left of the left one; expected it to the right: left and right are swapped"),
        ({"translation_m": [0, 0, 0]}, r"the cameras are 0 m apart; expected 0\.005 to 2 m"),
        ({"translation_m": [-120.0, 0, 0]}, "Millimetres must be converted"),
        ({"translation_m": [-0.01, 0.1, 0]}, "Cameras above each other must be turned"),
        ({"translation_m": [-0.1, 0]}, "expected 3"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "is no rotation"),
        ({"right": dataclasses.asdict(dataclasses.replace(CAMERA, width=80))}, "has 160 x 60 pixels, the right one 80 x 60"),
        ({"right": {**dataclasses.asdict(CAMERA), "fx_px": -1.0}}, "right: Intrinsics: fx_px is"),
        ({"lefft": 1}, "lefft"),
        ({"format": "other"}, "format is 'other'"),
    ],
)  # fmt: skip
def test_a_file_that_describes_no_pair_is_refused(tmp_path: Path, change: dict, message: str) -> None:
    values = {"left": dataclasses.asdict(CAMERA), "translation_m": [-0.1, 0, 0], **change}
    (tmp_path / "stereo.json").write_text(json.dumps(values))
    with pytest.raises(RecordingError, match=message):
        read_rig(tmp_path / "stereo.json")


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no readable camera file"):
        read_rig(tmp_path / "none.json")
    (tmp_path / "stereo.json").write_text("[1]")
    with pytest.raises(RecordingError, match="no keys and values"):
        read_rig(tmp_path / "stereo.json")


def _boards(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Poses of a held board in the left camera: rotation and translation."""
    poses, middle = [], Board().corners_m().mean(axis=0)
    for seed in range(count):
        rng = np.random.default_rng(seed)
        tilt = cv2.Rodrigues(np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.2, 0.2)]))[0]
        turn = tilt @ cv2.Rodrigues(np.array([np.pi, 0.0, 0.0]))[0]
        poses.append(
            (turn, np.array([rng.uniform(0.0, 0.1), rng.uniform(-0.05, 0.05), rng.uniform(0.5, 0.7)]) - turn @ middle)
        )
    return poses


def test_calibration_recovers_the_pair_from_corners() -> None:
    board, model = Board(), Board().corners_m()
    views: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for number, (turn, shift) in enumerate(_boards(10)):
        views[0].append(_projected(model, RIG.left, turn, shift))
        right = _projected(model, RIG.right, RIG.rotation @ turn, RIG.rotation @ shift + RIG.translation_m)
        views[1].append(right[::-1] if number == 3 else right)  # found from the board's other end
    found = calibrate_pair(*views, board, 320, 240)
    np.testing.assert_allclose(found.rig.translation_m, RIG.translation_m, atol=2e-4)
    np.testing.assert_allclose(found.rig.rotation, RIG.rotation, atol=1e-3)
    assert found.rig.right.fx_px == pytest.approx(304, abs=0.5)
    assert found.row_difference_px < 0.02
    with pytest.raises(RecordingError, match="left and right are swapped"):
        calibrate_pair(views[1], views[0], board, 320, 240)
    with pytest.raises(CalibrationError, match="9 views on the left, 10 on the right"):
        calibrate_pair(views[0][1:], views[1], board, 320, 240)
    with pytest.raises(CalibrationError, match="2 pictures show the board"):
        calibrate_pair(views[0][:2], views[1][:2], board, 320, 240)
    turn, shift = _boards(3)[2]
    spin, middle = cv2.Rodrigues(np.array([0.0, 0.0, 1.2]))[0], model.mean(axis=0)
    other = _projected((model - middle) @ spin.T + middle, RIG.left, turn, shift)
    with pytest.raises(CalibrationError, match="Pair 2: the board is turned by"):
        calibrate_pair(views[0], [*views[1][:2], other, *views[1][3:]], board, 320, 240)


def test_the_commands_configurations_are_those_of_the_library() -> None:
    for name, schema, given in (
        ("stereo", StereoSettings, {"recording": "a.zarr"}),
        ("calibrate_stereo", CalibrateStereoSettings, {"left": "a", "right": "b"}),
    ):
        values = {**composed(name), **given}
        assert values.pop("progress") is True
        values.pop("paths", None)
        assert from_mapping(schema, values) == schema(**given)


@pytest.mark.ci
def test_calibration_recovers_the_pair_from_drawn_boards(tmp_path: Path) -> None:
    rng, board = np.random.default_rng(11), Board()
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
    for number, (turn, shift) in enumerate(_boards(8)):
        cameras = {
            "left": PlaneCamera(RIG.left, turn, shift),
            "right": PlaneCamera(RIG.right, RIG.rotation @ turn, RIG.rotation @ shift + RIG.translation_m),
        }
        for side, camera in cameras.items():
            cv2.imwrite(str(tmp_path / side / f"{number}.png"), draw_board(camera, board, rng))
    out = tmp_path / "stereo.json"
    settings = CalibrateStereoSettings(str(tmp_path / "left"), str(tmp_path / "right"), str(out))
    found, lines = calibrate_stereo_folders(settings)
    assert found.rig.baseline_m == pytest.approx(RIG.baseline_m, rel=0.01)
    assert found.row_difference_px < 0.15
    np.testing.assert_allclose(read_rig(out).translation_m, RIG.translation_m, atol=2e-3)
    assert any("8 of 8 pairs" in line for line in lines)
    (tmp_path / "right" / "7.png").unlink()
    with pytest.raises(CalibrationError, match=r"8 pictures in .* 7 in"):
        calibrate_stereo_folders(settings)
    cv2.imwrite(str(tmp_path / "right" / "7.png"), np.zeros((100, 320, 3), np.uint8))
    with pytest.raises(CalibrationError, match="320 x 100 pixels; expected 320 x 240"):
        calibrate_stereo_folders(settings)


def _recorded(tmp_path: Path, count: int = 4) -> StereoSettings:
    """Folders of pictures of a plane that comes nearer, named by time, with a camera file."""
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
    for frame in range(count):
        for side, picture in zip(("left", "right"), _plane(8.0 + frame)[:2], strict=True):
            cv2.imwrite(str(tmp_path / side / f"{1700000000 + frame / 10:.3f}.png"), picture)
    write_rig(StereoRig(CAMERA, CAMERA, translation_m=np.array([-BASELINE_M, 0, 0])), tmp_path / "stereo.json")
    sides = (str(tmp_path / "left"), str(tmp_path / "right"))
    return StereoSettings(*sides, str(tmp_path / "stereo.json"), match=SETTINGS, out=str(tmp_path / "a.zarr"))


@pytest.mark.filterwarnings("ignore:The recording has no tag read")
def test_two_folders_become_a_recording(tmp_path: Path) -> None:
    settings = _recorded(tmp_path)
    stereo_recording(settings)
    stored = open_recording(tmp_path / "a.zarr")
    assert stored.name == "left-stereo"
    np.testing.assert_array_equal(np.diff(stored.time_ns), 100_000_000)
    for frame in range(4):
        depth = stored.depth_metres(frame)[:, 20:]
        assert np.median(depth[depth > 0]) == pytest.approx(FOCAL_PX * BASELINE_M / (8 + frame), rel=0.01)
    np.testing.assert_array_equal(stored.colour[2], _plane(10.0)[0])
    plain = dataclasses.replace(settings, out=None)
    with pytest.raises(RecordingError, match="swapped"):
        stereo_recording(dataclasses.replace(plain, left=settings.right, right=settings.left))
    first = min((tmp_path / "left").iterdir())
    first.unlink()
    with pytest.raises(RecordingError, match="3 pictures on the left, 4 on the right"):
        stereo_recording(plain)
    min((tmp_path / "right").iterdir()).unlink()
    max((tmp_path / "right").iterdir()).rename(tmp_path / "right" / "1700000000.350.png")
    with pytest.raises(RecordingError, match=r"frame 2: the times of left and right differ by 50\.0 ms more"):
        stereo_recording(plain)
    other = dataclasses.replace(CAMERA, width=161)
    write_rig(StereoRig(other, other, translation_m=np.array([-BASELINE_M, 0, 0])), tmp_path / "stereo.json")
    with pytest.raises(RecordingError, match="160 x 60 pixels; expected 161 x 60"):
        stereo_recording(plain)


def test_a_video_is_read_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "left.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for frame in range(5):
        writer.write(np.full((48, 64, 3), 40 * frame + 20, np.uint8))
    writer.release()
    frames, times = open_pictures(path, "left", None)
    assert frames.shape == (5, 48, 64, 3)
    np.testing.assert_allclose(np.diff(times), 1e8, atol=1e6)
    for frame in (3, 0, 4, -1, 2):
        assert np.abs(frames[frame].astype(int) - (40 * (frame % 5) + 20)).max() <= 4
    np.testing.assert_array_equal(frames[1:3][0], frames[1])
    with pytest.raises(IndexError):
        frames[5]
    np.testing.assert_array_equal(open_pictures(path, "left", 4.0)[1], np.arange(5) * 250_000_000)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(RecordingError, match=f"left={path}"):
        open_pictures(path, "left", None)


def test_inputs_that_are_missing_or_contradict_each_other(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="found no pictures"):
        StereoSettings()
    with pytest.raises(ConfigError, match="found left; expected left="):
        StereoSettings(left="a")
    with pytest.raises(ConfigError, match="found recording and left, reads"):
        StereoSettings(recording="a", left="b", reads="c")
    with pytest.raises(ConfigError, match="fps is 0"):
        StereoSettings(recording="a", fps=0.0)
    with pytest.raises(RecordingError, match="no such file or folder"):
        open_pictures(tmp_path / "none.mp4", "left", None)
    (tmp_path / "a.txt").write_text("a")
    with pytest.raises(RecordingError, match="no known video"):
        open_pictures(tmp_path / "a.txt", "right", None)
    with pytest.raises(RecordingError, match="no picture"):
        open_pictures(tmp_path, "left", None)
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(RecordingError, match=r"look like frame numbers.*give the frame rate: fps=30"):
        open_pictures(tmp_path, "left", None)
    assert open_pictures(tmp_path, "left", 30.0)[0].shape == (1, 4, 4, 3)
