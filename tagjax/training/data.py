"""What a training run draws its samples from, and what it is validated on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import grain
import jax
import numpy as np
from rich.console import Console

from ..core.errors import RecordingError
from ..core.folder_lock import locked_folder
from ..core.progress import progress_lines
from ..core.results import to_json_values
from ..core.settings import ConfigError
from ..core.stream import Stream
from ..recording import Recording
from ..tagattention.segments import TagAttention
from ..tagattention.tracer_settings import make_tracer
from ..tracing.clips import clip_loader
from .clip_dataset import clip_dataset
from .config import TrainConfig
from .hindsight import HindsightSettings, PieceFiles, PieceWindows
from .step import ClipLike

VALIDATION_CLIPS = 2


@dataclasses.dataclass(frozen=True)
class TrainingData:
    """Samples for training, without end, and samples of the validation recordings."""

    samples: Stream
    batch_size: int  # samples in a step
    held_out: Sequence[ClipLike] | PieceFiles | PieceWindows
    score: str  # the diagnostic of `held_out` that says how good unlabelled results are
    remove: Callable[[], None] = lambda: None  # deletes what is of no use after the run


def training_data(
    config: TrainConfig, folder: Path, training: Sequence[Recording], validation: Sequence[Recording], console: Console
) -> TrainingData:
    """The samples of a run in `folder`, for what it learns."""
    if isinstance(config.learned, HindsightSettings):
        return _pieces(config, config.learned, folder, training, validation, console)
    clips = config.data.clips
    samples = clip_dataset(
        training,
        clip_length=clips.length,
        seed=config.seed,
        epcs=clips.epcs,
        min_motion=clips.min_motion,
        max_tags=clips.max_tags,
        workers=clips.workers,
        shard=(jax.process_index(), jax.process_count()),
        colour=config.joint is not None,
        **clips.arguments(),
    )
    # Every process has all validation clips, so that none waits for another.
    return TrainingData(samples, config.loop.batch_size or 1, _validation_clips(config, validation), "own_coherence")


def _validation_clips(config: TrainConfig, recordings: Sequence[Recording]) -> list[ClipLike]:
    """`VALIDATION_CLIPS` evenly spaced clips of each recording, of the training clips' length (or shorter, if the recording is)."""
    settings = config.data.clips
    load = clip_loader(settings, colour=config.joint is not None)
    clips: list[Any] = []
    for recording in recordings:
        length = min(settings.length, recording.num_frames)
        starts = np.linspace(0, recording.num_frames - length, VALIDATION_CLIPS).astype(int)
        clips += [load(recording, int(start), int(start) + length) for start in sorted(set(starts.tolist()))]
    return clips


def _pieces(
    config: TrainConfig,
    settings: HindsightSettings,
    folder: Path,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    console: Console,
) -> TrainingData:
    """The pieces of all recordings, written to `settings.pieces`, or `folder`/pieces, where they are not there yet."""
    tracer = make_tracer(config.tracer, config.weights)
    if not isinstance(tracer, TagAttention):
        raise ConfigError(
            f"hindsight: {type(tracer).__name__} has no smoother to learn from; expected tracer=tagattention, or "
            "objective=coherent."
        )
    if jax.process_count() > 1:
        raise ConfigError(
            f"hindsight: found {jax.process_count()} processes; expected one, with any number of devices. For several, "
            "objective=coherent."
        )
    root, found = Path(settings.pieces or folder / "pieces"), {}
    with locked_folder(root), progress_lines(shown=config.loop.progress, console=console) as report:
        for kind, recordings in (("training", training), ("validation", validation)):
            found[kind] = PieceFiles(root / kind).made(
                recordings,
                tracer,
                clip_loader(config.data.clips),
                epcs=config.data.clips.epcs,
                num_frames=settings.piece_frames,
                teacher=settings.teacher,
                controls=settings.needs_controls,
                settings=_seen_with(config, settings),
                on_progress=report,
            )
    files, sure = found["training"], found["training"].num_sure(settings)
    if not sure:
        raise RecordingError(
            f"hindsight: found no mask with a confidence above {settings.sure} in any of {len(training)} recordings (teacher: "
            f"{settings.teacher}), so there is nothing to learn. Give recordings in which tags move and are read."
        )
    console.print(f"{sure} masks to learn from, in {len(files)} pieces of recordings (teacher: {settings.teacher}).")
    remove = (lambda: None) if settings.pieces else PieceFiles(root).remove
    score = "nats" if settings.learn == "reads" else "overlap"
    if config.joint is None:
        batch_size = config.loop.batch_size or len(files)
        return TrainingData(_stream(files, batch_size, config), batch_size, found["validation"], score, remove)
    length, both = config.data.clips.length, ((files, training), (found["validation"], validation))
    windows, held_out = (PieceWindows.of(*one, length=length, sure=settings.sure) for one in both)
    if not windows:
        raise RecordingError(
            f"hindsight: found no {length} frames in a row with a mask of a confidence above {settings.sure} in half of them, so there is "
            "nothing to learn from. Give longer recordings, or a smaller data.clips.length."
        )
    console.print(f"{len(windows)} windows of {length} frames for the flow network.")
    batch_size = config.loop.batch_size or 1
    return TrainingData(_stream(windows, batch_size, config), batch_size, held_out, score, remove)


def _seen_with(config: TrainConfig, settings: HindsightSettings) -> dict[str, Any]:
    """The settings on which the segments of pieces depend. Pieces that are kept may come from another tracer."""
    seen = {
        "clips": config.data.clips.arguments(),
        "control": config.data.control,
        "virtual_tag": dataclasses.asdict(config.data.virtual_tag),
    }
    own = {} if settings.pieces else {"tracer": config.tracer, "weights": config.weights}
    return to_json_values({**seen, **own})


def _stream(samples: Sequence[ClipLike] | PieceFiles | PieceWindows, batch_size: int, config: TrainConfig) -> Stream:
    """The samples again and again, shuffled where a step does not take all of them."""
    dataset = grain.MapDataset.source(samples)
    if batch_size < len(samples):
        dataset = dataset.shuffle(seed=config.seed)
    return Stream(dataset.repeat())
