"""RGB-D folders made here: pictures with .mat depth, and TUM RGB-D; whole, incomplete and damaged."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io

from tagjax.core.geometry import undistort
from tagjax.recording import Intrinsics, RecordingError
from tagjax.recording.importers.rgbd_folder import (
    TUM_INTRINSICS,
    import_jpg_mat,
    import_tum,
    load_calibration,
    read_colour,
    read_labels,
    read_mat_depth,
)
from tagjax.recording.store import open_recording, save_recording

HEIGHT, WIDTH = 48, 64
CAMERA = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])


def _picture(number: int, shape=(HEIGHT, WIDTH)) -> np.ndarray:
    """A smooth RGB picture, which JPEG keeps well, unlike in its three channels."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.stack([x * 200 / shape[1], y * 200 / shape[0], np.full(shape, 40.0 + 10 * number)], -1).astype(np.uint8)


def _depth_mm(number: int) -> np.ndarray:
    depth = np.full((HEIGHT, WIDTH), 3000, np.uint16)
    depth[10:30, 20:40] = 1500 + 10 * number
    return depth


def _save_calibration(path: Path, *, translation=(0.0, 0.0, 0.0), **changes) -> Path:
    found = {"Kdepth": CAMERA, "Krgb": CAMERA, "R": np.eye(3), "T": np.reshape(translation, (3, 1)), **changes}
    scipy.io.savemat(path, {"cam_params": {name: value for name, value in found.items() if value is not None}})
    return path


@pytest.fixture
def folder(tmp_path) -> Path:
    """Four pictures with depth and label masks (in masks/), depth and colour camera being the same."""
    path = tmp_path / "walk"
    (path / "masks").mkdir(parents=True)
    for number in range(4):
        cv2.imwrite(str(path / f"image{number:03d}.jpg"), _picture(number)[..., ::-1])
        scipy.io.savemat(path / f"image{number:03d}.mat", {"depth_array": _depth_mm(number)}, do_compression=True)
        labels = np.where(_depth_mm(number) < 3000, number + 1, 0).astype(np.uint8)
        cv2.imwrite(str(path / "masks" / f"{number:03d}.png"), labels)
    _save_calibration(path / "cameras.mat")
    return path


@pytest.fixture
def importing(folder):
    return lambda **settings: import_jpg_mat(folder, folder / "cameras.mat", **{"fps": 10.0, **settings})


def test_pictures_with_mat_depth_are_imported_as_they_are(folder, importing, tmp_path):
    recording = importing(masks=folder / "masks")
    with pytest.warns(UserWarning, match="no tag read"):
        recording.check()
    assert recording.colour.shape == (4, HEIGHT, WIDTH, 3)
    for number in range(4):
        # JPEG is lossy; red and blue in each other's place would differ by up to 160.
        np.testing.assert_allclose(recording.colour[number], _picture(number), atol=12)
        np.testing.assert_array_equal(recording.depth[number], _depth_mm(number))
        assert set(np.unique(recording.truth.labels[number])) == {0, number + 1}
    np.testing.assert_array_equal(recording.time_ns, np.arange(4) * 100_000_000)
    assert (recording.intrinsics.fx_px, recording.intrinsics.cx_px) == (60.0, 31.5)
    save_recording(recording, tmp_path / "a.zarr")
    with pytest.warns(UserWarning, match="no tag read"):
        again = open_recording(tmp_path / "a.zarr")
    np.testing.assert_array_equal(again.depth[3], _depth_mm(3))
    np.testing.assert_array_equal(again.colour[2], recording.colour[2])


def test_frames_come_in_the_order_of_the_numbers_in_their_names(folder, importing):
    for number in range(4):
        for old, new in ((f"image{number:03d}", f"image{number + 8}"), (f"masks/{number:03d}", f"masks/{number + 8}")):
            for path in folder.glob(f"{old}.*"):
                path.rename(folder / f"{new}{path.suffix}")
    recording = importing(masks=folder / "masks")
    for number in range(4):
        np.testing.assert_array_equal(recording.depth[number], _depth_mm(number))
        assert recording.truth.labels[number].max() == number + 1


