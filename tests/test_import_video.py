"""Videos with a folder of depth pictures: frame times of the container, depth by time or by number, damaged files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rgbd_files import CAMERA, HEIGHT, WIDTH, colour, cut, depth_mm, imported, smooth, write_camera

from tagjax.recording import RecordingError
from tagjax.recording.importers.rgbd.video_file import open_video

FPS = 25.0
NUM_FRAMES = 8


def _write_video(path: Path, codec: str, frames: list[np.ndarray]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), FPS, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    return path


def _write_depth(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for number, name in enumerate(names):
        cv2.imwrite(str(folder / f"{name}.png"), depth_mm(number))


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """A lossy .mp4, depth 5 ms after each frame (seconds since the first), and the camera file."""
    path = _write_video(tmp_path / "in" / "take1.mp4", "mp4v", [smooth(number) for number in range(NUM_FRAMES)])
    _write_depth(tmp_path / "in" / "depth", [f"{number / FPS + 0.005:.3f}" for number in range(NUM_FRAMES)])
    write_camera(tmp_path / "in" / "camera.json")
    return path


def test_an_mp4_has_the_times_of_its_container_and_the_depth_of_its_folder(video, tmp_path):
    recording = imported(video, tmp_path / "a.zarr")
    np.testing.assert_array_equal(recording.time_ns, np.arange(NUM_FRAMES) * 40_000_000)
    for number in range(NUM_FRAMES):
        np.testing.assert_array_equal(recording.depth[number], depth_mm(number))
        # mp4v is lossy; red and blue in each other's place would differ by up to 190.
        assert np.abs(recording.colour[number].astype(int) - smooth(number)).mean() < 5
    assert recording.name == "take1"


def _speed_up(path: Path, first: int) -> None:
    """Give the frames of an .mp4 from number `first` on half the duration: a second entry in its table of durations."""
    data = bytearray(path.read_bytes())
    parents, place, end = [], 0, len(data)
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"):
        while data[place + 4 : place + 8] != name:
            place += int.from_bytes(data[place : place + 4], "big")
            assert place < end
        parents.append(place)
        end, place = place + int.from_bytes(data[place : place + 4], "big"), place + 8
    count, number, duration = (int.from_bytes(data[place + 4 * n : place + 4 * n + 4], "big") for n in (1, 2, 3))
    assert (count, number) == (1, NUM_FRAMES)
    table = (2, first, duration, NUM_FRAMES - first, duration // 2)
    data[place + 4 : place + 16] = b"".join(value.to_bytes(4, "big") for value in table)
    for box in parents:
        data[box : box + 4] = (int.from_bytes(data[box : box + 4], "big") + 8).to_bytes(4, "big")
    path.write_bytes(data)


def test_frames_of_different_durations_keep_their_times(video, tmp_path):
    _speed_up(video, 3)
    times_s = np.array([0.0, 0.04, 0.08, 0.12, 0.14, 0.16, 0.18, 0.20])
    for number, path in enumerate(sorted((video.parent / "depth").iterdir())):
        path.rename(path.with_name(f"{times_s[number] + 0.001:.3f}.png"))
    recording = imported(video, tmp_path / "a.zarr")
    np.testing.assert_array_equal(recording.time_ns, np.rint(times_s * 1e9))
    np.testing.assert_array_equal(recording.depth[7], depth_mm(7))


def test_a_lossless_video_keeps_every_pixel(tmp_path):
    frames = [colour(number) for number in range(NUM_FRAMES)]
    path = _write_video(tmp_path / "in" / "take.avi", "MPNG", frames)
    _write_depth(tmp_path / "in" / "take_depth", [f"{number:04d}" for number in range(NUM_FRAMES)])
    write_camera(tmp_path / "in" / "take.json", times="frames")
    recording = imported(path, tmp_path / "a.zarr")
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(recording.colour[number], frame)
        np.testing.assert_array_equal(recording.depth[number], depth_mm(number))
    np.testing.assert_array_equal(recording.time_ns, np.arange(NUM_FRAMES) * 40_000_000)


def test_a_start_puts_frames_and_depth_on_one_clock(video, tmp_path):
    depth = video.parent / "depth"
    start_ns = 1_700_000_000_500_000_000
    for number, path in enumerate(sorted(depth.iterdir())):
        path.rename(depth / f"{start_ns + number * 40_000_000 + 5_000_000}.png")
    with pytest.raises(RecordingError, match="expected both on one clock"):
        imported(video, tmp_path / "a.zarr")
    for start in ("2023-11-14T22:13:20.5Z", 1_700_000_000.5):
        recording = imported(video, tmp_path / f"{type(start).__name__}.zarr", start=start)
        np.testing.assert_array_equal(recording.time_ns, start_ns + np.arange(NUM_FRAMES) * 40_000_000)
        np.testing.assert_array_equal(recording.depth[3], depth_mm(3))
    with pytest.raises(RecordingError, match="start is 'yesterday'"):
        imported(video, tmp_path / "b.zarr", start="yesterday")


def test_depth_may_count_from_the_first_frame_whatever_the_start(video, tmp_path):
    start_ns = 1_700_000_000_500_000_000
    by_name = imported(video, tmp_path / "names.zarr", start="2023-11-14T22:13:20.5Z")
    write_camera(video.parent / "camera.json", times="frames", fps=FPS)
    by_number = imported(video, tmp_path / "numbers.zarr", start="2023-11-14T22:13:20.5Z")
    for recording in (by_name, by_number):
        np.testing.assert_array_equal(recording.time_ns, start_ns + np.arange(NUM_FRAMES) * 40_000_000)
        np.testing.assert_array_equal(recording.depth[3], depth_mm(3))


def test_depth_by_number_needs_one_picture_a_frame(video, tmp_path):
    write_camera(video.parent / "camera.json", times="frames")
    (video.parent / "depth" / "0.045.png").unlink()
    with pytest.raises(RecordingError, match="7 depth pictures for 8 frames"):
        imported(video, tmp_path / "a.zarr")


def test_videos_that_are_cut_short_or_of_another_size_are_refused(video, tmp_path):
    write_camera(video.parent / "camera.json", colour={**CAMERA, "width": WIDTH * 2})
    with pytest.raises(RecordingError, match="colour of 64 x 48 pixels; expected 128 x 48"):
        imported(video, tmp_path / "a.zarr")
    write_camera(video.parent / "camera.json")
    cut(video, 0.7)  # the index stands at the end
    with pytest.raises(RecordingError, match=r"take1\.mp4: no readable video"):
        open_video(video)
    (tmp_path / "in" / "text.mp4").write_text("no video")
    with pytest.raises(RecordingError, match=r"text\.mp4: no readable video \(8 bytes\)"):
        open_video(tmp_path / "in" / "text.mp4")


def test_a_video_that_ends_before_its_index_says_is_refused(tmp_path):
    path = _write_video(tmp_path / "in" / "take.avi", "MJPG", [smooth(number) for number in range(NUM_FRAMES)])
    _write_depth(tmp_path / "in" / "depth", [f"{number / FPS:.3f}" for number in range(NUM_FRAMES)])
    write_camera(tmp_path / "in" / "camera.json")
    cut(path, 0.5)
    with pytest.raises(RecordingError, match=r"of 8 frames can be decoded|no readable video"):
        imported(path, tmp_path / "a.zarr")
    assert not (tmp_path / "a.zarr").exists()


def test_a_video_without_camera_file_or_depth_is_refused(video, tmp_path):
    (video.parent / "depth").rename(video.parent / "z")
    with pytest.raises(RecordingError, match="no folder take1_depth or depth"):
        open_video(video)
    (video.parent / "camera.json").unlink()
    with pytest.raises(RecordingError, match=r"no camera file; expected take1\.json or camera\.json there.*fx_px"):
        open_video(video)
