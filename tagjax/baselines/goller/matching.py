"""Which blob carries a tag (Goller et al., III.C): Gaussian distance, background by velocity, HMM forward filter."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

_MIN_PROBABILITY = 1e-12


class AssociationModel(eqx.Module):
    """The standard deviations of Eqs. 2-4, the rate of state changes, and the density of outliers."""

    log_distance_m: Float[Array, " 2"]  # sigma_x, sigma_y of Eq. 3
    log_speed_m_s: Float[Array, ""]  # sigma_v of the velocity of a tag in the background
    log_switch_hz: Float[Array, ""]
    log_clutter: Float[Array, ""]  # added to every density, so that one outlier decides nothing


def make_association(
    *,
    distance_m: tuple[float, float] = (0.8, 0.6),
    speed_m_s: float = 0.6,
    switch_hz: float = 0.05,
    clutter: float = 3e-3,
) -> AssociationModel:
    """An `AssociationModel` from values that must be positive."""
    values = {"speed_m_s": speed_m_s, "switch_hz": switch_hz, "clutter": clutter}
    for name, value in {"distance_m": min(distance_m), **values}.items():
        if not value > 0:
            raise ValueError(f"{name} is {value}; expected a positive number.")
    return AssociationModel(
        jnp.asarray(np.log(distance_m), jnp.float32), *(jnp.asarray(np.log(v), jnp.float32) for v in values.values())
    )


def _log_gaussian(offset: Float[Array, " 2"], log_width: Float[Array, " 2"]) -> Float[Array, ""]:
    """Log of the zero-mean Gaussian of two axes (Eq. 2)."""
    scaled = offset * jnp.exp(-log_width)
    return -0.5 * jnp.sum(jnp.square(scaled)) - jnp.sum(log_width) - jnp.log(2.0 * jnp.pi)


def assignment_row(
    model: AssociationModel,
    tag_m: Float[Array, " 2"],
    velocity_m_s: Float[Array, " 2"],
    blob_m: Float[Array, "slots 2"],
) -> Float[Array, " states"]:
    """One tag's row of the assignment matrix (Eq. 5), as logs: background first, then every blob slot.

    A blob's entry is the Gaussian of its distance to the tag (Eqs. 2, 3), the background's that of the tag's velocity
    (Eq. 4); `clutter` is added to each.
    """
    wide = jnp.broadcast_to(model.log_speed_m_s, (2,))
    still = _log_gaussian(velocity_m_s, wide)
    near = jax.vmap(lambda position: _log_gaussian(tag_m - position, model.log_distance_m))(blob_m)
    row = jnp.concatenate([still[None], near])
    return jnp.logaddexp(row, jnp.broadcast_to(model.log_clutter, row.shape))


class Associations(eqx.Module):
    """State probabilities of a tag at every frame; the last axis is background, then blob slots."""

    probability: Float[Array, "*time states"]
    log_evidence: Float[Array, "*time"]  # log likelihood of the frame's observation given earlier ones; 0 without one


class AssociationState(eqx.Module):
    """State probabilities of a tag after a frame, and the identities in the slots at that frame."""

    probability: Float[Array, " states"]
    identity: Int[Array, " slots"]


def forward_start(num_slots: int) -> AssociationState:
    """Before the first frame: no state has probability, which makes the prior of the first frame uniform."""
    return AssociationState(jnp.zeros(1 + num_slots), jnp.zeros(num_slots, jnp.int32))


def forward_step(
    model: AssociationModel,
    state: AssociationState,
    elapsed_s: Float[Array, ""],
    row: Float[Array, " states"],
    identity: Int[Array, " slots"],
    observed: Bool[Array, ""],
) -> tuple[AssociationState, Associations]:
    """One frame of the HMM's forward filter (Eq. 6): p_t ~ B_t A_t^T p_{t-1}.

    `row` is the logarithm of the assignment row, `identity` the blob in each slot, 0 = none. A tag keeps its state with
    probability exp(-switch * frame interval), otherwise it changes to any other present state with equal probability.
    The probability of a blob that disappeared, or whose slot another blob took, is distributed evenly over the present
    states. A frame without an observation only applies the transition. Without any blob the background has probability
    1.
    """
    is_present = jnp.concatenate([jnp.ones(1, bool), identity > 0])
    same = jnp.concatenate([jnp.ones(1, bool), (identity > 0) & (identity == state.identity)])
    present = is_present.astype(row.dtype)
    num = jnp.sum(present)
    carried = jnp.where(same, state.probability, 0.0)
    carried = carried + (1.0 - jnp.sum(carried)) * present / num
    stay = jnp.where(num > 1, jnp.exp(-jnp.exp(model.log_switch_hz) * elapsed_s), 1.0)
    # Without other states stay is 1, and the divisor does not matter.
    moved = (1.0 - stay) * (jnp.sum(carried) - carried) / jnp.maximum(num - 1.0, 1.0)
    # A state of probability 0 would never recover, whatever is observed.
    predicted = jnp.where(is_present, stay * carried + moved + _MIN_PROBABILITY, 0.0)
    best = jax.lax.stop_gradient(jnp.max(jnp.where(is_present, row, -jnp.inf)))
    relative = jnp.where(is_present, jnp.exp(jnp.where(is_present, row - best, 0.0)), 0.0)
    joint = predicted * jnp.where(observed, relative, present)
    total = jnp.sum(joint)
    posterior = joint / total
    evidence = jnp.where(observed, jnp.log(total) + best, 0.0)
    return AssociationState(posterior, identity), Associations(posterior, evidence)


def forward_filter(
    model: AssociationModel,
    time_s: Float[Array, " time"],
    rows: Float[Array, "time states"],
    identity: Int[Array, "time slots"],
    observed: Bool[Array, " time"],
) -> Associations:
    """Filter a tag's assignments over all frames from a uniform prior, with one `lax.scan` of `forward_step`."""
    step_s = jnp.diff(time_s, prepend=time_s[:1])
    start = forward_start(identity.shape[1])
    start = AssociationState(start.probability.astype(rows.dtype), start.identity.astype(identity.dtype))
    _, out = jax.lax.scan(
        lambda state, frame: forward_step(model, state, *frame), start, (step_s, rows, identity, observed)
    )
    return out


def associate(
    model: AssociationModel,
    time_s: Float[Array, " time"],
    tag_m: Float[Array, "time 2"],
    velocity_m_s: Float[Array, "time 2"],
    observed: Bool[Array, " time"],
    blob_m: Float[Array, "time slots 2"],
    identity: Int[Array, "time slots"],
) -> Associations:
    """One tag's assignments over all frames: `assignment_row` of each frame, then `forward_filter`."""
    rows = jax.vmap(assignment_row, in_axes=(None, 0, 0, 0))(model, tag_m, velocity_m_s, blob_m)
    return forward_filter(model, time_s, rows, identity, observed)
