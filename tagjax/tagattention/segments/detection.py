"""Detection: the confidence that a tag is on the body that its mask shows.

Three explanations of a tag's reads compete, each with its log likelihood ratio to phases at random in nats: the tag moves with
its body (E_b), it is stationary (E_s), or it moves on a smooth path of its own (E_f, see `FreePath`). The best of hundreds of
segments explains any reads fairly well. So the body counts by what it explains better than the others do:

    confidence = p_moves p_body (1 - exp(-n))
    p_moves = sigmoid((max(E_b, E_f) - max(E_s, 0)) / T_m - c_m)
    p_body = sigmoid((E_b - w_s min(E_s, 0) - w_f max(E_f, 0) - w_r max(R_f, 0)) / T - c) .

So p_moves asks whether the tag moves on any path, and p_body whether on this one. A tag that surely moves (E_s < 0) needs less evidence for its body. R_f is the part of E_f from recent reads, and n is their number: each counts as exp(-age / fresh_s). What was read seconds ago
says little of where the tag is now; at least one read is recent with probability 1 - exp(-n). The weights are learned
without labels: the confidence should be 1 where the mask is the smoother's, and 0 where it is not, and for reads that belong
to nothing in view, which are taken to be one tenth of all.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int8

from ...core.constrained import Positive
from ...radio.arrivals import Arrivals
from ...tracing.status import Status


class RecentReads(eqx.Module):
    """What each tag's recent reads amount to; each counts as `Detection` says."""

    number: Float[Array, " tag"]
    free_nats: Float[Array, " tag"]  # evidence for a free path

    @staticmethod
    def nothing(num_tags: int) -> RecentReads:
        """Before the first read."""
        return RecentReads(jnp.zeros(num_tags), jnp.zeros(num_tags))


class Explanations(eqx.Module):
    """The evidence of all reads so far for each explanation of them, nats."""

    body: Float[Array, " tag"]
    stationary: Float[Array, " tag"]
    free: Float[Array, " tag"]


def best_of_segments(
    evidence_nats: Float[Array, "tag segment"], moving: Bool[Array, " segment"]
) -> Float[Array, " tag"]:
    """Each tag's largest evidence among the `moving` segments, 0 where there is none; no gradient. It is shown, not used."""
    best = jnp.max(jnp.where(moving, evidence_nats, -jnp.inf), axis=1)
    return jax.lax.stop_gradient(jnp.where(jnp.any(moving), best, 0.0))


class Detection(eqx.Module):
    """Stage that decides which tags are detected. `Detection()` has good values."""

    temperature_nats: Positive
    stationary: Float[Array, ""]  # w_s
    free: Float[Array, ""]  # w_f
    free_recent: Float[Array, ""]  # w_r
    level: Float[Array, ""]  # c
    moves_nats: Positive  # T_m
    moves_level: Float[Array, ""]  # c_m: prior log odds of a stationary tag against one that moves
    fresh_s: Positive  # time constant of the reads' age
    threshold: float = eqx.field(static=True)  # confidence above which a tag is detected; no gradient reaches it

    def __init__(
        self,
        *,
        temperature_nats: float = 20.0,
        stationary: float = 0.5,
        free: float = 0.65,
        free_recent: float = 1.0,
        level: float = 0.3,
        moves_nats: float = 2.0,
        moves_level: float = 1.3,
        fresh_s: float = 0.7,
        threshold: float = 0.4,
    ) -> None:
        """Raises `ValueError` for a time or temperature that is not positive, or a threshold that is not between 0 and 1."""
        self.temperature_nats, self.moves_nats = Positive(temperature_nats), Positive(moves_nats)
        self.fresh_s = Positive(fresh_s)
        weights = stationary, free, free_recent, level, moves_level
        self.stationary, self.free, self.free_recent, self.level, self.moves_level = (
            jnp.asarray(weight, jnp.float32) for weight in weights
        )
        if not 0.0 < threshold < 1.0:
            raise ValueError(f"threshold is {threshold}; expected a confidence strictly between 0 and 1.")
        self.threshold = float(threshold)

    def received(
        self,
        state: RecentReads,
        arrivals: Arrivals,
        added_free_nats: Float[Array, " tag"],
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
    ) -> RecentReads:
        """The recent reads after a frame; its reads, `arrivals`, add this evidence for a free path."""
        fresh = jnp.exp(-jnp.maximum(now_s - arrivals.time_s, 0.0) / self.fresh_s.value)
        new = jax.ops.segment_sum(jnp.where(arrivals.valid, fresh, 0.0), arrivals.tag, state.number.shape[0])
        kept = jnp.exp(-(now_s - since_s) / self.fresh_s.value)
        return RecentReads(
            number=kept * state.number + new,
            free_nats=kept * state.free_nats + added_free_nats,
        )

    def confidence(self, nats: Explanations, recent: RecentReads) -> Float[Array, " tag"]:
        """The confidence of each tag, 0 to 1, from the evidence and the recent reads."""
        some_path, none = jnp.maximum(nats.body, nats.free), jnp.maximum(nats.stationary, 0.0)
        moves = (some_path - none) / self.moves_nats.value - self.moves_level
        free, free_recent = jnp.maximum(nats.free, 0.0), jnp.maximum(recent.free_nats, 0.0)
        rivals = self.stationary * jnp.minimum(nats.stationary, 0.0) + self.free * free + self.free_recent * free_recent
        better = (nats.body - rivals) / self.temperature_nats.value - self.level
        return jax.nn.sigmoid(moves) * jax.nn.sigmoid(better) * -jnp.expm1(-recent.number)

    def detected(self, confidence: Float[Array, " tag"]) -> Bool[Array, " tag"]:
        """Whether the confidence exceeds the threshold."""
        return confidence > self.threshold

    def status(
        self,
        nats: Explanations,
        recent: RecentReads,
        detected: Bool[Array, " tag"],
        in_view: Bool[Array, " tag"],
        hidden: Bool[Array, " tag"],
    ) -> Int8[Array, " tag"]:
        """`Status.DETECTED`, or the reason against it; no gradient.

        `nats` are those of `confidence`, with the evidence of the last body where that is `hidden`; `in_view` is whether
        some segment probably belongs to the body. The reasons, in order: not even one read is recent (at even odds); the
        tag explains its reads best as stationary; its last body is hidden; no body explains its reads well enough.
        """
        # Before anything moves, the best body and the static background explain the reads alike.
        stationary = (nats.stationary >= nats.free) & ((nats.stationary >= nats.body) | ~in_view)
        reason = jnp.where(hidden, jnp.int8(Status.OCCLUDED), jnp.int8(Status.NOT_FOUND))
        reason = jnp.where(stationary, jnp.int8(Status.STATIONARY), reason)
        reason = jnp.where(recent.number < jnp.log(2.0), jnp.int8(Status.NOT_READ), reason)
        return jnp.where(detected, jnp.int8(Status.DETECTED), reason)
