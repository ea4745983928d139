"""Detection: the probability that a tag is on the body that its mask shows.

Three hypotheses explain the reads of the last seconds: the tag moves with its body (log likelihood ratio E_b to phases at
random), it is stationary (E_s), or it was on the body and has left it of late: it is elsewhere, hidden or on something that
is not followed, and the phases of recent reads are at random (E_b - R, where R is what these add to E_b). With a temperature
T, as errors of a motion are common to many reads, and prior log odds c_s and c_e of the last two against the first,

    p = exp(E_b / T) / (exp(E_b / T) + exp(E_s / T + c_s) + exp((E_b - R) / T + c_e)) .

What was read seconds ago says little of where the tag is now: R and the number n of recent reads count each read as
exp(-age / fresh_s). At least one is recent with probability 1 - exp(-n). The confidence is the product of the two.
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
    nats: Float[Array, " tag"]  # evidence for the tag's body

    @staticmethod
    def nothing(num_tags: int) -> RecentReads:
        """Before the first read."""
        return RecentReads(jnp.zeros(num_tags), jnp.zeros(num_tags))


class Detection(eqx.Module):
    """Stage that decides which tags are detected. `Detection()` has good values."""

    temperature_nats: Positive
    stationary: Float[Array, ""]  # prior log odds of a stationary tag against one on its body
    elsewhere: Float[
        Array, ""
    ]  # prior log odds of a tag that has left its body; low: reflections change phases that fit
    fresh_s: Positive  # time constant of the reads' age
    threshold: float = eqx.field(static=True)  # confidence above which a tag is detected; no gradient reaches it

    def __init__(
        self,
        *,
        temperature_nats: float = 2.0,
        stationary: float = 1.3,
        elsewhere: float = -4.0,
        fresh_s: float = 0.7,
        threshold: float = 0.5,
    ) -> None:
        """Raises `ValueError` for a time or temperature that is not positive, or a threshold that is not between 0 and 1."""
        self.temperature_nats, self.fresh_s = Positive(temperature_nats), Positive(fresh_s)
        self.stationary, self.elsewhere = (jnp.asarray(odds, jnp.float32) for odds in (stationary, elsewhere))
        if not 0.0 < threshold < 1.0:
            raise ValueError(f"threshold is {threshold}; expected a confidence strictly between 0 and 1.")
        self.threshold = float(threshold)

    def received(
        self,
        state: RecentReads,
        arrivals: Arrivals,
        added_nats: Float[Array, " tag"],
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
    ) -> RecentReads:
        """The recent reads after a frame; `added_nats` is what its reads, `arrivals`, are as evidence for each tag's body."""
        fresh = jnp.exp(-jnp.maximum(now_s - arrivals.time_s, 0.0) / self.fresh_s.value)
        new = jax.ops.segment_sum(jnp.where(arrivals.valid, fresh, 0.0), arrivals.tag, state.number.shape[0])
        kept = jnp.exp(-(now_s - since_s) / self.fresh_s.value)
        return RecentReads(number=kept * state.number + new, nats=kept * state.nats + added_nats)

    def confidence(
        self, body_nats: Float[Array, " tag"], stationary_nats: Float[Array, " tag"], recent: RecentReads
    ) -> Float[Array, " tag"]:
        """The probability that each tag is on its body, from the evidence for the hypotheses and the recent reads."""
        return self.probabilities(body_nats, stationary_nats, recent)[0]

    def probabilities(
        self, body_nats: Float[Array, " tag"], stationary_nats: Float[Array, " tag"], recent: RecentReads
    ) -> Float[Array, "4 tag"]:
        """The probabilities that each tag is on its body, stationary, elsewhere, and that none of its reads is recent."""
        temperature_nats = self.temperature_nats.value
        stationary = (stationary_nats - body_nats) / temperature_nats + self.stationary
        elsewhere = self.elsewhere - recent.nats / temperature_nats
        level = jnp.stack([jnp.zeros_like(stationary), stationary, elsewhere])
        explained = jax.nn.softmax(level, axis=0) * -jnp.expm1(-recent.number)[None]
        return jnp.concatenate([explained, jnp.exp(-recent.number)[None]])

    def detected(self, confidence: Float[Array, " tag"]) -> Bool[Array, " tag"]:
        """Whether the confidence exceeds the threshold."""
        return confidence > self.threshold

    def status(
        self,
        probabilities: Float[Array, "4 tag"],
        detected: Bool[Array, " tag"],
        in_view: Bool[Array, " tag"],
        hidden: Bool[Array, " tag"],
    ) -> Int8[Array, " tag"]:
        """`Status.DETECTED`, or the most probable reason against it; no gradient.

        `probabilities` are those of the method of this name, with the evidence of the last body where that is `hidden`.
        `in_view` is whether some segment probably belongs to the body: without one, and not hidden, it is not found. A tag
        that is elsewhere is occluded if its last body is hidden: so it is known where.
        """
        body, stationary, elsewhere, unread = probabilities
        reasons = {
            Status.NOT_READ: unread,
            Status.OCCLUDED: jnp.where(hidden, body + elsewhere, 0.0),
            Status.STATIONARY: stationary,
            Status.NOT_FOUND: jnp.where(hidden, 0.0, elsewhere + jnp.where(in_view, 0.0, body)),
        }
        codes = jnp.asarray(list(reasons), jnp.int8)
        reason = codes[jnp.argmax(jnp.stack(list(reasons.values())), axis=0)]
        return jnp.where(detected, jnp.int8(Status.DETECTED), reason)
