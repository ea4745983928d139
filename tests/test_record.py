"""python -m experiments.record: what is captured equals what was played; errors; the adapters of cameras, with stand-ins."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from capture_scenes import small_recording
from captured_scores import NETWORK, capture, clock_error_s, compare, lost_and_added

from tagjax.core.errors import RecordingError
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.recording.capture.camera import AbstractCamera, CameraError, CameraSettings
from tagjax.recording.capture.hardware_cameras import AzureKinectCamera, OrbbecCamera, RealSenseCamera
from tagjax.recording.capture.record import record
from tagjax.recording.capture.settings import RecordConfig, make_reader, make_sensors
from tagjax.recording.store import open_recording, save_recording

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("played") / "small.zarr"
    save_recording(small_recording(3.0, frame_rate_hz=10.0), path)
    return path


def config(**values: Any) -> RecordConfig:
    return from_mapping(RecordConfig, values)


@pytest.mark.parametrize("reader", ["playback", "llrp", "r700"])
def test_what_is_recorded_is_what_was_played(played: Path, tmp_path: Path, reader: str) -> None:
    lines: list[str] = []
    summary = record(
        config(
            recording=str(played),
            reader=reader,
            emulate=reader != "playback",
            out=str(tmp_path / "a.zarr"),
            emulator=NETWORK,
        ),
        tmp_path,
        on_status=lines.append,
    )
    source, found = open_recording(played), open_recording(tmp_path / "a.zarr")
    assert summary["dropped_frames"] == summary["dropped_reads"] == 0
    assert summary["events"] == {"connected": 1}
    assert summary["reads"] == source.reads.num_reads == found.reads.num_reads
    assert summary["tags"] == source.reads.epcs
    np.testing.assert_array_equal(np.asarray(found.colour), np.asarray(source.colour))
    np.testing.assert_array_equal(np.asarray(found.depth), np.asarray(source.depth))
    np.testing.assert_array_equal(found.antennas_m, source.antennas_m)
    order = np.argsort(found.reads.reader_time_ns, kind="stable")
    for name in ("epc", "antenna", "carrier_hz", "phase_rad", "rssi_dbm"):
        one, other = getattr(found.reads, name)[order], getattr(source.reads, name)
        if one.dtype.kind == "f":
            np.testing.assert_allclose(one, other, atol=1e-4, rtol=0, err_msg=name)
        else:
            np.testing.assert_array_equal(one, other, err_msg=name)
    capture = json.loads((tmp_path / "a.zarr" / "zarr.json").read_text())["attributes"]["capture"]
    assert capture["reader"]["protocol"] == reader
    assert capture["reader"]["antennas"] == [1, 2]
    assert tuple(capture["reader"]["hop_table_hz"]) == (() if reader == "r700" else source.reads.hop_table_hz)
    assert (tmp_path / "preview.jpg").read_bytes()[:2] == b"\xff\xd8"
    assert any("frames/s" in line and "reads/s of 4 tags" in line for line in lines)


def test_a_recording_ends_with_its_time_and_existing_ones_are_kept(played: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.zarr"
    record(config(recording=str(played), out=str(out), duration_s=1.0))
    assert 5 <= open_recording(out).num_frames <= 25
    with pytest.raises(RecordingError, match="exists"):
        record(config(recording=str(played), out=str(out)))
    assert record(config(finish=str(out)))["reads"] == open_recording(out).reads.num_reads


def test_a_camera_that_cannot_be_opened_leaves_no_folder(played: Path, tmp_path: Path) -> None:
    settings = {"camera": "k4a", "recording": str(played), "out": str(tmp_path / "a.zarr")}
    with pytest.raises(CameraError, match="tagjax\\[k4a\\]"):
        record(config(**settings))
    assert not (tmp_path / "a.zarr").exists()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({}, "neither out nor finish"),
        ({"out": "a", "finish": "b"}, "or both"),
        ({"out": "a"}, "recording is null"),
        ({"out": "a", "camera": "k4a", "reader": "llrp", "address": "x"}, "antennas_m is null"),
        ({"out": "a", "recording": "r", "reader": "llrp"}, "emulate=true"),
        ({"out": "a", "recording": "r", "reader": "llrp", "address": "x", "emulate": True}, "emulate=true"),
        ({"out": "a", "recording": "r", "emulate": True}, "needs no emulator"),
        ({"out": "a", "recording": "r", "commit_s": 0.0}, "positive seconds"),
        (
            {"out": "a", "recording": "r", "reader": "llrp", "address": "x", "antennas_m": [[0.0, 0.0, 0.0]], "inventory": {"antennas": [1, 2]}},
            "one for every port",
        ),
        ({"out": "a", "recording": "r", "emulator": {"jitter_s": -1.0}}, "0 to 10 s"),
        ({"out": "a", "recording": "r", "camera": "webcam"}, "webcam"),
        ({"out": "a", "recording": "r", "reader": "r700", "address": "https://root:a@b"}, "found a user or password"),
    ],
)  # fmt: skip
def test_settings_that_do_not_fit_together_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        config(**values)


@pytest.mark.ci
@pytest.mark.parametrize("command", ["record", "stream"])
def test_no_file_keeps_a_password_of_an_address(played: Path, tmp_path: Path, command: str) -> None:
    words = ["camera=playback", "reader=r700", "address=https://root:hidden@127.0.0.1:9", f"recording={played}"]
    words += [f"hydra.run.dir={tmp_path / 'run'}", *([f"out={tmp_path / 'a.zarr'}"] if command == "record" else [])]
    ended = subprocess.run(
        [sys.executable, "-m", f"experiments.{command}", *words], capture_output=True, text=True, cwd=ROOT, timeout=120
    )
    assert ended.returncode != 0
    assert "TAGJAX_READER_PASSWORD" in ended.stdout + ended.stderr
    assert "hidden" not in ended.stdout + ended.stderr
    for path in tmp_path.rglob("*"):
        assert path.is_dir() or b"hidden" not in path.read_bytes(), path


def test_the_yaml_repeats_the_defaults_of_the_library() -> None:
    values = yaml.safe_load((ROOT / "conf" / "record.yaml").read_text())
    own = {field.name for field in dataclasses.fields(RecordConfig)}
    assert set(values) - {"defaults", "progress"} == own
    given = {name: values[name] for name in own} | {"out": "a", "recording": "r"}
    assert from_mapping(RecordConfig, given) == config(out="a", recording="r")


def test_addresses_have_ports(played: Path) -> None:
    for address, expected in (
        ("10.0.0.1", ("10.0.0.1", 5084)),
        ("reader.local:5085", ("reader.local", 5085)),
        ("fe80::1", ("fe80::1", 5084)),
    ):
        settings = config(out="a", recording=str(played), reader="llrp", address=address)
        reader: Any = make_reader(settings, make_sensors(settings))
        assert (reader.host, reader.port) == expected


@pytest.mark.ci
def test_the_command_ends_at_ctrl_c_with_a_whole_recording(played: Path, tmp_path: Path) -> None:
    out, run = tmp_path / "a.zarr", tmp_path / "run"
    words = [f"recording={played}", "reader=llrp", "emulate=true", f"out={out}", f"hydra.run.dir={run}"]
    child = subprocess.Popen(
        [sys.executable, "-m", "experiments.record", *words], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    while not (run / "preview.jpg").exists():
        assert child.poll() is None
    os.kill(child.pid, signal.SIGINT)
    assert child.stdout is not None
    lines = child.stdout.read().splitlines()
    child.stdout.close()
    assert child.wait() == 0
    summary = json.loads(lines[-1])
    assert summary["interrupted"]
    assert summary["frames"] == open_recording(out).num_frames > 0


@pytest.fixture(scope="module")
def waved_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first test recording of a bag of the suite `single_static` with pictures of 192 pixels, 15 a second, for 6 s.

    It is traced well, and read times that are wrong by 5 ms change its mean IoU by 0.0005.
    """
    pytest.importorskip("mujoco")
    from tagjax.sim.record import simulate_recording
    from tagjax.sim.suites import Counts, Suite, item_scenario

    settings = yaml.safe_load((ROOT / "conf" / "suite" / "single_static.yaml").read_text())
    suite = from_mapping(Suite, settings, where="suite")
    suite = dataclasses.replace(suite, duration_s=6.0, counts=Counts(0, 0, 1))
    (item,) = (one for one in suite.items() if "bag" in one.name)
    made_with = dataclasses.replace(suite.capture, width=192, frame_rate_hz=15.0)
    recording = simulate_recording(item_scenario(item), made_with, seed=item.seed, name=item.name)
    path = tmp_path_factory.mktemp("bag") / "a.zarr"
    save_recording(recording, path)
    return path


