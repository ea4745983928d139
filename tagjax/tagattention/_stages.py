"""The stages of the learnable tracer, frame by frame."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core.numerics import safe_sqrt
from ..radio.reads import PhaseReads, RadioWindow
from ..tracing.tracer import MAX_OBJECTS, Camera, Frame, Trace
from ._evidence import AbstractEvidence
from .anchor import Anchor, joined, log_density, lost_drift_m, move_anchor, update_belief, votes
from .background import Background, empty_background, is_background, remember, shows_rest
from .backward_message import BackwardMessage
from .common_fate import common_fate
from .frame_trace import describe
from .motion import MotionMap, PlaceMap, carry, empty_motion, empty_places, push_gather, push_places
from .phase_memory import PhaseMemory, carry_phases
from .propagation import propagate, rival_log_odds, soft_clip
from .segmentation import cdf_cut, compact_cut, diffuse, membership, pool, unpool
from .view import Grouping, Ranging, View, elapsed_s, of_each_antenna, view_of

SIGNIFICANCE = 1e-3
"""Share of the pixels by which the histogram rises at a corner of its CDF."""


MIN_RADIUS_M = 0.05
"""No object is taken to be smaller than this."""


class Place(eqx.Module):
    """Where each tag's object was at the last frame."""

    centre_m: Float[Array, "*tag 3"]
    velocity_m_s: Float[Array, "*tag 3"]
    confidence: Float[Array, "*tag"]
    radius_m: Float[Array, "*tag"]  # root mean square distance of its points from the centre


class Belief(eqx.Module):
    """What a tag's radio says of every pixel by now, as log odds of object against background."""

    log_odds: Float[Array, "*tag height width"]  # what is carried on to the next frame
    held: Float[Array, "*tag height width"]  # spread over segments that are alike
    near: Float[Array, "*tag height width"]  # log density of its range by the anchor


class _Observation(eqx.Module):
    """One frame as a step sees it."""

    view: View
    belief: Belief
    step_m: Float[Array, "antenna height width"]
    recent: Bool[Array, "height width"]
    shift_m: Float[Array, "rows columns 3"]  # of each segment in space over the window,
    shifted: Float[Array, "rows columns"]  # and of how many of its pixels that is known


class TagAttentionState(eqx.Module):
    """Everything a frame hands to the next: fixed shapes, whatever the length of the recording."""

    motion: MotionMap
    places: PlaceMap
    time_s: Float[Array, " window"]
    log_odds: Float[Array, "tag height width"]
    fate: Float[Array, "tag height width"]  # log odds, at most 0, of moving in space as the tag's object does
    place: Place
    anchor: Anchor
    background: Background
    phases: PhaseMemory


