"""Azure Kinect recordings (.mkv) of k4arecorder, and of Orbbec's cameras through its Azure Kinect wrapper.

Colour is Motion-JPEG, NV12, YUY2 or BGRA; depth is 16-bit millimetres; the calibration is an attachment. No SDK and no
ffmpeg is needed. Written by the description of the format and the SDK's source; not tested on files of a real camera.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ....core.camera import Intrinsics
from ....core.errors import RecordingError
from ....core.names import valid_name
from .camera_file import read_camera_file
from .matroska import Block, Matroska, Track
from .source import Picture, RgbdSource, Rig

_CODEC = "V_MS/VFW/FOURCC"
_COLOUR_KINDS = (b"MJPG", b"NV12", b"YUY2", b"BGRA")
_DEPTH_KIND = b"b16g"
_BYTES_PER_PIXEL = {b"NV12": 1.5, b"YUY2": 2.0, b"BGRA": 4.0}

_DEPTH_CROPS = {
    (320, 288): (512, 96, 90),
    (640, 576): (1024, 192, 180),
    (512, 512): (512, 0, 0),
    (1024, 1024): (1024, 0, 0),
}
"""Size of depth pictures: side of the (binned) sensor, and first column and row of the picture on it."""

_BROWN = "CALIBRATION_LensDistortionModelBrownConrady"
_PARAMETERS = 14  # cx cy fx fy k1 k2 k3 k4 k5 k6 codx cody p2 p1


def open_azure_kinect(path: Path, camera_file: Path | None = None) -> RgbdSource:
    """An Azure Kinect recording. Times are those of the device, since the start of the recording.

    A camera file takes the place of the calibration in the file. Raises `RecordingError` for files of another kind, missing
    tracks or calibration, and files that are cut short.
    """
    file = Matroska(path)
    tracks = {stream: _track(file, name) for stream, name in (("colour", "COLOR"), ("depth", "DEPTH"))}
    if camera_file is not None:
        rig = read_camera_file(camera_file).rig(str(camera_file))
    else:
        rig = _rig(file, tracks["colour"], tracks["depth"])
        rig.check(str(path))
    streams = {track.number: stream for stream, track in tracks.items()}

    def pictures() -> Iterator[Picture]:
        counts = dict.fromkeys(streams, 0)
        for block in file.blocks(set(streams)):
            track = file.tracks[block.track]
            where = f"{path}: track {track.name}, picture {counts[block.track]}"
            counts[block.track] += 1
            yield Picture(streams[block.track], block.time_ns, where, partial(_decode, track, block, where))  # type: ignore[arg-type]

    return RgbdSource(
        name=valid_name(path.stem),
        description=f"Azure Kinect recording {path.name}, colour {_four(tracks['colour']).decode()}, depth mode "
        f"{file.tags.get('K4A_DEPTH_MODE', 'unknown')}",
        rig=rig,
        pictures=pictures,
    )


def _four(track: Track) -> bytes:
    """The kind of a track's pictures."""
    return track.private[16:20]


def _track(file: Matroska, name: str) -> Track:
    wanted, kinds = file.tags.get(f"K4A_{name}_TRACK"), _COLOUR_KINDS if name == "COLOR" else (_DEPTH_KIND,)
    found = next((track for track in file.tracks.values() if track.name == name), None)
    described = ", ".join(f"{track.name or track.number} ({track.codec})" for track in file.tracks.values()) or "none"
    if found is None:
        raise RecordingError(
            f"{file.path}: no track {name}{f' (number {wanted})' if wanted else ''}; expected an Azure Kinect recording with COLOR and DEPTH. "
            f"Found the tracks {described}. Convert another .mkv with ffmpeg: colour to .mp4, depth to 16-bit .png (docs/importing.md)."
        )
    if found.codec != _CODEC or _four(found) not in kinds or found.compressed:
        kind = _four(found).decode("ascii", "replace") if found.codec == _CODEC else found.codec
        raise RecordingError(
            f"{file.path}: track {name} holds {kind!r}; expected {', '.join(one.decode() for one in kinds)}, uncompressed by the "
            "container. Convert it with ffmpeg: colour to .mp4, depth to 16-bit .png (docs/importing.md)."
        )
    return found


