"""Phase evidence against the integral that it stands for, and what it must not depend on."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special

from tagjax.core.numerics import log_i0
from tagjax.radio.reads import PhaseReads
from tagjax.tagattention.phases import MAX_FRESH_READS, Fresh, PhaseNoise, Phasor, explain, fresh_reads

C = 299_792_458.0
FRAME_S = 0.05
COMPILED, FRESH = jax.jit(explain, static_argnames="doubled_angle"), jax.jit(fresh_reads)
NO_CHANNEL = jnp.asarray(-1, jnp.int32)


def _noise(spread_rad: float = 0.1, slack: float = 1e-6, outlier: float = 1e-9, dtype=jnp.float32) -> PhaseNoise:
    return PhaseNoise(*(jnp.asarray(value, dtype) for value in (spread_rad**2, slack, outlier)))


def _reads(time_s, distance_m, channel, rng=None, *, flips: bool = False, dtype=jnp.float32) -> PhaseReads:
    """Noise-free reads (but for the given generator's) at these distances, an offset for each channel."""
    time_s, channel = np.asarray(time_s, float), np.asarray(channel)
    carrier = 902.75e6 + 5e5 * channel
    phase = 4 * np.pi * carrier * np.asarray(distance_m) / C + 1.7 * channel + 0.4
    if rng is not None:
        phase = phase + rng.normal(0, 0.1, phase.shape)
    if flips:
        phase = phase + np.pi * (np.arange(len(phase)) % 2)
    return PhaseReads(
        time_s=jnp.asarray(time_s, dtype),
        phase_rad=jnp.asarray(np.mod(phase, 2 * np.pi), dtype),
        carrier_hz=jnp.asarray(carrier, dtype),
        sigma_rad=jnp.full(len(phase), 0.03, dtype),
        channel=jnp.asarray(channel, jnp.int32),
        valid=jnp.ones(len(phase), bool),
    )


def _follow(reads: PhaseReads, path, num_frames: int, noise: PhaseNoise, doubled_angle: bool = False):
    """The sum of the evidence over frames for a thing at `path(t)`, and the last phasor."""
    phasor, channel, total = Phasor.nothing(()), NO_CHANNEL, 0.0
    dtype = reads.time_s.dtype
    for i in range(num_frames):
        since, now = (jnp.asarray(FRAME_S * k, dtype) for k in (i, i + 1))
        until = int(np.sum(reads.time_s <= now))
        buffer = jax.tree.map(lambda leaf, until=until: np.roll(leaf, -until), reads)  # ends with the newest
        fresh = FRESH(buffer, channel, since, now)
        step = jnp.asarray(path(FRAME_S * (i + 1)) - path(FRAME_S * i), dtype)
        found, phasor = COMPILED(phasor, step, fresh, noise, doubled_angle=doubled_angle)
        total, channel = total + float(found), fresh.channel
    return total, phasor, channel


def test_log_i0_is_scipys():
    x = np.array([0.0, 1e-3, 0.5, 3.0, 30.0, 400.0])
    np.testing.assert_allclose(log_i0(jnp.asarray(x, jnp.float32)), np.log(special.i0e(x)) + x, rtol=1e-5, atol=1e-6)


def test_the_evidence_is_the_marginal_likelihood_over_the_offset():
    """Against the integral over one unknown offset a dwell, done by SciPy; two dwells, motion between frames."""
    rng = np.random.default_rng(0)
    time_s = np.sort(rng.uniform(0.001, 0.399, 14))
    channel = (time_s > 0.21).astype(int) * 3

    def path(t):
        return 2.0 + 0.5 * t

    with jax.enable_x64(True):
        reads = _reads(time_s, 2.0 + 0.45 * time_s, channel, rng, dtype=jnp.float64)
        weight = 1 / (0.03**2 + 0.1**2)
        noise = _noise(slack=1e-12, outlier=1e-300, dtype=jnp.float64)
        ours, _, _ = _follow(reads, path, 8, noise)
    expected = 0.0
    for one in (0, 3):
        own = channel == one
        residual = (
            np.asarray(reads.phase_rad)[own] - 4 * np.pi * np.asarray(reads.carrier_hz)[own] * path(time_s[own]) / C
        )

        def density(offset, residual=residual):
            return np.exp(weight * np.sum(np.cos(residual - offset) - 1))

        peak = np.angle(np.exp(1j * residual).sum())
        integral = integrate.quad(density, peak - np.pi, peak + np.pi, points=[peak])[0] / (2 * np.pi)
        expected += np.log(integral) - own.sum() * np.log(special.i0e(weight))
    assert ours == pytest.approx(expected, rel=1e-6)


def test_frames_share_the_evidence_as_they_like():
    """The same reads in one long frame, or in eight: the thing's speed is the same, and so is the sum."""
    rng = np.random.default_rng(1)
    time_s = np.sort(rng.uniform(0.001, 0.399, 12))
    reads = _reads(time_s, 2 + 0.4 * time_s, (time_s > 0.2).astype(int), rng)
    eight, last, channel = _follow(reads, lambda t: 2 + 0.4 * t, 8, _noise())
    fresh = fresh_reads(reads, NO_CHANNEL, jnp.asarray(0.0), jnp.asarray(0.4))
    at_once, phasor = explain(Phasor.nothing(()), jnp.asarray(0.16), fresh, _noise(), doubled_angle=False)
    assert eight == pytest.approx(float(at_once), abs=1e-2)
    np.testing.assert_allclose(phasor.total, last.total, rtol=1e-2)
    assert float(phasor.moved_m) == pytest.approx(float(last.moved_m), rel=1e-4)
    assert int(channel) == int(fresh.channel) == 1


def test_the_true_motion_explains_and_no_other_does():
    rng = np.random.default_rng(2)
    time_s = np.arange(0.01, 0.8, 0.03)
    reads = _reads(time_s, 2 + 0.5 * time_s, np.arange(len(time_s)) // 7, rng)
    scores = {speed: _follow(reads, lambda t, v=speed: 2 + v * t, 16, _noise())[0] for speed in (-0.5, 0.0, 0.4, 0.5)}
    assert scores[0.5] > 20
    assert scores[0.5] > scores[0.4] + 3
    assert max(scores[-0.5], scores[0.0]) < -20


def test_neither_range_nor_offset_matters():
    """Only how the distance changes counts: things near and far that move alike have one phasor."""
    time_s = np.arange(0.01, 0.39, 0.03)
    reads = _reads(time_s, 2 + 0.5 * time_s, np.zeros(len(time_s), int))
    near, one, _ = _follow(reads, lambda t: 2 + 0.5 * t, 8, _noise())
    turned = PhaseReads(
        reads.time_s, jnp.mod(reads.phase_rad + 2.1, 2 * jnp.pi), reads.carrier_hz, reads.sigma_rad, reads.channel,
        reads.valid,
    )  # fmt: skip
    far, other, _ = _follow(turned, lambda t: 7 + 0.5 * t, 8, _noise())
    assert near == pytest.approx(far, abs=2e-2)
    assert float(jnp.hypot(*one.total)) == pytest.approx(float(jnp.hypot(*other.total)), rel=1e-3)


def test_pi_flips_do_not_count_with_the_doubled_angle():
    time_s = np.arange(0.01, 0.39, 0.03)
    plain, flipped = (_reads(time_s, 2 + 0.5 * time_s, np.zeros(13, int), flips=flips) for flips in (False, True))
    follow = functools.partial(_follow, path=lambda t: 0.5 * t, num_frames=8, noise=_noise(), doubled_angle=True)
    assert follow(plain)[0] == pytest.approx(follow(flipped)[0], abs=1e-2)
    assert _follow(flipped, lambda t: 0.5 * t, 8, _noise())[0] < -50


def test_a_read_costs_no_more_than_the_share_of_outliers_and_leaves_the_phasor():
    time_s = np.arange(0.01, 0.39, 0.03)
    reads = _reads(time_s, np.full(13, 2.0), np.zeros(13, int))
    wrong = jnp.where(jnp.arange(13) == 9, reads.phase_rad + 2.0, reads.phase_rad)
    bent = PhaseReads(reads.time_s, wrong, reads.carrier_hz, reads.sigma_rad, reads.channel, reads.valid)
    noise = _noise(outlier=0.05)
    clean, phasor, _ = _follow(reads, lambda t: 2.0, 8, noise)
    found, after, _ = _follow(bent, lambda t: 2.0, 8, noise)
    one_read = clean / 12
    assert clean - found < 1.5 * one_read - np.log(0.05)
    assert float(jnp.hypot(*after.total)) == pytest.approx(12 / 13 * float(jnp.hypot(*phasor.total)), rel=0.02)


def test_slack_forgives_a_share_of_the_motion_and_nothing_at_rest():
    time_s = np.arange(0.01, 0.39, 0.03)
    moving = _reads(time_s, 2 + 0.4 * time_s, np.zeros(13, int))  # a thing that is seen to move at 0.5 m/s
    resting = _reads(time_s, np.full(13, 2.0), np.zeros(13, int))
    tight, slack = _noise(0.05, outlier=0.05), _noise(0.05, slack=0.3, outlier=0.05)
    assert _follow(moving, lambda t: 0.5 * t, 8, slack)[0] > _follow(moving, lambda t: 0.5 * t, 8, tight)[0] + 3
    assert _follow(resting, lambda t: 2.0, 8, slack)[0] == pytest.approx(_follow(resting, lambda t: 2.0, 8, tight)[0])


def test_without_reads_there_is_no_evidence_and_the_phasor_turns_with_the_object():
    reads = _reads([0.01, 0.02, 0.03], [2.0, 2.0, 2.0], [0, 0, 0])
    fresh = fresh_reads(reads, NO_CHANNEL, jnp.asarray(0.0), jnp.asarray(FRAME_S))
    _, phasor = explain(Phasor.nothing(()), jnp.asarray(0.0), fresh, _noise(), doubled_angle=False)
    silent = fresh_reads(reads, fresh.channel, jnp.asarray(FRAME_S), jnp.asarray(2 * FRAME_S))
    found, after = explain(phasor, jnp.asarray(0.01), silent, _noise(), doubled_angle=False)
    assert float(found) == 0.0
    assert int(silent.channel) == 0
    before, now = (float(jnp.arctan2(*one.total[::-1])) for one in (phasor, after))
    expected = 4 * np.pi * 902.75e6 * 0.01 / C
    assert np.mod(now - before, 2 * np.pi) == pytest.approx(expected, rel=1e-4)
    assert float(after.moved_m) == pytest.approx(0.01)


def test_of_too_many_reads_the_newest_count():
    time_s = np.linspace(0.001, 0.049, 3 * MAX_FRESH_READS)
    fresh = fresh_reads(
        _reads(time_s, np.full(len(time_s), 2.0), np.zeros(len(time_s), int)),
        NO_CHANNEL,
        jnp.asarray(0.0),
        jnp.asarray(1.0),
    )
    assert int(fresh.reads.valid.sum()) == MAX_FRESH_READS
    np.testing.assert_allclose(fresh.reads.time_s, time_s[-MAX_FRESH_READS:], rtol=1e-5)


def _some(dtype=jnp.float32) -> tuple[Phasor, Fresh]:
    rng = np.random.default_rng(3)
    reads = _reads([0.01, 0.02, 0.03, 0.04], 2 + rng.normal(0, 0.01, 4), [0, 0, 1, 1], dtype=dtype)
    edges = (jnp.asarray(value, dtype) for value in (0.005, FRAME_S))
    return Phasor(jnp.asarray([8.0, -3.0], dtype), jnp.asarray(0.02, dtype)), fresh_reads(
        reads, jnp.asarray(0, jnp.int32), *edges
    )


def test_gradients_are_those_of_finite_differences():
    with jax.enable_x64(True):
        phasor, fresh = _some(jnp.float64)

        @jax.jit
        def score(values):
            start, step, spread, slack, outlier = values[:3], values[3], values[4], values[5], values[6]
            noise = PhaseNoise(spread, slack, outlier)
            value, after = explain(Phasor(start[:2], start[2]), step, fresh, noise, doubled_angle=True)
            return value + 0.1 * jnp.sum(after.total) + after.moved_m

        at = jnp.concatenate([phasor.total, phasor.moved_m[None], jnp.asarray([0.013, 0.01, 0.2, 0.05])])
        gradient = jax.jit(jax.grad(score))(at)
        for i in range(len(at)):
            h = 1e-6
            change = (score(at.at[i].add(h)) - score(at.at[i].add(-h))) / (2 * h)
            assert float(gradient[i]) == pytest.approx(float(change), rel=1e-5, abs=1e-7), i


@pytest.mark.parametrize("silent", [False, True])
def test_gradients_are_finite_from_nothing(silent):
    _, fresh = _some()
    if silent:
        fresh = fresh_reads(fresh.reads, NO_CHANNEL, jnp.asarray(5.0), jnp.asarray(5.0))

    def score(phasor, step):
        value, after = explain(phasor, step, fresh, _noise(), doubled_angle=True)
        return value + jnp.sum(after.total)

    gradient = jax.jit(jax.grad(score, argnums=(0, 1)))(Phasor.nothing(()), jnp.asarray(0.0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_jit_and_vmap_are_eager_and_loop():
    phasor, fresh = _some()
    steps = jnp.asarray([-0.02, 0.0, 0.013])
    run = functools.partial(explain, fresh=fresh, noise=_noise(slack=0.2, outlier=0.05), doubled_angle=True)
    mapped = jax.jit(jax.vmap(run, in_axes=(None, 0)))(phasor, steps)
    for i, step in enumerate(steps):
        each = run(phasor, step)
        for ours, other in zip(jax.tree.leaves(mapped), jax.tree.leaves(each), strict=True):
            np.testing.assert_allclose(ours[i], other, rtol=2e-4, atol=2e-4)
