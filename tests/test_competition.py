"""Competition between tags: against the joint posterior of two tags, swaps, new segments, gradients."""

from __future__ import annotations

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from segments_scenes import segment_frame

from tagjax.tagattention.segments import Competition
from tagjax.tagattention.segments.competition import CompetitionState

PRESENT = jnp.ones(2, bool)
PEOPLE = {0: (1, 2, 3), 1: (4, 5)}  # segments of two people; 6 is a third mover, 7 an empty slot


def scene():
    centre = np.zeros((8, 3)) + np.array([0.0, 0.0, 3.0])
    area = jnp.array([900.0, 20.0, 30.0, 10.0, 25.0, 25.0, 15.0, 0.0])
    return segment_frame(centre, np.zeros((8, 3)), area=area, life_s=2.0)


def bodies(*of_tag: int) -> CompetitionState:
    """The state in which each tag had this person."""
    member = np.zeros((len(of_tag), 8), np.float32)
    for tag, person in enumerate(of_tag):
        member[tag, list(PEOPLE[person])] = 1.0
    return CompetitionState(jnp.asarray(member), jnp.ones(len(of_tag)))


def evidence(*rows: tuple[float, float, float]) -> jax.Array:
    """Each tag's evidence for the two people and the third mover, nats."""
    out = np.zeros((len(rows), 8), np.float32)
    for tag, (first, second, third) in enumerate(rows):
        out[tag, list(PEOPLE[0])], out[tag, list(PEOPLE[1])], out[tag, 6] = first, second, third
    return jnp.asarray(out)


def prior_of(stage: Competition, state: CompetitionState, rows, found, present=PRESENT) -> jax.Array:
    """The log prior at a temperature of 8 nats."""
    temperature_nats = jnp.asarray(8.0, rows.dtype)
    return stage.log_prior(stage.bodies(state, found, present), rows, found, temperature_nats)


@pytest.mark.parametrize("held", [(0, 1), (1, 0)])
def test_two_tags_have_the_marginals_of_their_joint_posterior(held):
    rows, e = ((40.0, 36.0, 5.0), (22.0, 30.0, 12.0)), 0.1
    log_prior = prior_of(Competition(together=e), bodies(*held), evidence(*rows), scene(), PRESENT)
    alone = np.exp(np.array(rows) / 8.0)
    joint = np.zeros((3, 3))
    for first, second in itertools.product(range(3), repeat=2):
        joint[first, second] = alone[0, first] * alone[1, second] * (e if first == second < 2 else 1.0)
    joint /= joint.sum()
    at = [1, 4, 6]
    for tag in range(2):
        mine = alone[tag] * np.exp(np.asarray(log_prior)[tag, at])
        np.testing.assert_allclose(mine / mine.sum(), joint.sum(axis=1 - tag), rtol=1e-4)
    np.testing.assert_allclose(log_prior[:, jnp.array([0, 6, 7])], 0.0, atol=1e-6)


def test_tags_that_took_each_others_bodies_change_places():
    rows = evidence((40.0, 38.0, 0.0), (38.0, 40.0, 0.0))
    prior = 8.0 * prior_of(Competition(), bodies(1, 0), rows, scene(), PRESENT)
    assert float((rows + prior)[0, 1] - (rows + prior)[0, 4]) > 2.5
    assert float((rows + prior)[1, 4] - (rows + prior)[1, 1]) > 2.5


def test_reads_that_surely_agree_outweigh_the_prior():
    rows = evidence((90.0, 0.0, 0.0), (80.0, 20.0, 0.0))  # two tags on one person
    prior = 8.0 * prior_of(Competition(), bodies(0, 0), rows, scene(), PRESENT)
    assert float(jnp.min(prior)) > -8.0 * np.log(1 / 0.02) - 1e-3
    assert (jnp.argmax(rows + prior, axis=1) == 1).all()


def test_one_tag_and_tags_that_are_not_there_have_no_competition():
    rows = evidence((40.0, 38.0, 0.0), (38.0, 40.0, 0.0))
    alone = prior_of(Competition(), bodies(0), rows[:1], scene(), PRESENT[:1])
    np.testing.assert_allclose(alone, 0.0, atol=1e-6)
    beside = prior_of(Competition(), bodies(0, 1), rows, scene(), jnp.array([True, False]))
    np.testing.assert_allclose(beside[0], 0.0, atol=1e-6)
    before = prior_of(Competition(), CompetitionState.nothing(2, 8), rows, scene(), PRESENT)
    np.testing.assert_allclose(before, 0.0, atol=1e-6)


