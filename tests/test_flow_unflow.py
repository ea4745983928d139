"""UnFlow's terms of the flow loss: closed forms, NumPy references, gradients, and what they leave unchanged."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from composed import settings as composed_settings
from scipy.ndimage import gaussian_filter, map_coordinates

from tagjax.flow.loss_terms import consistency_term, generalised_charbonnier, inside, masked_mean, second_order_term
from tagjax.flow.losses import FlowLossSettings, data_distance, data_term, level_terms, total_loss, visible_mask
from tagjax.image.census import census_offsets, ternary, to_grey
from tagjax.training.flow_config import TrainFlowConfig
from tagjax.training.flow_step import terms_both_ways

FLOOR = 1e-6**0.45  # of the robust function
UNFLOW = FlowLossSettings(
    data="photometric", robust_function="unflow", robustness=0.45, smooth_first=0.0, edge_weight=0.0,
    level_weights=(12.7, 4.35, 3.9), smooth_levels=3.0, consistency=0.2, occlusion_penalty=12.4,
)  # fmt: skip


def _rho(x: np.ndarray) -> np.ndarray:
    return (x.astype(float) ** 2 + 1e-6) ** 0.45


def _constant(height: int, width: int, dx: float = 0.0, dy: float = 0.0) -> jnp.ndarray:
    return jnp.broadcast_to(jnp.asarray([dx, dy], jnp.float32).reshape(1, 1, 2), (height, width, 2))


def _uneven(height: int, width: int, seed: int = 0, size: float = 1.0) -> np.ndarray:
    """A flow whose targets keep away from pixel centres, where bilinear sampling has a kink."""
    rng = np.random.default_rng(seed)
    whole = np.rint(rng.uniform(-size, size, (height, width, 2)))
    return (whole + rng.uniform(0.2, 0.8, (height, width, 2))).astype(np.float32)


def _picture(height: int, width: int, seed: int = 0) -> np.ndarray:
    grey = gaussian_filter(np.random.default_rng(seed).normal(size=(height, width, 3)), (1.5, 1.5, 0))
    return (0.5 + 0.15 * grey / grey.std()).astype(np.float32)


def _pyramid(seed: int = 0) -> tuple[jax.Array, ...]:
    return tuple(jnp.asarray(_uneven(side, side, seed + side)) for side in (8, 16, 32))


def _sampled(values: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Each channel at pixel + flow, bilinearly; any value outside."""
    y, x = np.mgrid[: flow.shape[0], : flow.shape[1]]
    at = [y + flow[..., 1].astype(float), x + flow[..., 0].astype(float)]
    return np.stack(
        [map_coordinates(channel.astype(float), at, order=1, mode="nearest") for channel in np.moveaxis(values, -1, 0)],
        axis=-1,
    )


@functools.partial(jax.jit, static_argnames="settings")
def _terms(forward, backward, first, second, settings, occlusion_weight=1.0):
    return level_terms(forward, backward, first, second, jnp.asarray(occlusion_weight), settings)


# The robust function


def test_the_robust_function_is_unflows(gradients_agree):
    x = np.asarray([-2.0, -0.3, 0.0, 5e-4, 1.7], np.float32)
    np.testing.assert_allclose(generalised_charbonnier(jnp.asarray(x)), _rho(x), rtol=1e-6)
    gradients_agree(generalised_charbonnier, (x,), step=1e-8, rtol=1e-4)
    assert float(jax.grad(generalised_charbonnier)(jnp.zeros(()))) == 0


def test_the_data_term_takes_the_function_of_the_settings():
    first, second = (to_grey(jnp.asarray(_picture(20, 24, seed))) for seed in (0, 1))
    mask = jnp.asarray(np.random.default_rng(0).uniform(size=(20, 24)) < 0.6, jnp.float32)
    found = data_term(_constant(20, 24), first, second, mask, UNFLOW)
    gap = _rho(np.asarray(data_distance(first, second, UNFLOW, 0)))
    assert float(found) == pytest.approx(gap[np.asarray(mask) > 0].mean(), rel=1e-5)
    assert float(data_term(_constant(20, 24), first, first, mask, UNFLOW)) == pytest.approx(FLOOR, rel=1e-5)


@pytest.mark.parametrize(("level", "radius"), [(0, 3), (1, 2), (2, 1), (4, 1)])
def test_the_census_is_summed_over_the_neighbours_of_each_level(level, radius):
    first, second = (to_grey(jnp.asarray(_picture(20, 24, seed))) for seed in (0, 1))
    settings = FlowLossSettings(robust_function="unflow", census_stride=1)
    soft = [ternary(grey, census_offsets(radius)) for grey in (first, second)]
    squared = np.square(np.asarray(soft[0]) - np.asarray(soft[1]))
    half = (squared / (0.1 + squared)).sum(axis=0)  # each pair of neighbours once
    np.testing.assert_allclose(data_distance(first, second, settings, level), 2 * half, rtol=1e-4)
    assert len(census_offsets(radius)) == ((2 * radius + 1) ** 2 - 1) / 2


