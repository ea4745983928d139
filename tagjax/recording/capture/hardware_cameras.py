"""RealSense, Orbbec and Azure Kinect cameras behind the interface of `camera`. Untested on hardware.

Each needs its maker's package, which is imported where the camera is opened: extras `realsense`, `orbbec`, `k4a`. Depth is
registered to colour by the maker's own code, and depth is z. Times are those of the camera's own clock.
"""

from __future__ import annotations

import abc
import importlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ...core.camera import Intrinsics
from .camera import AbstractCamera, CameraError, CameraFrame, CameraSettings
from .reads import HOST_CLOCK
from .writer import VideoFormat

_TIMEOUT_MS = 1000
_MAX_MISSED = 10  # time-outs in a row before the camera counts as gone


def _package(name: str, extra: str) -> Any:
    """A maker's package. Raises `CameraError` where it is not installed or lacks a library of the system."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise CameraError(
            f"The package for this camera is missing ({error}). pip install 'tagjax[{extra}]' installs it; some need a library of "
            "the system too (libusb for RealSense)."
        ) from error


def _coefficients(values: Any) -> tuple[float, ...]:
    """Distortion coefficients in OpenCV's order; none where all are zero."""
    numbers = tuple(float(value) for value in np.ravel(values))
    return numbers if any(numbers) else ()


def _millimetres(raw: np.ndarray, unit_mm: float) -> np.ndarray:
    """Depth in whole millimetres, uint16; what is farther than 65 m is missing."""
    if unit_mm == 1.0:
        return raw
    depth = np.rint(raw.astype(np.float32) * np.float32(unit_mm))
    return np.where(depth <= np.iinfo(np.uint16).max, depth, 0).astype(np.uint16)


class _AbstractHardwareCamera(AbstractCamera):
    def __init__(self, settings: CameraSettings):
        self.settings = settings
        self._about: dict[str, Any] = {}

    def frames(self, stopped: Callable[[], bool]) -> Iterator[CameraFrame]:
        """The frames as they come. Raises `CameraError` where none come for ten seconds."""
        missed = 0
        while not stopped():
            frame = self._next()
            missed = missed + 1 if frame is None else 0
            if missed >= _MAX_MISSED:
                raise CameraError(f"{self.name}: no frame for {missed * _TIMEOUT_MS / 1000:.0f} s. Check its cable.")
            if frame is not None:
                yield frame

    @abc.abstractmethod
    def _next(self) -> CameraFrame | None:
        """The next frame; None where none came in time."""

    def describe(self) -> dict[str, Any]:
        """Name, serial number and settings."""
        return {"name": self.name, "frame_rate_hz": self.settings.frame_rate_hz, **self._about}


class _AbstractPipelineCamera(_AbstractHardwareCamera):
    """A camera whose package gives its frames by a pipeline."""

    _pipeline: Any = None

    def close(self) -> None:
        """Stop the camera."""
        pipeline, self._pipeline = self._pipeline, None
        if pipeline is not None:
            pipeline.stop()


class RealSenseCamera(_AbstractPipelineCamera):
    """Intel RealSense D400 and L500 (package pyrealsense2). Untested on hardware."""

    name = "RealSense"

    def open(self) -> VideoFormat:
        """Start colour and depth."""
        rs, wanted = _package("pyrealsense2", "realsense"), self.settings
        config, self._pipeline, size = rs.config(), rs.pipeline(), (wanted.width, wanted.height)
        if wanted.serial is not None:
            config.enable_device(wanted.serial)
        config.enable_stream(rs.stream.color, *size, rs.format.rgb8, wanted.frame_rate_hz)
        config.enable_stream(rs.stream.depth, *size, rs.format.z16, wanted.frame_rate_hz)
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            self._pipeline = None
            raise CameraError(
                f"RealSense: {error}; expected a camera with {size} at {wanted.frame_rate_hz}/s."
            ) from error
        device = profile.get_device()
        for sensor in device.query_sensors():  # the host's estimate of the camera's time is not the camera's time
            if sensor.supports(rs.option.global_time_enabled):
                sensor.set_option(rs.option.global_time_enabled, 0)
        self._align = rs.align(rs.stream.color)
        self._unit_mm = 1e3 * device.first_depth_sensor().get_depth_scale()
        self._about = {
            "name": device.get_info(rs.camera_info.name),
            "serial": device.get_info(rs.camera_info.serial_number),
        }
        found = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        plain = found.model in (rs.distortion.brown_conrady, rs.distortion.modified_brown_conrady)
        intrinsics = Intrinsics(
            fx_px=found.fx,
            fy_px=found.fy,
            cx_px=found.ppx,
            cy_px=found.ppy,
            width=found.width,
            height=found.height,
            distortion=_coefficients(found.coeffs) if plain else (),
        )
        return VideoFormat(intrinsics)

    def _next(self) -> CameraFrame | None:
        found, frames = self._pipeline.try_wait_for_frames(_TIMEOUT_MS)
        arrival_ns = HOST_CLOCK.now_ns()
        if not found:
            return None
        frames = self._align.process(frames)
        colour, depth = frames.get_color_frame(), frames.get_depth_frame()
        if not colour or not depth:
            return None
        values = _millimetres(np.asanyarray(depth.get_data()).copy(), round(self._unit_mm, 6))
        device_ns = round(1e6 * colour.get_timestamp())
        return CameraFrame(np.asanyarray(colour.get_data()).copy(), values, arrival_ns, device_ns)


