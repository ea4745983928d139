"""Where recordings come from: stores, simulated suites, and virtual tags put on recordings with known tracks."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ..config import ClipSettings, ConfigError, DataSettings, VirtualTagSettings, from_mapping
from ..data.clips import Clip, load_clip
from ..data.picture_files import read_labels
from ..data.store import open_recording
from ..recording import Recording, RecordingError, TagReads, Truth


def clip_loader(settings: ClipSettings, *, colour: bool = False) -> Callable[..., Clip]:
    """`load(recording, start, stop, epcs=...)` with the settings filled in; `colour` as of `load_clip`."""

    def load(recording: Recording, start: int, stop: int, *, epcs: Sequence[str] | None = None) -> Clip:
        return load_clip(
            recording,
            start,
            stop,
            epcs=settings.epcs if epcs is None else epcs,
            colour=colour,
            **settings.arguments(),
        )

    return load


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


def opened(paths: Sequence[str], virtual_tag: VirtualTagSettings) -> list[Recording]:
    """The recordings at these paths, with virtual tags where tracks are given. Raises as `open_recording` does."""
    return [with_virtual_tags(open_recording(path), virtual_tag) for path in paths]


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


def with_virtual_tags(recording: Recording, settings: VirtualTagSettings) -> Recording:
    """The recording with a virtual tag on each tracked label, for each seed, read as if it were alone.

    Unchanged if no tracks are given. Raises `ConfigError` for settings that a reader does not have.
    """
    if settings.tracks is None:
        return recording
    from ..sim.reader import ReaderSettings
    from ..sim.virtual_tag import attach_virtual_tags, load_tracks_csv

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


def join_reads(parts: Sequence[TagReads]) -> TagReads:
    """The reads of several tables in order of time. Raises `RecordingError` where their phase conventions differ."""
    first = parts[0]
    for part in parts[1:]:
        if (part.phase_period_rad, part.phase_sign) != (first.phase_period_rad, first.phase_sign):
            raise RecordingError("Reads of differing phase period or sign cannot be put into one table; convert first.")
    columns = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in dataclasses.fields(first)
        if all(isinstance(getattr(part, field.name), np.ndarray) for part in parts)
    }
    return dataclasses.replace(first, **columns)[np.argsort(columns["time_ns"], kind="stable")]


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
