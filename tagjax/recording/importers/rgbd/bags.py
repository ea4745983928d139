"""ROS bags with colour, depth and camera-info topics: RealSense's own .bag, ROS 1 bags, ROS 2 bags (MCAP, SQLite)."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ....core.camera import Intrinsics
from ....core.errors import RecordingError
from ....core.names import valid_name
from .bag_reader import Bag
from .camera_file import read_camera_file
from .ros_cameras import between_frames, intrinsics_of, matrix_of
from .ros_images import encodings, kind_of, pixels
from .source import Picture, RgbdSource, Rig

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO = "sensor_msgs/msg/CameraInfo"
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_REALSENSE = re.compile(r"(/device_\d+/sensor_\d+)/\w+_\d+/image/data")
_ALIGNED = re.compile(r"align|registered|depth_to_colou?r")
_NO_DEPTH = re.compile(r"infra|(^|[/_])ir([/_0-9]|$)|confidence|amplitude")

Stream = Literal["colour", "depth"]


@dataclasses.dataclass(frozen=True)
class Topics:
    """Topics of a bag; null: found by their types and names."""

    colour: str | None = None
    depth: str | None = None
    colour_info: str | None = None
    depth_info: str | None = None


def open_bag(path: Path, topics: Topics | None = None, camera_file: Path | None = None) -> RgbdSource:
    """A ROS bag with a colour and a depth topic.

    Frame times are the header stamps (of the bag's log where a stamp is 0). Intrinsics come from the camera-info topics,
    the transform from depth to colour from RealSense's extrinsics or /tf_static; a camera file takes their place. Depth in
    the frame of the colour camera, with its intrinsics, counts as registered. Integer depth is in millimetres unless a
    RealSense bag or a camera file states its unit. Raises `RecordingError` where rosbags is not installed, for missing or
    ambiguous topics, and for damaged bags and messages.
    """
    with Bag(path) as bag:
        chosen = {
            stream: _image_topic(bag, stream, getattr(topics or Topics(), stream)) for stream in ("colour", "depth")
        }
        if camera_file is not None:
            rig = read_camera_file(camera_file).rig(str(camera_file))
        else:
            rig = _rig(bag, chosen, topics or Topics())
            rig.check(str(path))

    def pictures() -> Iterator[Picture]:
        return _pictures(path, {topic: stream for stream, topic in chosen.items()})

    return RgbdSource(
        name=valid_name(path.resolve().stem),
        description=f"bag {path.name}, colour of {chosen['colour']}, depth of {chosen['depth']}",
        rig=rig,
        pictures=pictures,
    )


def _pictures(path: Path, streams: dict[str, Any]) -> Iterator[Picture]:
    counts = dict.fromkeys(streams, 0)
    with Bag(path) as bag:
        for topic, log_ns, message in bag.messages([one for one in bag.of_type(*_IMAGES) if one.topic in streams]):
            where = f"{path}: {topic}, message {counts[topic]}"
            counts[topic] += 1
            stamp = message.header.stamp
            yield Picture(
                streams[topic],
                int(stamp.sec) * 10**9 + int(stamp.nanosec) or log_ns,
                where,
                partial(pixels, message, where),
            )


def _image_topic(bag: Bag, stream: str, given: str | None) -> str:
    """The topic of a stream: `given`, or the one that fits best. Raises `RecordingError` for none and for several."""
    images = {one.topic: one for one in bag.of_type(*_IMAGES)}
    if given is not None:
        if given not in images:
            raise RecordingError(
                f"{bag.path}: topics.{stream} is {given!r}; expected one of the image topics {_listed(images)}."
            )
        if (message := bag.first(images[given])) is None or kind_of(message) != stream:
            found = "no message" if message is None else getattr(message, "encoding", getattr(message, "format", ""))
            raise RecordingError(f"{bag.path}: {given} holds {found}; expected {stream} ({encodings()}).")
        return given
    ranked: list[tuple[int, str]] = []
    for topic, connection in images.items():
        message = bag.first(connection)
        if message is not None and kind_of(message) == stream and not (stream == "depth" and _NO_DEPTH.search(topic)):
            aligned = stream == "depth" and _ALIGNED.search(topic)
            ranked.append((2 * (not aligned) + (connection.msgtype != _IMAGES[0]), topic))
    if not ranked:
        raise RecordingError(
            f"{bag.path}: no {stream} topic; expected {' or '.join(_IMAGES)} of encoding {encodings()}. The bag has the topics "
            f"{_listed({one.topic: one for one in bag.connections})}."
        )
    best = sorted(topic for rank, topic in ranked if rank == min(ranked)[0])
    if len(best) > 1:
        raise RecordingError(
            f"{bag.path}: {len(best)} {stream} topics ({', '.join(best)}); expected one. Give topics.{stream}=<topic>."
        )
    return best[0]


def _listed(topics: dict[str, Any]) -> str:
    return ", ".join(f"{topic} ({one.msgtype.split('/')[-1]})" for topic, one in sorted(topics.items())) or "none"


def _info(bag: Bag, topic: str, given: str | None, stream: str) -> tuple[Intrinsics, str]:
    """Intrinsics of an image topic, and the frame of its camera."""
    infos = {one.topic: one for one in bag.of_type(_INFO)}
    if given is not None and given not in infos:
        raise RecordingError(f"{bag.path}: topics.{stream}_info is {given!r}; expected one of {_listed(infos)}.")
    near = {name: _common_parts(name, topic) for name in infos}
    best = [name for name in near if near[name] == max(near.values()) and near[name] > 0]
    if given is None and len(best) != 1:
        raise RecordingError(
            f"{bag.path}: {'no' if not best else 'no single'} camera-info topic beside {topic}; expected one. Give "
            f"topics.{stream}_info=<topic> (found {_listed(infos)}), or camera=<file>."
        )
    chosen = given or best[0]
    if (message := bag.first(infos[chosen])) is None:
        raise RecordingError(f"{bag.path}: {chosen} has no message; expected the intrinsics. Give camera=<file>.")
    return intrinsics_of(message, f"{bag.path}: {chosen}"), message.header.frame_id


def _common_parts(first: str, second: str) -> int:
    """Number of leading names that two topics share."""
    count = 0
    for one, other in zip(first.strip("/").split("/"), second.strip("/").split("/"), strict=False):
        if one != other:
            break
        count += 1
    return count


def _rig(bag: Bag, chosen: dict[str, str], topics: Topics) -> Rig:
    """The cameras by the messages of the bag."""
    colour, colour_frame = _info(bag, chosen["colour"], topics.colour_info, "colour")
    depth, depth_frame = _info(bag, chosen["depth"], topics.depth_info, "depth")
    unit_m = _realsense_unit_m(bag, chosen["depth"])
    matrix = _realsense_matrix(bag, chosen)
    if matrix is None:
        if colour_frame and colour_frame == depth_frame:
            matrix = np.eye(4)
        else:
            transforms = [one for _, _, tf in bag.messages(_static(bag)) for one in tf.transforms]
            matrix = between_frames(transforms, depth_frame, colour_frame)
    if matrix is None:
        raise RecordingError(
            f"{bag.path}: no transform from the depth camera (frame {depth_frame!r}) to the colour camera (frame {colour_frame!r}); "
            "expected it in /tf_static. Record aligned depth, or give camera=<file> with rotation and translation_m."
        )
    if np.allclose(matrix, np.eye(4), atol=1e-9) and _same_view(colour, depth):
        return Rig(colour=colour, depth_unit_m=unit_m)
    return Rig(colour=colour, depth=depth, rotation=matrix[:3, :3], translation_m=matrix[:3, 3], depth_unit_m=unit_m)


def _static(bag: Bag) -> list[Any]:
    return [one for one in bag.of_type(_TRANSFORMS) if one.topic.endswith("tf_static")]


def _same_view(colour: Intrinsics, depth: Intrinsics) -> bool:
    same_size = (colour.width, colour.height) == (depth.width, depth.height)
    return (
        same_size and np.allclose(colour.matrix(), depth.matrix(), atol=0.01) and colour.distortion == depth.distortion
    )


def _realsense_unit_m(bag: Bag, topic: str) -> float:
    """Metres of one unit of depth: RealSense's option, else a millimetre (ROS's convention)."""
    if found := _REALSENSE.fullmatch(topic):
        pattern = re.compile(rf"{re.escape(found[1])}/option/Depth[ _]Units/value")
        for one in bag.of_type("std_msgs/msg/Float32"):
            if pattern.fullmatch(one.topic) and (message := bag.first(one)) is not None:
                return round(float(message.data), 9)
    return 0.001


def _realsense_matrix(bag: Bag, chosen: dict[str, str]) -> np.ndarray | None:
    """Depth to colour by the extrinsics of a RealSense bag: each takes points of one reference to its stream."""
    found = {}
    for stream, topic in chosen.items():
        prefix = topic.removesuffix("image/data") + "tf/0"
        for one in bag.of_type("geometry_msgs/msg/Transform"):
            if _REALSENSE.fullmatch(topic) and one.topic == prefix and (message := bag.first(one)) is not None:
                found[stream] = matrix_of(message)
    if len(found) < 2:
        return None
    return found["colour"] @ np.linalg.inv(found["depth"])
