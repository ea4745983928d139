"""Azure Kinect recordings made here: exact, with the calibration of their mode, and refused where they are damaged."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rgbd_files import CAMERA, cut, imported, write_camera
from rgbd_mkv import COLOUR_LENS, DEPTH_LENS, calibration, cluster, track, write_mkv

from tagjax.core.geometry import register_depth, undistort
from tagjax.recording import RecordingError
from tagjax.recording.importers.rgbd.azure_kinect import open_azure_kinect
from tagjax.recording.importers.rgbd.matroska import Matroska
from tagjax.recording.importers.rgbd.pairing import Tally, pairs

TIMES_US = [1_000_000, 1_033_333, 1_066_656]


def _colour(number: int) -> np.ndarray:
    y, x = np.mgrid[:720, :1280]
    return np.stack([x / 6, y / 4, np.full(x.shape, 40.0 * number)], -1).astype(np.uint8)


def _depth(number: int) -> np.ndarray:
    found = np.random.default_rng(number).integers(500, 4000, (288, 320)).astype(np.uint16)
    found[:, :9] = 0
    return found


def _jpeg(number: int) -> bytes:
    return cv2.imencode(".jpg", _colour(number)[..., ::-1])[1].tobytes()


def _clusters(*, grouped: bool = True) -> list[bytes]:
    """A cluster a frame: colour, then depth 100 us before the cluster's own time."""
    return [
        cluster(time_us, [(1, 0, _jpeg(number)), (2, -100, _depth(number).astype(">u2").tobytes())], grouped=grouped)
        for number, time_us in enumerate(TIMES_US)
    ]