def test_frames_that_are_files_behave_as_arrays(importing):
    depth = importing().depth
    np.testing.assert_array_equal(depth[1:3], [_depth_mm(1), _depth_mm(2)])
    np.testing.assert_array_equal(depth[-1], _depth_mm(3))
    assert np.asarray(depth).shape == (4, HEIGHT, WIDTH)
    assert depth[2:2].shape == (0, HEIGHT, WIDTH)
    with pytest.raises(IndexError):
        depth[4]


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_a_shifted_depth_camera_moves_the_depth_by_its_parallax(folder, unit):
    # 0.1 m to the right: 60 px * 0.1 m / 1.5 m = 4 px of the near square, 2 px of the wall.
    calibration = _save_calibration(folder / "moved.mat", translation=np.array([0.1, 0, 0]) * unit)
    moved = import_jpg_mat(folder, calibration, fps=10.0).depth[0]
    assert np.all(moved[10:30, 24:44] == 1500)
    assert np.all(moved[10:30, 46:] == 3000)
    assert np.all(moved[12:28, 22:24] == 0)  # the wall that the colour camera sees and the depth camera does not
    assert np.all(moved[:, 1] == 0)
    corrected = import_jpg_mat(folder, calibration, fps=10.0, correction=(-0.1, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0)).depth[0]
    np.testing.assert_array_equal(corrected, _depth_mm(0))


def test_incomplete_folders_are_errors(folder, importing, tmp_path):
    with pytest.raises(RecordingError, match="0 masks for 4 images"):
        importing(masks=tmp_path)
    (folder / "masks" / "002.png").unlink()
    with pytest.raises(RecordingError, match="3 masks for 4 images"):
        importing(masks=folder / "masks")
    with pytest.raises(RecordingError, match="positive frame rate"):
        importing(fps=0.0)
    (folder / "image002.mat").unlink()
    with pytest.raises(RecordingError, match=r"1 of 4 images have no depth file \(no image002\.mat\)"):
        importing()
    with pytest.raises(RecordingError, match=r"no \.jpg file"):
        import_jpg_mat(tmp_path, folder / "cameras.mat", fps=10.0)


def _cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


@pytest.mark.parametrize("share", [0.0, 0.1, 0.7, 0.999])
@pytest.mark.parametrize("name", ["whole.jpg", "whole.png", "progressive.jpg"])
def test_a_picture_that_is_cut_short_is_an_error(tmp_path, name, share):
    path = tmp_path / name
    noisy = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    cv2.imwrite(str(path), noisy, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1] if "progressive" in name else [])
    assert read_colour(path).shape == (64, 64, 3)
    _cut(path, share)
    for read in (read_colour, read_labels):
        with pytest.raises(RecordingError, match=f"{name}: "):
            read(path)


def test_what_follows_a_picture_and_what_precedes_it_does_not_matter(tmp_path):
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), _picture(0))
    data = path.read_bytes()
    padded, with_thumbnail = data + bytes(700), data[:2] + b"\xff\xe1\x00\x06\xff\xd9\xff\xd9" + data[2:]
    for good in (padded, with_thumbnail):
        path.write_bytes(good)
        assert read_colour(path).shape == (HEIGHT, WIDTH, 3)
    # The end marker of a thumbnail in the header is not the picture's.
    path.write_bytes(with_thumbnail[: len(with_thumbnail) * 2 // 3])
    with pytest.raises(RecordingError, match=r"a\.jpg: the image is truncated"):
        read_colour(path)


def test_altered_and_foreign_pictures_are_errors(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), _picture(0))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(RecordingError, match=r"a\.png: the image is truncated or damaged"):
        read_colour(path)
    path.write_text("no picture")
    with pytest.raises(RecordingError, match=r"a\.png: no readable image \(10 bytes\)"):
        read_colour(path)
    with pytest.raises(RecordingError, match=r"b\.png: cannot be read"):
        read_colour(tmp_path / "b.png")


def test_a_cut_picture_stops_the_import_before_it_is_in_a_recording(folder, importing, tmp_path):
    _cut(folder / "image002.jpg", 0.8)
    recording = importing()
    with pytest.raises(RecordingError, match=r"image002\.jpg: the image is truncated"):
        recording.colour[1:4]
    with pytest.raises(RecordingError, match=r"image002\.jpg"):
        save_recording(recording, tmp_path / "a.zarr")
    assert not (tmp_path / "a.zarr").exists()


@pytest.mark.parametrize("compressed", [False, True])
def test_a_mat_file_that_is_cut_short_is_an_error_wherever_it_is_cut(tmp_path, compressed):
    path = tmp_path / "a.mat"
    depth = np.random.default_rng(0).integers(0, 4000, (8, 8)).astype(np.uint16)
    scipy.io.savemat(path, {"depth_array": depth}, do_compression=compressed)
    np.testing.assert_array_equal(read_mat_depth(path), depth)
    data = path.read_bytes()
    for length in range(0, len(data) - 1, 3):
        path.write_bytes(data[:length])
        with pytest.raises(RecordingError, match=r"a\.mat: "):
            read_mat_depth(path)


def test_garbage_in_a_mat_file_is_an_error_or_the_depth_of_another_picture(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"depth_array": _depth_mm(0)}, do_compression=True)
    data = path.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(100):
        altered = bytearray(data)
        altered[int(rng.integers(116, len(data)))] = int(rng.integers(256))
        path.write_bytes(bytes(altered))
        try:
            read_mat_depth(path)
        except RecordingError:
            refused += 1
    assert refused > 50
    path.write_bytes(rng.bytes(5000))
    with pytest.raises(RecordingError, match=r"a\.mat: no readable MATLAB file"):
        read_mat_depth(path)