# Consistency


def test_consistent_flows_cost_the_floor_and_a_known_gap_its_penalty():
    ones, way = jnp.ones((20, 24)), _constant(20, 24, 3.0, -2.0)
    assert float(consistency_term(way, -way, ones)) == pytest.approx(FLOOR, rel=1e-5)
    back = _constant(20, 24, -2.5, 2.25)
    expected = (_rho(np.asarray(0.5)) + _rho(np.asarray(0.25))) / 2
    assert float(consistency_term(way, back, ones)) == pytest.approx(expected, rel=1e-5)
    # Consistent along the motion, not pixel by pixel: what comes back is that of the target.
    left = jnp.zeros((20, 24, 2)).at[:, 12:, 0].set(-4.0)
    right = jnp.zeros((20, 24, 2)).at[:, 8:20, 0].set(4.0)
    mask = jnp.zeros((20, 24)).at[:, 8:20].set(1.0)
    assert float(consistency_term(right, left, mask)) == pytest.approx(FLOOR, rel=1e-5)


def test_consistency_agrees_with_numpy_over_the_visible_pixels_inside():
    flow, back = _uneven(20, 24, 0, 3.0), _uneven(20, 24, 1, 3.0)
    mask = np.random.default_rng(2).uniform(size=(20, 24)) < 0.7
    y, x = np.mgrid[:20, :24]
    u, v = x + flow[..., 0], y + flow[..., 1]
    chosen = mask & (u >= 0) & (u <= 23) & (v >= 0) & (v <= 19)
    expected = _rho(flow + _sampled(back, flow)).mean(axis=-1)[chosen].mean()
    found = consistency_term(jnp.asarray(flow), jnp.asarray(back), jnp.asarray(mask, jnp.float32))
    assert float(found) == pytest.approx(expected, rel=1e-4)


def test_consistency_gradient_reaches_both_flows_and_the_sampling_position(gradients_agree):
    flow, back = _uneven(5, 6), _uneven(5, 6, 1)
    mask = np.random.default_rng(2).uniform(0.2, 1.0, (5, 6))

    def term(flow, back):
        return consistency_term(flow, back, jnp.asarray(mask, flow.dtype))

    gradients_agree(term, (flow, back), rtol=1e-4)
    # Where the backward flow rises by 0.5 a pixel, the gap changes by 1.5 times the forward flow: half of it by the position.
    ramp = np.zeros((5, 9, 2), np.float32)
    ramp[..., 0] = 0.5 * np.arange(9)
    still = np.full((5, 9, 2), 0.25, np.float32)
    back_there = jnp.asarray(_sampled(ramp, still), jnp.float32)
    mask_inside = inside(jnp.asarray(still)).astype(jnp.float32)

    def without_position(flow):
        return masked_mean(jnp.mean(generalised_charbonnier(flow + back_there), axis=-1), mask_inside)

    slope = jax.grad(lambda flow: consistency_term(flow, jnp.asarray(ramp), jnp.ones((5, 9))))(jnp.asarray(still))
    fixed = jax.grad(without_position)(jnp.asarray(still))
    np.testing.assert_allclose(slope[:4, :8, 0], 1.5 * fixed[:4, :8, 0], rtol=1e-4)


# Second differences


def test_second_differences_of_planes_cost_the_floor_and_of_a_parabola_a_constant():
    y, x = np.mgrid[:9, :11].astype(np.float32)
    plane = np.stack([0.3 * x - 0.2 * y + 1, 0.1 * y], axis=-1)
    assert float(second_order_term(jnp.asarray(plane))) == pytest.approx(2 * FLOOR, rel=1e-3)
    bowl = np.stack([0.25 * x * x, 0 * x], axis=-1)
    # Along x and both diagonals the second difference is 0.5; along y, and of the other component, 0.
    expected = (3 * _rho(np.asarray(0.5)) + FLOOR) / 4 + FLOOR
    assert float(second_order_term(jnp.asarray(bowl))) == pytest.approx(expected, rel=1e-4)


def test_second_differences_agree_with_numpy():
    flow = _uneven(7, 9, size=2.0)
    means = [
        _rho(flow[:, :-2] - 2 * flow[:, 1:-1] + flow[:, 2:]),
        _rho(flow[:-2] - 2 * flow[1:-1] + flow[2:]),
        _rho(flow[:-2, :-2] - 2 * flow[1:-1, 1:-1] + flow[2:, 2:]),
        _rho(flow[:-2, 2:] - 2 * flow[1:-1, 1:-1] + flow[2:, :-2]),
    ]
    expected = sum(2 * each.mean() for each in means) / 4
    assert float(second_order_term(jnp.asarray(flow))) == pytest.approx(expected, rel=1e-5)


