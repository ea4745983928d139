"""What the tracer on segments carries from frame to frame."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...tracing.tracer import Frame
from .attention import AttentionState
from .body import BodyState
from .competition import CompetitionState
from .detection import RecentReads
from .dwell import DwellState
from .free_path import FreePathState
from .hidden import HiddenState
from .step import SegmentTrackerState
from .travel import TravelState
from .unknown_depth import UnknownDepthState


class TagState(eqx.Module):
    """What is carried from frame to frame of the tags, and of the motion that all of them share."""

    time_s: Float[Array, ""]  # of the last frame; NaN before the first
    travel: TravelState | None
    dwell: DwellState | UnknownDepthState | None
    attention: AttentionState | None
    body: BodyState | None
    competition: CompetitionState | None
    hidden: HiddenState | None
    free: FreePathState | None
    recent: RecentReads


class TagAttentionState(eqx.Module):
    """What is carried from frame to frame."""

    segments: SegmentTrackerState
    tags: TagState
    background_lost: Float[Array, ""]  # of the last frame, as in `SegmentFrame`
    camera_moved: Bool[Array, ""]  # so far


def last_s(state: TagState, frame: Frame) -> Float[Array, ""]:
    """The time of the last frame, that of this one before the first. A time that goes back counts as that of the last frame."""
    return jnp.where(jnp.isfinite(state.time_s), jnp.minimum(state.time_s, frame.time_s), frame.time_s)


def of_tags(state: TagState) -> list[Any]:
    """The arrays with one row a tag."""
    found = [*jax.tree.leaves(state.recent), *jax.tree.leaves(state.hidden), *jax.tree.leaves(state.free)]
    found += jax.tree.leaves(state.competition)
    if state.dwell is not None:
        found += state.dwell.of_tags()
    if state.attention is not None:
        found.append(state.attention.log_likelihood)
    return found if state.body is None else [*found, state.body.membership]


def times(state: TagState) -> list[Any]:
    """The arrays of times."""
    found = [state.time_s]
    if state.free is not None:
        found.append(state.free.time_s)
    if state.travel is not None:
        found.append(state.travel.past.time_s)
    if state.attention is not None:
        found.append(state.attention.time_s)
    return found if state.body is None else [*found, state.body.past.time_s]