@pytest.mark.parametrize("grouped", [True, False])
def test_pictures_and_times_of_both_tracks_are_kept(tmp_path, grouped):
    source = open_azure_kinect(write_mkv(tmp_path / "take.mkv", _clusters(grouped=grouped)))
    tally = Tally()
    found = list(pairs(source.pictures(), source.max_gap_s, tally))
    assert [colour.time_ns for colour, _ in found] == [time_us * 1000 for time_us in TIMES_US]
    assert [depth.time_ns for _, depth in found] == [time_us * 1000 - 100_000 for time_us in TIMES_US]
    assert tally.line() == "3 of 3 colour pictures have depth, of 3 depth pictures"
    for number, (colour, depth) in enumerate(found):
        np.testing.assert_array_equal(depth.decode(), _depth(number))
        decoded = cv2.imdecode(np.frombuffer(_jpeg(number), np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(colour.decode(), decoded[..., ::-1])
    assert "depth mode NFOV_2X2BINNED" in source.description


def test_an_independent_reader_sees_the_same_colour(tmp_path):
    path = write_mkv(tmp_path / "take.mkv", _clusters(grouped=False))
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (1280, 720)
    colour = [one for one in open_azure_kinect(path).pictures() if one.stream == "colour"]
    for one in colour:
        decoded, image = video.read()
        assert decoded
        # FFmpeg converts from YUV by another rounding.
        difference = np.abs(image[..., ::-1].astype(int) - one.decode())
        assert difference.max() <= 6
        assert difference.mean() < 1.5
    video.release()


def test_the_calibration_is_that_of_the_mode(tmp_path):
    rig = open_azure_kinect(write_mkv(tmp_path / "take.mkv", _clusters())).rig
    # 720p: the 4:3 sensor scaled to 1280 x 960, 120 rows cut off; a pixel's centre lies half a pixel from its corner.
    cx, cy, fx, fy = COLOUR_LENS[:4]
    np.testing.assert_allclose(
        [rig.colour.cx_px, rig.colour.cy_px, rig.colour.fx_px, rig.colour.fy_px],
        [cx * 1280 - 0.5, cy * 960 - 120 - 0.5, fx * 1280, fy * 960],
    )
    # NFOV_2X2BINNED: 512 x 512, of which columns from 96 and rows from 90 on are kept.
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = DEPTH_LENS
    np.testing.assert_allclose(
        [rig.depth.cx_px, rig.depth.cy_px, rig.depth.fx_px, rig.depth.fy_px],
        [cx * 512 - 96 - 0.5, cy * 512 - 90 - 0.5, fx * 512, fy * 512],
    )
    assert rig.depth.distortion == (k1, k2, p1, p2, k3, k4, k5, k6)
    np.testing.assert_allclose(rig.translation_m, [-0.032, -0.002, 0.004])
    np.testing.assert_allclose(rig.rotation, cv2.Rodrigues(np.array([0.1, 0.0, 0.0]))[0])


def test_an_older_calibration_is_of_the_wide_picture(tmp_path):
    cx, cy, fx, fy = COLOUR_LENS[:4]
    wide = [cx, (cy * 3072 - 384) / 2304, fx, fy * 3072 / 2304, *COLOUR_LENS[4:]]
    older = write_mkv(tmp_path / "old.mkv", _clusters(), attached=calibration(colour=wide, sensor=(4096, 2304)))
    found, expected = open_azure_kinect(older).rig, open_azure_kinect(write_mkv(tmp_path / "a.mkv", _clusters())).rig
    np.testing.assert_allclose(found.colour.matrix(), expected.colour.matrix())


def test_a_recording_is_undistorted_and_registered(tmp_path):
    path = write_mkv(tmp_path / "take.mkv", _clusters())
    recording = imported(path, tmp_path / "a.zarr", start="2025-06-01T12:00:00Z")
    np.testing.assert_array_equal(np.diff(recording.time_ns), 1000 * np.diff(TIMES_US))
    assert recording.time_ns[0] == 1_748_779_200 * 10**9
    assert recording.intrinsics.distortion == ()
    rig = open_azure_kinect(path).rig
    straight, depth_m, camera = undistort(
        np.zeros((288, 320, 3), np.uint8), (_depth(1) / 1000).astype(np.float32), rig.depth
    )
    assert straight.shape == (288, 320, 3)
    size = 3  # 320 columns of depth for 1280 of colour: f is 251 and 611 px
    fine = depth_m.repeat(size, axis=0).repeat(size, axis=1)
    larger = type(camera)(
        camera.fx_px * size,
        camera.fy_px * size,
        camera.cx_px * size + 1,
        camera.cy_px * size + 1,
        320 * size,
        288 * size,
    )
    expected = register_depth(fine, larger, recording.intrinsics, rig.rotation, rig.translation_m)
    same = recording.depth[1] == np.rint(1000 * expected).astype(np.uint16)
    assert same.mean() > 0.99
    assert 0.35 < (recording.depth[1] > 0).mean() < 0.5  # the depth camera sees the middle only


@pytest.mark.parametrize("kind", [b"NV12", b"YUY2", b"BGRA"])
def test_uncompressed_colour_is_converted(tmp_path, kind):
    picture = _colour(1)
    if kind == b"NV12":
        planes = cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_I420)
        u, v = (planes[720 + 180 * n : 900 + 180 * n].reshape(360, 640) for n in (0, 1))
        data = np.concatenate([planes[:720], np.stack([u, v], -1).reshape(360, 1280)]).tobytes()
    elif kind == b"YUY2":
        data = cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_YUY2).tobytes()
    else:
        data = cv2.cvtColor(picture, cv2.COLOR_RGB2BGRA).tobytes()
    tracks = [track(1, "COLOR", kind, 1280, 720), track(2, "DEPTH", b"b16g", 320, 288)]
    depth = _depth(0).astype(">u2").tobytes()
    path = write_mkv(tmp_path / "a.mkv", [cluster(0, [(1, 0, data), (2, 0, depth)])], tracks=tracks)
    found = next(one for one in open_azure_kinect(path).pictures() if one.stream == "colour").decode()
    assert np.abs(found.astype(int) - picture).max() <= (0 if kind == b"BGRA" else 8)
    path = write_mkv(tmp_path / "b.mkv", [cluster(0, [(1, 0, data[:-2]), (2, 0, depth)])], tracks=tracks)
    with pytest.raises(RecordingError, match=r"track COLOR, picture 0: \d+ bytes; expected"):
        next(open_azure_kinect(path).pictures()).decode()


