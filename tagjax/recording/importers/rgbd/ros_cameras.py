"""Cameras of a bag: intrinsics of camera-info messages, and the transform from depth to colour."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from ....core.camera import Intrinsics
from ....core.errors import RecordingError

_MODELS = (
    "plumb_bob",
    "rational_polynomial",
    "brown conrady",
    "modified brown conrady",
    "inverse brown conrady",
    "none",
    "",
)
"""Lens models whose coefficients are OpenCV's.

librealsense itself projects "inverse Brown-Conrady" by these coefficients and inverts them to deproject, and its ROS wrapper
publishes them as plumb_bob.
"""


def intrinsics_of(info: Any, where: str) -> Intrinsics:
    """Intrinsics with distortion of a sensor_msgs/CameraInfo message. Raises `RecordingError` for a lens of another model."""
    lower = hasattr(info, "k")  # ROS 2
    k = np.asarray(info.k if lower else info.K, float)
    distortion = tuple(float(value) for value in np.asarray(info.d if lower else info.D, float))
    camera = Intrinsics(float(k[0]), float(k[4]), float(k[2]), float(k[5]), int(info.width), int(info.height))
    try:
        camera.check()
    except RecordingError as error:
        raise RecordingError(f"{where}: {error}") from error
    if not any(distortion):
        return camera
    if info.distortion_model.lower().replace("_", " ") not in (model.replace("_", " ") for model in _MODELS):
        raise RecordingError(
            f"{where}: lens model {info.distortion_model!r}; expected plumb_bob or rational_polynomial. Rectify the pictures "
            "first, or give camera=<file> with coefficients of OpenCV's model."
        )
    camera = dataclasses.replace(camera, distortion=distortion)
    try:
        camera.check()
    except RecordingError as error:
        raise RecordingError(f"{where}: {error}") from error
    return camera


def matrix_of(transform: Any) -> np.ndarray:
    """The 4 x 4 matrix of a geometry_msgs/Transform message."""
    q, t = transform.rotation, transform.translation
    x, y, z, w = np.array([q.x, q.y, q.z, q.w], float) / max(1e-12, np.linalg.norm([q.x, q.y, q.z, q.w]))
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = [t.x, t.y, t.z]
    return out


def between_frames(transforms: Iterable[Any], source: str, target: str) -> np.ndarray | None:
    """The matrix that takes points from frame `source` to frame `target`, by the static transforms of a bag; None without.

    A geometry_msgs/TransformStamped takes points of its child to its parent.
    """
    steps: dict[str, list[tuple[str, np.ndarray]]] = {}
    for one in transforms:
        matrix = matrix_of(one.transform)
        parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
        steps.setdefault(child, []).append((parent, matrix))
        steps.setdefault(parent, []).append((child, np.linalg.inv(matrix)))
    found, pending = {source.lstrip("/"): np.eye(4)}, [source.lstrip("/")]
    while pending:
        here = pending.pop()
        for there, matrix in steps.get(here, []):
            if there not in found:
                found[there] = matrix @ found[here]
                pending.append(there)
    return found.get(target.lstrip("/"))
