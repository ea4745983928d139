"""Motion pooled over what travels together: closed forms, gradients, compiled or not."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from segments_scenes import segment_frame

from tagjax.tagattention.segments import CarryingBody, TravellingTogether

NUM = 24
AREA = jnp.full(NUM, 16.0).at[0].set(500.0)
GOES_ON = jnp.full(NUM, -2, jnp.int32)


def walker(num_frames: int = 20, *, noise_m: float = 0.0, rate_hz: float = 10.0, apart: bool = False):
    """A trunk (1 to 12) that travels 1.2 m/s, a leg (13 to 18) that swings by 10 cm about it, and a shape at rest beside.

    Where `apart`, the leg stays behind instead, as an arm does. Yields centre, motion and time.
    """
    rng = np.random.default_rng(0)
    start = np.zeros((NUM, 3)) + np.array([0.0, 0.0, 4.0])
    start[1:13] += rng.uniform([-0.15, -0.3, 0.0], [0.15, 0.3, 0.1], (12, 3))
    start[13:19] += np.stack([np.zeros(6), np.linspace(0.35, 0.7, 6), np.zeros(6)], axis=-1)
    start[19:] += rng.uniform([0.9, -0.3, 0.0], [1.2, 0.3, 0.1], (5, 3))
    last = start
    for frame in range(num_frames):
        time_s, at = frame / rate_hz, start.copy()
        at[1:13, 0] += 1.2 * time_s
        at[13:19, 0] += 0.2 * time_s if apart else 1.2 * time_s + 0.1 * np.sin(2 * np.pi * time_s)
        error = rng.normal(0, noise_m, (NUM, 3)) if frame else np.zeros((NUM, 3))
        yield (
            jnp.asarray(at, jnp.float32),
            jnp.asarray(at - last + error, jnp.float32),
            jnp.asarray(time_s, jnp.float32),
        )
        last = at


@eqx.filter_jit
def stepped(stage: TravellingTogether, *arguments):
    """`step`, compiled once for all tests."""
    return stage.step(*arguments)


def travelled(stage: TravellingTogether, frames):
    """Each frame with pooled motion, and the pooling."""
    state, last_s = stage.init(NUM), jnp.asarray(-0.1)
    for centre, motion, now_s in frames:
        state, found, pooling = stepped(stage, state, segment_frame(centre, motion, area=AREA), last_s, now_s)
        last_s = now_s
        yield found, pooling


def test_pooling_averages_errors_away_and_leaves_what_travels_otherwise():
    noisy = list(walker(noise_m=0.02))
    errors, plain = [], []
    for (_, motion, _), (travel, _), (_, true, _) in zip(
        noisy, travelled(TravellingTogether(), noisy), walker(), strict=True
    ):
        errors.append(travel.increment_m[0, 1:13] - true[1:13, 0])
        plain.append(motion[1:13, 0] - true[1:13, 0])
    assert np.std(errors[8:]) < 0.5 * np.std(plain[8:])
    *_, (travel, pooling) = travelled(TravellingTogether(), walker(apart=True))
    np.testing.assert_allclose(travel.increment_m[0, 1:13], 0.12, atol=2e-3)
    np.testing.assert_allclose(travel.increment_m[0, 13:19], 0.02, atol=2e-3)
    np.testing.assert_allclose(jnp.sum(pooling.weight, axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("apart", [False, True])
def test_a_swinging_leg_belongs_to_the_walker_and_what_stays_behind_does_not(apart):
    evidence = jnp.zeros((1, NUM)).at[0, 1:13].set(60.0).at[0, 13:19].set(40.0)
    body, last_s = CarryingBody(), jnp.asarray(-0.1)
    state, bodies = body.init(1, NUM), None
    step = eqx.filter_jit(body.step)
    frames = list(walker(apart=apart))
    for (_, _, now_s), (travel, _) in zip(frames, travelled(TravellingTogether(), frames), strict=True):
        now = eqx.tree_at(lambda one: one.size_m, travel, jnp.full(NUM, 0.1))
        state, bodies = step(state, evidence, now, last_s, now_s)
        last_s = now_s
    member = np.asarray(bodies.log_odds)[0] > 0
    assert member[1:13].all()
    assert not member[19:].any()
    assert member[13:19].all() if not apart else not member[13:19].any()


def test_a_new_segment_goes_on_from_its_source_or_the_nearest_mover():
    stage = TravellingTogether()
    state, last_s = stage.init(NUM), jnp.asarray(-0.1)
    frames = list(walker())
    for centre, motion, now_s in frames[:-1]:
        state, _, _ = stepped(stage, state, segment_frame(centre, motion, area=AREA), last_s, now_s)
        last_s = now_s
    centre, motion, now_s = frames[-1]
    source = GOES_ON.at[5].set(3).at[13].set(-1).at[20].set(-1)
    _, travel, _ = stepped(stage, state, segment_frame(centre, motion, area=AREA, source=source), last_s, now_s)
    np.testing.assert_allclose(travel.displacement_m[5], state.displacement_m[3], atol=1e-6)
    assert int(travel.source[13]) in range(1, 19)
    assert float(travel.displacement_m[13, 0]) > 1.5
    assert int(travel.source[20]) == -1
    assert float(travel.life_s[20]) == pytest.approx(0.1, abs=1e-3)
    assert int(travel.source[5]) == 3
    assert int(travel.source[0]) == -2


def test_evidence_heals_towards_that_of_what_travels_together():
    stage = TravellingTogether()
    *_, (_, pooling) = travelled(stage, walker())
    log_likelihood = jnp.full((1, NUM), 0.0).at[0, 1:19].set(50.0).at[0, 4].set(0.0)
    healed = stage.heal(pooling, log_likelihood, jnp.asarray(1.0))
    assert 30.0 < float(healed[0, 4]) < 50.0
    assert float(healed[0, 20]) < 1e-3
    np.testing.assert_allclose(stage.heal(pooling, log_likelihood, jnp.asarray(0.0)), log_likelihood, atol=1e-4)


def test_gradients_are_finite_and_compiled_is_eager():
    stage = TravellingTogether()
    frames = jax.tree.map(lambda *leaves: jnp.stack(leaves), *walker(6))

    def total(learned):
        stage, scale = learned

        def step(carry, frame):
            state, last_s = carry
            centre, motion, now_s = frame
            state, travel, pooling = stage.step(state, segment_frame(centre, scale * motion, area=AREA), last_s, now_s)
            evidence = jnp.cumsum(jnp.abs(travel.increment_m), axis=1) * 100.0
            evidence = stage.heal(pooling, evidence, now_s - last_s)
            return (state, now_s), jnp.sum(jnp.sin(evidence)) + jnp.sum(travel.displacement_m)

        return jnp.sum(jax.lax.scan(step, (stage.init(NUM), jnp.asarray(-0.1)), frames)[1])

    given = stage, jnp.ones(())
    compiled, gradients = eqx.filter_jit(eqx.filter_value_and_grad(total))(given)
    leaves = jax.tree.leaves(eqx.filter(gradients, eqx.is_inexact_array))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in leaves)
    assert float(jnp.abs(leaves[-1])) > 0
    with jax.disable_jit():
        np.testing.assert_allclose(compiled, total(given), rtol=1e-3)


@pytest.mark.parametrize("arguments", [{"num_active": 0}, {"num_newborn": 0}, {"lag_s": 0.0}, {"reach_m": -1.0}])
def test_wrong_travel_settings_are_refused(arguments):
    with pytest.raises(ValueError, match="expected"):
        TravellingTogether(**arguments)


def test_a_gradient_does_not_grow_with_the_frames():
    """Where parts drift apart, what is pooled with what depends on all frames before: that path is left out of the gradient."""
    stage, frames = TravellingTogether(), list(walker(60, noise_m=0.02, apart=True))

    def last(moved_m: jax.Array) -> jax.Array:
        """The displacements at the end, if those of the second frame were other by this."""
        state, last_s = stage.init(NUM), jnp.asarray(-0.1)
        for number, (centre, motion, now_s) in enumerate(frames):
            given = segment_frame(centre, motion + (moved_m if number == 1 else 0.0), area=AREA)
            state, *_ = stepped(stage, state, given, last_s, now_s)
            last_s = now_s
        return state.displacement_m[:, 0]

    slope = jax.jacrev(last)(jnp.zeros((NUM, 3)))
    assert float(jnp.max(jnp.sum(jnp.abs(slope), axis=(1, 2)))) <= 1.0 + 1e-4
    np.testing.assert_allclose(jnp.sum(slope[1:13, :, 0], axis=1), 1.0, atol=1e-4)  # what all move by, each moves by
