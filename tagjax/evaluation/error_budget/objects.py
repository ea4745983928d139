"""True objects in place of the segments over which a tracer pools."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, UInt8

from ...recording import Recording, RecordingError, Truth
from ...tracing.clips import Clip
from ...tracing.tracer import MAX_OBJECTS


def with_objects(clip: Clip, recording: Recording, stride: int) -> Clip:
    """The clip with the truth's labelled objects in its frames (`Frame.objects`), at the working resolution.

    Raises `RecordingError` without labels, or where these name more objects than a frame can give.
    """
    truth = recording.truth
    if truth is None or truth.labels is None:
        raise RecordingError(
            f"{recording.name}: found no labels in the truth; true segments need a labelled recording."
        )
    labels = np.asarray(truth.labels[clip.start : clip.stop])[:, ::stride, ::stride]
    objects = jnp.asarray(numbered(labels, recording.name), jnp.int32)
    return eqx.tree_at(lambda one: one.frames.objects, clip, objects, is_leaf=lambda leaf: leaf is None)


def numbered(labels: UInt8[np.ndarray, "time height width"], name: str) -> Int[np.ndarray, "time height width"]:
    """Labels as numbers of objects: 0 where there is none, and on pixels that are labelled 255 (ignore)."""
    objects = np.where(labels == Truth.IGNORE, 0, labels).astype(np.int64)
    if objects.max(initial=0) > MAX_OBJECTS:
        raise RecordingError(f"{name}: found the label {objects.max()}; expected labels up to {MAX_OBJECTS}.")
    return objects