@pytest.mark.parametrize(
    ("found", "message"),
    [
        ({"depth": np.zeros((4, 4), np.uint16)}, "no variable 'depth_array'"),
        ({"depth_array": np.zeros((4, 4))}, r"depth_array is float64 of shape \(4, 4\)"),
        ({"depth_array": np.zeros((4, 4, 2), np.uint16)}, r"uint16 of shape \(4, 4, 2\)"),
        ({"depth_array": "text"}, "depth_array is <U4"),
    ],
)
def test_another_mat_file_is_an_error(tmp_path, found, message):
    scipy.io.savemat(tmp_path / "a.mat", found)
    with pytest.raises(RecordingError, match=message):
        read_mat_depth(tmp_path / "a.mat")


def test_depth_or_pictures_of_another_size_are_errors(folder, importing):
    scipy.io.savemat(folder / "image001.mat", {"depth_array": np.ones((10, 12), np.uint16)})
    cv2.imwrite(str(folder / "image003.jpg"), _picture(0, (20, 30)))
    recording = importing()
    with pytest.raises(RecordingError, match=r"image001\.mat: depth of shape \(10, 12\); expected \(48, 64\)"):
        recording.depth[1]
    with pytest.raises(RecordingError, match=r"image003\.jpg: an image of shape \(20, 30, 3\)"):
        recording.colour[3]


def test_a_calibration_that_lacks_something_is_an_error(tmp_path):
    path = tmp_path / "cameras.mat"
    for changes in ({"T": None}, {"Krgb": np.eye(2)}, {"T": np.zeros(4)}):
        _save_calibration(path, **changes)
        with pytest.raises(RecordingError, match=r"cameras\.mat: cam_params is incomplete"):
            load_calibration(path, (HEIGHT, WIDTH))
    scipy.io.savemat(path, {"cam_params": 3.0})
    with pytest.raises(RecordingError, match="cam_params is incomplete"):
        load_calibration(path, (HEIGHT, WIDTH))
    _save_calibration(path)
    _cut(path, 0.6)
    with pytest.raises(RecordingError, match=r"cameras\.mat: no (readable|variable)"):
        load_calibration(path, (HEIGHT, WIDTH))


