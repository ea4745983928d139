"""ROS bags of the pictures of rgbd_files.py, written with rosbags."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rgbd_files import CAMERA
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

LOG_DELAY_NS = 7_000_000
"""The log's times are later than the stamps, so that one is not taken for the other."""


class BagWriter:
    """A bag in the making: ROS 1 (.bag), or ROS 2 as a folder of MCAP or SQLite."""

    def __init__(self, path: Path, storage: str = "mcap"):
        self.ros1 = path.suffix == ".bag"
        self.types = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        self._writer: Any = Writer1(path) if self.ros1 else Writer2(path, version=9, storage_plugin=plugin)
        self._connections: dict[str, Any] = {}
        self._log_ns = 0
        path.parent.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> BagWriter:
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def make(self, kind: str, *values: Any, **named: Any) -> Any:
        return self.types.types[kind](*values, **named)

    def header(self, time_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", time_ns // 10**9, time_ns % 10**9)
        first = (0,) if self.ros1 else ()  # seq
        return self.make("std_msgs/msg/Header", *first, stamp, frame)

    def add(self, topic: str, message: Any, log_ns: int) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, message.__msgtype__, typestore=self.types)
        encode: Callable = self.types.serialize_ros1 if self.ros1 else self.types.serialize_cdr
        self._log_ns = max(log_ns, self._log_ns + 1)  # a log's clock runs on when a stamp goes back
        self._writer.write(self._connections[topic], self._log_ns, encode(message, message.__msgtype__))

    def image(self, topic: str, image: np.ndarray, time_ns: int, encoding: str, frame: str, **changes: Any) -> None:
        """An image message; rows are padded by 6 bytes."""
        rows = np.ascontiguousarray(image).view(np.uint8).reshape(image.shape[0], -1)
        padded = np.pad(rows, ((0, 0), (0, 6)), constant_values=77)
        values: dict[str, Any] = {
            "header": self.header(time_ns, frame),
            "height": image.shape[0],
            "width": image.shape[1],
            "encoding": encoding,
            "is_bigendian": 0,
            "step": padded.shape[1],
            "data": padded.reshape(-1),
        }
        self.add(topic, self.make("sensor_msgs/msg/Image", **{**values, **changes}), time_ns + LOG_DELAY_NS)

    def compressed(self, topic: str, data: bytes, time_ns: int, layout: str, frame: str) -> None:
        message = self.make(
            "sensor_msgs/msg/CompressedImage", self.header(time_ns, frame), layout, np.frombuffer(data, np.uint8)
        )
        self.add(topic, message, time_ns + LOG_DELAY_NS)

    def info(self, topic: str, time_ns: int, frame: str, **changes: Any) -> None:
        """A camera-info message of rgbd_files.CAMERA, with changes (also distortion, model)."""
        camera = {**CAMERA, "distortion": (), "model": "plumb_bob", **changes}
        k = [camera["fx_px"], 0, camera["cx_px"], 0, camera["fy_px"], camera["cy_px"], 0, 0, 1]
        arrays = (np.array(camera["distortion"], float), np.array(k, float), np.eye(3).reshape(-1), np.zeros(12))
        region = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        header = self.header(time_ns, frame)
        message = self.make(
            "sensor_msgs/msg/CameraInfo", header, camera["height"], camera["width"], camera["model"], *arrays, 0, 0, region
        )  # fmt: skip
        self.add(topic, message, time_ns + LOG_DELAY_NS)

    def transform(self, quaternion: list[float], shift_m: list[float]) -> Any:
        rotation = self.make("geometry_msgs/msg/Quaternion", *quaternion)
        return self.make("geometry_msgs/msg/Transform", self.make("geometry_msgs/msg/Vector3", *shift_m), rotation)

    def static(self, parent: str, child: str, quaternion: list[float], shift_m: list[float], time_ns: int) -> None:
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped",
            self.header(time_ns, parent),
            child,
            self.transform(quaternion, shift_m),
        )
        self.add("/tf_static", self.make("tf2_msgs/msg/TFMessage", [stamped]), time_ns)