def _decode(track: Track, block: Block, where: str) -> np.ndarray:
    """Colour as uint8 RGB, or depth as uint16. Raises `RecordingError` for damaged data."""
    kind, width, height, data = _four(track), track.width, track.height, np.frombuffer(block.data, np.uint8)
    if kind == b"MJPG":
        try:
            image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
        except cv2.error:
            image = None
        if image is None or b"\xff\xd9" not in block.data[-64:]:
            raise RecordingError(f"{where}: no whole JPEG ({data.size} bytes). Copy the file again.")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    expected = round(width * height * _BYTES_PER_PIXEL.get(kind, 2.0))
    if data.size != expected:
        raise RecordingError(f"{where}: {data.size} bytes; expected {expected}. Copy the file again.")
    if kind == _DEPTH_KIND:
        return data.view(">u2").reshape(height, width).astype(np.uint16)
    if kind == b"NV12":
        return cv2.cvtColor(data.reshape(height * 3 // 2, width), cv2.COLOR_YUV2RGB_NV12)
    if kind == b"YUY2":
        return cv2.cvtColor(data.reshape(height, width, 2), cv2.COLOR_YUV2RGB_YUY2)
    return cv2.cvtColor(data.reshape(height, width, 4), cv2.COLOR_BGRA2RGB)


def _rig(file: Matroska, colour: Track, depth: Track) -> Rig:
    """The cameras by the attached calibration."""
    where = f"{file.path}: calibration.json"
    if "calibration.json" not in file.attachments:
        raise RecordingError(f"{where} is not attached; expected the camera's calibration. Give camera=<file>.")
    try:
        values = json.loads(file.attachments["calibration.json"].rstrip(b"\x00").decode())
        cameras = {one["Location"]: one for one in values["CalibrationInformation"]["Cameras"]}
        of_depth = cameras["CALIBRATION_CameraLocationD0"]
        of_colour = cameras["CALIBRATION_CameraLocationPV0"]
        from_depth, from_colour = _pose(of_depth), _pose(of_colour)
        matrix = from_colour @ np.linalg.inv(from_depth)
        return Rig(
            colour=_colour_camera(of_colour, colour.width, colour.height, where),
            depth=_depth_camera(of_depth, depth.width, depth.height, where),
            rotation=matrix[:3, :3],
            translation_m=matrix[:3, 3],
        )
    except RecordingError:
        raise
    except Exception as error:  # missing keys, other types, no JSON
        raise RecordingError(
            f"{where} is incomplete ({type(error).__name__}: {error}); expected cameras D0 and PV0. Give camera=<file>."
        ) from error


def _pose(camera: dict[str, Any]) -> np.ndarray:
    """The matrix that takes points of the rig's frame, in metres, to this camera's."""
    out = np.eye(4)
    out[:3, :3] = np.array(camera["Rt"]["Rotation"], float).reshape(3, 3)
    out[:3, 3] = np.array(camera["Rt"]["Translation"], float).reshape(3)
    return out


def _lens(camera: dict[str, Any], where: str) -> tuple[np.ndarray, tuple[float, ...]]:
    """cx, cy, fx, fy as fractions of the sensor, and distortion in OpenCV's order."""
    lens = camera["Intrinsics"]
    if lens["ModelType"] != _BROWN:
        raise RecordingError(f"{where}: lens model {lens['ModelType']!r}; expected {_BROWN}. Give camera=<file>.")
    values = np.array(lens["ModelParameters"][:_PARAMETERS], float)
    k1, k2, k3, k4, k5, k6, _, _, p2, p1 = (float(value) for value in values[4:_PARAMETERS])
    return values[:4], (k1, k2, p1, p2, k3, k4, k5, k6)


def _depth_camera(camera: dict[str, Any], width: int, height: int, where: str) -> Intrinsics:
    """Depth modes are crops of the square sensor, half of them binned. The sensor's corner is at 0, a pixel's centre at 0.5."""
    if (width, height) not in _DEPTH_CROPS:
        sizes = ", ".join(f"{one} x {other}" for one, other in _DEPTH_CROPS)
        raise RecordingError(f"{where}: depth of {width} x {height}; expected {sizes}. Give camera=<file>.")
    side, left, top = _DEPTH_CROPS[width, height]
    (cx, cy, fx, fy), distortion = _lens(camera, where)
    return Intrinsics(fx * side, fy * side, cx * side - left - 0.5, cy * side - top - 0.5, width, height, distortion)


def _colour_camera(camera: dict[str, Any], width: int, height: int, where: str) -> Intrinsics:
    """Colour modes are the 4:3 sensor scaled, and cut to 16:9 in the middle. Older calibrations are of the 16:9 picture."""
    (cx, cy, fx, fy), distortion = _lens(camera, where)
    if camera["SensorWidth"] * 9 == camera["SensorHeight"] * 16:
        cy, fy = (cy * 2304 + 384) / 3072, fy * 2304 / 3072
    whole = width * 3 / 4
    return Intrinsics(
        fx * width, fy * whole, cx * width - 0.5, cy * whole - (whole - height) / 2 - 0.5, width, height, distortion
    )
