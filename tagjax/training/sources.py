"""Where training and validation recordings come from: stores with optional virtual tags, or a simulated suite."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ..core.settings import ConfigError
from ..recording import Recording, RecordingError
from ..recording.loading import VirtualTagSettings, open_recordings
from ..tracing.clips import ClipSettings


@dataclasses.dataclass(frozen=True)
class DataSettings:
    """Recordings for training, held-out ones, and how they become clips."""

    recordings: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    clips: ClipSettings = dataclasses.field(default_factory=ClipSettings)
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)


def training_recordings(data: DataSettings) -> tuple[list[Recording], list[Recording]]:
    """Training and held-out recordings by their paths, with virtual tags where tracks are given.

    Raises `RecordingError` for recordings that cannot be used, or that are in both, and `ConfigError` without any.
    """
    if not data.recordings:
        if data.validation:
            raise ConfigError(
                f"data.validation names {', '.join(data.validation)}, but data.recordings is empty; expected both, or "
                "neither and suite=<name>."
            )
        if data.virtual_tag != VirtualTagSettings():
            raise ConfigError(
                "data.virtual_tag is given, but data.recordings is empty; expected the recordings for the virtual tags."
            )
        raise ConfigError(
            "data.recordings is empty; expected recordings: data.recordings=[a.zarr,...] or suite=<name>."
        )
    held_out = {_place(path) for path in data.validation}
    twice = [path for path in data.recordings if _place(path) in held_out]
    if twice:
        raise RecordingError(f"{', '.join(sorted(twice))}: named both for training and for validation; hold it out.")
    return open_recordings(data.recordings, data.virtual_tag), open_recordings(data.validation, data.virtual_tag)


def _place(path: str) -> str:
    """One name for a folder, however its path is written; addresses as they are."""
    return path if "://" in path else str(Path(path).resolve())