class OrbbecCamera(_AbstractPipelineCamera):
    """Orbbec Femto, Gemini, Astra 2 (package pyorbbecsdk2). Untested on hardware."""

    name = "Orbbec"

    def open(self) -> VideoFormat:
        """Start colour and depth."""
        ob, wanted = _package("pyorbbecsdk", "orbbec"), self.settings
        try:
            devices = ob.Context().query_devices()
            if not len(devices):
                raise CameraError("Orbbec: no camera found; expected one. Check its cable.")
            serial = wanted.serial
            device = devices[0] if serial is None else devices.get_device_by_serial_number(serial)
            pipeline, config = ob.Pipeline(device), ob.Config()
            profiles = pipeline.get_stream_profile_list(ob.OBSensorType.COLOR_SENSOR)
            colour = profiles.get_video_stream_profile(
                wanted.width, wanted.height, ob.OBFormat.RGB, wanted.frame_rate_hz
            )
            profiles = pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR)
            depth = profiles.get_video_stream_profile(0, 0, ob.OBFormat.Y16, wanted.frame_rate_hz)
            config.enable_stream(colour)
            config.enable_stream(depth)
            config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
            pipeline.enable_frame_sync()
            pipeline.start(config)
        except ob.OBError as error:
            raise CameraError(f"Orbbec: {error}; expected a camera with RGB of this size and rate.") from error
        self._pipeline, self._align = pipeline, ob.AlignFilter(align_to_stream=ob.OBStreamType.COLOR_STREAM)
        self._about = {"serial": device.get_device_info().get_serial_number()}
        own, bent = colour.get_intrinsic(), colour.get_distortion()
        order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        intrinsics = Intrinsics(
            fx_px=own.fx,
            fy_px=own.fy,
            cx_px=own.cx,
            cy_px=own.cy,
            width=own.width,
            height=own.height,
            distortion=_coefficients([getattr(bent, name) for name in order]),
        )
        return VideoFormat(intrinsics)

    def _next(self) -> CameraFrame | None:
        frames = self._pipeline.wait_for_frames(_TIMEOUT_MS)
        arrival_ns = HOST_CLOCK.now_ns()
        frames = None if frames is None else self._align.process(frames)
        if not frames:
            return None
        frames = frames.as_frame_set()
        colour, depth = frames.get_color_frame(), frames.get_depth_frame()
        if colour is None or depth is None:
            return None
        shape = (colour.get_height(), colour.get_width())
        raw = np.frombuffer(depth.get_data(), np.uint16).reshape(depth.get_height(), depth.get_width()).copy()
        picture = np.frombuffer(colour.get_data(), np.uint8).reshape(*shape, 3).copy()
        values = _millimetres(raw, round(float(depth.get_depth_scale()), 6))
        return CameraFrame(picture, values, arrival_ns, 1000 * int(colour.get_timestamp_us()))


class AzureKinectCamera(_AbstractHardwareCamera):
    """Azure Kinect (package pyk4a), 5, 15 or 30 frames a second, 720 to 3072 lines. Untested on hardware."""

    name = "Azure Kinect"
    _device: Any = None

    def open(self) -> VideoFormat:
        """Start colour and depth."""
        k4a, wanted = _package("pyk4a", "k4a"), self.settings
        sizes = {
            (1280, 720): k4a.ColorResolution.RES_720P,
            (1920, 1080): k4a.ColorResolution.RES_1080P,
            (2560, 1440): k4a.ColorResolution.RES_1440P,
            (2048, 1536): k4a.ColorResolution.RES_1536P,
            (3840, 2160): k4a.ColorResolution.RES_2160P,
            (4096, 3072): k4a.ColorResolution.RES_3072P,
        }
        rates = {5: k4a.FPS.FPS_5, 15: k4a.FPS.FPS_15, 30: k4a.FPS.FPS_30}
        size, rate_hz = (wanted.width, wanted.height), wanted.frame_rate_hz
        if size not in sizes or rate_hz not in rates:
            raise CameraError(
                f"Azure Kinect: found {size} at {rate_hz}/s; expected one of {', '.join(map(str, sizes))} at 5, 15 or 30."
            )
        config = k4a.Config(
            color_resolution=sizes[size],
            color_format=k4a.ImageFormat.COLOR_BGRA32,
            depth_mode=k4a.DepthMode.NFOV_UNBINNED,
            camera_fps=rates[rate_hz],
            synchronized_images_only=True,
        )
        device = k4a.PyK4A(config=config)
        try:
            device.start()
        except k4a.K4AException as error:
            raise CameraError(f"Azure Kinect: it does not start ({error!r}). Check its cable and power.") from error
        self._device, self._k4a = device, k4a
        if wanted.serial not in (None, device.serial):
            raise CameraError(f"Azure Kinect: found {device.serial}; expected {wanted.serial}. Unplug the other one.")
        self._about = {"serial": device.serial}
        kind = k4a.CalibrationType.COLOR
        matrix = device.calibration.get_camera_matrix(kind)
        intrinsics = Intrinsics(
            fx_px=float(matrix[0, 0]),
            fy_px=float(matrix[1, 1]),
            cx_px=float(matrix[0, 2]),
            cy_px=float(matrix[1, 2]),
            width=wanted.width,
            height=wanted.height,
            distortion=_coefficients(device.calibration.get_distortion_coefficients(kind)),
        )
        return VideoFormat(intrinsics)

    def _next(self) -> CameraFrame | None:
        try:
            capture = self._device.get_capture(timeout=_TIMEOUT_MS)
        except self._k4a.K4ATimeoutException:
            return None
        arrival_ns = HOST_CLOCK.now_ns()
        colour, depth = capture.color, capture.transformed_depth
        if colour is None or depth is None:
            return None
        picture = np.ascontiguousarray(colour[..., 2::-1])  # BGRA
        return CameraFrame(picture, np.asarray(depth, np.uint16), arrival_ns, 1000 * capture.color_timestamp_usec)

    def close(self) -> None:
        """Stop the camera."""
        device, self._device = self._device, None
        if device is not None:
            device.stop()
