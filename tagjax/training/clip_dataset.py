"""Training clips: which sections of the recordings are sampled, with which tags, and in which order."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from typing import Any

import grain
import jax
import jax.numpy as jnp
import numpy as np

from ..core.errors import RecordingError, RecordingWarning
from ..core.stream import Stream
from ..recording import Recording
from ..tracing.clips import (
    Antennas,
    Clip,
    Estimator,
    check_clip,
    choose_antennas,
    load_clip,
    selected_tags,
    true_range_m,
)
from ..tracing.motion_evidence import coherence_loss

_PIECE_S = 0.5
"""Length of the pieces in which a clip's reads are tested for motion."""


def measured_motion(
    recording: Recording, starts: Sequence[int], length: int, epcs: Sequence[str], antennas: Sequence[int]
) -> np.ndarray:
    """How much each tag moves in each clip, from its reads alone: (clips, tags); the largest value over the antennas.

    The mean over the clip's pieces of half a second of the coherence, modulo pi, that the reads lose if the tag is assumed
    stationary (`tagjax.tracing.motion_evidence`): about 0.02 from noise for a stationary tag, 0.2 to 0.6 for a waving hand.
    """
    time_s = recording.frame_time_s()
    edges = np.arange(time_s[0], time_s[-1] + _PIECE_S, _PIECE_S)
    motion = np.zeros((len(starts), len(epcs)))
    for (tag, epc), antenna in itertools.product(enumerate(epcs), antennas):
        reads = recording.reads.select(epc)
        lost = coherence_loss(reads[reads.antenna == antenna], edges, int(recording.time_ns[0]))
        for number, start in enumerate(starts):
            first, last = np.searchsorted(edges, time_s[[start, start + length - 1]], side="right") - 1
            motion[number, tag] = max(motion[number, tag], lost[first : last + 1].mean())
    return motion


def _choose_tags(motion: np.ndarray, max_tags: int | None, seed: tuple[int, ...]) -> list[int]:
    """Numbers of the tag with the most motion and of random others, `max_tags` in all."""
    moving = int(motion.argmax())
    others = np.random.default_rng(seed).permutation(np.delete(np.arange(len(motion)), moving))
    return sorted([moving, *others.tolist()][:max_tags])


class _ClipSource:
    """Every clip of `length` frames that starts on a multiple of `step`, as Grain's random access source.

    Only clips in which the reads of some tag show motion of `min_motion` or more (`measured_motion`) are included, each
    with `max_tags` of its tags. Warns (`RecordingWarning`) of recordings that are shorter. Raises `RecordingError` for
    recordings of which no clip can be loaded, before the first clip is sampled.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        length: int,
        step: int,
        on_host: bool,
        epcs: Sequence[str] | None = None,
        min_motion: float = 0.0,
        max_tags: int | None = None,
        **settings: Any,
    ):
        self._recordings, self._length, self._settings = list(recordings), length, settings
        self._on_host = on_host  # NumPy arrays, which can be passed between processes
        self._places: list[tuple[int, int, tuple[str, ...], tuple[int, ...]]] = []
        if all(recording.num_frames < length for recording in recordings):
            longest = max((recording.num_frames for recording in recordings), default=0)
            raise RecordingError(
                f"No clip of {length} frames in {len(self._recordings)} recordings (the longest has {longest} frames). "
                "Ask for shorter clips or give longer recordings."
            )
        max_measured = 0.0
        for number, recording in enumerate(recordings):
            if recording.num_frames < length:
                warnings.warn(
                    f"{recording.name} has {recording.num_frames} frames, fewer than a clip's {length}: it gives no clip. "
                    "Ask for shorter clips to use it.",
                    RecordingWarning,
                    stacklevel=3,
                )
                continue
            selected = selected_tags(recording, epcs)
            chosen = choose_antennas(recording, selected, settings["antennas"])
            if settings["estimator"] == "truth":
                for epc, antenna in itertools.product(selected, chosen):
                    true_range_m(recording, epc, antenna)
            starts = range(0, recording.num_frames - length + 1, step)
            motion = measured_motion(recording, starts, length, selected, chosen)
            for start, tag_motion in zip(starts, motion, strict=True):
                if tag_motion.max() >= min_motion:
                    tags = _choose_tags(tag_motion, max_tags, (number, start))
                    self._places.append((number, start, tuple(selected[tag] for tag in tags), chosen))
            max_measured = max(max_measured, float(motion.max()))
        if not self._places:
            raise RecordingError(
                f"No clip of {length} frames has a tag whose reads show motion of {min_motion} or more (the maximum is "
                f"{max_measured:.3f}; noise alone gives about 0.02): there is nothing to learn motion from. Give recordings "
                "in which tags move and are read, or set data.clips.min_motion lower."
            )

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index) -> Clip:
        number, start, epcs, antennas = self._places[int(index)]
        settings: dict[str, Any] = {**self._settings, "antennas": antennas}  # chosen from all tags of the recording
        clip = load_clip(self._recordings[number], start, start + self._length, epcs=epcs, **settings)
        return jax.tree.map(np.asarray, clip) if self._on_host else clip


def _on_device(clip: Clip) -> Clip:
    return jax.tree.map(jnp.asarray, clip)


def clip_dataset(
    recordings: Sequence[Recording],
    *,
    clip_length: int,
    seed: int,
    stride: int | None = None,
    epcs: Sequence[str] | None = None,
    flow: str = "dis",
    window: int = 5,
    window_s: float | None = None,
    max_reads: int = 64,
    estimator: Estimator = "robust",
    antennas: Antennas = "all",
    colour: bool = False,
    step: int | None = None,
    min_motion: float = 0.0,
    max_tags: int | None = None,
    workers: int = 0,
    shard: tuple[int, int] = (0, 1),
) -> Stream:
    """An endless, shuffled stream of clips; the same seed gives the same order.

    Its iterator's `get_state` and `set_state` resume exactly. Clips begin on multiples of `step` (half a clip if None);
    clips in which the reads of no tag show motion of `min_motion` (`measured_motion`) are left out. A clip has
    `max_tags` of its tags, all if None: the tag with the most motion and some of the others, always the same ones.
    `workers` processes load the clips and compute their radio features; 0 does this in a thread. `shard` (i, n) takes
    every n-th clip from the i-th on. Warns (`RecordingWarning`) of recordings shorter than a clip; raises
    `RecordingError` if all recordings are, and for an unknown EPC or antenna; `ValueError` for settings that no clip can
    have.
    """
    check_clip(stride=stride, window=window, max_reads=max_reads)
    for name, found, unit in (
        ("clip_length", clip_length, "frame"),
        ("step", step, "frame"),
        ("max_tags", max_tags, "tag"),
    ):
        if found is not None and found < 1:
            raise ValueError(f"{name} is {found}; expected at least 1 {unit}.")
    source = _ClipSource(
        recordings,
        clip_length,
        step or max(1, clip_length // 2),
        workers > 0,
        epcs,
        min_motion,
        max_tags,
        stride=stride,
        flow=flow,
        window=window,
        window_s=window_s,
        max_reads=max_reads,
        estimator=estimator,
        antennas=antennas,
        colour=colour,
    )
    dataset = grain.MapDataset.source(source).shuffle(seed=seed).repeat()
    return Stream(dataset, workers=workers, shard=shard, transform=_on_device if workers else None)
