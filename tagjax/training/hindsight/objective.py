"""What is learned from hindsight: the mask, made from the past alone, should be the teacher's, and the confidence say how well."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PyTree

from ...core.constrained import learning_only
from ...core.numerics import safe_divide
from ...core.settings import ConfigError
from ...tagattention.segments import Detection, TagAttention
from ...tagattention.segments.detection import Explanations, RecentReads
from ...tracing.tracer import AbstractTracer, Camera
from .likelihood import FilmedFrames, moved_by_flow, read_nats
from .pieces import PieceFrames, frame_of
from .teachers import Teacher

_RIGHT = 0.3  # IoU above which a mask counts as right


@dataclasses.dataclass(frozen=True)
class HindsightSettings:
    """Settings of learning from hindsight."""

    sure: float = (
        0.9  # a mask counts where the teacher's confidence is above this, its silence where below 1 minus this
    )
    clip_norm: float = 0.3  # of a piece's gradient, at most: some have 50 times the median
    piece_frames: int = 256  # a recording is cut into pieces of at most so many frames
    teacher: Teacher = "smoother"  # or labels: the true masks of simulated recordings, to compare with
    # masks: what belongs to the body, all stages but detection; confidence: detection; all: both;
    # place: on which body the tag is, by all stages that say so; reads: the reader's noise, and with `joint` the flow
    learn: Literal["all", "masks", "place", "confidence", "reads"] = "all"
    parameters: tuple[str, ...] | None = None  # dotted names of those that are learned, or patterns (body.*); None: all
    controls: float = 0.0  # of the confidence: fraction of reads taken to belong to nothing in view; 0: none
    pieces: str | None = None  # folder that keeps the pieces for later runs; None: the run folder, until the run ends
    term_norms: ClassVar[bool] = False  # there is one term

    def __post_init__(self) -> None:
        if not 0.5 <= self.sure < 1:
            raise ConfigError(f"sure is {self.sure}; expected a confidence from 0.5 to 1, 1 excluded.")
        if not self.clip_norm > 0:
            raise ConfigError(f"clip_norm is {self.clip_norm}; expected a positive norm.")
        if self.piece_frames < 1:
            raise ConfigError(f"piece_frames is {self.piece_frames}; expected at least 1 frame.")
        if not 0 <= self.controls < 1:
            raise ConfigError(f"controls is {self.controls}; expected a fraction from 0 to 1, 1 excluded.")

    @property
    def needs_controls(self) -> bool:
        """Whether control reads take part."""
        return self.learn in ("all", "confidence") and self.controls > 0

    def weights(self) -> dict[str, float]:
        """The weight of each term."""
        return {"hindsight": 1.0}

    def learning(self, tracer: TagAttention) -> TagAttention:
        """The tracer in which gradients reach `parameters` only. Raises `ConfigError` for one that it does not have."""
        if self.parameters is None:
            return tracer
        try:
            return learning_only(tracer, self.parameters)
        except ValueError as error:
            raise ConfigError(f"hindsight.parameters: {error}") from error

    def bounded(self, gradient: PyTree) -> PyTree:
        """The gradient of a piece, scaled to at most `clip_norm`."""
        norm = optax.tree.norm(gradient)
        return jax.tree.map(lambda leaf: leaf * jnp.minimum(1.0, self.clip_norm / jnp.maximum(norm, 1e-12)), gradient)

    def terms(
        self, tracer: AbstractTracer, camera: Camera, frames: PieceFrames | FilmedFrames
    ) -> tuple[dict[str, Float[Array, ""]], dict[str, Array]]:
        """The loss of a piece, and what it consists of; NaN for a mean over nothing."""
        assert isinstance(tracer, TagAttention)
        tracer = self.learning(tracer)
        if isinstance(frames, FilmedFrames):
            frames = moved_by_flow(tracer.segments, camera, frames)
        if self.learn == "reads":
            nats, number = read_nats(
                tracer.reader, camera.antennas_m.shape[0], frames, frames.present & (frames.confidence > self.sure)
            )
            total, count = jnp.sum(nats), jnp.sum(number)
            return {"hindsight": -safe_divide(total, count)}, {"nats": _known_mean(total, count)}
        sums, loss = hindsight_sums(tracer, camera, frames, self), jnp.zeros(())
        if self.learn == "place":
            loss = loss + safe_divide(sums.surprise, sums.num_there)
        if self.learn in ("all", "masks"):
            loss = loss + safe_divide(sums.missed, sums.num_there)
        if self.learn in ("all", "confidence"):
            loss = loss + safe_divide(sums.wrong, sums.num_there + sums.num_away)
        logged = {
            "overlap": 1.0 - _known_mean(sums.missed, sums.num_there),
            "place_nats": _known_mean(sums.surprise, sums.num_there),
            "false_confidence": _known_mean(sums.claimed, sums.num_away),
        }
        if self.needs_controls:
            strange = control_sums(tracer, camera, frames, self)
            loss = loss + self.controls / (1.0 - self.controls) * safe_divide(strange.wrong, strange.num)
            logged["false_confidence/control"] = _known_mean(strange.claimed, strange.num)
        return {"hindsight": loss}, logged


def _known_mean(total: Float[Array, ""], count: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(count > 0, safe_divide(total, count), jnp.nan)


class HindsightSums(NamedTuple):
    """Sums over the tag-frames of which the teacher is sure, and their numbers."""

    missed: Float[Array, ""]  # 1 - IoU where the teacher sees the object
    surprise: Float[Array, ""]  # there as well: -log of the probability that the tag is in the teacher's mask, nats
    wrong: Float[Array, ""]  # (confidence - 1)^2 where the mask is right, confidence^2 elsewhere
    claimed: Float[Array, ""]  # confidence where it sees nothing
    num_there: Float[Array, ""]
    num_away: Float[Array, ""]


class ControlSums(NamedTuple):
    """Sums over the tag-frames of a control, in all of which the confidence should be 0, and their number."""

    wrong: Float[Array, ""]  # confidence^2
    claimed: Float[Array, ""]  # confidence
    num: Float[Array, ""]


class _Apart(eqx.Module):
    """A detection, to whose inputs no gradient flows."""

    stage: Detection

    def received(self, state: RecentReads, arrivals: Any, *given: Array) -> RecentReads:
        return self.stage.received(state, arrivals, *jax.lax.stop_gradient(given))

    def confidence(self, nats: Explanations, recent: RecentReads) -> Array:
        return self.stage.confidence(jax.lax.stop_gradient(nats), recent)

    def __getattr__(self, name: str) -> Any:  # of the status, which has no gradient
        return getattr(self.stage, name)


def hindsight_sums(
    tracer: TagAttention, camera: Camera, frames: PieceFrames, settings: HindsightSettings
) -> HindsightSums:
    """The questions of each tag-frame: where the tag is, what belongs to the object, and how sure one may be of it.

    Place: the log score of the probability that the tag is in the teacher's mask, which is wrong with the probability
    1 - `sure`. Its gradient does not vanish where the tracer is sure and wrong, as that of the overlap does. Mask: IoU is the
    soft one of the teacher's mask and the tracer's, on segments weighted by their areas. Confidence: it should be the
    probability that the mask is right, that is, of an IoU above 0.3: its squared error is least where it is (a
    proper score; Brier, 1950). The mask does not depend on detection, so it teaches every other stage; the confidence carries no
    gradient to what detection is given, so it teaches detection alone. Where that is all that learns, no other backward pass is made.
    """
    if settings.learn == "confidence":
        overlap, inside, confidence, size = _of_detection(tracer, camera, frames)
    else:
        apart = eqx.tree_at(lambda one: one.detection, tracer, replace_fn=_Apart)
        overlap, inside, confidence, size = _scanned(apart, camera, frames, lambda state: state, jax.checkpoint)
    there = frames.present & (frames.confidence > settings.sure) & (size > 0)
    away = frames.present & (frames.confidence < 1.0 - settings.sure)
    right = jnp.where(there & (overlap > _RIGHT), 1.0, 0.0)
    wrong = jnp.where(there | away, (confidence - right) ** 2, 0.0)
    surprise = -jnp.log(settings.sure * inside + (1.0 - settings.sure))

    return HindsightSums(
        missed=jnp.sum(jnp.where(there, 1.0 - overlap, 0.0)),
        surprise=jnp.sum(jnp.where(there, surprise, 0.0)),
        wrong=jnp.sum(wrong),
        claimed=jnp.sum(jnp.where(away, confidence, 0.0)),
        num_there=jnp.sum(there.astype(wrong.dtype)),
        num_away=jnp.sum(away.astype(wrong.dtype)),
    )


def control_sums(tracer: TagAttention, camera: Camera, frames: PieceFrames, settings: HindsightSettings) -> ControlSums:
    """How sure the tracer is of tags whose reads belong to nothing in view. Detection alone learns from it."""
    frames = frames.of_control()
    _, _, confidence, _ = _of_detection(tracer, camera, frames)
    claimed = jnp.where(frames.present, confidence, 0.0)
    return ControlSums(jnp.sum(claimed**2), jnp.sum(claimed), jnp.sum(frames.present.astype(claimed.dtype)))


def _of_detection(tracer: TagAttention, camera: Camera, frames: PieceFrames) -> tuple[Array, Array, Array, Array]:
    """`_scanned` with gradients of detection only: the backward pass goes through its recent reads, and traces nothing again."""
    tracer = eqx.tree_at(lambda one: one.detection, jax.lax.stop_gradient(tracer), tracer.detection)

    def before(state: Any) -> Any:
        return eqx.tree_at(lambda one: one.recent, jax.lax.stop_gradient(state), state.recent)

    return _scanned(tracer, camera, frames, before, lambda step, **_: step)


def _scanned(
    tracer: TagAttention,
    camera: Camera,
    frames: PieceFrames,
    before: Callable[[Any], Any],
    wrapped: Callable[..., Callable[..., Any]],
) -> tuple[Float[Array, "time tag"], Float[Array, "time tag"], Float[Array, "time tag"], Float[Array, "time tag"]]:
    """Soft IoU with the target, probability that the tag is in it, confidence, and the target's area, pixels.

    `before` is done to the state at each frame.
    """
    frames = dataclasses.replace(frames, control=None)

    def step(state: Any, frame: PieceFrames) -> tuple[Any, tuple[Array, Array, Array, Array]]:
        seen = frame_of(frame, camera.antennas_m.shape[0])
        state, out = tracer.associate(camera, before(state), frame.found, seen)
        area = frame.found.area
        both = out.membership * frame.target
        overlap = safe_divide(both @ area, (out.membership + frame.target - both) @ area)
        inside = jnp.sum(out.place * frame.target, axis=1)
        return state, (overlap, inside, out.confidence, frame.target @ area)

    num_antennas, num_tags = camera.antennas_m.shape[0], frames.present.shape[1]
    begin = tracer.no_reads(num_tags, num_antennas, frames.radio.relative_m.shape[-1], frames.time_s[0])
    # In a scan nothing can be merged across the forward and the backward pass.
    return jax.lax.scan(wrapped(step, prevent_cse=False), begin, frames)[1]
