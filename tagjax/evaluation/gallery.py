"""A gallery of suites: of each one frame with the tracer's masks, boxes and names, chosen by its time alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ..core.progress import OnProgress, unobserved
from ..core.settings import ConfigError
from ..recording.image_files import write_image
from ..recording.suite_folder import SPLITS
from .picture import frame_overlay
from .traced import Traced, TracedConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class GalleryConfig:
    """Which suites are shown, and how. The picture of a suite is of the first recording, by name, of the split.

    `suites` are names of folders in `recordings_dir`; all that have recordings of the split if None.
    """

    tracer: Mapping[str, Any]
    out: str  # folder of the pictures, <suite>.jpg
    suites: tuple[str, ...] | None = None
    recordings_dir: str = "recordings"
    split: str = "validation"
    at_s: float = 3.0  # time of the shown frame from the first one, s; a shorter recording shows its last frame
    width: int = 480  # pixels
    quality: int = 80  # of JPEG, 1 to 100
    weights: str | None = None

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise ConfigError(f"split is {self.split!r}; expected one of {', '.join(SPLITS)}.")
        if not 0.0 <= self.at_s < np.inf:
            raise ConfigError(f"at_s is {self.at_s}; expected a time of at least 0 s.")
        if self.width < 480:
            raise ConfigError(f"width is {self.width}; expected at least 480 pixels, for names that can be read.")
        if not 1 <= self.quality <= 100:
            raise ConfigError(f"quality is {self.quality}; expected a value from 1 to 100.")

    def recordings(self) -> dict[str, Path]:
        """The recording that is shown of each suite. Raises `ConfigError` where one has none."""
        folder = Path(self.recordings_dir)
        if self.suites is None:
            names = sorted(one.name for one in folder.iterdir() if one.is_dir()) if folder.is_dir() else []
        else:
            names = list(self.suites)
        stored = {name: sorted((folder / name / self.split).glob("*.zarr")) for name in names}
        missing = [name for name, paths in stored.items() if not paths]
        if self.suites is not None and missing:
            raise ConfigError(
                f"Found no {self.split} recording of {', '.join(missing)} in {folder}; simulate them first: "
                f"python -m experiments.simulate suite={missing[0]}"
            )
        found = {name: paths[0] for name, paths in stored.items() if paths}
        if not found:
            raise ConfigError(
                f"Found no {self.split} recording in {folder}; expected {folder}/<suite>/{self.split}/*.zarr. "
                "Simulate some first: python -m experiments.simulate suite=multi_4"
            )
        return found


def make_gallery(config: GalleryConfig, *, on_progress: OnProgress = unobserved) -> list[Path]:
    """Trace each suite's recording up to the shown frame and write `<out>/<suite>.jpg`; the paths of the pictures."""
    out = Path(config.out)
    recordings = config.recordings()
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for number, (suite, path) in enumerate(recordings.items()):
        on_progress("suite", number, len(recordings), suite)
        written.append(out / f"{suite}.jpg")
        write_image(written[-1], still(config, path, suite), jpeg_quality=config.quality)
    on_progress("suite", len(recordings), len(recordings))
    return written


def still(config: GalleryConfig, path: Path, caption: str) -> UInt8[np.ndarray, "rows columns 3"]:
    """The overlay of the first frame at or after `at_s`, `width` pixels wide, captioned with its time."""
    traced = Traced.open(TracedConfig(recording=str(path), tracer=config.tracer, weights=config.weights))
    times_s = np.asarray(traced.recording.frame_time_s(), np.float64)
    shown = min(int(np.searchsorted(times_s - times_s[0], config.at_s)), len(times_s) - 1)
    traced = dataclasses.replace(traced, frames=(0, shown + 1))
    *_, (number, trace) = traced.traces()
    time_s = times_s[number] - times_s[0]
    return frame_overlay(traced, number, trace, config.width, caption=f"{caption}, {time_s:.1f} s")
