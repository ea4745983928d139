"""The free path: an independent filter in NumPy, what it explains and what it does not, padding, and its gradient."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

from tagjax.benchmarks.segments_numpy.reads import FreePaths
from tagjax.core.numerics import SPEED_OF_LIGHT_M_S
from tagjax.radio.arrivals import Arrivals
from tagjax.radio.reader_model import ReaderModel
from tagjax.tagattention.segments import FreePath
from tagjax.tagattention.segments.free_path import FreePathState

CARRIERS_HZ = np.array([903e6, 914e6, 926e6])
MEMORY_S = jnp.asarray(4.0)
READER, FREE = ReaderModel(), FreePath()


def reads(range_m, *, seconds: float = 2.0, rate_hz: float = 40.0, tag: int = 0, antenna: int = 0, seed: int = 0):
    """Reads of a tag at `range_m(time)` that hop every 0.2 s, with an offset for every dwell."""
    rng = np.random.default_rng(seed)
    time_s = np.sort(rng.uniform(0, seconds, int(seconds * rate_hz)))
    dwell = (time_s / 0.2).astype(int)
    carrier_hz = CARRIERS_HZ[dwell % 3]
    offset = rng.uniform(0, 2 * np.pi, dwell.max() + 1)[dwell]
    phase = 4 * np.pi * carrier_hz / SPEED_OF_LIGHT_M_S * range_m(time_s) + offset + rng.normal(0, 0.05, len(time_s))
    number = len(time_s)
    return Arrivals(
        tag=np.full(number, tag, np.int32),
        antenna=np.full(number, antenna, np.int32),
        time_s=time_s.astype(np.float32),
        phase_rad=np.mod(phase, 2 * np.pi).astype(np.float32),
        carrier_hz=carrier_hz.astype(np.float32),
        channel=(carrier_hz / 1e3).astype(np.int32),
        rssi_dbm=np.full(number, -55, np.float32),
        valid=np.ones(number, bool),
    )


def together(*parts: Arrivals) -> Arrivals:
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    order = np.argsort(joined.time_s, kind="stable")
    return jax.tree.map(lambda leaf: leaf[order], joined)


def random_phases(like: Arrivals, seed: int = 1) -> Arrivals:
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(like.time_s)).astype(np.float32)
    return eqx.tree_at(lambda one: one.phase_rad, like, phase)


def run(arrivals: Arrivals, free: FreePath = FREE, num_tags: int = 1, num_antennas: int = 1, padded: int = 0):
    """The state and evidence after one frame that holds all reads, without decay."""
    arrivals = jax.tree.map(lambda leaf: jnp.asarray(np.pad(leaf, (0, padded))), arrivals)
    now_s = jnp.max(arrivals.time_s)
    return free.step(READER, free.init(num_tags, num_antennas), arrivals, jnp.asarray(1e6), jnp.zeros(()), now_s)


def test_a_smooth_path_is_explained_and_random_phases_are_not():
    smooth = reads(lambda t: 2 + 0.3 * np.sin(2 * t))
    _, explained = run(smooth)
    _, random = run(random_phases(smooth))
    assert float(explained[0]) > 0.5 * len(smooth.time_s)
    assert float(random[0]) < 0


def test_a_path_known_beforehand_explains_the_reads_better():
    """The free path pays for each change of speed that it learns."""
    arrivals = reads(lambda t: 2 + 0.3 * np.sin(2 * t))
    distance_m = 2 + 0.3 * np.sin(2 * arrivals.time_s)
    real = imaginary = jnp.zeros(())
    last_m, channel, known = 0.0, -1, 0.0
    for at, (own_m, own) in enumerate(zip(distance_m, arrivals.channel, strict=True)):
        if own != channel:
            real = imaginary = jnp.zeros(())
        else:
            real, imaginary = READER.moved(
                real, imaginary, jnp.asarray(own_m - last_m), jnp.asarray(2.0), jnp.asarray(arrivals.carrier_hz[at])
            )
        concentration = READER.concentration(jnp.asarray(arrivals.rssi_dbm[at]), jnp.asarray(0.3))
        nats, real, imaginary = READER.add_read(real, imaginary, concentration, jnp.asarray(arrivals.phase_rad[at]))
        last_m, channel, known = own_m, own, known + float(nats)
    _, free = run(arrivals)
    assert known > float(free[0]) + 10.0


def test_one_dwell_at_constant_speeds_is_a_mixture():
    """Without diffusion the evidence is log(mean_k exp(evidence at the speed u_k))."""
    arrivals = reads(lambda t: 2 + 0.4 * t, seconds=0.19)
    free = FreePath(walk_m2_s3=1e-12, num_speeds=9)
    totals = []
    for speed in np.linspace(-2.4, 2.4, 9):
        real = imaginary = jnp.zeros(())
        total, last_s = 0.0, float(arrivals.time_s[0])
        for at, time_s in enumerate(arrivals.time_s):
            moved_m = jnp.asarray(speed * (time_s - last_s), jnp.float32)
            real, imaginary = READER.moved(real, imaginary, moved_m, jnp.asarray(2.0), jnp.asarray(914e6))
            concentration = READER.concentration(jnp.asarray(-55.0), jnp.asarray(speed, jnp.float32))
            nats, real, imaginary = READER.add_read(real, imaginary, concentration, jnp.asarray(arrivals.phase_rad[at]))
            total, last_s = total + float(nats), float(time_s)
        totals.append(total)
    one_carrier = eqx.tree_at(lambda one: one.carrier_hz, arrivals, np.full_like(arrivals.carrier_hz, 914e6))
    _, found = run(one_carrier, free)
    np.testing.assert_allclose(float(found[0]), logsumexp(totals) - np.log(9), rtol=1e-4)


def test_it_is_the_filter_in_numpy():
    """Two tags at two antennas, frame by frame, with flips of channels and reads in any order of tags."""
    parts = [
        reads(lambda t, tag=tag, antenna=antenna: 2 + 0.3 * np.sin(2 * t + tag), tag=tag, antenna=antenna, seed=seed)
        for seed, (tag, antenna) in enumerate(np.ndindex(2, 2))
    ]
    arrivals = together(*parts)
    twin, state = FreePaths(FREE, READER, 2, 2), FREE.init(2, 2)
    step = eqx.filter_jit(
        lambda state, given, since_s, now_s: FREE.step(READER, state, given, MEMORY_S, since_s, now_s)
    )
    for frame in range(20):
        since_s, now_s = np.float32(0.1 * frame), np.float32(0.1 * (frame + 1))
        valid = (arrivals.time_s > since_s) & (arrivals.time_s <= now_s)
        given = eqx.tree_at(lambda one: one.valid, arrivals, valid)
        state, added = step(state, jax.tree.map(jnp.asarray, given), jnp.asarray(since_s), jnp.asarray(now_s))
        expected = twin.step(vars(given), np.float32(4), since_s, now_s)
        np.testing.assert_allclose(added, expected, rtol=1e-3, atol=2e-3, err_msg=f"frame {frame}")
    np.testing.assert_allclose(state.log_likelihood, twin.log_likelihood, rtol=1e-3)
    np.testing.assert_allclose(state.probability, twin.probability, atol=1e-3)


def test_tags_and_antennas_do_not_disturb_each_other():
    one = reads(lambda t: 2 + 0.2 * t, seed=3)
    other = random_phases(reads(lambda t: 2 - 0.1 * t, tag=1, antenna=1, seed=4))
    _, alone = run(one, num_tags=2, num_antennas=2)
    _, both = run(together(one, other), num_tags=2, num_antennas=2)
    np.testing.assert_allclose(both[0], alone[0], rtol=1e-5)
    assert float(alone[1]) == 0.0


def test_padding_changes_nothing():
    arrivals = reads(lambda t: 2 + 0.2 * t)
    state, nats = run(arrivals)
    with_padding, same = run(arrivals, padded=5)
    np.testing.assert_array_equal(same, nats)
    for found, expected in zip(jax.tree.leaves(with_padding), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_evidence_is_forgotten_and_no_reads_add_none():
    empty = jax.tree.map(jnp.asarray, reads(lambda t: 2 + 0 * t))
    empty = eqx.tree_at(lambda one: one.valid, empty, jnp.zeros(len(empty.time_s), bool))
    before = eqx.tree_at(lambda one: one.log_likelihood, FREE.init(1, 1), jnp.array([50.0]))
    after, added = FREE.step(READER, before, empty, MEMORY_S, jnp.zeros(()), jnp.asarray(2.0))
    assert float(added[0]) == 0.0
    np.testing.assert_allclose(after.log_likelihood, 50 * np.exp(-0.5), rtol=1e-5)


def test_reads_at_one_time_and_a_clock_that_goes_back_are_finite_with_their_gradients():
    arrivals = jax.tree.map(jnp.asarray, reads(lambda t: 2 + 0.2 * t, seconds=0.5))
    time_s = arrivals.time_s.at[3].set(arrivals.time_s[2]).at[5].set(0.0)

    def total(phase_rad, time_s, reader):
        given = eqx.tree_at(lambda one: (one.phase_rad, one.time_s), arrivals, (phase_rad, time_s))
        state: FreePathState = FREE.init(1, 1)
        return jnp.sum(FREE.step(reader, state, given, MEMORY_S, jnp.zeros(()), jnp.asarray(0.5))[1])

    value, gradient = jax.value_and_grad(total, argnums=(0, 1, 2))(arrivals.phase_rad, time_s, READER)
    assert np.isfinite(value)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


def test_the_gradient_is_that_of_finite_differences():
    with jax.enable_x64(True):
        arrivals = jax.tree.map(jnp.asarray, reads(lambda t: 2 + 0.2 * t, seconds=0.4))
        arrivals = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, arrivals)
        start, reader = jax.tree.map(
            lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, (FREE.init(1, 1), READER)
        )

        def total(shift_rad):
            given = eqx.tree_at(lambda one: one.phase_rad, arrivals, arrivals.phase_rad + shift_rad * arrivals.time_s)
            return FREE.step(reader, start, given, jnp.asarray(4.0), jnp.zeros(()), jnp.asarray(0.4))[1][0]

        step = 1e-5
        expected = (total(step) - total(-step)) / (2 * step)
        np.testing.assert_allclose(jax.grad(total)(0.0), expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"max_speed_m_s": 0.0}, "max_speed_m_s is 0"),
        ({"walk_m2_s3": -1.0}, "walk_m2_s3 is -1"),
        ({"num_speeds": 2}, "2"),
    ],
)
def test_settings_that_cannot_be_are_refused(wrong, text):
    with pytest.raises(ValueError, match=text):
        FreePath(**wrong)