@pytest.mark.ci
@pytest.mark.parametrize("reader", ["llrp", "r700"])
def test_a_simulated_recording_is_traced_alike_after_it_went_through_sockets(
    waved_bag: Path, tmp_path: Path, reader: str
) -> None:
    """No read is lost or doubled, clocks agree to 1 ms, boxes overlap by all but 0.005, and IoU is the same to 0.005."""
    capture(waved_bag, tmp_path / "b.zarr", reader)
    one, other = open_recording(waved_bag), open_recording(tmp_path / "b.zarr")
    assert lost_and_added(one, other) == (0, 0)
    assert clock_error_s(one, other) < 1e-3
    found = compare(one, other, {"_target_": "tagjax.tagattention.TagAttention"})
    assert found["iou"] > 0.7
    assert found["identification"] > 0.9
    assert found["box_overlap"] > 0.995
    assert found["boxes_in_one_only"] <= 1
    assert found["iou_captured"] == pytest.approx(found["iou"], abs=0.005)
    assert found["identification_captured"] == pytest.approx(found["identification"], abs=0.005)


def _k4a() -> Any:
    class NoFrameError(Exception):
        pass

    class Device:
        serial = "000123"
        calibration = types.SimpleNamespace(
            get_camera_matrix=lambda kind: np.array([[600.0, 0, 639.0], [0, 601.0, 359.0], [0, 0, 1]]),
            get_distortion_coefficients=lambda kind: np.arange(8) / 100,
        )

        def __init__(self, config: Any):
            self.config, self.count = config, 0

        def start(self) -> None:
            self.running = True

        def stop(self) -> None:
            self.running = False

        def get_capture(self, timeout: int) -> Any:
            self.count += 1
            if self.count == 2:
                raise NoFrameError
            colour = np.zeros((720, 1280, 4), np.uint8)
            colour[...] = (1, 2, 3, 255)  # BGRA
            depth = np.full((720, 1280), 1500 + self.count, np.uint16)
            return types.SimpleNamespace(
                color=colour, transformed_depth=depth, color_timestamp_usec=33_333 * self.count
            )

    names = types.SimpleNamespace
    return names(
        PyK4A=Device,
        Config=names,
        K4AException=RuntimeError,
        K4ATimeoutException=NoFrameError,
        CalibrationType=names(COLOR=1),
        ImageFormat=names(COLOR_BGRA32=3),
        DepthMode=names(NFOV_UNBINNED=2),
        FPS=names(FPS_5=0, FPS_15=1, FPS_30=2),
        ColorResolution=names(RES_720P=1, RES_1080P=2, RES_1440P=3, RES_1536P=4, RES_2160P=5, RES_3072P=6),
    )