def _tum(path: Path, rgb_s, depth_s) -> Path:
    """A TUM RGB-D folder with the given times, in the order given; the n-th depth map is a wall at 1 + n / 10 m."""
    for kind in ("rgb", "depth"):
        (path / kind).mkdir(parents=True)
    for number, stamp in enumerate(rgb_s):
        cv2.imwrite(str(path / "rgb" / f"{stamp:.3f}.png"), _picture(number, (480, 640))[..., ::-1])
    for number, stamp in enumerate(depth_s):
        wall = np.full((480, 640), 5000 + 500 * number, np.uint16)
        wall[200:240, 300:340] = 0
        cv2.imwrite(str(path / "depth" / f"{stamp:.3f}.png"), wall)
    for kind, stamps in (("rgb", rgb_s), ("depth", depth_s)):
        lines = ["# color images", "# timestamp filename", *(f"{s:.3f} {kind}/{s:.3f}.png" for s in stamps)]
        (path / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    return path


def test_tum_pairs_pictures_with_the_nearest_depth(tmp_path):
    # Out of order; 100.2 has no depth within 20 ms, 100.1 has two.
    folder = _tum(
        tmp_path / "rgbd_dataset_freiburg3_walk", [100.1, 100.0, 100.3, 100.2], [100.31, 100.098, 100.004, 100.115]
    )
    recording = import_tum(folder)
    with pytest.warns(UserWarning, match="no tag read"):
        recording.check()
    np.testing.assert_array_equal(recording.time_ns, [100_000_000_000, 100_100_000_000, 100_300_000_000])
    # Units of 1/5000 m: walls 2, 1 and 0 of the list, at 1.2, 1.1 and 1.0 m.
    np.testing.assert_array_equal(recording.depth[:][:, 0, 0], [1200, 1100, 1000])
    assert np.all(recording.depth[0][200:240, 300:340] == 0)
    np.testing.assert_array_equal(recording.colour[0], _picture(1, (480, 640)))
    np.testing.assert_array_equal(recording.colour[2], _picture(2, (480, 640)))
    assert "1 of 4 images without depth left out" in recording.source
    assert recording.intrinsics == Intrinsics(535.4, 539.2, 320.1, 247.6, 640, 480)
    assert import_tum(folder, max_gap_s=0.003).num_frames == 1
    assert import_tum(folder, max_gap_s=0.2).num_frames == 4
    with pytest.raises(RecordingError, match="no image has a depth map within"):
        import_tum(folder, max_gap_s=0.0005)


@pytest.mark.parametrize("camera", ["freiburg1", "freiburg2"])
def test_tum_lens_distortion_is_undone(tmp_path, camera):
    folder = _tum(tmp_path / "somewhere", [1.0], [1.0])
    fx, fy, cx, cy, distortion = TUM_INTRINSICS[camera]
    ideal = Intrinsics(fx, fy, cx, cy, 640, 480)
    # A dot that the ideal camera sees at (column, row) is painted where OpenCV says that the lens shows it.
    column, row = 520, 80
    ray = np.array([[[(column - cx) / fx, (row - cy) / fy, 1.0]]])
    seen, _ = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), ideal.matrix(), np.array(distortion))
    x, y = np.rint(seen.reshape(2)).astype(int)
    assert np.hypot(x - column, y - row) > 3
    picture = np.zeros((480, 640, 3), np.uint8)
    picture[y - 2 : y + 3, x - 2 : x + 3] = (200, 100, 50)
    cv2.imwrite(str(folder / "rgb" / "1.000.png"), picture[..., ::-1])
    raw = np.full((480, 640), 10000, np.uint16)
    raw[y - 2 : y + 3, x - 2 : x + 3] = 5000
    cv2.imwrite(str(folder / "depth" / "1.000.png"), raw)

    recording = import_tum(folder, camera=camera)
    assert recording.intrinsics == ideal
    assert f"distortion of {camera} removed" in recording.source
    colour, depth = recording.colour[0], recording.depth[0]
    np.testing.assert_array_equal(colour[row, column], [200, 100, 50])
    assert depth[row, column] == 1000
    assert set(np.unique(depth)) <= {0, 1000, 2000}  # nearest: depths are not mixed
    place = np.argwhere(depth == 1000).mean(axis=0)
    np.testing.assert_allclose(place, [row, column], atol=0.8)
    expected = undistort(picture, (raw / 5000).astype(np.float32), dataclasses.replace(ideal, distortion=distortion))
    np.testing.assert_array_equal(colour, expected[0])
    np.testing.assert_allclose(depth / 1000, expected[1], atol=1e-3)


def test_tum_folders_that_cannot_be_used_are_errors(tmp_path):
    folder = _tum(tmp_path / "freiburg3", [1.0, 2.0], [1.0, 2.0])
    with pytest.raises(RecordingError, match="unknown TUM camera 'kinect'"):
        import_tum(folder, camera="kinect")
    _cut(folder / "rgb" / "2.000.png", 0.5)
    with pytest.raises(RecordingError, match=r"2\.000\.png: the image is truncated"):
        import_tum(folder).colour[1]
    cv2.imwrite(str(folder / "depth" / "2.000.png"), np.zeros((480, 640), np.uint8))
    with pytest.raises(RecordingError, match=r"2\.000\.png: uint8 of shape"):
        import_tum(folder).depth[1]
    cv2.imwrite(str(folder / "rgb" / "1.000.png"), np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(RecordingError, match=r"an image of \(240, 320\); expected \(480, 640\)"):
        import_tum(folder)
    (folder / "depth" / "2.000.png").unlink()
    (folder / "depth" / "1.000.png").unlink()
    with pytest.raises(
        RecordingError, match=r"depth\.txt: 2 of 2 rows rejected \(2: the file is missing \(lines 3, 4\)\)"
    ):
        import_tum(folder)
    (folder / "rgb.txt").write_text("# none\n")
    with pytest.raises(RecordingError, match=r"rgb\.txt: found no row; expected a time in seconds"):
        import_tum(folder)
    (folder / "rgb.txt").write_text("1.0\n")
    with pytest.raises(RecordingError, match=r"rgb\.txt: 1 of 1 rows rejected"):
        import_tum(folder)
    (folder / "rgb.txt").unlink()
    with pytest.raises(RecordingError, match=r"rgb\.txt: missing"):
        import_tum(folder)
