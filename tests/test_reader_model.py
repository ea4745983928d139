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
    reader = ReaderModel(spread_rad=0.07, still_spread_rad=0.02, slack=0.3, modulo_pi=modulo_pi)
    moved = np.array([0.0, 0.05, -0.2])
    still = np.array([True, False, False])
    found = reader.concentration(
        jnp.asarray(-55.0), jnp.asarray(915e6), jnp.asarray(moved, jnp.float32), jnp.asarray(still)
    )
    slack = 0.3 * 4 * np.pi * 915e6 / 299_792_458.0 * moved
    variance = thermal_sigma_rad(np.full(3, -55.0)) ** 2 + np.where(still, 0.02, 0.07) ** 2 + slack**2
    np.testing.assert_allclose(found, 1 / ((4 if modulo_pi else 1) * variance), rtol=1e-5)


def test_a_read_adds_what_scipy_says_also_to_phasors_of_thousands():
    rng = np.random.default_rng(0)
    size, angle = rng.choice([0.0, 1e-6, 3.0, 50.0, 5000.0], 200), rng.uniform(0, 2 * np.pi, 200)
    phasor = (size * np.exp(1j * angle)).astype(np.complex64)
    weight = rng.uniform(0.5, 80, 200).astype(np.float32)
    residual = ((angle + rng.normal(0, 0.2, 200)) / 2).astype(np.float32)
    reader = ReaderModel(outlier=0.05)
    found, real, imaginary = reader.add_read(
        *(jnp.asarray(each) for each in (phasor.real, phasor.imag, weight, residual))
    )
    own = weight.astype(float) * np.exp(2j * residual.astype(float))
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
        return jnp.sum(reader.concentration(rssi, jnp.asarray(915e6), jnp.zeros(5), jnp.zeros(5, bool)))

    gradient = eqx.filter_grad(score)(ReaderModel(), jnp.asarray(RSSI_DBM))
    assert len(jax.tree.leaves(gradient)) == 7
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("wrong", [{"spread_rad": 0.0}, {"slack": -0.1}, {"outlier": 0.0}, {"outlier": 1.0}])
def test_values_that_a_reader_cannot_have_are_refused(wrong):
    with pytest.raises(ValueError, match="expected"):
        ReaderModel(**wrong)
