"""Given objects in place of the tracer's own segments, for error budgets: each is one segment, in the last slots."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ...tracing.tracer import MAX_OBJECTS
from .cells import NO_LABEL, NOT_NEW


def first_given(num_segments: int) -> int:
    """The slot of the first given object."""
    return num_segments - MAX_OBJECTS


def given_slots(objects: Int[Array, "height width"], num_segments: int, num_blocks: int) -> Int[Array, "height width"]:
    """The slot of each pixel's object (`Frame.objects`), -1 = none.

    Raises `ValueError` where the first frame's blocks would need these slots.
    """
    if num_blocks >= first_given(num_segments):
        raise ValueError(
            f"num_segments is {num_segments} and the first frame has {num_blocks} blocks; expected {MAX_OBJECTS} more slots "
            "than that, for given objects. Raise num_segments."
        )
    return jnp.where(objects > 0, first_given(num_segments) - 1 + objects, NO_LABEL).astype(jnp.int32)


def sources_with_given(
    source: Int[Array, " segment"], there: Bool[Array, " segment"], was_there: Bool[Array, " segment"]
) -> Int[Array, " segment"]:
    """The sources of new segments: an object that appears, or comes back, has no past."""
    own = jnp.arange(source.shape[0]) < first_given(source.shape[0])
    return jnp.where(own, source, jnp.where(there & ~was_there, NO_LABEL, NOT_NEW))


def without_joined(
    labels: Int[Array, "height width"], objects: Int[Array, "height width"], num_segments: int
) -> Int[Array, "height width"]:
    """Labels in which a given object has the given pixels and no others."""
    return jnp.where((labels >= first_given(num_segments)) & (objects == 0), NO_LABEL, labels)
