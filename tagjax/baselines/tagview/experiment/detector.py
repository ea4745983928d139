"""Training of Tagview's detector on the train split of suites, and its accuracy on the validation split."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ....core.progress import OnProgress, unobserved
from ....core.results import write_json
from ....recording.store import open_recording
from ....recording.suite_folder import find_recordings
from ..detection import BoxDetector
from ..training import TrainSettings, labelled_frames, measure_detector, train_detector
from ..weights import save_weights

if TYPE_CHECKING:
    from .run import TagviewExperiment


@dataclasses.dataclass(frozen=True)
class DetectorTraining:
    """Settings of the training, and of its evaluation."""

    settings: TrainSettings = dataclasses.field(default_factory=TrainSettings)
    weights: str = "detector.npz"  # output file, within the run folder unless absolute
    validation_stride: int = 4  # every how many validation frames are used


def train_tagview(config: TagviewExperiment, folder: Path, *, on_progress: OnProgress = unobserved) -> dict[str, Any]:
    """Train the detector on the suites' train split, measure it on the validation split, write its weights.

    Raises `ValueError` for suites without train recordings; suites without validation recordings are not measured.
    """
    training, settings = config.training, config.training.settings
    train, validation = [], []
    used: dict[str, int] = {}
    for suite in config.suites:
        paths = [path for _, path in dataclasses.replace(config, suites=(suite,)).find("train")]
        used[suite] = len(paths)
        for path in paths:
            recording = open_recording(path)
            train += labelled_frames(recording, stride=settings.frame_stride, min_side_px=settings.min_side_px)
        for one in find_recordings(Path(config.recordings_dir) / suite, "validation"):
            recording = open_recording(one.path)
            validation += labelled_frames(
                recording, stride=training.validation_stride, min_side_px=settings.min_side_px
            )
    network, record = train_detector(train, settings, on_progress=on_progress)
    chosen = dataclasses.replace(config.system.detector, kind="ssd")
    scores = measure_detector(BoxDetector(network, chosen), validation) if validation else {}
    about = {
        "network": {"widths": list(settings.widths), "depth": settings.depth},
        "training": record,
        "data": {"train recordings": used, "validation frames": len(validation)},
        "validation": {name: value for name, value in scores.items() if np.isfinite(value)},
    }
    save_weights(folder / training.weights, network, about)
    write_json(folder / "training.json", about)
    return about