class AbstractStages(AbstractEvidence):
    """One frame after the other: motion, evidence, propagation, pooling and the cut, for all tags."""

    def init(self, camera: Camera, frame: Frame) -> TagAttentionState:
        height, width = frame.depth_m.shape
        num_tags, num_antennas, num_window = frame.radio.relative_m.shape
        return TagAttentionState(
            motion=jax.vmap(lambda _: empty_motion(height, width, num_window))(camera.antennas_m),
            places=empty_places(height, width, num_window),
            time_s=jnp.broadcast_to(frame.time_s, (num_window,)),
            log_odds=jnp.zeros((num_tags, height, width)),
            fate=jnp.zeros((num_tags, height, width)),
            place=Place(
                jnp.zeros((num_tags, 3)),
                jnp.zeros((num_tags, 3)),
                jnp.zeros(num_tags),
                jnp.broadcast_to(jnp.exp(self.log_extent), (num_tags,)),
            ),
            anchor=Anchor.unknown(num_tags, num_antennas, num_window=num_window, num_bins=self.anchor_bins),
            background=empty_background(num_tags, height, width),
            phases=PhaseMemory.nothing(num_tags, num_antennas, height, width),
        )

    def step(self, camera: Camera, state: TagAttentionState, frame: Frame) -> tuple[TagAttentionState, Trace]:
        state, seen = self._observe(camera, state, frame)
        view, belief, moved = seen.view, seen.belief, state.phases.moved
        if frame.backward_message is not None:
            belief = jax.vmap(self._with_hindsight, in_axes=(None, 0, 0, 0))(
                view, belief, state.anchor, frame.backward_message
            )
            moved = jnp.maximum(moved, frame.backward_message.moved)
        rivals = soft_clip(rival_log_odds(belief.held + belief.near), jnp.exp(self.log_rivalry))
        shown = jax.vmap(self._shown, in_axes=(None, 0, 0))(view, belief, rivals)
        fate, shared = jax.vmap(self._share_fate, in_axes=(None, 0, 0, 0))(seen, shown, state.fate, state.place)
        mask, place, sure = jax.vmap(self._locate, in_axes=(None, 0, 0, 0))(view, belief, shown + shared, state.place)
        # Whether there is anything to claim is doubted, not where it is: the place is kept as it is.
        confidence = jax.nn.sigmoid(sure - self._doubt(jnp.max(moved, axis=1)))
        out = describe(mask, place.centre_m, seen.step_m, seen.recent, confidence, self.box_tail)
        # The place prior feeds its own result back; gradients through that loop grow without bound within a second.
        return eqx.tree_at(lambda one: (one.fate, one.place), state, (fate, jax.lax.stop_gradient(place))), out

    def backward_step(
        self, camera: Camera, state: TagAttentionState, frame: Frame
    ) -> tuple[TagAttentionState, BackwardMessage]:
        state, seen = self._observe(camera, state, frame)
        return state, BackwardMessage(seen.belief.log_odds, state.anchor, state.phases.moved)

    def compact(self, message: BackwardMessage) -> BackwardMessage:
        return eqx.tree_at(lambda one: one.log_odds, message, message.log_odds.astype(jnp.float16))

    def _observe(
        self, camera: Camera, state: TagAttentionState, frame: Frame
    ) -> tuple[TagAttentionState, _Observation]:
        """What is believed by this frame and those before it; the next state, but for the objects' places."""
        points = camera.rays * frame.depth_m[..., None]
        valid = frame.depth_m > 0
        distances = jnp.where(valid[None], camera.ranges_m(points), 0.0)
        distance = distances[0]
        time_s = jnp.concatenate([state.time_s[1:], frame.time_s[None]])
        # What shows the surface that has always been there has not moved, whatever shadow runs over it.
        rests = shows_rest(state.background, distance, valid)
        backward_px = jnp.where(rests[..., None], 0.0, frame.backward_px)
        max_step_m = self.max_speed_m_s * elapsed_s(time_s) + 0.05
        motion = of_each_antenna(
            lambda one, distance_m: push_gather(one, backward_px, distance_m, max_step_m), state.motion, distances
        )
        followed = jnp.all(motion.valid[..., -2], axis=0)
        recent = followed & valid
        step_m = jnp.where(recent[None], motion.distance_m[..., -1] - motion.distance_m[..., -2], 0.0)
        grouping = Grouping(
            temperature=jnp.exp(self.log_segment_temperature),
            affinity_length=jnp.exp(self.log_affinity_length),
            affinity_speed_m_s=jnp.exp(self.log_affinity_speed),
            pool_motion=jax.nn.sigmoid(self.logit_pool_motion),
            cell=self.cell,
        )
        objects = None if frame.objects is None else membership(frame.objects, MAX_OBJECTS)
        view = view_of(camera, points, distances, valid, motion, step_m, time_s, state.background, grouping, objects)

        both = jnp.moveaxis(jnp.concatenate([state.log_odds, state.fate]), 0, -1)
        moved, fate = jnp.split(jnp.moveaxis(carry(both, backward_px, jnp.zeros(())), -1, 0), 2)
        # A surface that was hidden a frame ago brings no history of its own, but for what its pixel remembers.
        shows = is_background(state.background, distance, valid)
        recalled = jnp.where(shows[None], state.background.log_odds, 0.0)
        carried = jnp.where((followed | ~valid)[None], moved, recalled)

        phases = carry_phases(state.phases, backward_px, followed)
        places = push_places(state.places, backward_px, points, max_step_m)
        shift_m, known = places.shift_m()
        shift_m, shifted = pool(view.segments, shift_m, known.astype(shift_m.dtype))

        belief, anchor, phases = jax.vmap(self._believe, in_axes=(None, 0, 0, 0, 0, 0))(
            view, carried, frame.radio, frame.reads, state.anchor, phases
        )
        background = remember(state.background, distance, valid, belief.log_odds)
        state = TagAttentionState(
            motion=motion,
            places=places,
            time_s=time_s,
            log_odds=belief.log_odds,
            fate=jnp.where(followed[None], fate, 0.0),
            place=state.place,
            anchor=anchor,
            background=background,
            phases=phases,
        )
        return state, _Observation(view, belief, step_m, recent, shift_m, shifted)

    def finish(self, state: TagAttentionState) -> TagAttentionState:
        return state

    def _believe(
        self,
        view: View,
        carried: Float[Array, "height width"],
        radio: RadioWindow,
        reads: PhaseReads,
        anchor: Anchor,
        phases: PhaseMemory,
    ) -> tuple[Belief, Anchor, PhaseMemory]:
        """What one tag's radio says of every pixel by now; radio, reads, anchor, phases per antenna."""
        gates = jax.vmap(self._gate, in_axes=(0, None))(radio, view.time_s)
        evidence, gate = self._weighed_evidence(view, radio, reads, gates)
        anchor, nears = of_each_antenna(
            functools.partial(self._update_anchor, view, evidence), view.ranging, anchor, radio, gates
        )
        near = jnp.sum(nears, axis=0)
        evidence = evidence + jnp.exp(self.log_anchor_rate) * near
        log_odds = propagate(carried, evidence, gate, jnp.exp(-view.elapsed_s / jnp.exp(self.log_memory)))
        told, phases = of_each_antenna(functools.partial(self._phase_evidence, view), view.ranging, reads, phases)
        log_odds = log_odds + jnp.sum(told, axis=0)
        log_odds = soft_clip(log_odds, jnp.exp(self.log_evidence_limit))

        return Belief(*self._spread(view, log_odds), near), anchor, phases

    def _spread(
        self, view: View, log_odds: Float[Array, "height width"]
    ) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
        """Log odds shared within segments, and besides among segments that are alike."""
        share = jax.nn.sigmoid(self.logit_pool_log_odds)
        pooled, _ = pool(view.segments, log_odds[..., None], view.valid.astype(log_odds.dtype))

        def refine(grid: Float[Array, "rows columns"]) -> Float[Array, "height width"]:
            mixed = (1.0 - share) * log_odds + share * unpool(view.segments, grid[..., None])[..., 0]
            return jnp.where(view.valid, mixed, log_odds)

        spread = diffuse(pooled[..., 0], view.affinity, jax.nn.sigmoid(self.logit_diffusion))
        return refine(pooled[..., 0]), refine(spread)

    def _with_hindsight(self, view: View, belief: Belief, anchor: Anchor, later: BackwardMessage) -> Belief:
        """What one tag's radio says by all frames, those to come included: two-filter smoothing (Fraser and Potter, 1969).

        Up to this frame and from it on motion and reads are different ones, so their log odds add up; anchors per antenna.
        """
        log_odds = soft_clip(belief.log_odds + later.log_odds, jnp.exp(self.log_evidence_limit))
        nears = of_each_antenna(
            lambda ranging, past, future: self._near(view, ranging, joined(past, future)),
            view.ranging,
            anchor,
            later.anchor,
        )
        return Belief(*self._spread(view, log_odds), jnp.sum(nears, axis=0))

    def _shown(self, view: View, belief: Belief, rivals: Float[Array, "height width"]) -> Float[Array, "height width"]:
        """One tag's log odds of what can be cut out: by radio, rivals, and what stands before the background."""
        held, near = belief.held, belief.near
        # Where nothing else can be its object, a tag shares one with its rivals. A maximum has the gradient 0 / 0 where it
        # is computed once more and rounded otherwise, as in the backward pass; and far from even odds it has none.
        elsewhere = jax.lax.stop_gradient(jnp.max(jnp.where(view.valid, held + near - rivals, -9.0)))
        rivals = rivals * jax.nn.sigmoid(elsewhere)
        # What carries the tag moves, so it stands before what has always been there; but where it began it is itself
        # what is remembered, and evidence outweighs that.
        front = jnp.where(view.front < 0, view.front * jax.nn.sigmoid(-held), view.front)
        return held + near + jnp.exp(self.log_foreground_weight) * front - rivals

    def _share_fate(
        self,
        seen: _Observation,
        shown: Float[Array, "height width"],
        carried: Float[Array, "height width"],
        place: Place,
    ) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
        """One tag's log odds by common fate, as they are carried on and as segments share them.

        They tell what else belongs to an object that was claimed at the last frame, not which object is the tag's.
        """
        view = seen.view
        weight = view.valid.astype(shown.dtype)
        before, _ = pool(view.segments, (shown + carried)[..., None], weight)
        told = common_fate(
            seen.shift_m,
            seen.shifted,
            before[..., 0],
            spread_m=jnp.exp(self.log_fate_spread),
            slack=jnp.exp(self.log_fate_slack),
            floor=jnp.exp(self.log_floor),
        )
        claimed = jax.nn.relu(2.0 * place.confidence - 1.0)
        told = unpool(view.segments, (jnp.exp(self.log_fate_weight) * claimed * told)[..., None])[..., 0]
        kept = jnp.exp(-view.elapsed_s / jnp.exp(self.log_memory))
        fate = propagate(carried, told, jnp.ones(()), kept)
        shared = unpool(view.segments, pool(view.segments, fate[..., None], weight)[0])[..., 0]
        return fate, jnp.where(view.valid, shared, 0.0)

    def _locate(
        self,
        view: View,
        belief: Belief,
        shown: Float[Array, "height width"],
        place: Place,
    ) -> tuple[Float[Array, "height width"], Place, Float[Array, ""]]:
        """One tag's soft mask, place, and log odds of the claim, which rest on the radio alone."""
        predicted = place.centre_m + place.velocity_m_s * view.elapsed_s * jax.nn.sigmoid(self.logit_inertia)
        mask, centre = self._cut(view, shown, predicted, place)
        told = belief.log_odds + jax.nn.sigmoid(self.logit_range_share) * belief.near
        sure = jnp.max(jnp.where((mask > 0.5) & view.valid, told, -9.0))
        confidence = jax.nn.sigmoid(sure)
        both = (place.confidence > 0.5) & (confidence > 0.5)
        move = jnp.clip((centre - place.centre_m) / view.elapsed_s, -self.max_speed_m_s, self.max_speed_m_s)
        velocity = jnp.where(both, 0.5 * place.velocity_m_s + 0.5 * move, 0.0)
        away = jnp.sum(jnp.square(view.points_m - centre[None, None]), axis=-1)
        radius = safe_sqrt(jnp.sum(mask * away) / jnp.maximum(jnp.sum(mask), 1e-6))
        rate = jax.nn.sigmoid(self.logit_size_rate)
        size_m = jnp.where(confidence > 0.5, (1.0 - rate) * place.radius_m + rate * radius, place.radius_m)
        return mask, Place(centre, velocity, confidence, size_m), sure

    def _doubt(self, moved: Float[Array, "*tag"]) -> Float[Array, "*tag"]:
        """Log odds that a claim loses, by the evidence of the tag's reads that it has moved at all, in nats."""
        return self.rest_doubt * jnp.exp(-moved / self.rest_nats)

    def _update_anchor(
        self,
        view: View,
        evidence: Float[Array, "height width"],
        ranging: Ranging,
        anchor: Anchor,
        radio: RadioWindow,
        gate: Float[Array, ""],
    ) -> tuple[Anchor, Float[Array, "height width"]]:
        """Move one antenna's anchor with its radio, let the segments that agree with the tag vote for its range.

        Also the log density of what the anchor then believes, at each pixel's range.
        """
        heard = jnp.all(jnp.isfinite(radio.std_m))
        drift = jnp.where(heard, jnp.exp(self.log_anchor_drift), lost_drift_m(view.time_s))
        anchor = move_anchor(anchor, radio.relative_m, heard, drift)
        told, _ = pool(view.segments, evidence[..., None], view.valid.astype(evidence.dtype))
        vote = votes(
            anchor,
            ranging.segment_range_m.reshape(-1),
            told.reshape(-1),
            view.segment_mass.reshape(-1) > 1.0,
            jnp.exp(self.log_anchor_width),
            self.anchor_unseen,
        )
        anchor = update_belief(anchor, vote, jnp.exp(self.log_anchor_weight) * gate)
        return anchor, self._near(view, ranging, anchor)

    def _near(self, view: View, ranging: Ranging, anchor: Anchor) -> Float[Array, "height width"]:
        """The log density of what an anchor believes, at each pixel's range."""
        near = log_density(anchor, ranging.distance_m, jnp.exp(self.log_anchor_depth), jnp.exp(self.log_anchor_limit))
        return near * view.valid.astype(near.dtype)

    def _cut(
        self,
        view: View,
        log_odds: Float[Array, "height width"],
        predicted_m: Float[Array, " 3"],
        place: Place,
    ) -> tuple[Float[Array, "height width"], Float[Array, " 3"]]:
        """The soft mask, and the object's centre: log odds with the place prior, cut, kept to one compact thing."""
        width = jnp.exp(self.log_cut_width)
        if self.cut_rule == "cdf_corner":
            mask = cdf_cut(log_odds, view.valid, jnp.asarray(SIGNIFICANCE), 0.1 * width)
            total = jnp.maximum(jnp.sum(mask), 1e-6)
            return mask, jnp.sum(view.points_m * mask[..., None], axis=(0, 1)) / total
        away = jnp.sum(jnp.square(view.points_m - predicted_m[None, None]), axis=-1)
        reach = jnp.exp(self.log_prior_reach) * jnp.maximum(place.radius_m, MIN_RADIUS_M)
        near = jnp.exp(-away / (2.0 * jnp.square(reach)))
        prior = jnp.exp(self.log_prior_weight) * jax.nn.relu(2.0 * place.confidence - 1.0) * (2.0 * near - 1.0)
        return compact_cut(
            view.points_m,
            view.valid,
            log_odds + prior,
            level=self.cut,
            share=jax.nn.sigmoid(self.logit_cut_share),
            margin=jnp.exp(self.log_cut_margin),
            width=width,
            extent_m=jnp.exp(self.log_extent),
        )
