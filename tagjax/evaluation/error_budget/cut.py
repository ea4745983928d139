"""The best possible cut: the threshold of a tracer's likelihood with the highest mask IoU, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...recording import Recording, RecordingError, Truth
from ...tagattention.published import TagAttentionPublished
from ...tagattention.published.tracer import PublishedState
from ...tracing.tracer import AbstractTracer, Camera, Frame, Trace


class Uncut(AbstractTracer):
    """A tracer whose mask is what it cuts: the normalised likelihood of the published tracer, the soft mask of others."""

    tracer: AbstractTracer

    def init(self, camera: Camera, frame: Frame) -> Any:
        return self.tracer.init(camera, frame)

    def step(self, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Trace]:
        state, trace = self.tracer.step(camera, state, frame)
        return state, eqx.tree_at(lambda one: one.mask, trace, _likelihood(self.tracer, state, trace))

    def finish(self, state: Any) -> Any:
        return self.tracer.finish(state)


def _likelihood(tracer: AbstractTracer, state: Any, trace: Trace) -> Float[Array, "tag height width"]:
    if isinstance(tracer, TagAttentionPublished):
        assert isinstance(state, PublishedState)
        return jnp.exp(state.log_likelihood)
    return trace.mask


def best_mask(
    likelihood: Float[np.ndarray, "height width"],
    true: Bool[np.ndarray, "height width"],
    counted: Bool[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """The pixels with a likelihood of at least the threshold at which their IoU with `true` is highest.

    Pixels that are not `counted` count neither way, and pixels without any likelihood are never inside. Of equally good
    thresholds the highest is taken. Empty where none reaches `true`.
    """
    usable = counted & (likelihood > 0)
    values = likelihood[usable]
    order = np.argsort(-values, kind="stable")
    ranked, hits = values[order], np.cumsum(true[usable][order])
    if not len(ranked) or hits[-1] == 0:
        return np.zeros(true.shape, bool)
    last = np.append(ranked[1:] != ranked[:-1], True)  # a threshold takes all pixels of one value
    iou = hits / (np.arange(1, len(ranked) + 1) + np.sum(true & counted) - hits)
    threshold = ranked[np.argmax(np.where(last, iou, -1.0))]
    return (likelihood >= threshold) & (likelihood > 0)


def with_best_cuts(
    traces: Iterator[tuple[int, Trace]], recording: Recording, epcs: Sequence[str], stride: int
) -> Iterator[tuple[int, Trace]]:
    """The traces with the best mask of each labelled tag, and its box and centroid; detections remain the tracer's.

    Raises `RecordingError` without labels.
    """
    truth = recording.truth
    if truth is None or truth.labels is None:
        raise RecordingError(
            f"{recording.name}: found no labels in the truth; the best cut needs a labelled recording."
        )
    for number, trace in traces:
        labels = np.asarray(truth.labels[number])[::stride, ::stride]
        mask, box, centre = (np.array(one, np.float32) for one in (trace.mask, trace.box_px, trace.centre_px))
        for tag, epc in enumerate(epcs):
            if epc not in truth.tag_to_label:
                continue
            best = best_mask(mask[tag], labels == truth.tag_to_label[epc], labels != Truth.IGNORE)
            mask[tag] = best
            rows, columns = np.nonzero(best)
            if len(rows):
                box[tag] = columns.min(), rows.min(), columns.max(), rows.max()
                centre[tag] = columns.mean(), rows.mean()
        yield number, eqx.tree_at(lambda one: (one.mask, one.box_px, one.centre_px), trace, (mask, box, centre))
