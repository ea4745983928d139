"""Rigid motion, past motion, and the body that carries a tag: closed forms, an independent reference, gradients."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from segments_scenes import segment_frame

from tagjax.tagattention.segments import CarryingBody, RigidMotion, SegmentFrame
from tagjax.tagattention.segments.past_motion import PastMotion
from tagjax.tagattention.segments.rigid import best_rotation, rigid_fit


def cloud(seed: int, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Points of a body of 20 cm, 2 m away, and weights."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.1, 0.1, (count, 3)) + np.array([0.3, -0.1, 2.0]), rng.uniform(0.1, 1.0, count)


fitted = jax.jit(rigid_fit)
log_ratio = eqx.filter_jit(RigidMotion.log_ratio)


def f32(values) -> jax.Array:
    return jnp.asarray(values, jnp.float32)


@pytest.mark.parametrize("seed", range(5))
def test_the_fit_is_that_of_scipy(seed):
    rng = np.random.default_rng(seed + 100)
    before, weight = cloud(seed)
    turn = Rotation.from_rotvec(rng.normal(0, 0.6, 3))
    after = turn.apply(before) + rng.normal(0, 0.2, 3) + rng.normal(0, 0.004, before.shape)
    middles = [np.average(points, axis=0, weights=weight) for points in (before, after)]
    expected = Rotation.align_vectors(after - middles[1], before - middles[0], weights=weight)[0]
    rotation, shift_m = fitted(f32(weight), f32(before), f32(after), jnp.zeros(()))
    np.testing.assert_allclose(rotation, expected.as_matrix(), atol=2e-4)
    np.testing.assert_allclose(shift_m, middles[1] - expected.as_matrix() @ middles[0], atol=1e-3)


def test_a_rigid_motion_is_found_exactly():
    before, weight = cloud(1)
    turn, shift_m = Rotation.from_euler("zyx", [0.4, -0.7, 0.2]), np.array([0.05, -0.1, 0.2])
    after = turn.apply(before) + shift_m
    rotation, found_m = fitted(f32(weight), f32(before), f32(after), jnp.zeros(()))
    np.testing.assert_allclose(before @ np.asarray(rotation).T + np.asarray(found_m), after, atol=2e-5)


@pytest.mark.parametrize("points", ["one", "line", "none"])
def test_where_no_axis_is_determined_no_turn_is_taken_about_it(points):
    before, weight = cloud(2, 8)
    if points == "one":
        before[:] = before[0]
    elif points == "line":
        before[:] = before[:1] + np.linspace(-0.1, 0.1, 8)[:, None] * np.array([0.0, 1.0, 0.0])
    else:
        weight[:] = 0
    after = before + 0.05
    given = f32(weight), f32(before)
    rotation, shift_m = fitted(*given, f32(after), jnp.asarray(1e-4))
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-3)
    np.testing.assert_allclose(shift_m, 0.0 if points == "none" else 0.05, atol=3e-3)
    gradient = jax.jit(jax.grad(lambda y: jnp.sum(rigid_fit(*given, y, jnp.asarray(1e-4))[0])))(f32(after))
    assert bool(jnp.all(jnp.isfinite(gradient)))


def test_shrinking_turns_the_body_less():
    before, _ = cloud(3)
    centred = before - before.mean(axis=0)
    covariance = jnp.asarray(centred.T @ Rotation.from_rotvec([0, 0, 0.5]).apply(centred) / len(centred), jnp.float32)
    angles = [
        Rotation.from_matrix(np.asarray(best_rotation(covariance, jnp.asarray(shrink)))).magnitude()
        for shrink in (0.0, 0.003, 0.03, 3.0)
    ]
    assert angles[0] == pytest.approx(0.5, abs=1e-3)
    assert angles == sorted(angles, reverse=True)
    assert angles[-1] < 0.01


def test_the_gradient_of_the_log_ratio_agrees_with_finite_differences():
    with jax.enable_x64(True):
        before, weight = cloud(4, 12)
        after = Rotation.from_rotvec([0.1, 0.2, 0.1]).apply(before) + 0.03
        after[6:] += np.array([0.0, 0.02, -0.01])
        rigid = RigidMotion(lags_s=(0.3,), least=50.0, most=50.0)
        rigid = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), rigid)
        known = jnp.ones((1, 12), bool)

        @jax.jit
        def total(y):
            return jnp.sum(jnp.sin(rigid.log_ratio(jnp.asarray(weight), jnp.asarray(before)[None], known, y)))

        gradient = np.asarray(jax.grad(total)(jnp.asarray(after)))
        direction = np.random.default_rng(0).normal(size=after.shape)
        step = 1e-6
        ahead, back = total(jnp.asarray(after + step * direction)), total(jnp.asarray(after - step * direction))
        assert float(ahead - back) / (2 * step) == pytest.approx(float(np.sum(gradient * direction)), rel=1e-4)


def test_the_log_ratio_is_that_of_two_normal_distributions():
    rigid = RigidMotion(
        lags_s=(0.3,), noise_m=0.005, noise_fraction=0.1, travel_per_m=0.5, other_fraction=0.7, least=99.0, most=99.0
    )
    before = jnp.asarray(cloud(5, 6)[0], jnp.float32)
    after = before + jnp.array([[0.1, 0.0, 0.0]])
    after = after.at[5].add(jnp.array([0.0, 0.03, 0.0]))
    weight = jnp.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    ratio = log_ratio(rigid, weight, before[None], jnp.ones((1, 6), bool), after)
    moved = np.array([0.1, np.hypot(0.1, 0.03)])
    inside = 0.005**2 + (0.1 * moved) ** 2 + (0.5 * 0.1**2) ** 2
    outside = inside + (0.7 * moved) ** 2
    expected = 1.5 * np.log(outside / inside) - 0.5 * np.array([0.0, 0.03]) ** 2 * (1 / inside - 1 / outside)
    np.testing.assert_allclose(ratio[jnp.array([0, 5])], expected, rtol=2e-3)


def test_a_lag_counts_only_for_segments_that_were_there():
    rigid = RigidMotion(lags_s=(0.2, 0.4))
    before = jnp.asarray(cloud(6, 5)[0], jnp.float32)
    after = before + 0.1
    known = jnp.ones((2, 5), bool).at[1, 2].set(False).at[:, 4].set(False)
    ratio = log_ratio(rigid, jnp.ones(5), jnp.stack([before, before]), known, after)
    np.testing.assert_allclose(ratio, [4.0, 4.0, 2.0, 4.0, 0.0], atol=1e-5)


def test_the_log_ratio_has_a_finite_gradient_where_the_body_was_not_there_yet():
    before = jnp.asarray(cloud(6, 5)[0], jnp.float32)
    known = jnp.array([[False, False, True, True, True]])
    weight = jnp.array([1.0, 1.0, 1e-25, 1e-25, 1e-25])
    rigid = RigidMotion(lags_s=(0.2,))
    gradients = jax.grad(lambda w, x: jnp.sum(rigid.log_ratio(w, before[None], known, x)), (0, 1))(weight, before + 0.1)
    assert all(np.isfinite(gradient).all() for gradient in gradients)
    ratio = log_ratio(rigid, weight, before[None], known, before + 0.1)
    nothing = log_ratio(rigid, jnp.zeros(5), before[None], known, before + 0.1)
    np.testing.assert_array_equal(ratio, nothing)


@pytest.mark.parametrize("rate_hz", [7.0, 10.0, 30.0, 60.0])
def test_past_motion_reaches_back_the_same_time_at_any_frame_rate(rate_hz):
    past = PastMotion.nothing(3, span_s=0.67)
    velocity = jnp.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, -1.0, 0.0]])
    now_s, displacement = jnp.zeros(()), jnp.zeros((3, 3))
    for frame in range(int(2 * rate_hz)):
        now_s = jnp.asarray(frame / rate_hz)
        displacement = velocity * now_s
        past = past.add(displacement, now_s)
    for lag_s in (0.17, 0.33, 0.67):
        moved_m, elapsed_s = past.since(lag_s, displacement, jnp.full(3, 9.0), now_s)
        assert float(elapsed_s[0]) == pytest.approx(lag_s, abs=0.6 / rate_hz + 0.02)
        np.testing.assert_allclose(moved_m, velocity * elapsed_s[0], atol=1e-5)


def test_a_newborn_segment_has_no_past_of_the_slot_before():
    past = PastMotion.nothing(2, span_s=0.5)
    for frame in range(20):
        past = past.add(jnp.full((2, 3), 0.1 * frame), jnp.asarray(frame / 30))
    past = past.inherited(jnp.array([-2, -1])).add(jnp.zeros((2, 3)), jnp.asarray(20 / 30))
    moved_m, elapsed_s = past.since(0.3, jnp.full((2, 3), 0.02), jnp.array([9.0, 1 / 30]), jnp.asarray(21 / 30))
    np.testing.assert_allclose(moved_m[1], 0.02, atol=1e-6)
    assert float(elapsed_s[1]) == pytest.approx(1 / 30)


AREA = jnp.full(21, 16.0)


def scene(num_frames: int = 30, *, rate_hz: float = 30.0, turned: bool = True):
    """Segments of an object (1 to 8), of an arm (9 to 14) that turns about its far end, and of another object (15 to 20).

    The object moves 0.4 m/s to the right; slot 0 is the background. Yields centre, displacement, and time.
    """
    rng = np.random.default_rng(0)
    thing = rng.uniform(-0.06, 0.06, (8, 3)) + np.array([0.0, 0.0, 2.0])
    arm = np.stack([np.full(6, 0.0), np.linspace(-0.12, -0.3, 6), np.full(6, 2.0)], axis=-1)
    other = rng.uniform(-0.06, 0.06, (6, 3)) + np.array([0.8, 0.0, 2.0])
    start = np.concatenate([[[0.0, 0.0, 3.0]], thing, arm, other])
    for frame in range(num_frames):
        time_s = frame / rate_hz
        at = start.copy()
        at[1:9, 0] += 0.4 * time_s
        at[9:15, 0] += 0.4 * time_s * (np.linspace(0.6, 0.1, 6) if turned else 1.0)
        at[15:, 2] += 0.4 * time_s
        yield jnp.asarray(at, jnp.float32), jnp.asarray(at - start, jnp.float32), jnp.asarray(time_s, jnp.float32)


def segments(centre_m, displacement_m, life_s, **others) -> SegmentFrame:
    """The segments of a frame of `scene`."""
    return segment_frame(centre_m, displacement_m, area=AREA, life_s=life_s, displacement_m=displacement_m, **others)


@eqx.filter_jit
def stepped(stage: CarryingBody, *arguments) -> tuple:
    """`step`, compiled once for all tests that have as many tags."""
    return stage.step(*arguments)


def found(stage: CarryingBody, evidence: jax.Array, frames) -> tuple:
    state, bodies, last_s = stage.init(evidence.shape[0], 21), None, jnp.zeros(())
    for centre, displacement, now_s in frames:
        state, bodies = stepped(stage, state, evidence, segments(centre, displacement, now_s), last_s, now_s)
        last_s = now_s
    return state, bodies


def test_the_body_is_the_rigid_one_at_the_place_of_the_tag():
    evidence = jnp.zeros((2, 21)).at[0, 4].set(60.0).at[1, 17].set(60.0)
    _, bodies = found(CarryingBody(), evidence, scene())
    member = np.asarray(bodies.log_odds) > 0
    assert member[0, 1:9].all()
    assert not member[0, 9:].any()
    assert not member[0, 0]
    assert member[1, 15:].all()
    assert not member[1, :15].any()
    np.testing.assert_allclose(np.sum(bodies.place, axis=1), 1.0, atol=1e-5)


def test_an_arm_that_moves_as_the_object_does_belongs_to_it_unless_the_reads_object():
    evidence = jnp.full((1, 21), 50.0).at[0, 15:].set(0.0)
    _, bodies = found(CarryingBody(), evidence, scene(turned=False))
    assert (np.asarray(bodies.log_odds)[0, 1:15] > 0).all()
    far_below = evidence.at[0, 9:15].set(-60.0)
    _, bodies = found(CarryingBody(), far_below, scene(turned=False))
    odds = np.asarray(bodies.log_odds)[0]
    assert odds[9:15].max() < odds[1:9].min()


def test_nothing_that_moves_and_no_tag_are_defined():
    still = [(centre, jnp.zeros_like(moved), now_s) for centre, moved, now_s in scene(5)]
    _, bodies = found(CarryingBody(), jnp.zeros((1, 21)), still)
    assert bool(jnp.all(jnp.isfinite(bodies.log_odds)))
    _, bodies = found(CarryingBody(), jnp.zeros((0, 21)), scene(3))
    assert bodies.log_odds.shape == (0, 21)
    stage = CarryingBody()
    state = stage.init(1, 21)
    empty = segment_frame(jnp.zeros((21, 3)), jnp.zeros((21, 3)), area=jnp.zeros(21), size_m=0.0)
    _, bodies = stepped(stage, state, jnp.zeros((1, 21)), empty, jnp.zeros(()), jnp.zeros(()))
    assert float(jnp.max(bodies.log_odds)) < -20
    assert float(jnp.sum(bodies.place)) == 0.0


@pytest.mark.parametrize(("size_m", "belongs"), [(0.05, False), (0.15, True)])
def test_what_moves_alike_belongs_to_the_body_where_it_is_connected(size_m: float, belongs: bool):
    stage, evidence = CarryingBody(), jnp.zeros((1, 21)).at[0, 4].set(60.0)
    state, bodies, last_s = stage.init(1, 21), None, jnp.zeros(())
    for centre, displacement, now_s in scene():
        centre = centre.at[15:].set(centre[1:7].at[:, 0].add(0.3))
        displacement = displacement.at[15:].set(displacement[1:7])
        now = segments(centre, displacement, now_s, size_m=size_m)
        state, bodies = stepped(stage, state, evidence, now, last_s, now_s)
        last_s = now_s
    assert bodies is not None
    member = np.asarray(bodies.log_odds)[0] > 0
    assert member[1:9].all()
    assert member[15:].all() == member[15:].any() == belongs


@pytest.mark.parametrize(
    ("life_s", "speed", "front", "age_s", "is_place"),
    [
        (0.4, 0.4, 0.0, 9.0, False),
        (0.4, 0.4, 1.0, 9.0, True),
        (9.0, 0.1, 0.0, 9.0, True),
        (9.0, 0.4, 0.0, 9.0, False),
        (9.0, 0.4, 1.0, 9.0, True),
        (0.4, 0.4, 0.0, 0.45, True),
    ],
    ids=["uncovered", "young, in front", "old, slow", "a shadow", "in front", "nothing seen at rest yet"],
)
def test_what_comes_into_view_or_slides_behind_is_no_place(
    life_s: float, speed: float, front: float, age_s: float, is_place: bool
):
    stage, evidence = CarryingBody(), jnp.zeros((1, 21)).at[0, 15:].set(60.0).at[0, 1:9].set(30.0)
    state, bodies, last_s = stage.init(1, 21), None, jnp.zeros(())
    state = eqx.tree_at(lambda one: one.age_s, state, jnp.asarray(age_s - 29 / 30))
    for centre, displacement, now_s in scene():
        displacement = displacement.at[15:].multiply(speed / 0.4)
        lives = jnp.full(21, 9.0).at[15:].set(life_s)
        now = segments(centre, displacement, lives, front=jnp.ones(21).at[15:].set(front))
        state, bodies = stepped(stage, state, evidence, now, last_s, now_s)
        last_s = now_s
    assert bodies is not None
    assert (float(jnp.sum(bodies.place[0, 15:])) > 0.9) == is_place
    assert (float(jnp.sum(bodies.place[0, 1:9])) > 0.9) != is_place


def test_membership_moves_on_with_the_place():
    evidence = jnp.zeros((1, 21)).at[0, 4].set(60.0)
    stage = CarryingBody()
    state, _ = found(stage, evidence, scene())
    assert float(state.membership[0, 4]) > 1.0
    frames = list(scene(32))
    centre, displacement, now_s = frames[30]
    other = jnp.zeros((1, 21)).at[0, 17].set(60.0)
    state, bodies = stepped(stage, state, other, segments(centre, displacement, now_s), frames[29][2], now_s)
    member = np.asarray(bodies.log_odds)[0] > 0
    assert member[15:].all()
    assert not member[:15].any()


def test_a_newborn_segment_inherits_the_membership_of_its_source():
    evidence = jnp.zeros((1, 21)).at[0, 4].set(60.0)
    stage = CarryingBody()
    state, _ = found(stage, evidence, scene())
    source = jnp.full(21, -2, jnp.int32).at[20].set(4).at[19].set(0).at[18].set(-1)
    frames = list(scene(32))
    centre, displacement, now_s = frames[30]
    centre = centre.at[20].set(centre[4] + 0.01)
    life_s = jnp.full(21, now_s).at[18:].set(0.0)
    displacement = displacement.at[18:].set(0.0)
    now = segments(centre, displacement, life_s, source=source)
    after, bodies = stepped(stage, state, evidence, now, frames[29][2], now_s)
    assert float(bodies.log_odds[0, 20]) > 0
    assert float(after.membership[0, 20]) > 1.0
    assert abs(float(after.membership[0, 19])) < 0.5


def test_gradients_reach_evidence_motion_and_parameters():
    stage = CarryingBody()
    frames = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scene(12))

    def total(learned):
        stage, evidence, scale = learned

        def step(carry, frame):
            state, last_s, _ = carry
            centre, displacement, now_s = frame
            state, bodies = stage.step(state, evidence, segments(centre, scale * displacement, now_s), last_s, now_s)
            return (state, now_s, jnp.sum(jax.nn.sigmoid(bodies.log_odds))), None

        (_, _, value), _ = jax.lax.scan(step, (stage.init(1, 21), jnp.zeros(()), jnp.zeros(())), frames)
        return value

    evidence = jnp.zeros((1, 21)).at[0, 1:9].set(20.0).at[0, 9:15].set(12.0)
    by_stage, *by_rest = eqx.filter_jit(eqx.filter_grad(total))((stage, evidence, jnp.ones(())))
    leaves = [*jax.tree.leaves(eqx.filter(by_stage, eqx.is_array)), *by_rest]
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in leaves)
    assert float(jnp.abs(by_rest[1])) > 0
    assert float(jnp.abs(by_stage.rigid.noise_fraction.unconstrained)) > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"lags_s": (0.3, 0.2)}, "rising order"),
        ({"lags_s": ()}, "rising order"),
        ({"noise_m": 0.0}, "positive"),
    ],
)
def test_wrong_rigid_motion_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        RigidMotion(**arguments)


def test_wrong_body_settings_are_refused():
    for arguments in ({"num_active": 0}, {"num_rounds": 0}, {"speed_s": 0.0}, {"temperature_nats": -1.0}):
        with pytest.raises(ValueError, match="expected"):
            CarryingBody(**arguments)
    with pytest.raises(ValueError, match="span_s"):
        PastMotion.nothing(3, span_s=0.0)
