"""Goller et al.: the antenna mixture and location."""

from __future__ import annotations

import equinox as eqx
import goller_scenes as scenes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tagjax.baselines.goller.antennas import (
    POWER_SCALE_DB,
    AntennaModel,
    antenna_weights,
    covariance_m2,
    fit_antennas,
    mixture_likelihood,
    response_db,
)
from tagjax.baselines.goller.location import locate, make_grid

RNG = np.random.default_rng(0)


def test_covariances_are_those_of_the_factor():
    lower = np.zeros((3, 2, 2))
    lower[:, 0, 0], lower[:, 1, 1], lower[:, 1, 0] = scenes.SCALES[:, 0], scenes.SCALES[:, 1], scenes.SKEWS
    np.testing.assert_allclose(covariance_m2(scenes.antennas()), lower @ lower.transpose(0, 2, 1), rtol=1e-5)


def test_the_mixture_is_scipys_and_has_mass_one():
    model, weights = scenes.antennas(), np.array([0.5, 0.3, 0.2])
    axis = np.linspace(-8, 12, 201)
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    found = np.asarray(mixture_likelihood(model, jnp.asarray(weights, jnp.float32), jnp.asarray(points, jnp.float32)))
    covariance = np.asarray(covariance_m2(model), np.float64)
    expected = sum(
        w * multivariate_normal(m, c).pdf(points) for w, m, c in zip(weights, scenes.MEANS, covariance, strict=True)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-9)
    assert abs(found.sum() * (axis[1] - axis[0]) ** 2 - 1) < 1e-3


def test_weights_are_ratios_of_received_powers():
    rssi, received = jnp.asarray([-60.0, -63.0, -50.0]), jnp.asarray([True, True, False])
    scale = jnp.asarray(POWER_SCALE_DB, jnp.float32)
    power = 10.0 ** (np.array([-60.0, -63.0]) / 10)
    weights = antenna_weights(rssi, received, scale)
    np.testing.assert_allclose(weights, [*(power / power.sum()), 0.0], rtol=1e-5)
    # A change of 15 dB at all antennas, as by the tag's orientation, changes nothing.
    np.testing.assert_allclose(antenna_weights(rssi - 15.0, received, scale), weights, rtol=1e-5)
    np.testing.assert_array_equal(antenna_weights(rssi, jnp.zeros(3, bool), scale), np.zeros(3))


def test_a_tag_that_no_antenna_received_has_likelihood_0_and_finite_gradients():
    model = scenes.antennas()
    points = jnp.asarray([[0.0, 0.0], [50.0, 50.0]])

    def total(rssi, scale):
        weights = antenna_weights(rssi, jnp.zeros(3, bool), scale)
        return jnp.sum(mixture_likelihood(model, weights, points))

    value, gradient = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(jnp.full(3, -jnp.inf), jnp.asarray(4.0))
    assert value == 0
    assert all(np.isfinite(np.asarray(g)).all() for g in gradient)


def test_gradients_of_the_mixture(gradients_agree):
    received = jnp.asarray([True, True, False])
    points = jnp.asarray([[0.3, -0.2], [2.0, 0.4]])

    def likelihood(mean, log_scale, skew, rssi, scale):
        model = AntennaModel(mean, log_scale, skew, jnp.zeros_like(skew), jnp.zeros((), skew.dtype))
        weights = antenna_weights(rssi, received, scale)
        return mixture_likelihood(model, weights, points.astype(mean.dtype))

    gradients_agree(
        jax.jit(likelihood),
        (scenes.MEANS, np.log(scenes.SCALES), scenes.SKEWS, np.array([-60.0, -63.0, -70.0]), np.array(5.0)),
    )


@pytest.mark.parametrize("fit_means", [False, True])
def test_the_fit_finds_the_gaussians_that_made_the_grid(fit_means):
    model, points = scenes.antennas(), scenes.grid_points()
    response = np.asarray(jax.vmap(lambda p: response_db(model, p))(jnp.asarray(points, jnp.float32)))
    mean_dbm = np.where(response > 0.02, response - 80.0, np.nan)
    start = scenes.MEANS + (0.3 if fit_means else 0.0)
    fitted = fit_antennas(points, mean_dbm, start, fit_means=fit_means)
    np.testing.assert_allclose(covariance_m2(fitted), covariance_m2(model), rtol=0.02, atol=0.01)
    np.testing.assert_allclose(fitted.mean_m, scenes.MEANS, atol=0.02)
    np.testing.assert_allclose(np.exp(fitted.log_peak_db), np.exp(model.log_peak_db), rtol=0.02)


def test_points_without_reads_limit_the_zone():
    model, points = scenes.antennas(), scenes.grid_points()
    response = np.asarray(jax.vmap(lambda p: response_db(model, p))(jnp.asarray(points, jnp.float32)))
    sparse = np.where(response > 10.0, response - 80.0, np.nan)
    fitted = fit_antennas(points, sparse, scenes.MEANS)
    assert np.all(np.exp(np.asarray(fitted.log_scale_m[:, 0])) < scenes.SCALES[:, 0])


def test_insufficient_grids_are_refused():
    points = scenes.grid_points()
    mean = np.full((len(points), 3), -60.0)
    mean[4:, 1] = np.nan
    with pytest.raises(ValueError, match="Antenna 2 received the tag at 4"):
        fit_antennas(points, mean, scenes.MEANS)
    line = np.stack([np.linspace(0, 4, 20), np.zeros(20)], axis=-1)
    with pytest.raises(ValueError, match="on a line"):
        fit_antennas(line, np.full((20, 3), -60.0), scenes.MEANS)