def test_a_tag_of_which_nothing_is_known_leaves_the_others_their_bodies():
    rows = evidence((30.0, 10.0, 0.0), (0.0, 0.0, 0.0))
    same = CompetitionState(bodies(0, 0).membership, jnp.array([0.8, 0.05]))
    prior = 8.0 * prior_of(Competition(), same, rows, scene())
    assert float(prior[0, 1]) > -0.5
    assert float(prior[1, 1]) < -8.0


def test_a_body_that_several_tags_had_counts_once():
    rows = evidence((20.0, 18.0, 0.0), (5.0, 9.0, 0.0), (-400.0, -400.0, 0.0))
    once = prior_of(Competition(), bodies(0, 1), rows[:2], scene())
    member = jnp.concatenate([bodies(0, 1).membership, bodies(0).membership])
    twice = CompetitionState(member, jnp.array([1.0, 1.0, 0.0]))
    np.testing.assert_allclose(prior_of(Competition(), twice, rows, scene(), jnp.ones(3, bool))[:2], once, atol=1e-5)


def test_a_new_segment_belongs_to_the_bodies_of_its_source():
    rows = evidence((0.0, 60.0, 0.0), (60.0, 0.0, 0.0))
    found = scene()
    found = eqx.tree_at(lambda one: one.source, found, jnp.full(8, -2).at[6].set(1))
    prior = prior_of(Competition(), bodies(1, 0), rows, found, PRESENT)
    assert float(prior[0, 6]) == pytest.approx(float(prior[0, 1]), rel=1e-5)
    nowhere = eqx.tree_at(lambda one: one.source, found, jnp.full(8, -2).at[2].set(-1))
    prior = prior_of(Competition(), bodies(1, 0), rows, nowhere, PRESENT)
    assert float(prior[0, 2]) == pytest.approx(0.0, abs=1e-6)


def test_the_gradients_agree_with_finite_differences_and_are_finite_without_bodies():
    with jax.enable_x64(True):
        wide = lambda tree: jax.tree.map(  # noqa: E731
            lambda leaf: leaf.astype(jnp.float64) if leaf.dtype == jnp.float32 else leaf, tree
        )
        found, state, stage = wide(scene()), wide(bodies(0, 1)), wide(Competition())
        state = CompetitionState(0.3 + 0.4 * state.membership, state.confidence)
        rows = wide(evidence((20.0, 17.0, 5.0), (12.0, 15.0, 3.0)))

        def total(stage, rows):
            return jnp.sum(prior_of(stage, state, rows, found) @ jnp.arange(8.0))

        by_stage, by_rows = eqx.filter_grad(total)(stage, rows), jax.grad(total, 1)(stage, rows)
        step = 1e-5
        moved = jax.tree.map(lambda leaf: leaf + step, stage), jax.tree.map(lambda leaf: leaf - step, stage)
        numeric = (float(total(moved[0], rows)) - float(total(moved[1], rows))) / (2 * step)
        assert float(jax.tree.leaves(by_stage)[0]) == pytest.approx(numeric, rel=1e-6)
        for at in ((0, 1), (0, 4), (1, 5), (1, 6)):
            numeric = (total(stage, rows.at[at].add(step)) - total(stage, rows.at[at].add(-step))) / (2 * step)
            assert float(by_rows[at]) == pytest.approx(float(numeric), rel=1e-5, abs=1e-9)
        nothing = CompetitionState.nothing(2, 8)

        def without(rows):
            return jnp.sum(prior_of(stage, nothing, rows, found))

        assert bool(jnp.all(jnp.isfinite(jax.grad(without)(rows))))


def test_compiled_is_eager():
    rows, stage = evidence((20.0, 17.0, 5.0), (12.0, 15.0, 3.0)), Competition()
    arguments = bodies(0, 1), rows, scene()
    np.testing.assert_allclose(
        eqx.filter_jit(prior_of)(stage, *arguments), prior_of(stage, *arguments), rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("together", [0.0, 1.0, -0.1])
def test_wrong_settings_are_refused(together: float):
    with pytest.raises(ValueError, match="expected"):
        Competition(together=together)
