"""Recordings by their paths, with virtual tags on known tracks where the settings ask for them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import RecordingError
from ..core.settings import ConfigError, from_mapping
from ..radio.reader import ReaderSettings
from .picture_files import read_labels
from .reads import join_reads
from .recording import Recording, Truth
from .store import open_recording
from .virtual_tags import attach_virtual_tags, load_tracks_csv


@dataclasses.dataclass(frozen=True)
class VirtualTagSettings:
    """Virtual tags for recordings with known tracks: one tag on each label, each simulated alone at the full read rate."""

    tracks: str | None = None  # CSV: frame,person,x_m,y_m,z_m,range_m,visible
    labels: str | None = None  # folder of label masks NNNNNNNN.png
    seeds: tuple[int, ...] = (0,)
    reader: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # fields of the reader's settings

    def __post_init__(self) -> None:
        if not self.seeds:
            raise ConfigError("seeds is empty; expected at least one: a reader and its noise are drawn for each.")
        if self.tracks is None and (self.labels, self.seeds, dict(self.reader)) != (None, (0,), {}):
            raise ConfigError(
                "tracks is null, so there is no virtual tag; give tracks (a CSV file), or leave out labels, seeds and reader."
            )


def opened(paths: Sequence[str], virtual_tag: VirtualTagSettings) -> list[Recording]:
    """The recordings at these paths, with virtual tags where tracks are given. Raises as `open_recording` does."""
    return [with_virtual_tags(open_recording(path), virtual_tag) for path in paths]


def with_virtual_tags(recording: Recording, settings: VirtualTagSettings) -> Recording:
    """The recording with a virtual tag on each tracked label, for each seed, read as if it were alone.

    Unchanged if no tracks are given. Raises `ConfigError` for settings that a reader does not have.
    """
    if settings.tracks is None:
        return recording
    if settings.labels is not None:
        recording = dataclasses.replace(recording, truth=_labelled(recording, Path(settings.labels)))
    tracks = load_tracks_csv(settings.tracks, recording.frame_time_s())
    reader = from_mapping(ReaderSettings, settings.reader, where="virtual_tag.reader")
    tagged = [
        attach_virtual_tags(
            recording, {label: track}, reader, seed=seed, epc_of=lambda one, s=seed: f"label{one}-seed{s}"
        )
        for seed in settings.seeds
        for label, track in tracks.items()
    ]
    return dataclasses.replace(
        recording,
        reads=join_reads([one.reads for one in tagged]),
        truth=_joined_truth([one.truth for one in tagged if one.truth is not None]),
    )


def _joined_truth(parts: Sequence[Truth]) -> Truth:
    joined: dict[str, Any] = {}
    for name in ("tag_to_label", "tag_range_m", "tag_position_m", "visible"):
        joined[name] = {key: value for part in parts for key, value in getattr(part, name).items()}
    return dataclasses.replace(parts[0], **joined)


def _labelled(recording: Recording, folder: Path) -> Truth:
    """The recording's truth with label masks read from a folder of PNG files, one a frame in order of name."""
    files = sorted(folder.glob("*.png"))
    if len(files) != recording.num_frames:
        raise RecordingError(
            f"{folder}: {len(files)} PNG files; expected {recording.num_frames}, one a frame of {recording.name}."
        )
    masks = [read_labels(file) for file in files]
    for file, mask in zip(files, masks, strict=True):
        if mask.shape != recording.image_shape:
            raise RecordingError(f"{file}: a picture of {mask.shape}; expected {recording.image_shape} as the frames.")
    return dataclasses.replace(recording.truth or Truth(), labels=np.stack(masks))  # type: ignore[arg-type]
