"""Opening recordings by path, optionally with virtual tags on known tracks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import RecordingError
from ..core.settings import ConfigError, from_mapping
from ..radio.reader import ReaderSettings
from .controls import Control, with_control
from .image_files import read_labels
from .reads import join_reads
from .recording import Recording, Truth
from .store import open_recording
from .virtual_tags import attach_virtual_tags, load_tracks_csv


@dataclasses.dataclass(frozen=True)
class VirtualTagSettings:
    """Virtual tags for recordings with known tracks: one tag for each label and seed, each alone at the full read rate.

    Raises `ConfigError` for settings without effect.
    """

    tracks: str | None = None  # CSV: frame,person,x_m,y_m,z_m,range_m,visible
    labels: str | None = None  # folder of label masks NNNNNNNN.png
    seeds: tuple[int, ...] = (0,)
    reader: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # fields of the reader's settings

    def __post_init__(self) -> None:
        if not self.seeds:
            raise ConfigError("seeds is empty; expected at least one seed (reader and noise are drawn for each).")
        if self.tracks is None and (self.labels, self.seeds, dict(self.reader)) != (None, (0,), {}):
            raise ConfigError(
                "tracks is null, so there are no virtual tags; give tracks (a CSV file), or leave labels, seeds and reader out."
            )


def open_recordings(
    paths: Sequence[str], virtual_tag: VirtualTagSettings, control: Control | None = None
) -> list[Recording]:
    """The recordings at these paths, with virtual tags if tracks are given, or with the reads of a control.

    Errors as of `open_recording` and `with_control`.
    """
    return with_control([with_virtual_tags(open_recording(path), virtual_tag) for path in paths], control)


def with_virtual_tags(recording: Recording, settings: VirtualTagSettings) -> Recording:
    """The recording with a virtual tag on each tracked label, for each seed, read as if it were the only tag.

    Unchanged if no tracks are given. Raises `ConfigError` for invalid settings of the reader, `RecordingError` for
    files that do not fit the recording.
    """
    if settings.tracks is None:
        return recording
    if settings.labels is not None:
        recording = dataclasses.replace(recording, truth=_with_labels(recording, Path(settings.labels)))
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
        truth=_merge_truth([one.truth for one in tagged if one.truth is not None]),
    )


def _merge_truth(parts: Sequence[Truth]) -> Truth:
    merged: dict[str, Any] = {}
    for name in ("tag_to_label", "tag_range_m", "tag_position_m", "visible"):
        merged[name] = {key: value for part in parts for key, value in getattr(part, name).items()}
    return dataclasses.replace(parts[0], **merged)


def _with_labels(recording: Recording, folder: Path) -> Truth:
    """The recording's truth with label masks from a folder of PNG files, one per frame in order of name."""
    files = sorted(folder.glob("*.png"))
    if len(files) != recording.num_frames:
        raise RecordingError(
            f"{folder}: {len(files)} PNG files; expected {recording.num_frames}, one per frame of {recording.name}."
        )
    masks = [read_labels(file) for file in files]
    for file, mask in zip(files, masks, strict=True):
        if mask.shape != recording.image_shape:
            raise RecordingError(f"{file}: an image of {mask.shape}; expected {recording.image_shape} like the frames.")
    return dataclasses.replace(recording.truth or Truth(), labels=np.stack(masks))  # type: ignore[arg-type]