def test_files_of_another_kind_are_refused_with_what_to_do(tmp_path):
    (tmp_path / "text.mkv").write_bytes(b"no video at all")
    with pytest.raises(RecordingError, match=r"text\.mkv: (no Matroska file|truncated or damaged)"):
        Matroska(tmp_path / "text.mkv")
    film = track(1, "film", b"\x00" * 4, 64, 48, codec="V_MPEG4/ISO/AVC")
    with pytest.raises(RecordingError, match=r"no track COLOR.*film \(V_MPEG4/ISO/AVC\).*ffmpeg: colour to \.mp4"):
        open_azure_kinect(write_mkv(tmp_path / "film.mkv", [], tracks=[film]))
    other = [track(1, "COLOR", b"H264", 64, 48), track(2, "DEPTH", b"b16g", 64, 48)]
    with pytest.raises(RecordingError, match=r"track COLOR holds 'H264'; expected MJPG"):
        open_azure_kinect(write_mkv(tmp_path / "h264.mkv", [], tracks=other))
    small = [track(1, "COLOR", b"MJPG", 64, 48), track(2, "DEPTH", b"b16g", 64, 48)]
    with pytest.raises(RecordingError, match="depth of 64 x 48; expected 320 x 288"):
        open_azure_kinect(write_mkv(tmp_path / "small.mkv", [], tracks=small))
    source = open_azure_kinect(tmp_path / "small.mkv", write_camera(tmp_path / "mine.json"))
    assert source.rig.colour.fx_px == CAMERA["fx_px"]


@pytest.mark.parametrize(
    ("attached", "message"),
    [
        (b"{", r"calibration\.json is incomplete"),
        (b'{"CalibrationInformation": {"Cameras": []}}', r"calibration\.json is incomplete \(KeyError"),
        ({**calibration(depth=[0.5] * 3)}, r"calibration\.json is incomplete"),
    ],
)
def test_a_calibration_that_lacks_something_is_refused(tmp_path, attached, message):
    with pytest.raises(RecordingError, match=message):
        open_azure_kinect(write_mkv(tmp_path / "a.mkv", _clusters(), attached=attached))


@pytest.mark.parametrize("fraction", [0.0, 0.0001, 0.01, 0.4, 0.95])
def test_a_file_that_is_cut_short_is_refused(tmp_path, fraction):
    path = cut(write_mkv(tmp_path / "take.mkv", _clusters()), fraction)
    with pytest.raises(RecordingError, match="truncated or damaged at byte"):
        imported(path, tmp_path / "a.zarr")
    assert not (tmp_path / "a.zarr").exists()


def test_a_damaged_jpeg_stops_the_import(tmp_path: Path):
    depth = _depth(0).astype(">u2").tobytes()
    path = write_mkv(tmp_path / "a.mkv", [cluster(0, [(1, 0, _jpeg(0)[:900]), (2, 0, depth)])])
    with pytest.raises(RecordingError, match="track COLOR, picture 0: no whole JPEG"):
        imported(path, tmp_path / "a.zarr")


def test_garbage_is_an_error_or_other_pictures_but_never_a_crash(tmp_path):
    small = [track(1, "COLOR", b"BGRA", 8, 6), track(2, "DEPTH", b"b16g", 8, 6)]
    blocks = [cluster(0, [(1, 0, bytes(192)), (2, 0, bytes(96))])]
    good = write_mkv(tmp_path / "good.mkv", blocks, tracks=small, attached=b"{}").read_bytes()
    camera = write_camera(tmp_path / "mine.json")
    rng, refused = np.random.default_rng(0), 0
    for _ in range(120):
        bad = bytearray(good)
        bad[int(rng.integers(0, len(good)))] = int(rng.integers(256))
        (tmp_path / "bad.mkv").write_bytes(bad)
        try:
            for one in open_azure_kinect(tmp_path / "bad.mkv", camera).pictures():
                one.decode()
        except RecordingError:
            refused += 1
    assert 20 < refused < 115
