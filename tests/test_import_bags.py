"""RealSense and ROS bags, written here by rosbags: exact, with topics found or given, and refused where they are damaged."""

from __future__ import annotations

import builtins
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.spatial
from rgbd_bags import BagWriter
from rgbd_files import CAMERA, START_NS, colour, cut, depth_mm, imported, write_camera

from tagjax.core.geometry import register_depth
from tagjax.recording import Intrinsics, RecordingError
from tagjax.recording.importers.rgbd.bags import Topics, open_bag
from tagjax.recording.importers.rgbd.ros_cameras import between_frames
from tagjax.recording.importers.settings import ImportSettings, import_recording

NUM_FRAMES = 5
TIMES = [START_NS + 33_333_333 * number for number in range(NUM_FRAMES)]
COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
FRAME = "camera_color_optical_frame"


def _aligned(bag: BagWriter, *, first: int = 0, encoding: str = "rgb8") -> None:
    """Colour and aligned depth, with their camera-info topics; depth 2 ms later."""
    for topic in (COLOUR, DEPTH):
        bag.info(topic.replace("image_raw", "camera_info"), TIMES[0], FRAME)
    for number in range(first, NUM_FRAMES):
        bag.image(COLOUR, colour(number)[..., :: 1 if encoding == "rgb8" else -1], TIMES[number], encoding, FRAME)
        bag.image(DEPTH, depth_mm(number), TIMES[number] + 2_000_000, "16UC1", FRAME)


def _check_exact(recording) -> None:
    np.testing.assert_array_equal(recording.time_ns, TIMES)
    assert recording.intrinsics == Intrinsics(**CAMERA)
    for number in range(NUM_FRAMES):
        np.testing.assert_array_equal(recording.colour[number], colour(number))
        np.testing.assert_array_equal(recording.depth[number], depth_mm(number))


@pytest.mark.parametrize("kind", ["take.bag", "mcap", "sqlite3", "single.mcap", "single.db3"])
def test_times_intrinsics_and_pixels_of_a_ros_bag_are_kept(tmp_path, kind):
    path = tmp_path / ("take.bag" if kind == "take.bag" else "take")
    with BagWriter(path, "sqlite3" if kind in ("sqlite3", "single.db3") else "mcap") as bag:
        bag.image("/camera/infra1/image_rect_raw", colour(0)[..., 0], TIMES[0], "mono8", "infra")
        _aligned(bag, encoding="bgr8" if kind == "mcap" else "rgb8")
    if kind.startswith("single"):  # the file without its folder
        path = next(path.glob(f"*.{kind.split('.')[1]}"))
    _check_exact(imported(path, tmp_path / "a.zarr"))


