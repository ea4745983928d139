"""Competition: a body hardly ever carries two tags.

Two people may walk alike for a while, and then the reads of one's tag explain the other nearly as well. What the tags' reads say
together is surer. With m_bi the membership of segment i in the body b that a tag had at the last frame, A_i its area, E_ki the
evidence of tag k at segment i, T the temperature of a tag's place, c_k the tag's confidence at the last frame, and n_b the number
of tags that had body b, tag k is on body b with the probability p_kb:

    E_kb = sum_i m_bi A_i E_ki / sum_i m_bi A_i ,    p_kb = c_k exp(E_kb / T) / n_b / (exp(E_k0 / T) + sum_b exp(E_kb / T) / n_b) ,

where E_k0 is the best evidence in no such body, at least that of a tag at rest. If two tags are on one body with the prior
probability e, the other tags leave tag k the prior

    log o_ki = sum_{j != k} log(1 - (1 - e) sum_b p_jb m_bi)

at segment i. For two tags whose confidence is 1 that is the exact marginal of both, since p is of each tag's own reads alone.
So a tag that is as probable on another's body as on its own goes to its own, and two tags that took each other's bodies
change places.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...core.constrained import Fraction
from ...core.numerics import safe_divide
from .cells import row_sources
from .labels import STATIC
from .step import SegmentFrame

_NOWHERE = -1e9  # evidence of what does not exist, nats
_HELD = 0.5  # of a body that a segment most probably belongs to
_SOME = 1.0  # pixels: a smaller body is none


class CompetitionState(eqx.Module):
    """The tags' bodies at the last frame."""

    membership: Float[Array, "tag segment"]  # probability that the segment belongs to the tag's body
    confidence: Float[Array, " tag"]  # of each tag, without gradient

    @staticmethod
    def nothing(num_tags: int, num_segments: int) -> CompetitionState:
        """No body yet."""
        return CompetitionState(jnp.zeros((num_tags, num_segments)), jnp.zeros(num_tags))


class LastBodies(eqx.Module):
    """The bodies of the last frame on the segments of this one."""

    membership: Float[Array, "body segment"]
    weight: Float[Array, "body segment"]  # pixels
    confidence: Float[Array, " body"]

    def evidence_of(self, evidence: Float[Array, "tag segment"]) -> Float[Array, "tag body"]:
        """The mean evidence of each tag over each body, nats; very low for a body of less than a pixel."""
        mass = jnp.sum(self.weight, axis=1)
        mean = safe_divide(evidence @ self.weight.T, jnp.broadcast_to(mass[None], (len(evidence), len(mass))))
        return jnp.where((mass > _SOME)[None], mean, _NOWHERE)

    def num_tags(self) -> Float[Array, " body"]:
        """The number of tags that had each body, at least 1: by how much of it is theirs."""
        mass = jnp.sum(self.weight, axis=1)
        shared = self.weight @ self.membership.T
        shared = safe_divide(shared, jnp.broadcast_to(mass[:, None], shared.shape))
        return jnp.maximum(jnp.sum(shared, axis=1), 1.0)


class Competition(eqx.Module):
    """Stage that makes bodies which explain other tags' reads improbable for a tag. `Competition()` has good values."""

    together: Fraction  # e: prior probability that two tags are on one body; scores change little from 0.002 to 0.1

    def __init__(self, *, together: float = 0.02) -> None:
        """Raises `ValueError` for a probability that is not between 0 and 1."""
        self.together = Fraction(together)

    def bodies(self, state: CompetitionState, found: SegmentFrame, present: Bool[Array, " tag"]) -> LastBodies:
        """The bodies of the last frame on the segments of this one, none for a tag that is not `present`.

        A new segment belongs to the bodies to which the one belonged that it comes from.
        """
        source = row_sources(found.source)
        there = found.in_view & (source != STATIC)
        membership = jnp.where(there[None] & present[:, None], state.membership[:, source], 0.0)
        return LastBodies(membership, membership * found.area[None], jnp.where(present, state.confidence, 0.0))

    def log_prior(
        self,
        last: LastBodies,
        evidence: Float[Array, "tag segment"],
        found: SegmentFrame,
        temperature_nats: Float[Array, ""],
    ) -> Float[Array, "tag segment"]:
        """Log prior of each segment as the place of each tag, 0 at most; `evidence` is against a tag at rest, nats."""
        free = found.in_view & (jnp.max(last.membership, axis=0, initial=0.0) < _HELD)
        elsewhere = jnp.max(jnp.where(free[None], evidence, 0.0), axis=1, initial=0.0)
        # A body that several tags had at the last frame is one body.
        of_body = last.evidence_of(evidence) / temperature_nats - jnp.log(last.num_tags())[None]
        logits = jnp.concatenate([of_body, (elsewhere / temperature_nats)[:, None]], axis=1)
        on_body = last.confidence[:, None] * jax.nn.softmax(logits, axis=1)[:, :-1]
        taken = on_body @ last.membership
        left = jnp.log1p(-(1.0 - self.together.value) * jnp.clip(taken, 0.0, 1.0))
        return jnp.sum(left, axis=0, keepdims=True) - left
