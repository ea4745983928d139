"""The camera file of a recording: intrinsics, unit of depth, registration and times, as JSON or YAML."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from ....core.camera import Intrinsics
from ....core.errors import RecordingError
from ....core.settings import ConfigError, from_mapping
from .source import Rig

NAMES = ("camera.json", "camera.yaml", "camera.yml", "intrinsics.json", "intrinsics.yaml", "intrinsics.yml")
"""Names under which the camera file of a folder is found; another one is given by `camera=`."""

MAX_BYTES = 1_000_000
"""A camera file is far smaller."""

EXAMPLE = (
    "colour: {fx_px: 615.0, fy_px: 615.0, cx_px: 319.5, cy_px: 239.5, width: 640, height: 480}, depth_unit_m: 0.001, "
    "depth_registered: true"
)
"""The smallest camera file."""


class _Loader(yaml.SafeLoader):
    """Plain values only: a time stays the text that it is."""

    yaml_implicit_resolvers = {  # noqa: RUF012 (PyYAML's own attribute)
        first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


@dataclasses.dataclass(frozen=True)
class CameraFile:
    """Content of a camera file. Raises `ConfigError` for values that contradict each other.

    Depth that is not registered to colour needs `depth`, `rotation` and `translation_m`. `times` says where the times of the
    pictures are: in their `names`, in a list (the name of a file with a time and a name in each row), or nowhere: `frames`
    numbers the pictures in order, `fps` a second; beside a video, `frames` gives the n-th depth picture to its n-th frame.
    """

    colour: Intrinsics
    depth_unit_m: float  # metres of one unit of integer depth: 0.001 for millimetres
    depth_registered: bool  # whether each depth picture is in the view of the colour camera already
    depth: Intrinsics | None = None  # the depth camera's, where depth is not registered
    rotation: tuple[tuple[float, float, float], ...] | None = None  # X_colour = rotation X_depth + translation_m
    translation_m: tuple[float, float, float] | None = None
    depth_kind: Literal["depth", "range"] = "depth"  # along z, or the distance to the camera
    colour_folder: str | None = None  # beside the camera file; null: colour, color, rgb or image
    depth_folder: str | None = None  # null: depth
    times: str = "names"
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"  # auto: by size
    fps: float | None = None  # of times: frames
    start: str | float | None = None  # time of the first frame: ISO, or seconds since 1970
    max_gap_s: float = 0.02

    def __post_init__(self) -> None:
        given = [name for name in ("depth", "rotation", "translation_m") if getattr(self, name) is not None]
        if self.depth_registered and given:
            raise ConfigError(
                f"depth_registered is true, and {', '.join(given)} is given; expected one or the other. Set depth_registered to "
                "false if the depth camera has its own view."
            )
        if not self.depth_registered and len(given) < 3:
            raise ConfigError(
                "depth_registered is false; expected depth (the depth camera's intrinsics), rotation (3 rows of 3) and "
                f"translation_m (3): X_colour = rotation X_depth + translation_m. Found {', '.join(given) or 'none of them'}."
            )
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise ConfigError(f"fps is {self.fps}; expected a frame rate above 0 and at most 1000.")
        if not self.max_gap_s >= 0:
            raise ConfigError(f"max_gap_s is {self.max_gap_s}; expected seconds, 0 or more.")

    def rig(self, where: str) -> Rig:
        """The cameras, checked. Raises `RecordingError`, which names `where` they come from."""
        rig = Rig(colour=self.colour, depth_unit_m=self.depth_unit_m, depth_kind=self.depth_kind)
        if not self.depth_registered:
            turn, shift = np.array(self.rotation, float), np.array(self.translation_m, float)
            rig = dataclasses.replace(rig, depth=self.depth, rotation=turn, translation_m=shift)
        rig.check(where)
        return rig


def find_camera_file(folder: Path, *more: str) -> Path | None:
    """The camera file of a folder, one of `more` or `NAMES`; None without one. Raises `RecordingError` for several."""
    found = [folder / name for name in (*more, *NAMES) if (folder / name).is_file()]
    if len(found) > 1:
        raise RecordingError(
            f"{folder}: found {', '.join(path.name for path in found)}; expected one camera file. Remove the others, or give "
            "camera=<file>."
        )
    return found[0] if found else None


def required_camera_file(folder: Path, *more: str) -> Path:
    """As `find_camera_file`. Raises `RecordingError`, which shows what a camera file holds, where there is none."""
    found = find_camera_file(folder, *more)
    if found is None:
        names = [*(more[:1] or NAMES[1:2]), NAMES[0]]
        raise RecordingError(
            f"{folder}: no camera file; expected {' or '.join(names)} there, or camera=<file>. It holds, for example: {EXAMPLE}. "
            "docs/importing.md has all keys."
        )
    return found


def read_camera_file(path: Path) -> CameraFile:
    """A camera file, validated. Raises `RecordingError` for a file that cannot be read, unknown keys and wrong values."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise RecordingError(f"{path}: {path.stat().st_size} bytes; expected a camera file of some lines.")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{path}: cannot be read ({error}). Is it the camera file, a text as JSON or YAML?"
        ) from error
    values = _parsed(path, text)
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise RecordingError(f"{path}: no keys and values; expected a camera file: {EXAMPLE}.")
    try:
        return from_mapping(CameraFile, values)
    except (ConfigError, TypeError) as error:
        raise RecordingError(f"{path}: {error} A camera file is, for example: {EXAMPLE}.") from error


def _parsed(path: Path, text: str) -> Any:
    try:
        if path.suffix == ".json":
            return json.loads(text)
        # References could make a small file a huge one.
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, _Loader)):
            raise RecordingError(f"{path}: a reference (*name); expected plain values. Write them out.")
        return yaml.load(text, _Loader)  # a SafeLoader
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(
            f"{path}: no readable {'JSON' if path.suffix == '.json' else 'YAML'} ({' '.join(str(error).split())}). Correct it."
        ) from error
