"""Pixels of ROS image messages: sensor_msgs/Image and sensor_msgs/CompressedImage, of ROS 1 and ROS 2."""

from __future__ import annotations

import re
import struct
from typing import Any, Literal

import cv2
import numpy as np

from ....core.errors import RecordingError

_EIGHT_BIT = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8uc3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8uc4": (4, cv2.COLOR_BGRA2RGB),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
}
"""Channels of an encoding, and OpenCV's conversion to RGB."""

_DEPTH = {"16uc1": np.dtype(np.uint16), "mono16": np.dtype(np.uint16), "z16": np.dtype(np.uint16),
          "32fc1": np.dtype(np.float32)}  # fmt: skip

_CONFIG_BYTES = 12  # before a compressedDepth picture: format, and two parameters of its inverse depth


def kind_of(message: Any) -> Literal["colour", "depth"] | None:
    """Whether an image message holds colour or depth; None for another encoding (infrared, Bayer, labels)."""
    if hasattr(message, "encoding"):
        encoding = message.encoding.lower()
        return "colour" if encoding in _EIGHT_BIT else "depth" if encoding in _DEPTH else None
    layout = message.format.lower()
    if "compresseddepth" in layout or layout.startswith(tuple(_DEPTH)):
        return "depth"
    return None if layout.startswith(("mono", "8uc1", "bayer")) else "colour"


def encodings() -> str:
    """The supported encodings, for messages."""
    return ", ".join([*_EIGHT_BIT, *_DEPTH])


def pixels(message: Any, where: str) -> np.ndarray:
    """Colour as uint8 RGB (height, width, 3), or depth as uint16 or float32 (height, width).

    Raises `RecordingError`, which names `where` the message stands, for an unknown encoding and for damaged data.
    """
    if not hasattr(message, "encoding"):
        return _compressed(message, where)
    encoding = message.encoding.lower()
    if encoding in _EIGHT_BIT:
        channels, conversion = _EIGHT_BIT[encoding]
        image = _rows(message, np.dtype(np.uint8), channels, where)
        return np.ascontiguousarray(image) if conversion is None else cv2.cvtColor(image, conversion)
    if encoding in _DEPTH:
        kind = _DEPTH[encoding].newbyteorder(">" if message.is_bigendian else "<")
        return np.ascontiguousarray(_rows(message, kind, 1, where)[..., 0].astype(_DEPTH[encoding]))
    raise RecordingError(
        f"{where}: encoding {message.encoding!r}; expected one of {encodings()}. Record or convert the topic in one of them."
    )


def _rows(message: Any, kind: np.dtype, channels: int, where: str) -> np.ndarray:
    """The data as (height, width, channels), without the padding at the end of rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    used = width * channels * kind.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if height <= 0 or width <= 0 or step < used or len(data) < height * step:
        raise RecordingError(
            f"{where}: {len(data)} bytes for {width} x {height} pixels of {message.encoding} in rows of {step} bytes; the message is "
            "truncated or damaged. Copy the bag again."
        )
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :used])
    return rows.view(kind).reshape(height, width, channels)


def _compressed(message: Any, where: str) -> np.ndarray:
    data, layout = bytes(message.data), message.format.lower()
    depth = kind_of(message) == "depth"
    if "rvl" in layout:
        raise RecordingError(f"{where}: RVL-compressed depth; expected PNG or JPEG. Republish the topic as raw images.")
    head, body = (data[:_CONFIG_BYTES], data[_CONFIG_BYTES:]) if "compresseddepth" in layout else (b"", data)
    try:
        flags = cv2.IMREAD_UNCHANGED if depth else cv2.IMREAD_COLOR
        image = cv2.imdecode(np.frombuffer(body, np.uint8), flags) if body else None
    except cv2.error:
        image = None
    if image is None or (head and len(head) < _CONFIG_BYTES):
        raise RecordingError(f"{where}: no readable picture of format {message.format!r}. Copy the bag again.")
    if not depth:
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    if head and re.match("32fc1", layout):
        # compressed_depth_image_transport stores the inverse depth: value = a / depth + b.
        a, b = struct.unpack("<2f", head[4:])
        with np.errstate(divide="ignore"):
            metres = np.where(image > 0, a / (image.astype(np.float32) - b), 0)
        return metres.astype(np.float32)
    return image