def test_a_realsense_bag_has_its_unit_and_extrinsics(tmp_path):
    # The vendor's format: topics by device and sensor, mono16, extrinsics from one reference to each stream.
    turn = scipy.spatial.transform.Rotation.from_euler("xyz", [0.01, -0.02, 0.03])
    base, other = "/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0"
    with BagWriter(tmp_path / "take.bag") as bag:
        bag.add("/device_0/sensor_0/option/Depth Units/value", bag.make("std_msgs/msg/Float32", 0.00025), TIMES[0])
        bag.add(f"{base}/tf/0", bag.transform([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0]), TIMES[0])
        bag.add(f"{other}/tf/0", bag.transform(turn.as_quat().tolist(), [0.015, 0.001, -0.002]), TIMES[0])
        bag.info(f"{base}/info/camera_info", TIMES[0], "0", cx_px=30.5)
        bag.info(
            f"{other}/info/camera_info", TIMES[0], "0", model="Inverse Brown Conrady", distortion=[0.05, -0.1, 0, 0, 0]
        )
        for number, time_ns in enumerate(TIMES):
            bag.image(f"{base}/image/data", depth_mm(number), time_ns, "mono16", "0")
            bag.image("/device_0/sensor_0/Infrared_1/image/data", colour(number)[..., 0], time_ns, "mono8", "0")
            bag.image(f"{other}/image/data", colour(number), time_ns + 1_000_000, "rgb8", "0")
    rig = open_bag(tmp_path / "take.bag").rig
    assert rig.depth_unit_m == 0.00025
    assert rig.depth == Intrinsics(**{**CAMERA, "cx_px": 30.5})
    assert rig.colour.distortion == (0.05, -0.1, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(rig.rotation, turn.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(rig.translation_m, [0.015, 0.001, -0.002])
    recording = imported(tmp_path / "take.bag", tmp_path / "a.zarr")
    assert recording.intrinsics == Intrinsics(**CAMERA)
    np.testing.assert_array_equal(recording.time_ns, np.array(TIMES) + 1_000_000)
    metres = depth_mm(2).astype(np.float32) * np.float32(0.00025)
    expected = register_depth(metres, rig.depth, Intrinsics(**CAMERA), rig.rotation, rig.translation_m)
    np.testing.assert_allclose(recording.depth[2], expected, atol=1e-6)


def test_static_transforms_register_depth_of_another_frame(tmp_path):
    half = np.sqrt(0.5)
    with BagWriter(tmp_path / "take") as bag:
        # Both cameras hang from one link; a quarter turn about z, which the two transforms cancel.
        bag.static("link", "depth_frame", [0.0, 0.0, half, half], [0.0, 0.0, 0.0], TIMES[0])
        bag.static("link", "/colour_frame", [0.0, 0.0, half, half], [0.02, 0.0, 0.0], TIMES[0])
        bag.info("/cam/depth/camera_info", TIMES[0], "depth_frame")
        bag.info("/cam/rgb/camera_info", TIMES[0], "colour_frame")
        for number, time_ns in enumerate(TIMES):
            bag.image("/cam/depth/image", (depth_mm(number) / 1000).astype(np.float32), time_ns, "32FC1", "depth_frame")
            bag.image("/cam/rgb/image", colour(number), time_ns, "rgb8", "colour_frame")
    rig = open_bag(tmp_path / "take").rig
    np.testing.assert_allclose(rig.rotation, np.eye(3), atol=1e-12)
    # The link's x is minus the cameras' y after the turn: a point of the depth camera lies 0.02 m along y of the colour's.
    np.testing.assert_allclose(rig.translation_m, [0.0, 0.02, 0.0], atol=1e-12)
    recording = imported(tmp_path / "take", tmp_path / "a.zarr")
    assert recording.depth.dtype == np.float32
    assert recording.num_frames == NUM_FRAMES


def test_chains_of_transforms_are_followed_in_both_directions():
    class Of:
        def __init__(self, **values):
            self.__dict__.update(values)

    def one(parent, child, shift):
        x, y, z = shift
        transform = Of(translation=Of(x=x, y=y, z=z), rotation=Of(x=0.0, y=0.0, z=0.0, w=1.0))
        return Of(header=Of(frame_id=parent), child_frame_id=child, transform=transform)

    found = between_frames([one("a", "b", (1, 0, 0)), one("a", "c", (0, 2, 0)), one("c", "d", (0, 0, 3))], "b", "d")
    np.testing.assert_allclose(found[:3, 3], [1, -2, -3])
    assert between_frames([one("a", "b", (1, 0, 0))], "b", "z") is None


@pytest.mark.parametrize(
    ("encoding", "code"), [("yuv422_yuy2", cv2.COLOR_RGB2YUV_YUY2), ("uyvy", cv2.COLOR_RGB2YUV_UYVY)]
)
def test_colour_as_yuv_is_converted(tmp_path, encoding, code):
    picture = cv2.GaussianBlur(colour(1), (0, 0), 5)
    with BagWriter(tmp_path / "take") as bag:
        for topic in (COLOUR, DEPTH):
            bag.info(topic.replace("image_raw", "camera_info"), TIMES[0], FRAME)
        for time_ns in TIMES:
            bag.image(COLOUR, cv2.cvtColor(picture, code), time_ns, encoding, FRAME)
            bag.image(DEPTH, depth_mm(0).byteswap(), time_ns, "16UC1", FRAME, is_bigendian=1)
    recording = imported(tmp_path / "take", tmp_path / "a.zarr")
    assert np.abs(recording.colour[0].astype(int) - picture).max() < 16
    np.testing.assert_array_equal(recording.depth[0], depth_mm(0))


def test_compressed_pictures_are_decoded(tmp_path):
    a, b = 100.0, 5.0  # of the inverse depth of compressed_depth_image_transport: value = a / depth + b
    depth_m = np.where(depth_mm(0) > 0, depth_mm(0) / 1000, 0)
    values = np.where(depth_m > 0, a / np.maximum(depth_m, 0.1) + b, 0)
    inverse = cv2.imencode(".png", np.rint(values).astype(np.uint16))[1].tobytes()
    with BagWriter(tmp_path / "take") as bag:
        bag.info("/c/color/camera_info", TIMES[0], FRAME)
        bag.info("/c/depth/camera_info", TIMES[0], FRAME)
        for number, time_ns in enumerate(TIMES):
            png = cv2.imencode(".png", colour(number)[..., ::-1])[1].tobytes()
            bag.compressed("/c/color/compressed", png, time_ns, "rgb8; png compressed bgr8", FRAME)
            whole = bytes(12) + cv2.imencode(".png", depth_mm(number))[1].tobytes()
            bag.compressed("/c/depth/compressedDepth", whole, time_ns, "16UC1; compressedDepth png", FRAME)
            floats = struct.pack("<i2f", 0, a, b) + inverse
            bag.compressed("/c/depth/floats", floats, time_ns, "32FC1; compressedDepth", FRAME)
    with pytest.raises(
        RecordingError, match=r"2 depth topics \(/c/depth/compressedDepth, /c/depth/floats\).*topics\.depth="
    ):
        open_bag(tmp_path / "take")
    _check_exact(imported(tmp_path / "take", tmp_path / "a.zarr", topics=Topics(depth="/c/depth/compressedDepth")))
    found = imported(tmp_path / "take", tmp_path / "b.zarr", topics=Topics(depth="/c/depth/floats")).depth[0]
    np.testing.assert_allclose(found, depth_m, rtol=0.02)


def test_topics_may_be_given_and_a_camera_file_replaces_the_messages(tmp_path):
    with BagWriter(tmp_path / "take") as bag:
        for number, time_ns in enumerate(TIMES):
            for topic in ("/left", "/right"):
                bag.image(topic, colour(number if topic == "/right" else 9), time_ns, "rgb8", topic)
            bag.image("/z", depth_mm(number), time_ns, "16UC1", "z")
    with pytest.raises(RecordingError, match=r"2 colour topics \(/left, /right\); expected one"):
        open_bag(tmp_path / "take")
    with pytest.raises(RecordingError, match=r"no camera-info topic beside /right.*topics\.colour_info="):
        open_bag(tmp_path / "take", Topics(colour="/right"))
    with pytest.raises(
        RecordingError, match=r"topics\.colour is '/gone'; expected one of the image topics /left \(Image\)"
    ):
        open_bag(tmp_path / "take", Topics(colour="/gone"))
    with pytest.raises(RecordingError, match="/z holds 16UC1; expected colour"):
        open_bag(tmp_path / "take", Topics(colour="/z"))
    camera = write_camera(tmp_path / "mine.json")
    settings = {"topics": Topics(colour="/right"), "camera": str(camera)}
    _check_exact(imported(tmp_path / "take", tmp_path / "a.zarr", **settings))


def test_bags_without_what_is_needed_are_refused(tmp_path):
    with BagWriter(tmp_path / "one") as bag:
        bag.image(COLOUR, colour(0), TIMES[0], "rgb8", FRAME)
        bag.image("/odd", colour(0)[..., 0], TIMES[0], "bayer_rggb8", FRAME)
    with pytest.raises(
        RecordingError, match=r"no depth topic.*The bag has the topics /camera/color/image_raw \(Image\), /odd"
    ):
        open_bag(tmp_path / "one")
    with BagWriter(tmp_path / "two") as bag:
        bag.info("/camera/color/camera_info", TIMES[0], "a")
        bag.info("/camera/depth/camera_info", TIMES[0], "b")
        bag.image(COLOUR, colour(0), TIMES[0], "rgb8", "a")
        bag.image("/camera/depth/image_raw", depth_mm(0), TIMES[0], "16UC1", "b")
    with pytest.raises(RecordingError, match=r"no transform from the depth camera \(frame 'b'\) .*camera=<file>"):
        open_bag(tmp_path / "two")
    with BagWriter(tmp_path / "three") as bag:
        bag.info("/camera/color/camera_info", TIMES[0], FRAME, model="equidistant", distortion=[0.1, 0, 0, 0])
        bag.image(COLOUR, colour(0), TIMES[0], "rgb8", FRAME)
        bag.image(DEPTH, depth_mm(0), TIMES[0], "16UC1", FRAME)
    with pytest.raises(RecordingError, match="lens model 'equidistant'; expected plumb_bob"):
        open_bag(tmp_path / "three")


def test_messages_that_are_damaged_or_of_another_size_stop_the_import(tmp_path):
    for name, changes, message in (
        ("short", {"data": np.zeros(50, np.uint8)}, "50 bytes for 64 x 48 pixels of rgb8"),
        ("small", {"width": 32}, r"colour of 32 x 48 pixels; expected 64 x 48"),
    ):
        with BagWriter(tmp_path / name) as bag:
            bag.image(COLOUR, colour(0), TIMES[0], "rgb8", FRAME, **changes)
            bag.image(DEPTH, depth_mm(0), TIMES[0], "16UC1", FRAME)
            _aligned(bag, first=1)
        with pytest.raises(RecordingError, match=rf"{COLOUR}, message 0: {message}"):
            imported(tmp_path / name, tmp_path / "a.zarr")
        assert not (tmp_path / "a.zarr").exists()


@pytest.mark.parametrize("kind", ["take.bag", "mcap", "sqlite3"])
@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.9])
def test_a_bag_that_is_cut_short_is_refused_in_one_line(tmp_path, kind, fraction):
    path = tmp_path / ("take.bag" if kind == "take.bag" else "take")
    with BagWriter(path, kind) as bag:
        _aligned(bag)
    cut(path if path.is_file() else next(file for file in path.iterdir() if file.name != "metadata.yaml"), fraction)
    with pytest.raises(RecordingError, match="reindex") as caught:
        imported(path, tmp_path / "a.zarr")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "a.zarr").exists()