def test_azure_kinect_frames_become_rgb_and_millimetres(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for pyk4a: the adapter is untested on hardware."""
    monkeypatch.setitem(sys.modules, "pyk4a", _k4a())
    camera = AzureKinectCamera(CameraSettings(width=1280, height=720))
    video = camera.open()
    assert (video.intrinsics.fx_px, video.intrinsics.cy_px, video.intrinsics.width) == (600.0, 359.0, 1280)
    assert video.intrinsics.distortion == tuple(np.arange(8) / 100)
    frames = camera.frames(lambda: False)
    first, second = next(frames), next(frames)  # between them a time-out
    assert first.colour[0, 0].tolist() == [3, 2, 1]
    assert (first.depth[0, 0], second.depth[0, 0]) == (1501, 1503)
    assert second.device_time_ns == 99_999_000
    assert camera.describe()["serial"] == "000123"
    device = camera._device
    camera.close()
    assert not device.running
    with pytest.raises(CameraError, match="1280, 720"):
        AzureKinectCamera(CameraSettings()).open()
    with pytest.raises(CameraError, match="expected 7"):
        AzureKinectCamera(CameraSettings(width=1280, height=720, serial="7")).open()


def test_realsense_depth_units_become_millimetres(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for pyrealsense2, of a camera whose depth unit is 0.1 mm: the adapter is untested on hardware."""
    names, set_options = types.SimpleNamespace, []
    sensor = names(
        supports=lambda option: option == "global",
        set_option=lambda *values: set_options.append(values),
    )
    intrinsics = names(model="bc", fx=300.0, fy=301.0, ppx=4.0, ppy=3.0, width=8, height=6, coeffs=[0.1, 0, 0, 0, 0.0])
    profile = names(
        get_device=lambda: names(
            query_sensors=lambda: [sensor],
            first_depth_sensor=lambda: names(get_depth_scale=lambda: 1e-4),
            get_info=lambda what: what,
        ),
        get_stream=lambda what: names(as_video_stream_profile=lambda: names(get_intrinsics=lambda: intrinsics)),
    )
    depth = np.full((6, 8), 12345, np.uint16)
    frames = names(
        get_color_frame=lambda: names(get_data=lambda: np.zeros((6, 8, 3), np.uint8), get_timestamp=lambda: 1234.5),
        get_depth_frame=lambda: names(get_data=lambda: depth),
    )
    stopped = []
    pipeline = names(
        start=lambda config: profile,
        try_wait_for_frames=lambda timeout: (True, frames),
        stop=lambda: stopped.append(True),
    )
    package = names(
        config=lambda: names(enable_device=lambda serial: None, enable_stream=lambda *values: None),
        pipeline=lambda: pipeline,
        align=lambda stream: names(process=lambda frames: frames),
        stream=names(color=1, depth=2),
        format=names(rgb8=1, z16=2),
        option=names(global_time_enabled="global"),
        camera_info=names(name="D435", serial_number="77"),
        distortion=names(brown_conrady="bc", modified_brown_conrady="mbc"),
    )
    monkeypatch.setitem(sys.modules, "pyrealsense2", package)
    camera = RealSenseCamera(CameraSettings(width=8, height=6, serial="77"))
    video = camera.open()
    assert video.intrinsics.distortion == (0.1, 0.0, 0.0, 0.0, 0.0)
    assert set_options == [("global", 0)]
    frame = next(camera.frames(lambda: False))
    assert (frame.depth[0, 0], frame.device_time_ns) == (1234, 1_234_500_000)
    assert camera.describe() == {"name": "D435", "serial": "77", "frame_rate_hz": 30}
    camera.close()
    assert stopped == [True]


def _orbbec(devices: list[Any], started: list[Any]) -> Any:
    """A stand-in for pyorbbecsdk: colour of 8 x 6 pixels, depth in units of 0.25 mm, and a first set without depth."""
    names = types.SimpleNamespace

    class Profile:
        def __init__(self, *wanted: Any):
            self.wanted = wanted

        def get_intrinsic(self) -> Any:
            return names(fx=300.0, fy=301.0, cx=4.0, cy=3.0, width=8, height=6)

        def get_distortion(self) -> Any:
            return names(k1=0.1, k2=0.2, k3=0.5, k4=0.6, k5=0.7, k6=0.8, p1=0.3, p2=0.4)

    class Devices(list):
        def get_device_by_serial_number(self, serial: str) -> Any:
            return next(one for one in self if one.get_device_info().get_serial_number() == serial)

    pixels = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    colour = names(
        get_height=lambda: 6, get_width=lambda: 8, get_data=pixels.tobytes, get_timestamp_us=lambda: 1_234_567
    )
    raw = np.full((6, 8), 6001, np.uint16)
    depth = names(get_height=lambda: 6, get_width=lambda: 8, get_data=raw.tobytes, get_depth_scale=lambda: 0.25)
    sets = iter([names(get_color_frame=lambda: colour, get_depth_frame=lambda one=one: one) for one in (None, depth)])

    class Pipeline:
        def __init__(self, device: Any):
            self.device = device

        def get_stream_profile_list(self, sensor: str) -> Any:
            return names(get_video_stream_profile=lambda *wanted: Profile(sensor, *wanted))

        def enable_frame_sync(self) -> None:
            started.append("in step")

        def start(self, config: Any) -> None:
            started.append(config)

        def wait_for_frames(self, timeout_ms: int) -> Any:
            found = next(sets)
            return names(as_frame_set=lambda: found)

        def stop(self) -> None:
            started.append("stopped")

    class Config:
        def __init__(self) -> None:
            self.streams: list[tuple[Any, ...]] = []

        def enable_stream(self, profile: Profile) -> None:
            self.streams.append(profile.wanted)

        def set_frame_aggregate_output_mode(self, mode: str) -> None:
            self.mode = mode

    return names(
        Context=lambda: names(query_devices=lambda: Devices(devices)),
        Pipeline=Pipeline,
        Config=Config,
        AlignFilter=lambda align_to_stream: names(process=lambda frames: frames),
        OBError=RuntimeError,
        OBSensorType=names(COLOR_SENSOR="colour", DEPTH_SENSOR="depth"),
        OBFormat=names(RGB="rgb", Y16="y16"),
        OBStreamType=names(COLOR_STREAM="colour"),
        OBFrameAggregateOutputMode=names(FULL_FRAME_REQUIRE="both"),
    )


def test_orbbec_depth_becomes_millimetres_and_a_set_without_depth_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for pyorbbecsdk2: the adapter is untested on hardware."""
    devices = [
        types.SimpleNamespace(
            get_device_info=lambda serial=serial: types.SimpleNamespace(get_serial_number=lambda: serial)
        )
        for serial in ("66", "77")
    ]
    started: list[Any] = []
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", _orbbec(devices, started))
    camera = OrbbecCamera(CameraSettings(width=8, height=6, serial="77"))
    video = camera.open()
    assert (video.intrinsics.fx_px, video.intrinsics.cy_px, video.intrinsics.width) == (300.0, 3.0, 8)
    assert video.intrinsics.distortion == (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)  # OpenCV's order
    assert started[0] == "in step"
    assert started[1].streams == [("colour", 8, 6, "rgb", 30), ("depth", 0, 0, "y16", 30)]
    frame = next(camera.frames(lambda: False))
    assert frame.colour[0, 1].tolist() == [3, 4, 5]
    assert (frame.depth[0, 0], frame.depth.dtype, frame.device_time_ns) == (1500, np.uint16, 1_234_567_000)
    with pytest.raises((StopIteration, RuntimeError)):  # both sets were used
        next(camera.frames(lambda: False))
    assert camera.describe() == {"name": "Orbbec", "frame_rate_hz": 30, "serial": "77"}
    camera.close()
    assert started[-1] == "stopped"
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", _orbbec([], started))
    with pytest.raises(CameraError, match="no camera found"):
        OrbbecCamera(CameraSettings()).open()


@pytest.mark.parametrize(
    ("camera", "package", "extra"),
    [(RealSenseCamera, "pyrealsense2", "realsense"), (OrbbecCamera, "pyorbbecsdk", "orbbec"), (AzureKinectCamera, "pyk4a", "k4a")],
)  # fmt: skip
def test_without_the_makers_package_the_error_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, camera: type[AbstractCamera], package: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    made: Any = camera
    with pytest.raises(CameraError, match=rf"tagjax\[{extra}\]"):
        made(CameraSettings(width=1280, height=720)).open()
