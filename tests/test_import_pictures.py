"""Folders of colour and depth pictures with a camera file: imported exactly, registered, and refused where they are wrong."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from composed import CONF
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from rgbd_files import (
    CAMERA,
    HEIGHT,
    START_NS,
    WIDTH,
    colour,
    cut,
    depth_mm,
    imported,
    smooth,
    write_camera,
    write_pictures,
)

from tagjax.core.geometry import register_depth, undistort
from tagjax.core.settings import from_mapping
from tagjax.recording import Intrinsics, RecordingError
from tagjax.recording.importers.rgbd.camera_file import read_camera_file
from tagjax.recording.importers.rgbd.picture_folder import open_picture_folder
from tagjax.recording.importers.rgbd.source import Picture, Rig
from tagjax.recording.importers.rgbd.views import Views
from tagjax.recording.importers.settings import ImportSettings, import_recording

TIMES = [START_NS + 33_333_333 * number for number in range(5)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_pictures(tmp_path / "take 1", TIMES, [time_ns + 4_000_000 for time_ns in TIMES])


def _import(folder: Path, **settings):
    return imported(folder, folder.parent / "out.zarr", **settings)


def test_times_intrinsics_and_pixels_are_kept(folder):
    recording = _import(folder)
    np.testing.assert_array_equal(recording.time_ns, TIMES)
    assert recording.intrinsics == Intrinsics(**CAMERA)
    assert recording.depth.dtype == np.uint16
    assert recording.name == "take 1"
    assert "5 of 5 colour pictures have depth" in recording.source
    for number in range(5):
        np.testing.assert_array_equal(recording.colour[number], colour(number))
        np.testing.assert_array_equal(recording.depth[number], depth_mm(number))


def test_the_camera_file_may_be_yaml_elsewhere_and_the_folders_have_other_names(folder):
    (folder / "colour").rename(folder / "left")
    (folder / "depth").rename(folder / "z")
    (folder / "camera.json").unlink()
    text = "colour: {fx_px: 61, fy_px: 60.0, cx_px: 31.5, cy_px: 23.5, width: 64, height: 48}\ndepth_unit_m: 0.001\n"
    text += "depth_registered: true\ncolour_folder: left\ndepth_folder: z\nstart: 2025-06-01T12:00:00.25Z\n"
    (folder.parent / "mine.yaml").write_text(text)
    recording = _import(folder, camera=str(folder.parent / "mine.yaml"))
    assert recording.num_frames == 5
    assert recording.time_ns[0] == 1_748_779_200_250_000_000
    np.testing.assert_array_equal(np.diff(recording.time_ns), np.diff(TIMES))


def test_a_picture_without_depth_in_time_is_left_out_and_counted(folder):
    late = folder / "depth" / f"1700000000.{(TIMES[2] + 4_000_000) % 10**9:09d}.png"
    late.unlink()
    recording = _import(folder)
    np.testing.assert_array_equal(recording.time_ns, [*TIMES[:2], *TIMES[3:]])
    np.testing.assert_array_equal(recording.depth[2], depth_mm(3))
    assert "4 of 5 colour pictures have depth" in recording.source
    with pytest.raises(RecordingError, match=r"no colour picture has depth within 0\.001 s \(colour from 17000"):
        imported(folder, folder.parent / "b.zarr", max_gap_s=0.001)
    assert not (folder.parent / "b.zarr").exists()


def test_depth_units_that_are_no_millimetres_become_metres(folder):
    write_camera(folder / "camera.json", depth_unit_m=0.0002)
    recording = _import(folder)
    assert recording.depth.dtype == np.float32
    np.testing.assert_allclose(recording.depth[1], depth_mm(1) * 0.0002, rtol=1e-6)


@pytest.mark.parametrize("ending", [".tiff", ".npy"])
def test_depth_may_be_floats_in_metres(folder, ending):
    for number, path in enumerate(sorted((folder / "depth").glob("*.png"))):
        metres = (depth_mm(number) / 1000).astype(np.float32)
        metres[5, 5] = np.nan
        np.save(path.with_suffix(".npy"), metres) if ending == ".npy" else cv2.imwrite(
            str(path.with_suffix(ending)), metres
        )
        path.unlink()
    recording = _import(folder)
    expected = (depth_mm(3) / 1000).astype(np.float32)
    expected[5, 5] = 0
    np.testing.assert_array_equal(recording.depth[3], expected)


@pytest.mark.parametrize("listed", ["{time},{name}", "{name} {time}"])
def test_times_come_from_a_list_with_its_unit(folder, listed):
    rows = ["# comment", "name and time"]
    for kind in ("colour", "depth"):
        for number, path in enumerate(sorted((folder / kind).iterdir())):
            path.rename(folder / kind / f"{number:03d}.png")
            rows.append(listed.format(time=f"{1000 + 40 * number}.5", name=f"{kind}/{number:03d}.png"))
    (folder / "times.csv").write_text("\n".join(rows))
    write_camera(folder / "camera.json", times="times.csv", time_unit="ms")
    recording = _import(folder)
    np.testing.assert_array_equal(recording.time_ns, 1_000_500_000 + 40_000_000 * np.arange(5))
    np.testing.assert_array_equal(recording.colour[4], colour(4))


def test_numbered_frames_have_the_times_of_the_frame_rate(folder):
    for kind in ("colour", "depth"):
        for number, path in enumerate(sorted((folder / kind).iterdir())):
            path.rename(folder / kind / f"{number}.png")
    with pytest.raises(RecordingError, match=r"names such as 0 and 4 look like frame numbers"):
        _import(folder)
    write_camera(folder / "camera.json", times="frames")
    with pytest.raises(RecordingError, match="'frames' without fps"):
        _import(folder)
    write_camera(folder / "camera.json", times="frames", fps=15.0, start=1_700_000_000.5)
    recording = _import(folder)
    np.testing.assert_array_equal(recording.time_ns, 1_700_000_000_500_000_000 + np.rint(np.arange(5) * 1e9 / 15))


def _picture(stream, image) -> Picture:
    return Picture(stream, 0, "here", lambda: image)


def test_distortion_is_undone_as_opencv_does_it():
    lens = Intrinsics(**CAMERA, distortion=(0.12, -0.2, 0.003, -0.002, 0.05, 0.1, -0.1, 0.02))
    views = Views(Rig(colour=lens))
    picture = cv2.GaussianBlur(colour(0), (0, 0), 3)
    expected = cv2.undistort(picture, lens.matrix(), np.array(lens.distortion))
    assert np.abs(views.colour(_picture("colour", picture)).astype(int) - expected).max() <= 2
    assert np.abs(picture.astype(int) - expected).max() > 10
    nearest = undistort(picture, depth_mm(0).astype(np.float32), lens)[1]
    found = views.depth(_picture("depth", depth_mm(0)))
    # At the border SciPy counts positions up to half a pixel outside as outside.
    assert (found == nearest)[3:-3, 3:-3].mean() > 0.999
    assert found.dtype == np.uint16
    assert views.intrinsics == dataclasses.replace(lens, distortion=())


def test_depth_of_another_camera_is_registered_as_the_geometry_says(folder):
    angle = 0.05
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    shift = [0.03, 0.0, 0.01]
    other = {**CAMERA, "cx_px": 30.0, "fx_px": 62.0}
    changes = {"depth_registered": False, "depth": other, "rotation": turn.tolist(), "translation_m": shift}
    write_camera(folder / "camera.json", **changes)
    recording = _import(folder)
    metres = (depth_mm(2) / 1000).astype(np.float32)
    expected = register_depth(metres, Intrinsics(**other), Intrinsics(**CAMERA), turn, np.array(shift))
    np.testing.assert_array_equal(recording.depth[2], np.rint(1000 * expected).astype(np.uint16))
    assert recording.depth.dtype == np.uint16
    assert (recording.depth[2] != depth_mm(2)).mean() > 0.5


def test_coarse_depth_leaves_no_holes_in_a_fine_picture():
    fine = Intrinsics(200.0, 200.0, 99.5, 79.5, 200, 160)
    coarse = Intrinsics(80.0, 80.0, 39.5, 31.5, 80, 64)
    wall = np.full((64, 80), 2000, np.uint16)
    wall[:, :40] = 1000
    found = Views(Rig(colour=fine, depth=coarse)).depth(_picture("depth", wall))
    inside = found[4:-4, 4:-4]
    assert set(np.unique(inside)) == {1000, 2000}
    # The edge between columns 39 and 40 of the coarse picture lies between 99 and 100 of the fine one.
    assert np.abs((found[80] == 1000).sum() - 100) <= 1


def test_range_of_a_depth_camera_becomes_depth():
    camera = Intrinsics(**CAMERA)
    rays = np.stack(np.meshgrid((np.arange(WIDTH) - 31.5) / 61.0, (np.arange(HEIGHT) - 23.5) / 60.0), axis=-1)
    distance_m = (2.0 * np.sqrt(1 + np.square(rays).sum(axis=-1))).astype(np.float32)
    beside = Rig(colour=camera, depth=camera, translation_m=np.array([0.0, 0.0, 1e-6]), depth_kind="range")
    found = Views(beside).depth(_picture("depth", distance_m))
    np.testing.assert_allclose(found, 2.0, atol=1e-4)
    assert Views(beside).depth_kind == "depth"
    assert Views(Rig(colour=camera, depth_kind="range")).depth_kind == "range"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth_unit_m": None}, "no key 'depth_unit_m'"),
        ({"depth_registered": None}, "no key 'depth_registered'"),
        ({"depth_unit_m": 1.0}, r"depth_unit_m is 1\.0; expected the metres of one unit"),
        ({"depth_registered": False}, "expected depth .*, rotation .* and translation_m"),
        ({"depth": CAMERA}, "depth_registered is true, and depth is given"),
        ({"colour": {**CAMERA, "fx_px": 3.1}}, "fx_px is 3.1 for images of 64 x 48"),
        ({"colour": {**CAMERA, "fx": 3.1}}, "colour: unknown key 'fx'"),
        ({"colour": {**CAMERA, "distortion": [0.1]}}, "distortion is"),
        ({"fps": 0.0}, "fps is 0.0"),
        ({"colour_folder": "../take 1/colour"}, r"colour_folder is '\.\./take 1/colour'; expected a folder inside"),
        ({"colour_folder": "/etc"}, "colour_folder is '/etc'; expected a folder inside"),
        ({"depth_folder": "gone"}, "gone: no such folder; depth_folder names it"),
        ({"times": "../times.csv"}, r"times is '\.\./times.csv'; expected names, frames, or a list"),
        ({"start": "noon", "times": "frames", "fps": 30}, "start is 'noon'"),
    ],
)
def test_camera_files_that_cannot_be_used_are_refused(folder, changes, message):
    write_camera(folder / "camera.json", **changes)
    with pytest.raises(RecordingError, match=message):
        _import(folder)


@pytest.mark.parametrize(
    ("rotation", "translation", "message"),
    [
        (np.diag([1.0, 1.0, -1.0]).tolist(), [0.0, 0.0, 0.0], "is no rotation"),
        ((2 * np.eye(3)).tolist(), [0.0, 0.0, 0.0], "is no rotation"),
        (np.eye(3).tolist(), [25.0, 0.0, 0.0], "Millimetres must be converted"),
        (np.eye(2).tolist(), [0.0, 0.0, 0.0], "rotation"),
    ],
)
def test_extrinsics_that_cannot_be_are_refused(folder, rotation, translation, message):
    changes = {"depth_registered": False, "depth": CAMERA, "rotation": rotation, "translation_m": translation}
    write_camera(folder / "camera.json", **changes)
    with pytest.raises(RecordingError, match=message):
        _import(folder)


def test_camera_files_hold_plain_values_only(tmp_path):
    path = tmp_path / "camera.yaml"
    for text, message in (
        ("a: &x [1]\nb: *x", "a reference"),
        ("a: !!python/object/apply:os.system ['true']", "no readable YAML"),
        ("[1, 2]", "no keys and values"),
        ("a: [1", "no readable YAML"),
        (" " * 1_100_000, "expected a camera file of some lines"),
    ):
        path.write_text(text)
        with pytest.raises(RecordingError, match=message):
            read_camera_file(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecordingError, match="cannot be read"):
        read_camera_file(path)
    (tmp_path / "camera.json").write_text('{"a": ')
    with pytest.raises(RecordingError, match="no readable JSON"):
        read_camera_file(tmp_path / "camera.json")


def test_damaged_pictures_and_other_sizes_stop_the_import_and_leave_nothing(folder):
    victim = sorted((folder / "colour").iterdir())[3]
    whole = victim.read_bytes()
    cut(victim, 0.6)
    with pytest.raises(RecordingError, match="the image is truncated"):
        _import(folder)
    cv2.imwrite(str(victim), smooth(3)[:40])
    with pytest.raises(
        RecordingError, match=r"colour of 64 x 40 pixels; expected 64 x 48 as in the camera's intrinsics"
    ):
        _import(folder)
    victim.write_bytes(whole)
    victim = sorted((folder / "depth").iterdir())[2]
    cv2.imwrite(str(victim), np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(RecordingError, match="depth is uint8 of shape"):
        _import(folder)
    np.save(victim.with_suffix(".npy"), np.zeros((4, 4), object), allow_pickle=True)
    victim.unlink()
    with pytest.raises(RecordingError, match=r"no readable \.npy file"):
        _import(folder)
    assert [path.name for path in folder.parent.iterdir()] == ["take 1"]


def test_names_and_lists_that_give_no_time_are_refused(folder):
    first = min((folder / "colour").iterdir())
    first.rename(folder / "colour" / "first.png")
    with pytest.raises(RecordingError, match=r"first\.png names no time"):
        _import(folder)
    (folder / "colour" / "first.png").rename(folder / "colour" / f"{TIMES[1]}.png")
    with pytest.raises(RecordingError, match="have one time"):
        _import(folder)
    (folder / "colour" / f"{TIMES[1]}.png").rename(folder / "colour" / f"{10**25}.png")
    with pytest.raises(RecordingError, match="wrong unit"):
        _import(folder)
    write_camera(folder / "camera.json", times="list.txt")
    (folder / "list.txt").write_text("1 ../out.png\n2 /etc/a.png\n3 colour/gone.png\n")
    with pytest.raises(RecordingError, match=r"3 of 3 rows rejected \(2: the file is outside of the folder"):
        _import(folder)


def test_folders_without_what_is_needed_are_refused_with_what_is_supported(folder, tmp_path):
    for path in (folder / "depth").iterdir():
        path.unlink()
    with pytest.raises(RecordingError, match="no picture; expected files that end in"):
        _import(folder)
    (folder / "depth").rmdir()
    with pytest.raises(RecordingError, match="no folder depth"):
        _import(folder)
    (folder / "intrinsics.yaml").write_text("a: 1")
    with pytest.raises(RecordingError, match=r"found camera\.json, intrinsics\.yaml; expected one camera file"):
        _import(folder)
    with pytest.raises(RecordingError, match="no camera file"):
        open_picture_folder(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.xyz").touch()
    for name in ("empty", "a.xyz"):
        with pytest.raises(
            RecordingError, match=r"no known recording.*camera\.json.*\.mp4.*\.mcap.*\.mkv.*rgb\.txt"
        ) as caught:
            import_recording(ImportSettings(video=str(tmp_path / name)))
        assert "docs/importing.md" in str(caught.value)
    (tmp_path / "empty" / "take.mcap").touch()
    with pytest.raises(RecordingError, match=r"It holds take\.mcap: give the path of that file"):
        import_recording(ImportSettings(video=str(tmp_path / "empty")))
    with pytest.raises(RecordingError, match="no such file or folder"):
        import_recording(ImportSettings(video=str(tmp_path / "gone")))


def test_without_out_nothing_is_written(folder):
    recording, lines = import_recording(ImportSettings(video=str(folder)))
    assert recording is None
    assert any("colour camera: 64 x 48" in line for line in lines)
    assert [path.name for path in folder.parent.iterdir()] == ["take 1"]
    assert json.loads((folder / "camera.json").read_text())["depth_registered"] is True


def test_the_settings_of_the_command_are_those_of_the_library():
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        values = OmegaConf.to_container(compose("import_recording"), resolve=True)
    assert isinstance(values, dict)
    known = {field.name for field in dataclasses.fields(ImportSettings)}
    assert set(values) - {"paths"} == known
    assert (
        from_mapping(ImportSettings, {str(key): value for key, value in values.items() if key in known})
        == ImportSettings()
    )
