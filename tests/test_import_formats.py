"""A small file of every format: it is recognised by what it holds, imported, and named in the list of what is supported."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io
from rgbd_bags import BagWriter
from rgbd_files import START_NS, colour, depth_mm, imported, write_camera, write_pictures
from rgbd_mkv import cluster, write_mkv

from tagjax.recording import RecordingError
from tagjax.recording.importers.rgbd.formats import FORMATS, recognise, supported
from tagjax.recording.importers.settings import ImportSettings, import_recording

TIMES_NS = [START_NS, START_NS + 40_000_000]
PAGE = Path(__file__).parents[1] / "docs" / "importing.md"


@dataclasses.dataclass(frozen=True)
class Written:
    """A recording of two frames, and what its import needs beside its path."""

    path: Path
    size: tuple[int, int]  # width, height
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)


def _pictures(folder: Path) -> Written:
    return Written(write_pictures(folder / "take", TIMES_NS, TIMES_NS), (64, 48))


def _video(folder: Path) -> Written:
    path = folder / "take.mp4"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (64, 48))
    (folder / "depth").mkdir()
    for number in range(2):
        writer.write(np.ascontiguousarray(colour(number)[..., ::-1]))
        cv2.imwrite(str(folder / "depth" / f"{0.04 * number:.3f}.png"), depth_mm(number))
    writer.release()
    write_camera(folder / "camera.json")
    return Written(path, (64, 48))


def _bag(folder: Path) -> Written:
    with BagWriter(folder / "take") as bag:
        for topic in ("/camera/color", "/camera/aligned_depth_to_color"):
            bag.info(f"{topic}/camera_info", TIMES_NS[0], "optical")
        for number, time_ns in enumerate(TIMES_NS):
            bag.image("/camera/color/image_raw", colour(number), time_ns, "rgb8", "optical")
            bag.image("/camera/aligned_depth_to_color/image_raw", depth_mm(number), time_ns, "16UC1", "optical")
    return Written(folder / "take", (64, 48))


def _azure_kinect(folder: Path) -> Written:
    blocks = []
    for number in range(2):
        jpeg = cv2.imencode(".jpg", colour(number, (720, 1280)))[1].tobytes()
        depth = depth_mm(number, (288, 320)).astype(">u2").tobytes()
        blocks.append(cluster(40_000 * number, [(1, 0, jpeg), (2, 0, depth)]))
    return Written(write_mkv(folder / "take.mkv", blocks), (1280, 720))


def _tum(folder: Path) -> Written:
    path = folder / "rgbd_dataset_freiburg3_take"
    for name, make in (("rgb", colour), ("depth", depth_mm)):
        (path / name).mkdir(parents=True)
        for number in range(2):
            cv2.imwrite(str(path / name / f"{number}.png"), make(number, (480, 640)))
        (path / f"{name}.txt").write_text(f"# timestamp filename\n1.00 {name}/0.png\n1.04 {name}/1.png\n")
    return Written(path, (640, 480))


def _jpg_mat(folder: Path) -> Written:
    matrix = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
    path = folder / "take"
    path.mkdir()
    for number in range(2):
        cv2.imwrite(str(path / f"image{number}.jpg"), colour(number))
        scipy.io.savemat(path / f"image{number}.mat", {"depth_array": depth_mm(number)})
    cameras = {"Kdepth": matrix, "Krgb": matrix, "R": np.eye(3), "T": np.zeros((3, 1))}
    scipy.io.savemat(folder / "cameras.mat", {"cam_params": cameras})
    return Written(path, (64, 48), {"calibration": str(folder / "cameras.mat"), "fps": 25.0})


WRITERS: dict[str, Callable[[Path], Written]] = {
    "pictures": _pictures,
    "video": _video,
    "bag": _bag,
    "azure_kinect": _azure_kinect,
    "tum": _tum,
    "jpg_mat": _jpg_mat,
}


def test_every_format_has_a_writer_here_and_is_named_where_formats_are_listed() -> None:
    assert set(WRITERS) == set(FORMATS)
    for name in FORMATS:
        assert f"({name})" in supported()
        assert f"| `{name}` |" in PAGE.read_text()


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_of_each_format_is_recognised_and_imported(tmp_path: Path, name: str) -> None:
    (tmp_path / "in").mkdir()
    written = WRITERS[name](tmp_path / "in")
    assert recognise(written.path) == name
    recording = imported(written.path, tmp_path / "a.zarr", **written.settings)
    assert recording.num_frames == 2
    assert (recording.intrinsics.width, recording.intrinsics.height) == written.size
    assert recording.time_ns[1] - recording.time_ns[0] == 40_000_000
    assert np.mean(np.asarray(recording.depth[0]) > 0) > 0.1


def test_a_folder_of_pictures_without_a_camera_file_shows_what_one_holds(tmp_path: Path) -> None:
    path = _pictures(tmp_path).path
    (path / "camera.json").unlink()
    with pytest.raises(
        RecordingError, match=r"no camera file; expected camera\.yaml or camera\.json .*fx_px.*docs/import"
    ):
        import_recording(ImportSettings(video=str(path)))
