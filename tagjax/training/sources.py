"""Where recordings come from: stores, the simulator, and virtual tags put on recordings with known tracks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ..core.settings import ConfigError
from ..recording import Recording, RecordingError
from ..recording.loading import VirtualTagSettings, open_recordings
from ..recording.store import open_recording, save_recording
from ..tracing.clips import ClipSettings


def training_recordings(data: DataSettings) -> tuple[list[Recording], list[Recording]]:
    """Recordings to train on and held-out ones: those named, or simulated ones where none is named.

    Raises `RecordingError` for recordings that cannot be used, or that are in both, and `ConfigError` for settings that
    mean nothing without recordings.
    """
    if not data.recordings:
        if data.validation:
            raise ConfigError(
                f"data.validation names {', '.join(data.validation)}, but data.recordings is empty: simulated recordings "
                "would be trained and validated on. Name recordings to train on, or neither."
            )
        if data.virtual_tag != VirtualTagSettings():
            raise ConfigError(
                "data.virtual_tag is given, but data.recordings is empty; simulated recordings have tags of their own. "
                "Name the recordings that the virtual tags are put on."
            )
        return simulated_recordings(data.simulate)
    held_out = {_place(path) for path in data.validation}
    twice = [path for path in data.recordings if _place(path) in held_out]
    if twice:
        raise RecordingError(f"{', '.join(sorted(twice))}: named both for training and for validation; hold it out.")
    return open_recordings(data.recordings, data.virtual_tag), open_recordings(data.validation, data.virtual_tag)


def _place(path: str) -> str:
    """One name for a folder, however its path is written; addresses as they are."""
    return path if "://" in path else str(Path(path).resolve())


def simulated_recordings(settings: SimulateSettings) -> tuple[list[Recording], list[Recording]]:
    """Simulated recordings, made once and kept: the second call only opens them. Needs the sim extra."""
    training = [_simulated(settings, settings.seed + number) for number in range(settings.num_recordings)]
    return training, [_simulated(settings, settings.validation_seed)]


def _simulated(settings: SimulateSettings, seed: int) -> Recording:
    scene = dataclasses.asdict(settings)
    for name in ("num_recordings", "seed", "validation_seed", "folder"):
        del scene[name]
    size = (
        f"{settings.width}x{settings.height}-{settings.num_frames}f-{settings.frame_rate_hz:g}hz-{settings.num_people}p"
    )
    path = Path(settings.folder) / f"simulated-{size}-seed{seed}.zarr"
    if not path.exists():
        from ..sim.session import SceneSettings, simulate_recording

        made = simulate_recording(SceneSettings(**scene), seed=seed, progress=True)
        try:
            save_recording(made, path)
        except RecordingError:
            # The jobs of a sweep start at once and make the same recording; the first to finish is as good.
            if not path.is_dir():
                raise
    return open_recording(path)


@dataclasses.dataclass(frozen=True)
class SimulateSettings:
    """The simulated recordings used where none are named; made once and kept under `folder`."""

    num_recordings: int = 3
    num_frames: int = 90
    width: int = 320
    height: int = 240
    frame_rate_hz: float = 10.0
    num_people: int = 3
    seed: int = 0
    validation_seed: int = 1000
    folder: str = "recordings"


@dataclasses.dataclass(frozen=True)
class DataSettings:
    """What is trained on and what is held out. Without recordings, simulated ones are made."""

    recordings: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    clips: ClipSettings = dataclasses.field(default_factory=ClipSettings)
    simulate: SimulateSettings = dataclasses.field(default_factory=SimulateSettings)
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)