def test_second_difference_gradient(gradients_agree):
    gradients_agree(second_order_term, (_uneven(4, 5),))


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (1, 5), (2, 6), (3, 4)])
def test_a_level_of_few_pixels_has_a_finite_term(size):
    value, slope = jax.value_and_grad(second_order_term)(jnp.asarray(_uneven(*size)))
    assert np.isfinite(value)
    assert np.isfinite(slope).all()
    assert (value == 0) == (max(size) < 3)


# The penalty of occluded pixels


def test_the_occlusion_penalty_is_the_weighted_fraction_and_has_no_gradient():
    forward = (jnp.zeros((8, 8, 2)), jnp.zeros((16, 16, 2)).at[:4, :8, 0].set(9.0))
    backward = (jnp.zeros((8, 8, 2)).at[:2, :, 1].set(3.0), jnp.zeros((16, 16, 2)))
    only = FlowLossSettings(
        data="photometric", smooth_first=0.0, level_weights=(2.0, 0.5), occlusion_penalty=12.4,
    )  # fmt: skip
    first, second = jnp.asarray(_picture(16, 16)), jnp.asarray(_picture(16, 16, 1))
    terms = _terms(forward, backward, first, second, only)
    # The finest level: 32 of 256 pixels are inconsistent; the next: 16 of 64.
    assert float(terms["occlusion_penalty"]) == pytest.approx(2.0 * 32 / 256 + 0.5 * 16 / 64)
    assert float(total_loss(terms, only)) == pytest.approx(
        float(terms["data"]) + 12.4 * float(terms["occlusion_penalty"]), rel=1e-6
    )
    slope = jax.grad(lambda f, b: _terms(f, b, first, second, only)["occlusion_penalty"], argnums=(0, 1))
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(slope(forward, backward)))
    with_it, without = (
        jax.grad(lambda f, weight=weight: total_loss(_terms(f, backward, first, second, weight), weight))(forward)
        for weight in (only, dataclasses.replace(only, occlusion_penalty=0.0))
    )
    for one, other in zip(with_it, without, strict=True):
        np.testing.assert_array_equal(one, other)
    # Before the masks begin only what leaves the picture counts.
    early = _terms(forward, backward, first, second, only, 0.0)
    assert float(early["occlusion_penalty"]) == pytest.approx(2.0 * 4 / 256)


# The whole


def test_unflows_terms_are_summed_over_levels_by_their_weights():
    forward, backward = _pyramid(), _pyramid(9)
    first, second = jnp.asarray(_picture(32, 32)), jnp.asarray(_picture(32, 32, 5))
    found = _terms(forward, backward, first, second, UNFLOW)
    expected = dict.fromkeys(("smooth_levels", "consistency", "occlusion_penalty"), 0.0)
    for weight, flow, back in zip(UNFLOW.level_weights, forward[::-1], backward[::-1], strict=True):
        visible = visible_mask(flow, back, jnp.ones(()), UNFLOW)
        expected["smooth_levels"] += weight * float(second_order_term(flow))
        expected["consistency"] += weight * float(consistency_term(flow, back, visible))
        expected["occlusion_penalty"] += weight * (1 - float(visible.mean()))
    assert {name: float(found[name]) for name in expected} == pytest.approx(expected, rel=1e-5)
    parts = (found["data"], 3.0 * found["smooth_levels"], 0.2 * found["consistency"])
    assert float(total_loss(found, UNFLOW)) == pytest.approx(
        sum(map(float, parts)) + 12.4 * expected["occlusion_penalty"], rel=1e-5
    )


def test_both_directions_are_averaged():
    forward, backward = _pyramid(), _pyramid(9)
    clean = jnp.asarray(np.stack([_picture(32, 32), _picture(32, 32, 5)]))
    both = jax.jit(lambda f, b: terms_both_ways(f, b, clean, (32, 32), jnp.ones(()), UNFLOW))(forward, backward)
    ways = [
        _terms(forward, backward, clean[0], clean[1], UNFLOW),
        _terms(backward, forward, clean[1], clean[0], UNFLOW),
    ]
    for name, value in both.items():
        assert float(value) == pytest.approx(np.mean([float(way[name]) for way in ways]), rel=1e-5)


def test_the_whole_loss_has_the_gradient_of_its_parts(gradients_agree):
    pictures = _picture(6, 6), _picture(6, 6, 5)
    settings = dataclasses.replace(UNFLOW, occlusion=False)

    def loss(flow, back):
        one, other = (jnp.asarray(each, flow.dtype) for each in pictures)
        return total_loss(_terms((flow,), (back,), one, other, settings), settings)

    gradients_agree(loss, (_uneven(6, 6), _uneven(6, 6, 3)), atol=1e-5, rtol=1e-4)


