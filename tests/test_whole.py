"""Bodies that travel are whole: closed forms, gradients."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from segments_scenes import segment_frame

from tagjax.tagattention.segments import WholeBody

ELAPSED = jnp.full(9, 0.67)


def person(speed_m_s: float = 1.0):
    """A column of seven segments 12 cm apart (1 to 7), that moves but for the lowest, and another mover 1 m beside (8)."""
    centre = np.zeros((9, 3)) + np.array([0.0, 0.0, 3.0])
    centre[1:8, 1] = 0.12 * np.arange(7)
    centre[8, 0] = 1.0
    moved = np.zeros((9, 3))
    moved[1:7, 0] = moved[8, 0] = speed_m_s * 0.67
    area = jnp.full(9, 20.0).at[0].set(900.0)
    return segment_frame(centre, moved, area=area, life_s=2.0), jnp.asarray(moved, jnp.float32)


def trunk(probability: float = 0.9):
    """Membership of the second and third segment of the column."""
    return jnp.full((1, 9), 0.01).at[0, 2:4].set(probability)


def test_all_that_is_connected_and_travels_belongs_to_a_body_that_travels():
    found, moved = person()
    after = np.asarray(WholeBody().completed(trunk(), found, moved, ELAPSED))[0]
    assert (after[1:7] > 0.9).all()
    np.testing.assert_allclose(after[[0, 7, 8]], 0.01, atol=5e-3)


def test_a_body_that_does_not_travel_stays_as_it_is():
    found, moved = person(speed_m_s=0.05)
    np.testing.assert_allclose(WholeBody().completed(trunk(), found, moved, ELAPSED), trunk(), atol=5e-3)
    found, moved = person()
    still = jnp.full((1, 9), 0.01).at[0, 7].set(0.9)
    np.testing.assert_allclose(WholeBody().completed(still, found, moved, ELAPSED)[0, 7:], still[0, 7:], atol=1e-6)
    assert float(WholeBody().completed(still, found, moved, ELAPSED)[0, 3]) < 0.1


@pytest.mark.parametrize(("axis", "gap_m"), [(1, 0.2), (0, 0.2), (2, 0.2)])
def test_a_gap_ends_the_body(axis: int, gap_m: float):
    found, moved = person()
    found = eqx.tree_at(lambda one: one.centre_m, found, found.centre_m.at[5:7, axis].add(gap_m))
    after = np.asarray(WholeBody().completed(trunk(), found, moved, ELAPSED))[0]
    assert (after[1:5] > 0.9).all()
    assert (after[5:7] < 0.05).all()


def test_dark_clothes_without_depth_leave_a_gap_in_an_upright_body():
    found, moved = person()
    found = eqx.tree_at(lambda one: one.centre_m, found, found.centre_m.at[5:7, 1].add(0.12))
    assert (np.asarray(WholeBody().completed(trunk(), found, moved, ELAPSED))[0, 1:7] > 0.9).all()


def test_a_young_segment_that_is_connected_belongs_to_a_body_that_travels():
    found, moved = person()
    young = eqx.tree_at(lambda one: one.life_s, found, found.life_s.at[jnp.array([7, 8])].set(0.1))
    after = np.asarray(WholeBody().completed(trunk(), young, moved.at[7:].set(0.0), ELAPSED))[0]
    assert after[7] > 0.9
    assert after[8] < 0.05


def test_a_body_that_is_in_front_of_nothing_takes_nothing_along():
    found, moved = person()
    behind = eqx.tree_at(lambda one: one.front, found, found.front.at[1:8].set(0.0))
    after = WholeBody().completed(trunk(), behind, moved, ELAPSED)
    np.testing.assert_allclose(after, trunk(), atol=0.01)


def test_what_is_not_in_front_of_the_surface_at_rest_is_a_shadow():
    found, moved = person()
    shadow = eqx.tree_at(lambda one: one.front, found, found.front.at[jnp.array([5, 6])].set(0.2))
    after = np.asarray(WholeBody().completed(trunk(), shadow, moved, ELAPSED))[0]
    assert (after[1:5] > 0.9).all()
    assert (after[5:7] < 0.05).all()


def test_the_gradient_of_the_speed_agrees_with_finite_differences_and_is_finite_without_motion():
    with jax.enable_x64(True):
        found, moved = person(0.25)
        found = jax.tree.map(lambda leaf: leaf.astype(jnp.float64) if leaf.dtype == jnp.float32 else leaf, found)
        moved, membership = moved.astype(jnp.float64), trunk().astype(jnp.float64)
        stage = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), WholeBody())

        def total(stage, moved):
            return jnp.sum(stage.completed(membership, found, moved, ELAPSED)[0] * jnp.arange(9.0))

        gradient = eqx.filter_grad(total)(stage, moved).travel_m_s.unconstrained
        step = 1e-6

        def at(change):
            return float(
                total(
                    eqx.tree_at(
                        lambda one: one.travel_m_s.unconstrained, stage, stage.travel_m_s.unconstrained + change
                    ),
                    moved,
                )
            )

        assert float(gradient) == pytest.approx((at(step) - at(-step)) / (2 * step), rel=1e-5)
        assert abs(float(gradient)) > 1e-3
        assert bool(jnp.all(jnp.isfinite(jax.grad(total, 1)(stage, jnp.zeros_like(moved)))))


def test_compiled_is_eager_and_tags_are_independent():
    found, moved = person()
    two = jnp.concatenate([trunk(), trunk(0.3)])
    stage = WholeBody()
    eager = stage.completed(two, found, moved, ELAPSED)
    np.testing.assert_allclose(eqx.filter_jit(stage.completed)(two, found, moved, ELAPSED), eager, rtol=1e-6)
    np.testing.assert_allclose(stage.completed(two[1:], found, moved, ELAPSED)[0], eager[1], rtol=1e-6)


@pytest.mark.parametrize("arguments", [{"num_active": 0}, {"lag_s": 0.0}, {"share": 1.0}, {"travel_m_s": -1.0}])
def test_wrong_settings_are_refused(arguments):
    with pytest.raises(ValueError, match="expected"):
        WholeBody(**arguments)
