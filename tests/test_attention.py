"""Eqs. 4-6 against NumPy; Eq. 7's parts against their closed forms."""

import jax
import jax.numpy as jnp
import numpy as np

from tagjax.tagattention.attention import att_corr, att_rbf, attention, centre_first
from tagjax.tagattention.propagation import (
    log_likelihood_ratio,
    propagate,
    radio_speed,
    velocity_gate,
)

RNG = np.random.default_rng(0)
RHO = jnp.asarray(RNG.normal(size=(4, 3, 5)).astype(np.float32))
RD = jnp.asarray(RNG.normal(size=(1, 1, 5)).astype(np.float32))
ALL = jnp.ones(RHO.shape, dtype=bool)


def test_rbf_is_equation_4():
    out = att_rbf(RHO, RD, ALL, jnp.full((1, 1), 0.7))
    expected = np.exp(-np.sum((np.asarray(RHO) - np.asarray(RD)) ** 2, axis=-1) / 1.4)
    np.testing.assert_allclose(out, expected, rtol=1e-5)


def test_corr_is_equation_5():
    out = np.asarray(att_corr(RHO, RD, ALL))
    for i in range(4):
        for j in range(3):
            expected = max(0.0, np.corrcoef(np.asarray(RHO)[i, j], np.asarray(RD)[0, 0])[0, 1])
            np.testing.assert_allclose(out[i, j], expected, atol=1e-5)


def test_corr_ignores_scale_and_shift_and_is_0_without_variation():
    np.testing.assert_allclose(att_corr(3.0 * RD + 1.0, RD, ALL[:1, :1]), 1.0, atol=1e-6)
    assert float(att_corr(jnp.ones((1, 1, 5)), RD, ALL[:1, :1])[0, 0]) == 0.0


def test_mixture_is_equation_6():
    np.testing.assert_allclose(attention(jnp.asarray(0.5), jnp.asarray(1.0), jnp.asarray(0.8)), 0.6, rtol=1e-6)


def test_centred_motion_starts_at_0_and_marks_the_unknown():
    valid = ALL.at[0, 0, 2].set(False).at[1, 1, 0].set(False)
    out = centre_first(RHO, valid)
    assert float(jnp.abs(out[..., 0]).max()) == 0.0
    assert float(out[0, 0, 2]) == 0.0
    assert float(jnp.abs(out[1, 1]).max()) == 0.0


def test_an_unknown_sample_does_not_count():
    valid = ALL.at[..., 3].set(False)
    wild = RHO.at[..., 3].set(1e3)
    for score in (lambda m: att_rbf(m, RD, valid, jnp.ones((1, 1))), lambda m: att_corr(m, RD, valid)):
        np.testing.assert_allclose(score(wild), score(RHO), rtol=1e-5)


def test_gradients_agree_with_finite_differences(gradients_agree):
    sure = jnp.ones(5, dtype=bool)
    rho, rd = np.asarray(RHO[0, 0]), np.asarray(RD[0, 0])
    rd = rd * np.sign(np.corrcoef(rho, rd)[0, 1])
    gradients_agree(lambda m, r, a: att_rbf(m, r, sure, a), (rho, rd, np.asarray(0.7)))
    gradients_agree(lambda m, r: att_corr(m, r, sure), (rho, rd))


def test_gradients_are_finite_where_nothing_moves():
    still = jnp.zeros(5)
    sure = jnp.ones(5, dtype=bool)
    assert bool(jnp.isfinite(jax.grad(lambda m: att_corr(m, RD[0, 0], sure))(still)).all())
    assert bool(jnp.isfinite(jax.grad(lambda m: att_rbf(m, RD[0, 0], sure, jnp.asarray(5e-4)))(still)).all())


def test_jit_and_vmap_change_nothing():
    eager = att_corr(RHO, RD, ALL)
    looped = jnp.stack([att_corr(r[None], RD, v[None])[0] for r, v in zip(RHO, ALL, strict=True)])
    np.testing.assert_allclose(jax.jit(att_corr)(RHO, RD, ALL), eager, atol=1e-6)
    np.testing.assert_allclose(jax.vmap(lambda r, v: att_corr(r[None], RD, v[None])[0])(RHO, ALL), looped, atol=1e-6)


def test_gate_becomes_the_step():
    speed = jnp.asarray([0.0, 0.099, 0.101, 1.0])
    np.testing.assert_allclose(velocity_gate(speed, jnp.asarray(0.1), jnp.asarray(1e-5)), [0, 0, 1, 1], atol=1e-6)


def test_radio_speed_is_the_mean_over_the_window():
    time_s = jnp.asarray([0.0, 0.1, 0.3])
    np.testing.assert_allclose(radio_speed(jnp.asarray([0.0, -0.1, -0.15]), time_s), 0.5, rtol=1e-6)
    assert float(radio_speed(jnp.asarray([0.0, 1.0, 2.0]), jnp.zeros(3))) == 0.0


def test_propagation_is_equation_7_without_forgetting_and_rests_behind_a_closed_gate():
    past, now = jnp.asarray([1.0, -2.0]), jnp.asarray([0.3, 0.4])
    np.testing.assert_allclose(propagate(past, now, jnp.asarray(1.0), jnp.asarray(1.0)), past + now)
    np.testing.assert_array_equal(propagate(past, now, jnp.asarray(0.0), jnp.asarray(0.5)), past)


def test_evidence_is_log_attention_against_background_1():
    a = jnp.asarray([0.2, 0.9])
    out = log_likelihood_ratio(a, jnp.asarray(1.0), jnp.asarray(1e-7))
    np.testing.assert_allclose(out, np.log([0.2, 0.9]), rtol=1e-5)
