"""The static background in depth: per pixel, the surface that has been seen there at rest for long enough.

Optical flow follows shadows and halos on floors and walls; their depth says that nothing moves. A pixel's depth is first
a candidate. Seen for `confirm_s` without apparent motion it is confirmed, and stays so while something passes in front
of it. A deeper surface that shows behind a confirmed one proves that the confirmed one has left.

Long before that it is known what stands in front: where a deeper surface has been seen at rest.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...core.numerics import safe_divide
from ...core.parameters import check_positive

_MAX_COUNT = 100.0  # frames in a candidate's running mean
_REVEAL_FRAMES = 1.5  # a single frame's wrong depth reveals nothing
_NEARER_FACTOR = 10.0  # a nearer surface is more often a resting person than a new wall


class BackgroundState(eqx.Module):
    """What is remembered of each pixel; 0 m = nothing seen, nothing confirmed."""

    candidate_m: Float[Array, "height width"]  # running mean of the depth seen last
    count: Float[Array, "height width"]  # frames in that mean
    age_s: Float[Array, "height width"]  # time for which the candidate was seen at rest
    confirmed_m: Float[Array, "height width"]
    rested_m: Float[Array, "height width"]  # the deepest surface seen at rest for `early_s`; 0 once a deeper one shows
    deeper_s: Float[Array, "height width"]  # time for which a surface behind the confirmed one is seen
    started: Bool[Array, ""]  # a frame with depth has been seen


class BackgroundView(eqx.Module):
    """What the background model says of the pixels of one frame."""

    confirmed: Bool[Array, "height width"]  # the depth is the confirmed background's
    matched: Bool[Array, "height width"]  # the depth is that of the candidate of the frames before
    age_s: Float[Array, "height width"]  # of the candidate, this frame included
    early: Bool[Array, "height width"]  # that age is enough for a pixel without a label
    ripe: Bool[Array, "height width"]  # ... enough to be confirmed
    still: Bool[Array, "height width"]  # no apparent motion
    front: Bool[Array, "height width"]  # the depth is in front of all that has been seen at rest there
    lost: Float[Array, ""]  # fraction of the pixels with depth and a confirmed surface that show another; 0 without any

    @staticmethod
    def nothing(height: int, width: int) -> BackgroundView:
        """No pixel is known to be background."""
        no, zero = jnp.zeros((height, width), bool), jnp.zeros((height, width))
        return BackgroundView(no, no, zero, no, no, no, ~no, jnp.zeros(()))

    def without(self, pixels: Bool[Array, "height width"]) -> BackgroundView:
        """The same, but these pixels are known not to be background."""
        return eqx.tree_at(
            lambda one: (one.confirmed, one.matched), self, (self.confirmed & ~pixels, self.matched & ~pixels)
        )


class Background(eqx.Module):
    """Settings of the background model. They are static: only comparisons use them, and no gradient reaches them.

    Good values: `confirm_s` 1.5 (shorter confirms a person who pauses, longer lets shadows move for longer), `early_s` 0.3
    (age from which an unlabelled pixel counts as static), `still_m_s` 0.03 (apparent motion of a point, flow * z / focal),
    `tolerance_m` 0.004 and `tolerance_m_m2` 0.004 (depths differ by at most the first plus the second times z^2),
    `reveal_s` 0.08 (a deeper surface seen for so long, and for at least two frames, removes a confirmed one).
    Raises `ValueError` for a value that is not positive.
    """

    confirm_s: float = eqx.field(static=True, default=1.5)
    early_s: float = eqx.field(static=True, default=0.3)
    still_m_s: float = eqx.field(static=True, default=0.03)
    tolerance_m: float = eqx.field(static=True, default=0.004)
    tolerance_m_m2: float = eqx.field(static=True, default=0.004)
    reveal_s: float = eqx.field(static=True, default=0.08)

    def __check_init__(self) -> None:
        check_positive(**vars(self))

    def init(self, height: int, width: int) -> BackgroundState:
        """Nothing seen."""
        zero = jnp.zeros((height, width))
        return BackgroundState(zero, zero, zero, zero, zero, zero, jnp.zeros((), bool))

    def step(
        self,
        state: BackgroundState,
        depth_m: Float[Array, "height width"],
        valid: Bool[Array, "height width"],
        flow_px: Float[Array, "height width 2"],
        dt_s: Float[Array, ""],
        focal_px: Float[Array, ""],
    ) -> tuple[BackgroundState, BackgroundView]:
        """One frame on, `dt_s` after the last; `flow_px` to or from that frame. Pixels that are not valid keep their state."""
        tolerance = self.tolerance_m + self.tolerance_m_m2 * jnp.square(depth_m)
        # A sum over two channels takes XLA ten times as long as adding two maps.
        length_px = jnp.sqrt(jnp.square(flow_px[..., 0]) + jnp.square(flow_px[..., 1]))
        still = length_px * depth_m < self.still_m_s * focal_px * dt_s
        matched = valid & (jnp.abs(depth_m - state.candidate_m) < tolerance)
        seen, other = matched & still, valid & ~matched

        # A running mean: slow drift leaves its own tolerance.
        count = jnp.where(seen, jnp.minimum(state.count + 1.0, _MAX_COUNT), jnp.where(other, 1.0, state.count))
        mean = state.candidate_m + (depth_m - state.candidate_m) / jnp.maximum(count, 1.0)
        candidate = jnp.where(seen, mean, jnp.where(other, depth_m, state.candidate_m))
        # The first frame's pixels have most likely been there for some time.
        new_age = jnp.where(state.started, 0.0, self.early_s)
        age = jnp.where(seen, state.age_s + dt_s, jnp.where(other, new_age, state.age_s))

        nearer = (state.confirmed_m > 0) & (candidate < state.confirmed_m - tolerance)
        ripe = seen & (age >= jnp.where(nearer, _NEARER_FACTOR * self.confirm_s, self.confirm_s))
        confirmed = jnp.where(ripe, candidate, state.confirmed_m)
        deeper = valid & _behind(depth_m, confirmed, tolerance)
        deeper_s = jnp.where(deeper, state.deeper_s + dt_s, jnp.where(valid, 0.0, state.deeper_s))
        revealed = deeper_s > jnp.maximum(self.reveal_s, _REVEAL_FRAMES * dt_s)
        confirmed = jnp.where(revealed, 0.0, confirmed)

        # A surface behind what was seen at rest shows that this was an object, which has gone: a person who walks away.
        last = state.rested_m
        gone = valid & _behind(depth_m, last, tolerance)
        last = jnp.where(gone, 0.0, last)
        rested = jnp.where(seen & (age > self.early_s), jnp.maximum(last, candidate), last)
        # Both depths have their error.
        front = valid & ((rested <= 0) | (depth_m < rested - 2.0 * tolerance))
        known = valid & (state.confirmed_m > 0)
        other_surface = known & (jnp.abs(depth_m - state.confirmed_m) >= tolerance)
        view = BackgroundView(
            confirmed=valid & (confirmed > 0) & (jnp.abs(depth_m - confirmed) < tolerance),
            matched=matched,
            age_s=age,
            early=age >= self.early_s,
            ripe=age >= self.confirm_s,
            still=still,
            front=front,
            lost=safe_divide(jnp.sum(other_surface, dtype=depth_m.dtype), jnp.sum(known, dtype=depth_m.dtype)),
        )
        started = state.started | jnp.any(valid)
        return BackgroundState(candidate, count, age, confirmed, rested, deeper_s, started), view


def _behind(
    depth_m: Float[Array, "height width"],
    surface_m: Float[Array, "height width"],
    tolerance_m: Float[Array, "height width"],
) -> Bool[Array, "height width"]:
    """Whether the depth is behind a surface that is known; more than twice as deep is a wrong measurement more often than a view past it."""
    return (surface_m > 0) & (depth_m > surface_m + tolerance_m) & (depth_m < 2.0 * surface_m + 1.0)
