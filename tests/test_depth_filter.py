"""The filter over an unknown depth against a dense Kalman filter in float64, and closed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.tagattention.segments.depth_filter import (
    DepthBelief,
    Ranges,
    moved,
    ranges_at,
    settled,
    with_phase_set,
    with_rate,
    with_read,
)

NUM = 3
ONE = jnp.array([0.0, 1.0, 0.0])
H = np.array([0.0, 0.0, 0.0, 1.0, 0.0])


def _belief(seed: int, size: float = 0.3) -> tuple[DepthBelief, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = size * rng.normal(size=(2 + NUM, 2 + NUM))
    mean, covariance = rng.normal(size=2 + NUM) * 0.2, root @ root.T + 1e-3 * np.eye(2 + NUM)
    batch = (jnp.asarray(mean, jnp.float32)[:, None], jnp.asarray(covariance, jnp.float32)[..., None])
    return DepthBelief(*batch), mean, covariance


def _close(belief: DepthBelief, mean: np.ndarray, covariance: np.ndarray) -> None:
    np.testing.assert_allclose(belief.mean[:, 0], mean, atol=3e-5)
    np.testing.assert_allclose(belief.covariance[..., 0], covariance, atol=3e-5)


def test_ranges_and_their_derivatives() -> None:
    antennas = jnp.array([[0.0, 0.5, 0.0], [0.8, 0.2, 0.1], [-0.8, 0.0, 0.0]])
    ray, s = np.array([0.2, -0.1]), 0.7
    found = ranges_at(jnp.array([s]), jnp.asarray(ray, jnp.float32)[None], antennas, jnp.array(38.0))
    place = np.exp(s) * np.array([*ray, 1.0])
    away = np.linalg.norm(place - np.asarray(antennas), axis=1)
    np.testing.assert_allclose(found.phase[:, 0], 38.0 * away, rtol=1e-5)
    np.testing.assert_allclose(found.slope[:, 0], 38.0 * (place - np.asarray(antennas)) @ place / away, rtol=1e-4)


def test_a_step_is_that_of_a_dense_filter() -> None:
    belief, mean, covariance = _belief(0)
    before, after = np.array([3.0, 4.0, 5.0]), np.array([3.4, 3.8, 5.1])
    slopes = np.array([50.0, 40.0, 45.0]), np.array([51.0, 38.0, 45.0])
    dt, std, settle, noise = 0.02, 0.5, 0.3, np.array([0.01, 0.02, 0.03])
    last, now = (
        Ranges(jnp.asarray(p, jnp.float32)[:, None], jnp.asarray(s, jnp.float32)[:, None])
        for p, s in zip((before, after), slopes, strict=True)
    )
    got = moved(belief, last, now, jnp.array(dt), jnp.asarray(noise, jnp.float32)[:, None])
    got = settled(got, jnp.array(dt), jnp.array([std]), jnp.array(settle))
    kept = np.exp(-dt / settle)
    first = np.eye(2 + NUM)
    first[2:, 0], first[2:, 1] = slopes[1] - slopes[0], slopes[1] * dt
    second = np.eye(2 + NUM)
    second[0, 1], second[1, 1] = dt, kept
    expected = first @ covariance @ first.T + np.diag([0, 0, *noise])
    expected = second @ expected @ second.T + np.diag([0, std**2 * (1 - kept**2), 0, 0, 0])
    moved_mean = second @ (mean + np.concatenate([[0, 0], after - before]))
    np.testing.assert_allclose(got.mean[:, 0], moved_mean, atol=3e-5)
    np.testing.assert_allclose(got.covariance[..., 0], expected, rtol=2e-4, atol=2e-4)


def test_a_read_that_is_sure_of_its_turn_is_a_measurement_of_a_dense_filter() -> None:
    belief, mean, covariance = _belief(1, 0.1)
    phase, variance = mean[3] + 0.15, 0.02
    got, nats = with_read(belief, ONE, jnp.array(phase + 4 * np.pi), jnp.array([variance]), jnp.array(1e-9))
    total = H @ covariance @ H + variance
    gain = covariance @ H / total
    _close(got, mean + gain * (phase - H @ mean), covariance - np.outer(gain, gain) * total)
    expected = -0.5 * 0.15**2 / total - 0.5 * np.log(2 * np.pi * total) + np.log(2 * np.pi)
    assert float(nats[0]) == pytest.approx(expected, abs=1e-3)


def test_an_outlier_changes_little_and_costs_what_it_is_worth() -> None:
    belief, mean, covariance = _belief(1, 0.05)
    got, nats = with_read(belief, ONE, jnp.array(mean[3] + 2.5), jnp.array([0.01]), jnp.array(0.04))
    _close(got, mean, covariance)
    assert float(nats[0]) == pytest.approx(np.log(0.04), abs=1e-3)


def test_a_phase_that_may_be_anything_is_set_and_is_no_evidence() -> None:
    belief, mean, covariance = _belief(2)
    far = covariance + 40.0 * np.outer(H, H)
    belief = DepthBelief(belief.mean, jnp.asarray(far, jnp.float32)[..., None])
    got, nats = with_read(belief, ONE, jnp.array(1.0), jnp.array([0.02]), jnp.array(0.04))
    assert float(nats[0]) == 0.0
    assert float(got.mean[3, 0]) == pytest.approx(1.0)
    assert float(got.covariance[3, 3, 0]) == pytest.approx(0.02, abs=1e-4)
    np.testing.assert_allclose(got.mean[:2, 0], mean[:2], atol=1e-6)


@pytest.mark.parametrize("shifted", [[1.0, 1.0, 1.0], [0.0, 1.0, 0.0]])
def test_an_unknown_common_phase_is_set_by_its_first_read(shifted: list[float]) -> None:
    """The differences of what is shifted together stay, and so does what is known of the depth."""
    belief, mean, covariance = _belief(3)
    got = with_phase_set(belief, ONE, jnp.array(2.0), jnp.array([0.03]), jnp.array(shifted))
    g = np.array([0.0, 0.0, *shifted])
    change = np.eye(2 + NUM) - np.outer(g, H)
    _close(got, mean + g * (2.0 - mean[3]), change @ covariance @ change.T + 0.03 * np.outer(g, g))


def test_a_rate_of_infinite_variance_says_nothing() -> None:
    belief, mean, covariance = _belief(4)
    _close(with_rate(belief, jnp.array([5.0]), jnp.array([jnp.inf])), mean, covariance)
    sure = with_rate(belief, jnp.array([0.7]), jnp.array([1e-8]))
    assert float(sure.mean[1, 0]) == pytest.approx(0.7, abs=1e-4)
    assert float(sure.covariance[1, 1, 0]) == pytest.approx(0.0, abs=1e-5)


def test_gradients_are_finite() -> None:
    belief, _, _ = _belief(5)

    def nats(variance, phase):
        own, value = with_read(belief, ONE, phase, variance[None], jnp.array(0.04))
        return value[0] + jnp.sum(own.mean)

    for phase in (0.0, 3.1, 100.0):
        assert all(np.isfinite(one) for one in jax.grad(nats, (0, 1))(jnp.array(0.02), jnp.array(phase)))