def test_a_level_of_weight_0_adds_nothing():
    forward, backward = _pyramid(), _pyramid(9)
    first, second = jnp.asarray(_picture(32, 32)), jnp.asarray(_picture(32, 32, 5))
    coarse = dataclasses.replace(UNFLOW, level_weights=(0.0, 1.0, 0.3))
    slope = jax.grad(lambda f: total_loss(_terms(f, backward, first, second, coarse), coarse))(forward)
    assert not np.any(slope[2])
    assert np.any(slope[1])
    assert np.any(slope[0])
    small = [each.reshape(16, 2, 16, 2, 3).mean((1, 3)) for each in (first, second)]
    part = _terms(
        forward[:2], backward[:2], *small, dataclasses.replace(UNFLOW, level_weights=(1.0, 0.3), data="photometric")
    )
    whole = _terms(forward, backward, first, second, coarse)
    for name in ("data", "consistency", "smooth_levels", "occlusion_penalty"):
        assert float(whole[name]) == pytest.approx(float(part[name]), rel=1e-4)


def test_degenerate_flows_have_finite_losses_and_gradients():
    flat = jnp.full((16, 16, 3), 0.5)
    still = tuple(jnp.zeros((side, side, 2)) for side in (2, 4, 16))
    away = tuple(jnp.full((side, side, 2), 1e4) for side in (2, 4, 16))
    against = tuple(jnp.full((side, side, 2), 1.5) for side in (2, 4, 16))  # all occluded
    loss = jax.jit(
        jax.value_and_grad(
            lambda f, b: total_loss(level_terms(f, b, flat, flat, jnp.ones(()), UNFLOW), UNFLOW), argnums=(0, 1)
        )
    )
    for forward, backward in ((still, still), (away, still), (still, away), (away, away), (against, against)):
        value, slopes = loss(forward, backward)
        assert np.isfinite(value)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
    hidden = _terms(against, against, flat, flat, UNFLOW)
    assert float(hidden["consistency"]) == 0
    assert float(hidden["occlusion_penalty"]) == pytest.approx(sum(UNFLOW.level_weights))


def test_without_their_weights_the_loss_is_the_one_of_before():
    forward, backward = _pyramid(), _pyramid(9)
    first, second = jnp.asarray(_picture(32, 32)), jnp.asarray(_picture(32, 32, 5))
    settings = FlowLossSettings()
    terms = _terms(forward, backward, first, second, settings)
    assert set(terms) == {"data", "smooth_first", "smooth_second", "occluded_fraction"}
    assert float(total_loss(terms, settings)) == float(terms["data"] + terms["smooth_first"])


# Settings


def test_the_configuration_has_the_published_weights():
    loss = composed_settings(TrainFlowConfig, "train_flow", "flow_loss@loss=unflow").loss
    assert loss.level_weights == (12.7, 4.35, 3.9, 3.4, 1.1)
    assert (loss.smooth_levels, loss.consistency, loss.occlusion_penalty) == (3.0, 0.2, 12.4)
    assert (loss.robust_function, loss.robustness, loss.data, loss.census_stride) == ("unflow", 0.45, "census", 1)
    assert loss.smooth_first == loss.smooth_second == loss.edge_weight == 0
    assert (loss.occlusion, loss.occlusion_fraction, loss.occlusion_px2) == (True, 0.01, 0.5)
    flownet = composed_settings(TrainFlowConfig, "train_flow", "recipe=flownet").loss
    assert flownet.level_weights == (0.0, *loss.level_weights)  # FlowNet's full size is 1/4, enlarged
    assert flownet.census_radius == 1 + loss.census_radius == 4
    same = dataclasses.replace(
        flownet, level_weights=loss.level_weights, census_radius=3, occlusion_after=loss.occlusion_after,
        self_supervision_border_px=16,
    )  # fmt: skip
    assert same == loss
    joint = composed_settings(TrainFlowConfig, "train_flow", "recipe=[flownet,fine_tune]", "weights=a.safetensors")
    assert joint.loss == dataclasses.replace(flownet, occlusion_after=0)
    assert joint.weights == "a.safetensors"
    assert joint.data.variation.height % 64 == joint.data.variation.width % 64 == 0


@pytest.mark.parametrize("name", ["smooth_levels", "consistency", "occlusion_penalty"])
def test_weights_that_make_no_loss_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} is -1.0; expected a weight of 0 or more"):
        FlowLossSettings(**{name: -1.0})
    with pytest.raises(ValueError, match=f"{name} is 1.0 and sequence_decay is 0.8.*set one of the two to 0"):
        FlowLossSettings(**{name: 1.0}, sequence_decay=0.8)
