"""Training and validation recordings, with optional virtual tags."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ..core.settings import ConfigError
from ..recording import Recording, RecordingError
from ..recording.controls import Control
from ..recording.loading import VirtualTagSettings, open_recordings
from ..tracing.clips import ClipSettings


@dataclasses.dataclass(frozen=True)
class DataSettings:
    """Recordings for training and validation, and the settings of their clips."""

    recordings: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    clips: ClipSettings = dataclasses.field(default_factory=ClipSettings)
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)
    control: Control | None = None  # training on reads that do not belong to what is seen, which must teach nothing


def training_recordings(data: DataSettings) -> tuple[list[Recording], list[Recording]]:
    """Training and validation recordings, with virtual tags where tracks are given.

    Raises `RecordingError` for recordings that cannot be used or are in both lists, and `ConfigError` if there is none.
    """
    if not data.recordings:
        if data.validation:
            raise ConfigError(
                f"data.validation is {', '.join(data.validation)}, but data.recordings is empty; expected both, or "
                "neither and suite=<name>."
            )
        if data.virtual_tag != VirtualTagSettings():
            raise ConfigError(
                "data.virtual_tag is given, but data.recordings is empty; expected the recordings for the virtual tags."
            )
        raise ConfigError(
            "data.recordings is empty; expected recordings: data.recordings=[a.zarr,...] or suite=<name>."
        )
    validation = {_resolved(path) for path in data.validation}
    twice = [path for path in data.recordings if _resolved(path) in validation]
    if twice:
        raise RecordingError(
            f"{', '.join(sorted(twice))}: found in both data.recordings and data.validation; expected it in one of them."
        )
    training = open_recordings(data.recordings, data.virtual_tag, data.control)
    return training, open_recordings(data.validation, data.virtual_tag)


def _resolved(path: str) -> str:
    """The absolute path of a folder; URLs are left as they are."""
    return path if "://" in path else str(Path(path).resolve())
