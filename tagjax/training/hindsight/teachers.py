"""What a piece learns from, frame by frame: the smoother's masks, or, for comparison, true ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from ...core.errors import RecordingError
from ...metrics.locking import first_motion
from ...recording import Recording, Truth
from ...tagattention.segments import TagAttention
from ...tracing.recordings import TraceSettings, trace_recording

Teacher = Literal["smoother", "labels"]

Taught = tuple[Bool[np.ndarray, "tag height width"], Float[np.ndarray, " tag"]]
"""Masks at the working resolution, and how sure the teacher is that the tag's object is seen."""


def smoother_masks(
    tracer: TagAttention, recording: Recording, load: Callable[..., Any], epcs: Sequence[str]
) -> Iterator[Taught]:
    """What the tracer says of each frame when it knows the whole recording."""
    settings = TraceSettings(tags_at_once=len(epcs), smooth=True)
    for _, trace in trace_recording(tracer, recording, load, epcs=epcs, settings=settings):
        yield np.asarray(trace.mask) > 0.5, np.asarray(trace.confidence)


def true_masks(recording: Recording, shape: tuple[int, int], epcs: Sequence[str]) -> Iterator[Taught]:
    """The true masks at `shape`, sure (1) from the first motion on where the object is visible, and of nothing before (0.5).

    0 where the object is not visible, and for a tag that never moves: no tracer of motion can, or should, detect that.
    Raises `RecordingError` where the recording has no labels of a tag.
    """
    truth = recording.truth or Truth()
    labels = truth.labels
    missing = [epc for epc in epcs if epc not in truth.tag_to_label]
    if labels is None or missing:
        raise RecordingError(
            f"{recording.name}: found no true mask of {', '.join(missing) or 'any tag'}; expected labels of every tag with "
            "hindsight.teacher=labels. hindsight.teacher=smoother needs none."
        )
    stride = -(-recording.intrinsics.width // shape[1])
    motion = [first_motion(truth, epc, recording.frame_time_s()) for epc in epcs]
    own = [truth.tag_to_label[epc] for epc in epcs]
    for frame in range(recording.num_frames):
        shown = np.asarray(labels[frame])[::stride, ::stride]
        masks = np.stack([shown == label for label in own])
        seen = np.any(masks, axis=(1, 2))
        sure = [
            0.0 if begin is None or not there else 0.5 if frame < begin else 1.0
            for begin, there in zip(motion, seen, strict=True)
        ]
        yield masks, np.array(sure, np.float32)
