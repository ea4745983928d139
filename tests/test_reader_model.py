"""The reader's phase model against the measured noise, and its likelihood where float32 is short."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from tagjax.radio.noise import thermal_sigma_rad
from tagjax.radio.reader_model import ReaderModel

RSSI_DBM = np.array([-75.0, -60.0, -45.0, np.nan, -30.0], np.float32)


def test_thermal_noise_is_that_of_the_measured_fit():
    np.testing.assert_allclose(
        ReaderModel().thermal_rad(jnp.asarray(RSSI_DBM)), thermal_sigma_rad(RSSI_DBM.astype(float)), rtol=1e-5
    )


@pytest.mark.parametrize("modulo_pi", [True, False])
def test_the_concentration_is_the_inverse_of_the_variance(modulo_pi):
    reader = ReaderModel(spread_rad=0.07, still_spread_rad=0.02, moving_m_s=0.1, modulo_pi=modulo_pi)
    found = reader.concentration(jnp.asarray(-55.0), jnp.array([0.0, -0.1, 0.1, 1e6]))
    variance = thermal_sigma_rad(np.full(4, -55.0)) ** 2 + np.array([0.02**2, *[(0.02**2 + 0.07**2) / 2] * 2, 0.07**2])
    np.testing.assert_allclose(found, 1 / ((4 if modulo_pi else 1) * variance), rtol=1e-5)


def test_a_motion_turns_the_phasor_and_adds_its_variance():
    moved, phasor = np.array([0.0, 0.05, -0.2, 0.05]), np.array([5.0, 40.0, 40.0, 0.0]) * np.exp(0.3j)
    reader = ReaderModel(drift_m=0.003)
    real, imaginary, moved_m = (jnp.asarray(each, jnp.float32) for each in (phasor.real, phasor.imag, moved))
    real, imaginary = reader.moved(real, imaginary, moved_m, jnp.asarray(2.0), jnp.asarray(915e6))
    wave = 2 * 4 * np.pi * 915e6 / 299_792_458.0
    turned = np.exp(1j * (0.3 + wave * moved))
    length = np.array([1 / (1 / 5 + 0.0), *(1 / (1 / 40 + wave**2 * 0.003 * 2.0**2 * np.abs(moved[1:3]))), 0.0])
    np.testing.assert_allclose(np.asarray(real) + 1j * np.asarray(imaginary), length * turned, atol=2e-5)


def test_the_length_after_a_motion_is_that_of_a_distribution_with_the_added_variance():
    """A von Mises distribution of concentration 20, convolved with a normal one, in numbers."""
    angle = np.linspace(-np.pi, np.pi, 20001)
    before, noise = np.exp(20 * (np.cos(angle) - 1)), np.exp(-0.5 * angle**2 / 0.04)
    both = np.real(np.fft.ifft(np.fft.fft(before) * np.fft.fft(np.fft.ifftshift(noise))))
    resultant = np.sum(both * np.cos(angle)) / np.sum(both)
    moved = 0.04 / (0.003 * 3.0**2 * (8 * np.pi * 915e6 / 299_792_458.0) ** 2)
    real, imaginary = ReaderModel(drift_m=0.003).moved(
        jnp.asarray(20.0), jnp.asarray(0.0), jnp.asarray(moved, jnp.float32), jnp.asarray(3.0), jnp.asarray(915e6)
    )
    length = np.hypot(float(real), float(imaginary))
    assert special.ive(1, length) / special.ive(0, length) == pytest.approx(resultant, abs=2e-3)


def test_a_read_adds_what_scipy_says_also_to_phasors_of_thousands():
    rng = np.random.default_rng(0)
    size, angle = rng.choice([0.0, 1e-6, 3.0, 50.0, 5000.0], 200), rng.uniform(0, 2 * np.pi, 200)
    phasor = (size * np.exp(1j * angle)).astype(np.complex64)
    weight = rng.uniform(0.5, 80, 200).astype(np.float32)
    phase = ((angle + rng.normal(0, 0.2, 200)) / 2).astype(np.float32)
    reader = ReaderModel(outlier=0.05)
    found, real, imaginary = reader.add_read(*(jnp.asarray(each) for each in (phasor.real, phasor.imag, weight, phase)))
    own = weight.astype(float) * np.exp(2j * phase.astype(float))
    before, after = np.abs(phasor.astype(complex)), np.abs(phasor.astype(complex) + own)
    gain = (after - before - weight) + np.log(
        special.ive(0, after) / special.ive(0, before) / special.ive(0, weight.astype(float))
    )
    np.testing.assert_allclose(found, np.logaddexp(np.log(0.95) + gain, np.log(0.05)), atol=3e-5)
    inlier = 0.95 * np.exp(gain) / (0.95 * np.exp(gain) + 0.05)
    np.testing.assert_allclose(
        np.asarray(real) + 1j * np.asarray(imaginary), phasor + inlier * own, rtol=1e-5, atol=1e-4
    )


def test_gradients_are_finite_without_rssi():
    def score(reader, rssi):
        return jnp.sum(reader.concentration(rssi, jnp.array([0.0, 0.01, -0.1, 0.5, 0.0])))

    gradient = eqx.filter_grad(score)(ReaderModel(), jnp.asarray(RSSI_DBM))
    assert len(jax.tree.leaves(gradient)) == 8
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("wrong", [{"spread_rad": 0.0}, {"drift_m": -0.1}, {"outlier": 0.0}, {"outlier": 1.0}])
def test_values_that_a_reader_cannot_have_are_refused(wrong):
    with pytest.raises(ValueError, match="expected"):
        ReaderModel(**wrong)
