"""Flows smoothed by how far their two ways agree: what is hidden, what is right already, names, and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.flow import estimate, flow_along, make_flow
from tagjax.flow.estimates import consistency
from tagjax.flow.registry import flow_key, split_suffixes
from tagjax.flow.wls import weighted_least_squares
from tagjax.sim.flow_pairs import FlowPairSettings, flow_pair

HEIGHT, WIDTH, MOTION = 40, 64, 6


def _square_before_a_wall() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A bright square moves over a dark wall: its picture, the flows there and back, and what it will hide of the wall."""
    picture = np.full((HEIGHT, WIDTH, 3), 0.2, np.float32)
    picture[10:30, 20:40] = 0.8
    there, back = (np.zeros((HEIGHT, WIDTH, 2), np.float32) for _ in range(2))
    there[10:30, 20:40, 0] = MOTION
    back[10:30, 20 + MOTION : 40 + MOTION, 0] = -MOTION
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    hidden[10:30, 40 : 40 + MOTION] = True
    return picture, there, back, hidden


def test_what_is_hidden_takes_the_flow_of_what_it_belongs_to() -> None:
    picture, truth, back, hidden = _square_before_a_wall()
    guess = np.where(hidden[..., None], np.float32([9.0, -4.0]), truth)
    confidence = consistency(jnp.asarray(guess), jnp.asarray(back))
    assert float(confidence[hidden].max()) < 0.1
    found = np.asarray(weighted_least_squares(jnp.asarray(guess), confidence, jnp.asarray(picture)))
    assert np.linalg.norm(found - truth, axis=-1)[hidden].max() < 0.1
    assert np.linalg.norm(found - truth, axis=-1).max() < 0.1


def test_a_wrong_spot_that_agrees_with_itself_is_outvoted() -> None:
    """Both ways may agree on a wrong match; in the second round it weighs little against all around it."""
    picture, truth, _, _ = _square_before_a_wall()
    wrong = truth.copy()
    wrong[4:7, 50:53] = [8.0, 0.0]
    found = np.asarray(weighted_least_squares(jnp.asarray(wrong), jnp.ones((HEIGHT, WIDTH)), jnp.asarray(picture)))
    assert np.abs(found[4:7, 50:53]).max() < 0.8


def test_its_gradient_is_the_difference_quotient_and_finite_where_nothing_agrees(gradients_agree) -> None:
    random = np.random.default_rng(0)
    flow, confidence = random.normal(size=(4, 5, 2)), random.uniform(0.2, 1.0, size=(4, 5))
    picture = 0.02 * random.uniform(size=(4, 5, 3))  # affinities neither whole nor gone
    gradients_agree(weighted_least_squares, (flow, confidence, picture), atol=1e-5)
    gradients = jax.grad(lambda *arguments: jnp.sum(weighted_least_squares(*arguments)), argnums=(0, 1, 2))(
        jnp.zeros((4, 5, 2)), jnp.zeros((4, 5)), jnp.zeros((4, 5, 3))
    )
    assert all(np.isfinite(each).all() for each in gradients)


@pytest.fixture(scope="module")
def pair():
    settings = FlowPairSettings(height=80, width=96)
    drawn = jax.jit(lambda key: flow_pair(settings, key=key))(jax.random.key(3))
    pictures = [np.rint(255 * np.asarray(each)).astype(np.uint8) for each in (drawn.first, drawn.second)]
    return pictures, np.asarray(drawn.forward_px), np.asarray(drawn.occluded_first)


def test_a_flow_by_name_is_smoothed_in_both_directions(pair) -> None:
    (first, second), truth, hidden = pair
    plain, smoothed = make_flow("dis"), make_flow("dis+wls")
    (ahead, back), (again, _) = flow_along(smoothed, iter([first, second, first]))
    np.testing.assert_array_equal(again, back)
    np.testing.assert_array_equal(ahead, smoothed(first, second))
    np.testing.assert_array_equal(back, smoothed(second, first))
    found = estimate(smoothed, first, second)
    np.testing.assert_array_equal(found.forward_px, ahead)
    np.testing.assert_array_equal(found.backward_px, back)
    before, after = (np.linalg.norm(flow - truth, axis=-1) for flow in (plain(first, second), ahead))
    assert after.mean() < before.mean()
    assert after[hidden].mean() < before[hidden].mean()
    inverted = smoothed(first / np.float32(255), second / np.float32(255))
    np.testing.assert_allclose(inverted, ahead, atol=1e-4)


def test_names_are_taken_apart_and_applied_in_their_order(pair) -> None:
    (first, second), _, _ = pair
    assert split_suffixes("dis") == ("dis", "")
    assert split_suffixes("pyramid_fine:w.safetensors+wls+rest") == ("pyramid_fine:w.safetensors", "+wls+rest")
    assert len({flow_key(name) for name in ("dis", "dis+wls", "dis+rest", "dis+wls+rest", "dis+rest+wls")}) == 5
    rested = make_flow("dis+wls+rest")(first, second)
    smoothed = make_flow("dis+wls")(first, second)
    moving = np.any(rested != 0, axis=-1)
    np.testing.assert_array_equal(rested[moving], smoothed[moving])
    with pytest.raises(ValueError, match=r"Unknown optical flow 'diss'.*\+wls and \+rest may follow"):
        make_flow("diss+wls")