def test_times_that_go_back_once_are_left_out_and_a_clock_that_is_set_back_is_refused(tmp_path):
    def write(path: Path, back_ns: list[int]) -> Path:
        with BagWriter(path) as bag:
            for topic in (COLOUR, DEPTH):
                bag.info(topic.replace("image_raw", "camera_info"), START_NS, FRAME)
            for number, back in enumerate(back_ns):
                time_ns = START_NS + 33_000_000 * number - back
                bag.image(COLOUR, colour(number), time_ns, "rgb8", FRAME)
                bag.image(DEPTH, depth_mm(number), time_ns, "16UC1", FRAME)
        return path

    recording = imported(write(tmp_path / "once", [0] * 6 + [70_000_000] + [0] * 6), tmp_path / "a.zarr")
    assert recording.num_frames == 12
    assert "1 colour pictures that are not later" in recording.source
    np.testing.assert_array_equal(recording.colour[6], colour(7))
    with pytest.raises(
        RecordingError, match=r"the times of 4 of 10 colour pictures are not later.*A clock was set back"
    ):
        imported(write(tmp_path / "reset", [0] * 6 + [10**9] * 4), tmp_path / "b.zarr")


def test_without_rosbags_the_error_says_what_to_install(tmp_path, monkeypatch):
    load = builtins.__import__

    def absent(name, *rest):
        if name.startswith("rosbags"):
            raise ImportError("No module named 'rosbags'")
        return load(name, *rest)

    (tmp_path / "take.bag").touch()
    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(RecordingError, match=r"pip install 'tagjax\[bags\]'"):
        import_recording(ImportSettings(video=str(tmp_path / "take.bag")))