def test_a_tag_received_by_one_antenna_is_located_below_it():
    time_s = scenes.frame_times(20)
    received = jnp.zeros((20, 3), bool).at[:, 2].set(True)
    path = scenes.locate_compiled(scenes.location_model(), scenes.FLOOR, time_s, jnp.full((20, 3), -60.0), received)
    assert np.abs(np.asarray(path.position_m[-1]) - scenes.MEANS[2]).max() < 0.25
    assert bool(path.known.all())


def test_a_tag_that_was_never_received_has_the_uniform_distribution():
    time_s = scenes.frame_times(5)
    path = scenes.locate_compiled(
        scenes.location_model(), scenes.FLOOR, time_s, jnp.zeros((5, 3)), jnp.zeros((5, 3), bool)
    )
    np.testing.assert_allclose(path.position_m, np.broadcast_to([2.1, 0.0], (5, 2)), atol=1e-4)
    # The standard deviation of a uniform distribution over the grid's cells.
    np.testing.assert_allclose(path.std_m[0, 0], np.std(np.asarray(scenes.FLOOR.x_m)), rtol=1e-3)
    np.testing.assert_array_equal(path.velocity_m_s, np.zeros((5, 2)))
    assert not bool(path.known.any())


def test_a_walk_along_the_antennas_is_located_and_a_still_tag_does_not_move():
    time_s = np.arange(60) * 0.1
    walk = np.stack([4.5 - 0.8 * time_s, np.zeros(60)], axis=-1)
    everywhere = jnp.ones((60, 3), bool)
    path = scenes.locate_compiled(
        scenes.location_model(), scenes.FLOOR, jnp.asarray(time_s), jnp.asarray(scenes.rssi_at(walk)), everywhere
    )
    middle = slice(15, 50)
    assert np.abs(np.asarray(path.position_m[middle, 0]) - walk[middle, 0]).mean() < 0.6
    assert -1.2 < float(path.velocity_m_s[middle, 0].mean()) < -0.3
    still = scenes.locate_compiled(
        scenes.location_model(),
        scenes.FLOOR,
        jnp.asarray(time_s),
        jnp.asarray(scenes.rssi_at(walk[:1].repeat(60, 0))),
        everywhere,
    )
    assert np.abs(np.asarray(still.velocity_m_s[30:])).max() < 0.05


def test_without_reads_the_distribution_only_widens():
    received = jnp.zeros((30, 3), bool).at[:5].set(True)
    walk = np.broadcast_to(scenes.MEANS[1], (30, 2))
    path = scenes.locate_compiled(
        scenes.location_model(), scenes.FLOOR, scenes.frame_times(30), jnp.asarray(scenes.rssi_at(walk)), received
    )
    std = np.asarray(path.std_m[:, 0])
    assert np.all(np.diff(std[4:]) > 0)
    np.testing.assert_array_equal(path.received, [True] * 5 + [False] * 25)


def test_one_frame_and_frames_at_one_time_are_finite():
    single = scenes.locate_compiled(
        scenes.location_model(), scenes.FLOOR, jnp.zeros(1), jnp.full((1, 3), -60.0), jnp.ones((1, 3), bool)
    )
    same = scenes.locate_compiled(
        scenes.location_model(), scenes.FLOOR, jnp.zeros(3), jnp.full((3, 3), -60.0), jnp.ones((3, 3), bool)
    )
    for path in (single, same):
        assert np.isfinite(np.asarray(path.position_m)).all()
        np.testing.assert_array_equal(path.velocity_m_s, np.zeros_like(path.velocity_m_s))


@pytest.mark.ci
def test_gradients_of_the_location(gradients_agree):
    grid = make_grid((-1.0, -1.0), (5.0, 1.0), 1.0)
    received = jnp.asarray(RNG.random((6, 3)) < 0.7).at[0].set(True)

    def place(log_scale_db, log_walk, log_gain, log_lag, rssi):
        to = lambda tree: jax.tree.map(lambda x: x.astype(rssi.dtype), tree)  # noqa: E731
        model = eqx.tree_at(
            lambda m: (m.log_scale_db, m.log_walk_m2_s, m.log_gain_hz, m.log_lag_s),
            to(scenes.location_model()),
            (log_scale_db, log_walk, log_gain, log_lag),
        )
        path = locate(model, to(grid), scenes.frame_times(6).astype(rssi.dtype), rssi, received)
        return jnp.concatenate([path.position_m, path.velocity_m_s, path.std_m], axis=-1)

    rssi = scenes.rssi_at(np.stack([np.linspace(1, 3, 6), np.zeros(6)], axis=-1)).astype(float)
    gradients_agree(jax.jit(place), (np.log(5.0), np.log(0.4), np.log(4.0), np.log(0.5), rssi), atol=1e-5, rtol=1e-4)


def test_settings_of_a_location_are_checked():
    with pytest.raises(ValueError, match="walk_m2_s is 0"):
        scenes.location_model(walk_m2_s=0.0)
    with pytest.raises(ValueError, match="expected low below high"):
        make_grid((0.0, 0.0), (0.0, 1.0))
