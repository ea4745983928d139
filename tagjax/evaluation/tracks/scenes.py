"""Settings of the experiment on real tracks, and the tracks of its data sets on one clock."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...recording import RecordingError
from ...recording.importers.tagged_walks import read_kinect, read_xovis

NUM_WINDOW = 5
"""TagAttention's number of frames k in a motion vector."""


@dataclasses.dataclass(frozen=True)
class TracksConfig:
    """Settings of the experiment on real tracks."""

    folder: str  # contains kinect-rfid/ or xovis-uwb/, or both
    windows_s: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
    frame_rate_hz: float = 15.0  # to which tracks are resampled
    noise_m: float = 0.02  # standard deviation of the noise added to a track, per frame and axis
    min_move_m: float = 0.16  # half a wavelength: windows in which the tag's distance changes by less are left out
    max_windows: int = 40  # of each length and scene
    xovis_unit_m: float = 0.02
    region: str = "fcc"
    flip_probability: float = 0.08
    seed: int = 0

    def __post_init__(self):
        if not self.windows_s or min(self.windows_s) * self.frame_rate_hz < NUM_WINDOW:
            raise ValueError(
                f"windows_s is {self.windows_s} at {self.frame_rate_hz} frames/s; expected windows of at least {NUM_WINDOW} frames."
            )
        if self.noise_m < 0 or self.max_windows < 1 or not self.xovis_unit_m > 0:
            raise ValueError(
                f"found noise_m {self.noise_m}, max_windows {self.max_windows}, xovis_unit_m {self.xovis_unit_m}; expected at "
                "least 0, at least 1, and above 0."
            )


@dataclasses.dataclass(frozen=True)
class Scene:
    """People's tracks on one common clock, as if they were recorded at the same time; NaN where a track has no position."""

    name: str
    time_s: Float[np.ndarray, " time"]
    position_m: Float[np.ndarray, "people time 2"]  # on the floor


def _scene(name: str, tracks: Sequence[tuple[np.ndarray, np.ndarray]], rate_hz: float) -> Scene:
    """Each track from its first sample on, resampled to a constant rate."""
    longest = max(times[-1] - times[0] for times, _ in tracks)
    clock = np.arange(0.0, longest + 1e-9, 1.0 / rate_hz)
    out = np.full((len(tracks), len(clock), 2), np.nan)
    for row, (times, place) in enumerate(tracks):
        own_s, first = np.unique(times - times[0], return_index=True)
        inside = clock <= own_s[-1]
        for axis in range(2):
            out[row, inside, axis] = np.interp(clock[inside], own_s, place[first, axis])
    return Scene(name, clock, out)


def load_kinect(folder: Path, rate_hz: float) -> Scene:
    """All skeleton tracks of a folder (id, time, x cm, z cm), recorded one or two at a time, on a common clock.

    Raises `RecordingError` for files of another format and for fewer than two tracks.
    """
    tracks = []
    for path in sorted(folder.glob("[0-9]*.txt")):
        each = [np.array(own) for own in read_kinect(path).values() if len(own) > 1]
        tracks += [(own[:, 0], own[:, 1:]) for own in each]
    if len(tracks) < 2:
        raise RecordingError(f"{folder}: found {len(tracks)} tracks; expected two or more.")
    return _scene("kinect-rfid", tracks, rate_hz)


def load_xovis(path: Path, rate_hz: float, unit_m: float) -> Scene:
    """All tracks of a table ;time;id;x;y;... (ms; x and y in units of `unit_m`), on a common clock.

    Raises `RecordingError` for missing columns and for fewer than two tracks.
    """
    each = [np.array(own) for own in read_xovis(path, unit_m).values() if len(own) > 1]
    tracks = [(own[:, 0], own[:, 1:]) for own in each]
    if len(tracks) < 2:
        raise RecordingError(f"{path}: found {len(tracks)} tracks; expected two or more.")
    return _scene("xovis-uwb", tracks, rate_hz)


def load_scenes(config: TracksConfig) -> list[Scene]:
    """The scenes in the folder. Raises `RecordingError` where there is none."""
    folder, scenes = Path(config.folder), []
    if (folder / "kinect-rfid").is_dir():
        scenes.append(load_kinect(folder / "kinect-rfid", config.frame_rate_hz))
    table = folder / "xovis-uwb" / "raw_xovis.csv"
    if table.is_file():
        scenes.append(load_xovis(table, config.frame_rate_hz, config.xovis_unit_m))
    if not scenes:
        raise RecordingError(
            f"{folder}: found neither kinect-rfid/ nor xovis-uwb/raw_xovis.csv; expected at least one of them."
        )
    return scenes


def antenna_place(scene: Scene) -> Float[np.ndarray, " 3"]:
    """The position of the antenna: one metre outside the area of the tracks, off its middle, at the height of the tags."""
    low, high = np.nanmin(scene.position_m, axis=(0, 1)), np.nanmax(scene.position_m, axis=(0, 1))
    return np.array([low[0] - 1.0, 0.7 * low[1] + 0.3 * high[1], 0.0])
