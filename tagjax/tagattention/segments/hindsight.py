"""Offline (two-pass) smoothing: what the backward pass knows at a frame, handed over to the segments of the forward pass.

Two filters run over a recording from its two ends (Fraser and Potter, AIAA Journal, 1969), each with segments of its own. A
read counts once: the forward filter has those up to the frame, the backward filter those after it, and their evidence adds
up. A dwell that the frame cuts in two loses what its halves say of each other, about the evidence of one read.

The two label pictures of a frame connect the segments: with n_ij pixels that belong to segment i of the forward pass and j
of the backward pass, segment i has

    b_i = sum_j n_ij b_j / sum_j n_ij

of the backward pass's values b. The static background (slot 0) has those of the static background, and so has a segment
none of whose pixels the backward pass labels.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import safe_divide
from .body import LaterBody
from .detection import RecentReads
from .labels import STATIC


class Hindsight(eqx.Module):
    """The backward filter's state at a frame."""

    labels: Int[Array, "height width"]  # slot of each pixel, -1 = none
    evidence: Float[Array, "tag segment"]  # of the later reads, nats
    recent: RecentReads  # the next reads, each counted by its distance in time
    free_nats: Float[Array, " tag"]  # evidence of the later reads for a path of the tag's own
    body: LaterBody | None
    member: Bool[Array, " segment"]  # belongs to some tag's body

    def moves(self) -> Bool[Array, "height width"]:
        """The pixels of what is a tag's body later: no static background, even where it has not moved yet."""
        return self.member[jnp.maximum(self.labels, STATIC)] & (self.labels > STATIC)

    def on(self, labels: Int[Array, "height width"]) -> tuple[Float[Array, "tag segment"], LaterBody | None]:
        """The evidence and the body on the segments of the forward pass, whose label picture is `labels`."""
        return jax.tree.map(lambda values: handed_over(labels, self.labels, values), (self.evidence, self.body))

    def compact(self) -> Hindsight:
        """Half as many bytes: evidence of hundreds of nats is kept to a quarter of a nat."""
        half = jax.tree.map(
            lambda leaf: leaf.astype(jnp.float16) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, self
        )
        small = self.member.shape[0] <= 2**15  # slots that int16 can count
        return eqx.tree_at(lambda one: one.labels, half, self.labels.astype(jnp.int16)) if small else half


def handed_over(
    labels: Int[Array, "height width"],
    later_labels: Int[Array, "height width"],
    values: Float[Array, "*row segment"],
) -> Float[Array, "*row segment"]:
    """Each segment's mean of the later segments' values, weighted by the pixels that the two have in common.

    Both passes have the same number of slots. Pixels without a label in either picture do not count.
    """
    num_segments = values.shape[-1]
    there = ((labels >= 0) & (later_labels >= 0)).reshape(-1)
    slot = jnp.where(there, labels.reshape(-1), num_segments)
    number = jax.ops.segment_sum(there.astype(values.dtype), slot, num_segments)
    rows = values.reshape(-1, num_segments)
    pixels = jnp.take(rows, jnp.maximum(later_labels, 0).reshape(-1), axis=1)
    total = jax.vmap(lambda row: jax.ops.segment_sum(row, slot, num_segments))(pixels)
    mean = safe_divide(total, jnp.broadcast_to(number[None], total.shape))
    own = (number > 0) & (jnp.arange(num_segments) != STATIC)
    return jnp.where(own[None], mean, rows[:, STATIC : STATIC + 1]).reshape(values.shape)
