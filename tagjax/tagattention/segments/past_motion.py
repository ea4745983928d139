"""Where segments were a while ago: a ring of their displacements at times evenly spread over the past."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class PastMotion(eqx.Module):
    """Displacements since birth at the times of a ring of entries; entries come at least `span_s / num_entries` apart.

    The spacing is in seconds, so that the ring covers the same time at any frame rate.
    """

    displacement_m: Float[Array, "entry segment 3"]  # 0 before a segment's birth
    time_s: Float[Array, " entry"]  # minus infinity for an entry that is not used yet
    newest: Int[Array, ""]  # entry written last
    span_s: float = eqx.field(static=True)

    @staticmethod
    def nothing(num_segments: int, *, span_s: float, num_entries: int = 24) -> PastMotion:
        """Before the first frame. Raises `ValueError` for a span that is not positive or fewer than 2 entries."""
        if not span_s > 0:
            raise ValueError(f"span_s is {span_s}; expected a positive time.")
        if num_entries < 2:
            raise ValueError(f"num_entries is {num_entries}; expected at least 2.")
        return PastMotion(
            displacement_m=jnp.zeros((num_entries, num_segments, 3)),
            time_s=jnp.full(num_entries, -jnp.inf, float),
            newest=jnp.zeros((), jnp.int32),
            span_s=span_s,
        )

    def add(self, displacement_m: Float[Array, "segment 3"], now_s: Float[Array, ""]) -> PastMotion:
        """With the displacements of this frame, if the last entry is old enough."""
        num_entries = self.time_s.shape[0]
        # Half a millisecond: times are float32 seconds, and frames that are due must not be missed by rounding.
        due = now_s - self.time_s[self.newest] >= self.span_s / (num_entries - 2) - 5e-4
        at = jnp.where(due, (self.newest + 1) % num_entries, self.newest)
        return PastMotion(
            displacement_m=self.displacement_m.at[at].set(jnp.where(due, displacement_m, self.displacement_m[at])),
            time_s=self.time_s.at[at].set(jnp.where(due, now_s, self.time_s[at])),
            newest=at.astype(jnp.int32),
            span_s=self.span_s,
        )

    def inherited(self, newborn_source: Int[Array, " segment"]) -> PastMotion:
        """With the past of new segments that of their sources (slots above 0; -2 = not new), else nothing."""
        at, has = jnp.maximum(newborn_source, 0), newborn_source > 0
        past = jnp.where(has[None, :, None], self.displacement_m[:, at], self.displacement_m)
        none = (newborn_source > -2) & ~has
        return PastMotion(jnp.where(none[None, :, None], 0.0, past), self.time_s, self.newest, self.span_s)

    def since(
        self,
        lag_s: float | Float[Array, ""],
        displacement_m: Float[Array, "segment 3"],
        life_s: Float[Array, " segment"],
        now_s: Float[Array, ""],
    ) -> tuple[Float[Array, "segment 3"], Float[Array, " segment"]]:
        """Each segment's displacement over the last `lag_s` seconds or since its birth, metres, and that time, seconds.

        The entry nearest to the lag is used; before there is any, nothing has moved, over a time of 0.
        """
        at = jnp.argmin(jnp.abs(self.time_s - (now_s - lag_s)))
        used = jnp.isfinite(self.time_s[at])
        elapsed_s = jnp.where(used, now_s - self.time_s[at], 0.0)
        moved_m = jnp.where(used, displacement_m - self.displacement_m[at], 0.0)
        return moved_m, jnp.minimum(elapsed_s, life_s)
