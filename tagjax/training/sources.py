"""Where training and validation recordings come from: stores with optional virtual tags, or a simulated suite."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from ..core.settings import ConfigError, from_mapping
from ..recording import Recording, RecordingError
from ..recording.opening import VirtualTagSettings, opened
from ..recording.store import open_recording
from ..tracing.clips import ClipSettings


@dataclasses.dataclass(frozen=True)
class DataSettings:
    """Training and validation recordings: those named, or the train and validation split of a simulated suite."""

    recordings: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    clips: ClipSettings = dataclasses.field(default_factory=ClipSettings)
    suite: Mapping[str, Any] | None = None  # settings of a suite (tagjax.sim.suites.Suite), used without `recordings`
    suites_folder: str = "recordings/benchmark"  # where suites lie; missing recordings are simulated into it
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)


def training_recordings(data: DataSettings) -> tuple[list[Recording], list[Recording]]:
    """Training and validation recordings: those named, or those of `data.suite` where none is named.

    Raises `RecordingError` for recordings that cannot be used, or that are in both, and `ConfigError` for settings that
    mean nothing without recordings.
    """
    if not data.recordings:
        if data.validation:
            raise ConfigError(
                f"data.validation names {', '.join(data.validation)}, but data.recordings is empty: the simulated suite "
                "would be used for both. Name recordings to train on, or neither."
            )
        if data.virtual_tag != VirtualTagSettings():
            raise ConfigError(
                "data.virtual_tag is given, but data.recordings is empty; simulated recordings have tags of their own. "
                "Name the recordings that the virtual tags are put on."
            )
        if data.suite is None:
            raise ConfigError(
                "data.recordings is empty and data.suite is null; expected recordings to train on. Name them with "
                "data.recordings=[...], or choose data=simulated."
            )
        return suite_recordings(data.suite, Path(data.suites_folder))
    held_out = {_place(path) for path in data.validation}
    twice = [path for path in data.recordings if _place(path) in held_out]
    if twice:
        raise RecordingError(f"{', '.join(sorted(twice))}: named both for training and for validation; hold it out.")
    return opened(data.recordings, data.virtual_tag), opened(data.validation, data.virtual_tag)


def _place(path: str) -> str:
    """One name for a folder, however its path is written; addresses as they are."""
    return path if "://" in path else str(Path(path).resolve())


def suite_recordings(settings: Mapping[str, Any], folder: Path) -> tuple[list[Recording], list[Recording]]:
    """The train and validation split of a suite in `folder`. Missing recordings are simulated (sim extra) and kept.

    Several processes may ask for the same suite at once: one simulates, the others wait. Raises `ConfigError` for a
    suite without pictures or without training recordings.
    """
    from ..sim.suites import PLANAR, Suite, make_items

    suite = from_mapping(Suite, settings, where="data.suite")
    if suite.story == PLANAR or suite.counts.train < 1:
        raise ConfigError(
            f"data.suite is {suite.name}, which has no recordings to train on; expected a suite with pictures and "
            "counts.train of at least 1."
        )
    with Console().status(f"recordings of {suite.name} in {folder}: missing ones are simulated"):
        items = make_items(suite, folder, splits=("train", "validation"), workers=os.cpu_count() or 1)
    recordings = [(item.split, open_recording(item.path(folder))) for item in items]
    training, validation = (
        [recording for one, recording in recordings if one == split] for split in ("train", "validation")
    )
    return training, validation
