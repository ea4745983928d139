"""The fast global smoother against dense and banded solves, its limits, and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_banded

from tagjax.image.smoother import fast_global_smooth

STRENGTH, EDGE = 20.0, 0.1


def _drawn(height: int, width: int, seed: int = 0) -> tuple[jax.Array, jax.Array, jax.Array]:
    random = np.random.default_rng(seed)
    arrays = (
        random.normal(size=(height, width, 2)),
        random.uniform(0.1, 1.0, size=(height, width)),
        random.uniform(size=(height, width, 3)),
    )
    values, weights, guide = (jnp.asarray(array, jnp.float32) for array in arrays)
    return values, weights, guide


def test_one_row_in_one_round_is_the_weighted_least_squares_of_it() -> None:
    """Along a row it is exact: (W + 1.5 l A) u = W f has another diagonal, so numerator and denominator are solved apart."""
    values, weights, guide = (np.asarray(array, np.float64) for array in _drawn(1, 30))
    affinity = 0.5 * STRENGTH * np.exp(-np.abs(np.diff(guide[0], axis=0)).mean(axis=-1) / EDGE)
    laplacian = np.zeros((30, 30))
    for k, b in enumerate(affinity):
        laplacian[k : k + 2, k : k + 2] += b * np.asarray([[1, -1], [-1, 1]])
    inverse = np.linalg.inv(np.eye(30) + laplacian)
    expected = inverse @ (weights[0, :, None] * values[0]) / (inverse @ weights[0])[:, None]
    found = fast_global_smooth(*_drawn(1, 30), strength=STRENGTH, edge=EDGE, num_rounds=1)
    np.testing.assert_allclose(found[0], expected, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize(("height", "width"), [(9, 14), (14, 9), (2, 3)])
def test_a_picture_is_rows_and_columns_in_turn_with_less_strength_each_round(height: int, width: int) -> None:
    values, weights, guide = (np.asarray(array, np.float64) for array in _drawn(height, width))
    lines = np.concatenate([weights[..., None] * values, weights[..., None]], axis=-1)
    for strength in (0.4 * STRENGTH, 0.1 * STRENGTH):  # 1.5 (4, 1) / (4^2 - 1)
        for _ in range(2):
            affinity = strength * np.exp(-np.abs(np.diff(guide, axis=1)).mean(axis=-1) / EDGE)
            none = np.zeros((len(affinity), 1))
            before, after = np.concatenate([none, affinity], axis=1), np.concatenate([affinity, none], axis=1)
            for row in range(len(lines)):
                bands = np.stack([np.roll(-after[row], 1), 1 + before[row] + after[row], np.roll(-before[row], -1)])
                lines[row] = solve_banded((1, 1), bands, lines[row])
            lines, guide = lines.swapaxes(0, 1), guide.swapaxes(0, 1)
    found = fast_global_smooth(*_drawn(height, width), strength=STRENGTH, edge=EDGE, num_rounds=2)
    np.testing.assert_allclose(found, lines[..., :2] / lines[..., 2:], rtol=5e-5, atol=5e-6)


def test_what_is_everywhere_the_same_stays_so() -> None:
    _, weights, guide = _drawn(8, 11)
    constant = jnp.broadcast_to(jnp.asarray([2.5, -1.0]), (8, 11, 2))
    np.testing.assert_allclose(
        fast_global_smooth(constant, weights, guide, strength=50.0, edge=EDGE), constant, rtol=1e-5
    )


def test_no_strength_changes_nothing() -> None:
    values, weights, guide = _drawn(6, 7)
    np.testing.assert_allclose(fast_global_smooth(values, weights, guide, strength=0.0, edge=EDGE), values, rtol=1e-5)


def test_what_has_no_weight_is_filled_from_its_own_side_of_an_edge() -> None:
    side = np.arange(20) >= 10
    guide = jnp.asarray(np.broadcast_to(side[None, :, None], (12, 20, 3)), jnp.float32)
    truth = jnp.asarray(np.where(side, 4.0, -2.0)[None, :, None] * np.ones((12, 1, 1)), jnp.float32)
    hole = np.zeros((12, 20), bool)
    hole[4:8, 7:13] = True
    values, weights = jnp.where(hole[..., None], 99.0, truth), jnp.asarray(~hole, jnp.float32)
    found = fast_global_smooth(values, weights, guide, strength=200.0, edge=0.01)
    np.testing.assert_allclose(found, truth, atol=1e-3)


@pytest.mark.parametrize("step", [0.0, 0.3, 1.0])
def test_what_no_weight_reaches_keeps_what_it_has(step: float) -> None:
    """Behind an edge that lets nothing through, and where nothing weighs at all."""
    inside = np.zeros((10, 14), bool)
    inside[3:7, 8:] = True
    guide = jnp.asarray(step * np.broadcast_to(inside[..., None], (10, 14, 3)), jnp.float32)
    values = jnp.full((10, 14, 2), -12.0)
    for weights in (~inside, np.zeros_like(inside)):
        found = fast_global_smooth(values, jnp.asarray(weights, jnp.float32), guide, strength=200.0, edge=0.01)
        np.testing.assert_allclose(found, values, rtol=1e-5)


def test_where_nothing_weighs_it_is_finite_and_so_is_its_gradient() -> None:
    values, _, guide = _drawn(5, 6)
    silent = jnp.zeros((5, 6))
    flat = jnp.zeros_like(guide)
    for picture in (guide, flat):
        found, gradient = jax.value_and_grad(
            lambda v, w, g: jnp.sum(fast_global_smooth(v, w, g, strength=9.0, edge=EDGE)), argnums=(0, 1, 2)
        )(values, silent, picture)
        assert np.isfinite(found)
        assert all(np.isfinite(part).all() for part in gradient)


def test_the_gradient_is_the_difference_quotient(gradients_agree) -> None:
    values, weights, guide = _drawn(4, 5)
    gradients_agree(
        lambda v, w, g: fast_global_smooth(v, w, g, strength=3.0, edge=0.5, num_rounds=2), (values, weights, guide)
    )


def test_compiled_as_eager_and_a_batch_as_one_by_one() -> None:
    each = [_drawn(7, 9, seed) for seed in range(3)]
    one_by_one = [fast_global_smooth(*arrays, strength=STRENGTH, edge=EDGE) for arrays in each]
    np.testing.assert_allclose(
        jax.jit(lambda *arrays: fast_global_smooth(*arrays, strength=STRENGTH, edge=EDGE))(*each[0]),
        one_by_one[0],
        rtol=1e-5,
        atol=1e-6,
    )
    together = jax.vmap(lambda v, w, g: fast_global_smooth(v, w, g, strength=STRENGTH, edge=EDGE))(
        *(jnp.stack(arrays) for arrays in zip(*each, strict=True))
    )
    np.testing.assert_allclose(together, jnp.stack(one_by_one), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("wrong", [{"strength": -1.0}, {"edge": 0.0}, {"num_rounds": 0}])
def test_settings_without_a_meaning_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        fast_global_smooth(*_drawn(3, 4), **{"strength": 1.0, "edge": 1.0, **wrong})
