"""Messages of ROS bags without ROS: ROS 1 (.bag) and ROS 2 (folder, .mcap, .db3), through the package rosbags.

Only standard message types are read, by the definitions that rosbags brings: those in a bag are ignored, since rosbags makes
Python code of them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ....core.errors import RecordingError

BAG_ENDINGS = (".bag", ".mcap", ".db3")

_INSTALL = "pip install 'tagjax[bags]' (the package rosbags, which needs no ROS)"


class Bag:
    """An open bag. Raises `RecordingError` where rosbags is missing, and for a file that is no whole bag."""

    def __init__(self, path: Path):
        try:
            from rosbags.rosbag1 import Reader as Reader1
            from rosbags.rosbag2 import Reader as Reader2
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise RecordingError(f"{path}: reading ROS bags needs {_INSTALL}; found {error}.") from error
        self.path = path
        self._is_ros1 = path.suffix == ".bag"
        self._types = get_typestore(Stores.ROS1_NOETIC if self._is_ros1 else Stores.ROS2_HUMBLE)
        with self.readable():
            self._reader: Any = (Reader1 if self._is_ros1 else Reader2)(path)
            self._reader.open()
        self.connections: list[Any] = list(self._reader.connections)

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(Exception):  # a damaged bag may not close
            self._reader.close()

    @contextlib.contextmanager
    def readable(self) -> Iterator[None]:
        """Errors of the package in the block are raised as `RecordingError`."""
        try:
            yield
        except (RecordingError, GeneratorExit, MemoryError):
            raise
        # Of a damaged bag rosbags raises errors of its own, of struct, of its decompressors and of SQLite.
        except Exception as error:
            repair = "rosbag reindex" if self._is_ros1 else "ros2 bag reindex"
            raise RecordingError(
                f"{self.path}: no whole bag ({type(error).__name__}: {' '.join(str(error).split()) or 'no reason given'}). Copy it again; "
                f"a recording that was not stopped is repaired by {repair}."
            ) from error

    def of_type(self, *types: str) -> list[Any]:
        """Connections of these message types, such as sensor_msgs/msg/Image."""
        return [one for one in self.connections if one.msgtype in types]

    def messages(self, connections: Sequence[Any]) -> Iterator[tuple[str, int, Any]]:
        """(topic, time of the log in ns, message) of these connections, in order of the log."""
        if not connections:
            return
        with self.readable():
            for connection, log_ns, data in self._reader.messages(connections=connections):
                yield connection.topic, log_ns, self._message(data, connection.msgtype)

    def first(self, connection: Any) -> Any | None:
        """The first message of a connection; None if there is none."""
        return next((message for _, _, message in self.messages([connection])), None)

    def _message(self, data: Any, kind: str) -> Any:
        decode = self._types.deserialize_ros1 if self._is_ros1 else self._types.deserialize_cdr
        return decode(data, kind)
