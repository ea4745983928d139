"""Properties of phase unwrapping for any path within its limits: exact recovery, invariance to offsets, sign."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tagjax.core.numerics import SPEED_OF_LIGHT_M_S, wrap_to_pi
from tagjax.radio.phase import distance_to_phase, phase_to_distance
from tagjax.radio.reads import PhaseReads
from tagjax.radio.unwrap import MAX_ACCELERATION_M_S2, PI_JUMP_RAD, remove_jump, unwrap_paper

NUM_READS = 40  # one length, so that each function is compiled once
CARRIER_HZ = 920e6
MAX_STEP_M = 0.98 * float(PI_JUMP_RAD) * SPEED_OF_LIGHT_M_S / (4 * np.pi * CARRIER_HZ)
"""A step below the first threshold: an eighth of a wavelength, 41 mm."""

unwrap = jax.jit(unwrap_paper)
angles = st.floats(-1e3, 1e3)


@st.composite
def paths(draw):
    """Times and distances of reads whose steps and accelerations stay within the limits."""
    size = {"min_size": NUM_READS, "max_size": NUM_READS}
    gap_s = np.array(draw(st.lists(st.floats(0.005, 0.06), **size)))
    acceleration = np.array(draw(st.lists(st.floats(-0.98, 0.98), **size))) * MAX_ACCELERATION_M_S2
    velocity, distance_m = 0.0, [draw(st.floats(0.5, 10.0))]
    for number in range(1, NUM_READS):
        # The paper's acceleration: the change of velocity over the mean of the two gaps.
        velocity += acceleration[number] * 0.5 * (gap_s[number] + gap_s[number - 1])
        # Clipping at one bound for all gaps changes velocities by no more than the acceleration allows.
        velocity = float(np.clip(velocity, -MAX_STEP_M / 0.06, MAX_STEP_M / 0.06))
        distance_m.append(distance_m[-1] + velocity * gap_s[number])
    return np.cumsum(gap_s), np.array(distance_m)


def unwrapped(time_s, phase_rad) -> np.ndarray:
    """`unwrap_paper` in double precision, of reads of one channel with phases in [0, 2 pi)."""
    with jax.enable_x64(True):
        reads = PhaseReads(
            time_s=jnp.asarray(time_s),
            phase_rad=jnp.asarray(np.mod(phase_rad, 2 * np.pi)),
            carrier_hz=jnp.full(NUM_READS, CARRIER_HZ, jnp.float64),
            sigma_rad=jnp.full(NUM_READS, 0.05, jnp.float64),
            channel=jnp.zeros(NUM_READS, jnp.int32),
            valid=jnp.ones(NUM_READS, bool),
        )
        return np.asarray(unwrap(reads))


def phase_of(distance_m: np.ndarray) -> np.ndarray:
    return 4 * np.pi * CARRIER_HZ / SPEED_OF_LIGHT_M_S * distance_m


@given(paths())
def test_a_path_within_the_limits_is_recovered_exactly(path):
    time_s, distance_m = path
    np.testing.assert_allclose(unwrapped(time_s, phase_of(distance_m)), distance_m - distance_m[0], atol=1e-9)


@given(paths(), st.floats(-10.0, 10.0))
def test_a_constant_offset_of_the_phase_changes_nothing(path, offset_rad):
    time_s, distance_m = path
    found = unwrapped(time_s, phase_of(distance_m) + offset_rad)
    np.testing.assert_allclose(found, distance_m - distance_m[0], atol=1e-9)


@given(paths())
def test_distance_grows_with_phase(path):
    """The sign convention: the negative phase gives the mirrored path, and a growing phase a growing distance."""
    time_s, distance_m = path
    mirrored = unwrapped(time_s, -phase_of(distance_m))
    np.testing.assert_allclose(mirrored, distance_m[0] - distance_m, atol=1e-9)
    growing = unwrapped(time_s, 0.3 * np.arange(NUM_READS))
    np.testing.assert_allclose(np.diff(growing)[0], 0.3 * SPEED_OF_LIGHT_M_S / (4 * np.pi * CARRIER_HZ), atol=1e-12)


@given(st.floats(-0.499, 0.499), st.sampled_from([-2, -1, 0, 1, 2]))
def test_jumps_by_pi_and_2_pi_are_removed_whatever_the_step(step, half_turns):
    with jax.enable_x64(True):
        found = remove_jump(jnp.asarray((step + half_turns) * np.pi))
    np.testing.assert_allclose(found, step * np.pi, atol=1e-9)


@given(angles, st.sampled_from([np.pi, 2 * np.pi, 1.0]))
def test_a_wrapped_angle_differs_by_whole_periods_and_lies_about_zero(angle_rad, period_rad):
    with jax.enable_x64(True):
        wrapped = float(wrap_to_pi(jnp.asarray(angle_rad), period_rad))
        again = float(wrap_to_pi(jnp.asarray(wrapped), period_rad))
    turns = (angle_rad - wrapped) / period_rad
    assert abs(turns - round(turns)) < 1e-9
    assert -period_rad / 2 - 1e-9 <= wrapped <= period_rad / 2 + 1e-9
    assert abs(again - wrapped) < 1e-9 or abs(abs(again - wrapped) - period_rad) < 1e-9


@given(st.floats(-50.0, 50.0, allow_subnormal=False), st.floats(860e6, 960e6))
def test_distance_and_phase_are_inverse_to_each_other(distance_m, carrier_hz):
    with jax.enable_x64(True):
        carrier, distance = jnp.asarray(carrier_hz), jnp.asarray(distance_m)
        phase = distance_to_phase(distance, carrier)
        np.testing.assert_allclose(
            phase, 4 * np.pi * carrier_hz * distance_m / SPEED_OF_LIGHT_M_S, rtol=1e-12, atol=1e-300
        )
        np.testing.assert_allclose(phase_to_distance(phase, carrier), distance_m, rtol=1e-12, atol=1e-300)
