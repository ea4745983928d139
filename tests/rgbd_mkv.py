"""Azure Kinect recordings: a Matroska writer of the elements that k4arecorder writes."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

CODEC = "V_MS/VFW/FOURCC"
DEPTH_LENS = [0.51, 0.49, 0.49, 0.495, 4.2, 2.8, 0.12, 4.5, 4.3, 0.7, 0.0, 0.0, -0.0001, 0.0002]
COLOUR_LENS = [0.499, 0.507, 0.477, 0.636, 0.55, -2.6, 1.5, 0.43, -2.4, 1.4, 0.0, 0.0, 0.0003, -0.0004]


def element(kind: int, *content: bytes) -> bytes:
    """An EBML element; its size takes 8 bytes."""
    data = b"".join(content)
    size = (1 << 56) | len(data)
    return kind.to_bytes((kind.bit_length() + 7) // 8, "big") + size.to_bytes(8, "big") + data


def whole(kind: int, value: int) -> bytes:
    return element(kind, value.to_bytes(max(1, (value.bit_length() + 7) // 8), "big"))


def text(kind: int, value: str) -> bytes:
    return element(kind, value.encode())


def track(number: int, name: str, four: bytes, width: int, height: int, codec: str = CODEC) -> bytes:
    header = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 16, four, 0, 0, 0, 0, 0)
    video = element(0xE0, whole(0xB0, width), whole(0xBA, height))
    return element(
        0xAE,
        whole(0xD7, number),
        whole(0x73C5, number + 100),
        whole(0x83, 1),
        text(0x536E, name),
        text(0x86, codec),
        element(0x63A2, header),
        video,
    )


def cluster(time: int, blocks: list[tuple[int, int, bytes]], *, grouped: bool = True) -> bytes:
    """A cluster of blocks (track, time since the cluster's, data)."""
    parts = []
    for number, offset, data in blocks:
        block = bytes([0x80 | number]) + struct.pack(">hB", offset, 0x80) + data
        parts.append(element(0xA0, element(0xA1, block)) if grouped else element(0xA3, block))
    return element(0x1F43B675, whole(0xE7, time), *parts)


def calibration(**changes: Any) -> dict[str, Any]:
    """A calibration as it is attached; the colour camera stands 32 mm beside the depth camera."""

    def camera(place: str, lens: list[float], rotation: np.ndarray, shift: list[float], size: tuple[int, int]) -> dict:
        return {
            "Intrinsics": {
                "ModelParameterCount": 14,
                "ModelParameters": lens,
                "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
            },
            "Location": f"CALIBRATION_CameraLocation{place}",
            "Rt": {"Rotation": rotation.reshape(-1).tolist(), "Translation": shift},
            "SensorWidth": size[0],
            "SensorHeight": size[1],
        }

    turn = cv2.Rodrigues(np.array([0.1, 0.0, 0.0]))[0]
    cameras = [
        camera("D0", changes.get("depth", DEPTH_LENS), np.eye(3), [0.0, 0.0, 0.0], (1024, 1024)),
        camera(
            "PV0",
            changes.get("colour", COLOUR_LENS),
            turn,
            [-0.032, -0.002, 0.004],
            changes.get("sensor", (4096, 3072)),
        ),
    ]
    return {"CalibrationInformation": {"Cameras": cameras}}


def write_mkv(
    path: Path,
    clusters: list[bytes],
    *,
    tracks: list[bytes] | None = None,
    attached: dict[str, Any] | bytes | None = None,
    scale_ns: int = 1000,
) -> Path:
    """A file; by default of a 1280 x 720 Motion-JPEG track and a 320 x 288 depth track."""
    tracks = tracks or [track(1, "COLOR", b"MJPG", 1280, 720), track(2, "DEPTH", b"b16g", 320, 288)]
    data = attached if isinstance(attached, bytes) else json.dumps(attached or calibration()).encode() + b"\x00"
    file = element(
        0x61A7, text(0x466E, "calibration.json"), text(0x4660, "application/octet-stream"), element(0x465C, data)
    )
    tag = element(0x7373, element(0x67C8, text(0x45A3, "K4A_DEPTH_MODE"), text(0x4487, "NFOV_2X2BINNED")))
    head = element(0x1A45DFA3, text(0x4282, "matroska"), whole(0x4287, 4), whole(0x4285, 2))
    segment = element(
        0x18538067,
        element(0xEC, bytes(20)),  # room that is left
        element(0x1549A966, whole(0x2AD7B1, scale_ns)),
        element(0x1654AE6B, *tracks),
        element(0x1941A469, file),
        element(0x1254C367, tag),
        *clusters,
    )
    path.write_bytes(head + segment)
    return path
