"""Residual registration: recovered where it is known, and measured on real recordings."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import scipy.io

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.recording import Intrinsics, RecordingError
from tagjax.recording.image_files import read_colour
from tagjax.recording.importers.registration import estimate_correction, misalignment_px
from tagjax.recording.importers.rgbd_folder import DepthToColour, load_calibration, read_mat_depth
from tagjax.recording.importers.settings import ImportSettings, import_recording

RESIDUAL = (-0.006, 0.004, 0.002, 1.004, 0.99, 8.5, -3.0)


def _told() -> DepthToColour:
    """The calibration as its file tells it, which RESIDUAL makes right."""
    turned, _ = cv2.Rodrigues(np.array([0.003, -0.008, 0.002]))
    return DepthToColour(
        Intrinsics(285.0, 286.0, 158.3, 121.4, 320, 240),
        Intrinsics(268.0, 267.0, 155.2, 121.7, 320, 240),
        turned,
        np.array([-0.026, 0.001, -0.001]),
    )


class Room:
    """Boxes before a wall: some stand, some move; seen by ray casting with a z-buffer, from a rig that is tilted."""

    def __init__(self, seed: int, num_moving: int = 4):
        self.tilt, _ = cv2.Rodrigues(np.array([0.0, 0.0, 0.55]))  # so that outlines are oblique
        rng = np.random.default_rng(seed)
        self.rng = rng
        self.paint = np.random.default_rng(0).integers(20, 235, (64, 64, 64, 3))
        self.still = [np.array([[-1.6, 0.2, 3.2], [-0.9, 1.4, 3.8]]), np.array([[0.7, 0.5, 2.6], [1.1, 1.2, 3.0]])]
        self.start = rng.uniform([-0.5, -0.4, 0.0], [0.5, 0.3, 0.0], (num_moving, 3))
        self.depth_m = np.linspace(1.2, 3.6, max(num_moving, 1))[:num_moving]
        self.pace = rng.uniform(0.5, 1.5, (num_moving, 2))

    def boxes(self, frame: int) -> list[np.ndarray]:
        out = list(self.still)
        for start, z, pace in zip(self.start, self.depth_m, self.pace, strict=True):
            sway = np.array([0.32 * np.sin(0.8 * frame * pace[0]), 0.2 * np.sin(0.5 * frame * pace[1] + 1)])
            corner = np.append((start[:2] + sway) * z, z)
            out.append(np.stack([corner, corner + np.array([0.13 * z, 0.2 * z, 0.2])]))
        return out

    def cast(self, frame: int, camera: Intrinsics, rotation: np.ndarray, translation_m: np.ndarray):
        """Depth in this camera (metres), and colour."""
        column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = np.stack(
            [(column - camera.cx_px) / camera.fx_px, (row - camera.cy_px) / camera.fy_px, np.ones(column.shape)], -1
        )
        rays, origin = rays @ rotation @ self.tilt, -self.tilt.T @ rotation.T @ translation_m
        depth = (5.0 - origin[2]) / rays[..., 2]
        which = np.zeros(column.shape, int)
        for number, box in enumerate(self.boxes(frame), start=1):
            ends = (box[:, None, None, :] - origin) / rays
            enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
            seen = (enter < leave) & (enter > 0) & (enter < depth)
            depth, which = np.where(seen, enter, depth), np.where(seen, number, which)
        cell = np.floor((origin + rays * depth[..., None]) / 0.12).astype(int) % 64
        tint = np.random.default_rng(1).integers(0, 120, (len(self.boxes(frame)) + 1, 3))
        colour = 0.3 * self.paint[cell[..., 0], cell[..., 1], cell[..., 2]] + 1.2 * tint[which]
        return depth, colour

    def frames(self, numbers, view: DepthToColour) -> tuple[np.ndarray, np.ndarray]:
        colours, depths = [], []
        for frame in numbers:
            depth, _ = self.cast(frame, view.depth_camera, np.eye(3), np.zeros(3))
            noisy = depth + self.rng.normal(0, 0.002, depth.shape) * depth**2
            beside = np.roll(depth, 4, axis=1)
            noisy[beside < depth - 0.2] = 0  # the projector's shadow
            _, colour = self.cast(frame, view.colour_camera, view.rotation, view.translation_m)
            colour = cv2.GaussianBlur(colour, (0, 0), 0.7) + self.rng.normal(0, 2, colour.shape)
            colours.append(np.clip(colour, 0, 255).astype(np.uint8))
            depths.append(np.rint(noisy * 1000).astype(np.uint16))
        return np.stack(colours), np.stack(depths)


def _positions(view: DepthToColour, depth_mm: np.ndarray) -> np.ndarray:
    row, column = np.nonzero((depth_mm > 0) & (depth_mm < 4000))
    camera, z = view.depth_camera, depth_mm[row, column] / 1000.0
    points = np.stack([(column - camera.cx_px) / camera.fx_px * z, (row - camera.cy_px) / camera.fy_px * z, z], axis=-1)
    pixels = (points @ view.rotation.T + view.translation_m) @ view.colour_camera.matrix().T
    return pixels[:, :2] / pixels[:, 2:]


@pytest.fixture(scope="module")
def estimated():
    found = _told()
    room = Room(3)
    colour, depth = room.frames(range(0, 48, 2), found.corrected(RESIDUAL))
    held_out = room.frames(range(1, 48, 6), found.corrected(RESIDUAL))
    return found, (colour, depth), held_out, estimate_correction(colour, depth, found)


@pytest.mark.ci
def test_a_known_residual_is_recovered_to_a_pixel_in_held_out_frames(estimated) -> None:
    result, _, (_, depths), found = estimated
    errors = {"before": [], "after": []}
    for depth in depths:
        right = _positions(result.corrected(RESIDUAL), depth)
        errors["before"].append(np.linalg.norm(_positions(result, depth) - right, axis=1))
        errors["after"].append(np.linalg.norm(_positions(result.corrected(found.correction), depth) - right, axis=1))
    before, after = (np.concatenate(errors[key]) for key in ("before", "after"))
    assert 7.0 < np.median(before) < 11.0
    assert np.median(after) < 0.5
    assert np.percentile(after, 95) < 1.0


@pytest.mark.ci
def test_the_reported_misalignment_is_the_true_one(estimated) -> None:
    result, _, (colour, depth), found = estimated
    right = result.corrected(RESIDUAL)
    points = [_positions(view, depth[0]) for view in (result, right)]
    assert misalignment_px(colour, depth, result).median_px == pytest.approx(
        np.median(np.linalg.norm(points[0] - points[1], axis=1)), abs=1.0
    )
    assert misalignment_px(colour, depth, right).median_px < 0.7
    moved = dataclasses.replace(right, colour_camera=dataclasses.replace(right.colour_camera, cx_px=161.0))
    shift = misalignment_px(colour, depth, moved).mean_shift_px
    np.testing.assert_allclose(shift, (right.colour_camera.cx_px - 161.0, 0.0), atol=0.7)
    assert found.before.median_px > 6.0 > 1.0 > found.after.median_px
    assert found.line().startswith(f"Residual registration: {found.before.median_px:.1f} px before, ")


@pytest.mark.ci
@pytest.mark.parametrize("shift_px", [(0.0, 0.0), pytest.param((14.0, -17.0), marks=pytest.mark.ci)])
def test_right_is_left_where_it_is_and_far_off_is_brought_back(estimated, shift_px) -> None:
    found, (colour, depth), _, _ = estimated
    right = found.corrected(RESIDUAL)
    off = right.corrected((0.0, 0.0, 0.0, 1.0, 1.0, *shift_px))
    mended = off.corrected(estimate_correction(colour, depth, off).correction)
    error = np.linalg.norm(_positions(mended, depth[0]) - _positions(right, depth[0]), axis=1)
    assert np.percentile(error, 95) < 1.2


@pytest.mark.ci
def test_an_estimate_is_the_same_every_time(estimated) -> None:
    result, (colour, depth), _, found = estimated
    assert estimate_correction(colour, depth, result).correction == found.correction


def test_a_room_in_which_nothing_moves_gives_no_estimate() -> None:
    colour, depth = Room(0, num_moving=0).frames(range(6), _told())
    with pytest.raises(RecordingError, match="a person walks"):
        estimate_correction(colour, depth, _told())
    with pytest.raises(RecordingError, match="Only 0 of 0 moving objects"):
        misalignment_px(colour, depth, _told())


def test_frames_must_be_pairs_and_several() -> None:
    colour, depth = np.zeros((6, 8, 8, 3), np.uint8), np.zeros((6, 8, 8), np.uint16)
    with pytest.raises(RecordingError, match="6 colour frames and 5 depth"):
        misalignment_px(colour, depth[:5], _told())
    with pytest.raises(RecordingError, match="Only 4 frames"):
        estimate_correction(colour[:4], depth[:4], _told())


def _written(path, view, colour, depth):
    """A folder of pictures with their depth and calibration."""
    for number, (picture, raw) in enumerate(zip(colour, depth, strict=True)):
        cv2.imwrite(str(path / f"{number:04d}.jpg"), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])
        scipy.io.savemat(path / f"{number:04d}.mat", {"depth_array": raw})
    camera = {
        "Kdepth": view.depth_camera.matrix(),
        "Krgb": view.colour_camera.matrix(),
        "R": view.rotation,
        "T": view.translation_m,
    }
    (path / "camera").mkdir()
    scipy.io.savemat(path / "camera" / "camera.mat", {"cam_params": camera})
    return path


@pytest.fixture
def folder(estimated, tmp_path):
    found, (colour, depth), _, _ = estimated
    return _written(tmp_path, found, colour, depth)


@pytest.mark.ci
@pytest.mark.filterwarnings("ignore:The recording has no tag read")
def test_an_import_reports_its_estimate_so_that_it_can_be_repeated(folder, estimated) -> None:
    result, (_, depth), _, _ = estimated
    settings = ImportSettings(
        video=str(folder), calibration=str(folder / "camera" / "camera.mat"), fps=7.0, correction="estimate"
    )
    recording, found = import_recording(settings)
    assert found[0].startswith("Residual registration: ")
    numbers = [float(word) for word in recording.source.split("correction = [")[1].split("]")[0].split(",")]
    error = _positions(result.corrected(numbers), depth[0]) - _positions(result.corrected(RESIDUAL), depth[0])
    assert np.percentile(np.linalg.norm(error, axis=1), 95) < 1.5
    again, said_again = import_recording(dataclasses.replace(settings, correction=tuple(numbers)))
    assert not any(line.startswith("Residual") for line in said_again)
    assert again.intrinsics.cx_px == recording.intrinsics.cx_px
    np.testing.assert_array_equal(again.depth[3], recording.depth[3])
    plain, _ = import_recording(dataclasses.replace(settings, correction=None))
    assert "correction" not in plain.source
    assert (plain.depth[3] != recording.depth[3]).mean() > 0.05


@pytest.mark.parametrize("wrong", ["guess", (0.0, 1.0), (0.0, 0.0, 0.0, 1.0, 1.0, float("nan"), 0.0), ["a"] * 7, 3.0])
def test_a_correction_that_is_none_is_refused(tmp_path, wrong) -> None:
    folder = _written(tmp_path, _told(), np.zeros((2, 24, 32, 3), np.uint8), np.zeros((2, 24, 32), np.uint16))
    with pytest.raises(RecordingError, match="expected null, estimate or 7 numbers"):
        import_recording(
            ImportSettings(video=str(folder), calibration=str(folder / "camera" / "camera.mat"), correction=wrong)
        )


def test_a_folder_that_is_registered_takes_no_correction(tmp_path) -> None:
    with pytest.raises(RecordingError, match="registered already"):
        import_recording(ImportSettings(video=str(tmp_path), video_format="tum", correction="estimate"))


@pytest.mark.ci
@pytest.mark.real_data
@pytest.mark.parametrize(("name", "step"), [("ist-confusao", 8), ("ist-imgseq1", 4)])
def test_a_real_residual_is_mended_in_held_out_frames(real_data, name, step) -> None:
    pictures = sorted((real_data / "rgbd" / name).glob("*.jpg"))
    view = load_calibration(real_data / "rgbd" / "cameraparametersAsus.mat", (480, 640))

    def frames(chosen):
        depths = [read_mat_depth(path.with_suffix(".mat")) for path in chosen]
        return np.stack([read_colour(path) for path in chosen]), np.stack(depths)

    found = estimate_correction(*frames(pictures[:: step // 2]), view)
    held_out = frames(pictures[1 :: step // 2])
    assert misalignment_px(*held_out, view).median_px > 8.0
    assert misalignment_px(*held_out, view.corrected(found.correction)).median_px < 2.0
    assert abs(found.after.mean_shift_px[0]) < 1.0
    assert abs(found.after.mean_shift_px[1]) < 1.0


def test_an_unknown_key_of_the_virtual_reader_is_refused_before_anything_is_read():
    with pytest.raises(ConfigError, match="reader: unknown key 'foo'; known keys are region, num_tags"):
        from_mapping(ImportSettings, {"video": "gone", "reader": {"foo": 1}})
