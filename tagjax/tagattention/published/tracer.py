"""TagAttention as published (Shi et al., 2021, III.D-G): Eqs. 3-7 on pixels that move along the flow, and a refined mask.

What the text leaves open is read so that small objects survive (docs/published-tracer.md): every pixel of a frame is
moved, not averaged; K-means refines the mask, and the likelihood is kept; the cut lies in the flat part of the CDF; what
is propagated is bounded below.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from ...core.parameters import check_fractions, check_positive, check_positive_integers
from ...tracing.tracer import MAX_OBJECTS, AbstractTracer, Camera, Frame, Trace
from ..attention import att_corr, att_rbf, attention
from ..frame_trace import describe
from ..propagation import radio_speed
from .clusters import assign, k_means, means, refined, seed_centres
from .transport import filled, moved, nearest_source

_ITERATIONS, _EVERY = 3, 2


class PublishedState(eqx.Module):
    """What is carried from frame to frame; at pixels of the last frame."""

    range_m: Float[Array, "height width"]  # 0 = missing
    history_m: Float[Array, "height width past"]  # of the surface at each pixel, oldest first, before the last frame's
    known: Bool[Array, "height width past"]
    time_s: Float[Array, " window"]
    log_likelihood: Float[Array, "tag height width"]
    centres_m: Float[Array, "cluster 3"]
    num_frames: Float[Array, ""]


class PublishedStages(eqx.Module):
    """What one step computes on its way to the masks, for pictures of the stages; pixels of the working resolution."""

    motion_m: Float[Array, "height width window"]  # rho of Eq. 4: change of range since the window's first frame
    complete: Bool[Array, "height width"]  # the motion is known over the whole window
    step_m: Float[Array, "height width"]  # change of range since the last frame, 0 = unknown
    recent: Bool[Array, "height width"]  # that change is known
    moves: Bool[Array, " tag"]  # Eq. 7: the tag is as fast as v0
    attention: Float[Array, "tag height width"]  # Eq. 6; 0 where the motion is unknown
    carried: Float[Array, "tag height width"]  # the log likelihood of the last frame, moved along the flow
    probability: Float[Array, "tag height width"]  # exp(l), normalised to 0 to 1
    cut: Bool[Array, "tag height width"]  # the mask before the refinement
    mask: Float[Array, "tag height width"]  # the refined mask
    cluster: Int[Array, "height width"]  # K-means cluster of each pixel


def _scalar(value: float | Array) -> Float[Array, ""]:
    return jnp.asarray(value, jnp.float32)


class TagAttentionPublished(AbstractTracer):
    """Eqs. 3-7 and the refinement. beta and v0 are the paper's; the other constants were chosen on training recordings."""

    alpha_m2: Float[Array, ""] = eqx.field(converter=_scalar, default=1e-3)
    beta: Float[Array, ""] = eqx.field(converter=_scalar, default=0.8)
    v0_m_s: Float[Array, ""] = eqx.field(converter=_scalar, default=0.1)
    floor: Float[Array, ""] = eqx.field(converter=_scalar, default=0.01)  # attentions below count as this
    cut: Float[Array, ""] = eqx.field(converter=_scalar, default=0.1)  # of the normalised likelihood
    lowest: Float[Array, ""] = eqx.field(converter=_scalar, default=1e-3)  # a normalised likelihood is at least this
    whole: Float[Array, ""] = eqx.field(converter=_scalar, default=0.3)  # a cluster covered so far is taken whole
    part: Float[Array, ""] = eqx.field(converter=_scalar, default=0.1)  # one covered less than this is left out
    max_step_m: Float[Array, ""] = eqx.field(converter=_scalar, default=0.05)  # of a surface between two frames
    num_clusters: int = eqx.field(static=True, default=192)

    def __check_init__(self) -> None:
        given = {name: leaf for name, leaf in vars(self).items() if not isinstance(leaf, Tracer)}
        positive = given.keys() & {"alpha_m2", "floor", "lowest", "max_step_m"}
        check_positive(**{name: round(float(given[name]), 9) for name in positive})
        fractions = given.keys() & {"beta", "cut", "whole", "part"}
        check_fractions(**{name: round(float(given[name]), 6) for name in fractions})
        if "v0_m_s" in given and not given["v0_m_s"] >= 0:
            raise ValueError(f"v0_m_s is {given['v0_m_s']:g}; expected at least 0.")
        check_positive_integers(num_clusters=self.num_clusters)

    def init(self, camera: Camera, frame: Frame) -> PublishedState:
        height, width = frame.depth_m.shape
        num_tags, num_antennas, num_window = frame.radio.relative_m.shape
        if num_antennas != 1:
            raise ValueError(
                f"The published tracer measures ranges to one antenna; the clip has {num_antennas}. Set clips.antennas=busiest, or to one of them."
            )
        return PublishedState(
            range_m=jnp.zeros((height, width)),
            history_m=jnp.zeros((height, width, num_window - 1)),
            known=jnp.zeros((height, width, num_window - 1), bool),
            time_s=jnp.broadcast_to(frame.time_s, (num_window,)),
            log_likelihood=jnp.zeros((num_tags, height, width)),
            centres_m=jnp.zeros((self.num_clusters, 3)),
            num_frames=jnp.zeros(()),
        )

    def step(self, camera: Camera, state: PublishedState, frame: Frame) -> tuple[PublishedState, Trace]:
        after, stages = self.stages(camera, state, frame)
        points = camera.rays * frame.depth_m[..., None]
        number = jnp.sum(stages.mask, axis=(1, 2))
        centre = jnp.einsum("thw,hwc->tc", stages.mask, points) / jnp.maximum(number, 1.0)[:, None]
        return after, describe(stages.mask, centre, stages.step_m[None], stages.recent)

    def stages(self, camera: Camera, state: PublishedState, frame: Frame) -> tuple[PublishedState, PublishedStages]:
        """The next state, and all that a step computes on its way."""
        points = camera.rays * frame.depth_m[..., None]
        valid = frame.depth_m > 0
        range_m = jnp.where(valid, camera.ranges_m(points)[0], 0.0)
        time_s = jnp.concatenate([state.time_s[1:], frame.time_s[None]])

        # Eq. 3: each pixel of the last frame moves along the flow with its history and its likelihoods.
        source = nearest_source(frame.forward_px, state.range_m)
        source = filled(source, state.range_m, range_m, self.max_step_m)
        before = jnp.concatenate([state.history_m[..., 1:], state.range_m[..., None]], axis=-1)
        was_known = jnp.concatenate([state.known[..., 1:], (state.range_m > 0)[..., None]], axis=-1)
        history, reached = moved(before, source, jnp.zeros(before.shape[-1]))
        known_before, _ = moved(was_known.astype(before.dtype), source, jnp.zeros(before.shape[-1]))
        known = (known_before > 0.5) & reached[..., None]
        window = jnp.concatenate([history, range_m[..., None]], axis=-1)
        complete = jnp.all(known, axis=-1) & valid
        rho = jnp.where(complete[..., None], window - window[..., :1], 0.0)
        least = jnp.min(state.log_likelihood, axis=(1, 2))
        carried, _ = moved(jnp.moveaxis(state.log_likelihood, 0, -1), source, least)

        flat, known_flat = points.reshape(-1, 3), valid.reshape(-1)
        seeds = seed_centres(points, valid, self.num_clusters)
        centres = jnp.where(state.num_frames > 0, state.centres_m, seeds)
        centres = k_means(flat[::_EVERY], known_flat[::_EVERY], centres, num_iterations=_ITERATIONS)
        cluster = assign(flat, centres)
        if frame.objects is not None:
            objects = frame.objects.reshape(-1)
            cluster = jnp.where(objects > 0, self.num_clusters + objects - 1, cluster)

        def one_tag(
            log_likelihood: Float[Array, "height width"],
            relative_m: Float[Array, " window"],
            std_m: Float[Array, " window"],
        ) -> tuple[Array, ...]:
            rd = relative_m - relative_m[0]
            every = jnp.ones(rho.shape, bool)
            radial = att_rbf(rho, rd[None, None], every, self.alpha_m2[None, None])
            agreement = attention(radial, att_corr(rho, rd[None, None], every), self.beta)
            agreement = jnp.where(complete, agreement, 0.0)
            moves = jnp.all(jnp.isfinite(std_m)) & (radio_speed(rd, time_s) >= self.v0_m_s)
            evidence = jnp.where(moves, jnp.log(jnp.maximum(agreement, self.floor)), 0.0)
            return moves, agreement, *self._masked(log_likelihood + evidence, valid, cluster)

        moves, agreement, probability, cut, likelihood, mask = jax.vmap(one_tag)(
            jnp.moveaxis(carried, -1, 0), frame.radio.relative_m[:, 0], frame.radio.std_m[:, 0]
        )
        after = PublishedState(range_m, history, known, time_s, likelihood, centres, state.num_frames + 1)
        recent = known[..., -1] & valid
        stages = PublishedStages(
            motion_m=rho,
            complete=complete,
            step_m=jnp.where(recent, range_m - history[..., -1], 0.0),
            recent=recent,
            moves=moves,
            attention=agreement,
            carried=jnp.moveaxis(carried, -1, 0),
            probability=probability,
            cut=cut,
            mask=mask,
            cluster=cluster.reshape(valid.shape),
        )
        return after, stages

    def _masked(
        self,
        log_likelihood: Float[Array, "height width"],
        valid: Bool[Array, "height width"],
        cluster: Int[Array, " pixel"],
    ) -> tuple[Array, ...]:
        """The normalised likelihood, its cut, the refined likelihood, which is propagated, and the refined mask.

        Where nothing stands out, there is no mask.
        """
        top = jnp.max(jnp.where(valid, log_likelihood, -jnp.inf))
        odds = jnp.where(valid, jnp.exp(log_likelihood - jnp.where(jnp.isfinite(top), top, 0.0)), 0.0)
        least = jnp.min(jnp.where(valid, odds, jnp.inf))
        spread = jnp.where(jnp.isfinite(least), 1.0 - least, 0.0)
        normal = jnp.where(valid & (spread > 0), (odds - least) / jnp.where(spread > 0, spread, 1.0), 0.0)
        cut = valid & (normal >= self.cut) & (spread > 0)
        shape, num = valid.shape, self.num_clusters + MAX_OBJECTS
        mask = refined(cut.reshape(-1), cluster, valid.reshape(-1), num, whole=self.whole, part=self.part)
        mean, _ = means(normal.reshape(-1, 1), mask, cluster, num)
        mask = mask.reshape(shape)
        raised = jnp.where(mask, jnp.maximum(normal, mean[cluster, 0].reshape(shape)), normal)
        return normal, cut, jnp.log(jnp.maximum(raised, self.lowest)), mask.astype(log_likelihood.dtype)

    def finish(self, state: PublishedState) -> PublishedState:
        return state
