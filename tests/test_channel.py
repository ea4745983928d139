"""The radio channel against NumPy, closed forms and finite differences; drawn recordings against the measured tables."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from radio_environments import box_room, free_space, infinite_planes, point_scatterers
from scipy.optimize import fminbound, minimize

from tagjax.radio.noise import estimate_flip_probability
from tagjax.radio.reader import HOP_TABLES_HZ, ReaderState
from tagjax.recording.importers.clock import to_host_clock
from tagjax.recording.virtual_tags import Track
from tagjax.sim.radio import channel
from tagjax.sim.radio.channel import one_way_gain
from tagjax.sim.radio.environment import Environment, Planes, Scatterers
from tagjax.sim.radio.inventory import InventorySettings, clock_stamps, draw_schedule, simulate_inventory

C = 299_792_458.0
F = 915.25e6
CARRIER = jnp.float32(F)
BLOCKED = jnp.float32(0.0)
link_gain = eqx.filter_jit(one_way_gain)
free_gains = jax.jit(jax.vmap(lambda tag, carrier: one_way_gain(tag, HERE, carrier, free_space())))
HERE = jnp.zeros(3)
ROOM = box_room(
    np.array([-2.0, -2.5, -1.0]), np.array([3.0, 2.5, 12.0]), np.array([-0.4, -0.5, -0.6, 0.3, -0.7, -0.2j])
)
BODIES = Scatterers(
    position_m=[[0.8, 0.9, 2.0], [-1.0, 0.3, 4.0]],
    rcs_m2=[1.0, 0.3],
    reflection=[-0.7 + 0.2j, -1.0],
    axis=[[0.0, 1.0, 0.0], [0.6, 0.8, 0.0]],
    half_length_m=[0.85, 0.0],
    radius_m=[0.15, 0.0],
)
FURNISHED = Environment(ROOM, BODIES)
DIPOLE = np.array([0.6, 0.8, 0.0])
AHEAD = np.array([0.0, 0.28, 0.96])


def reference_gain(tag, antenna, carrier, transmission=1.0, dipole=None, boresight=None, *, environment=FURNISHED):
    """The one-way gain in float64, written from the physics: reflections by mirroring the tag, scatter by searching."""
    total = 0j

    def path(first, last, length, spread, factor):
        # first: ray as it leaves the antenna; last: as it meets the tag
        gain = 1.0
        if dipole is not None:
            lean = last @ dipole / np.linalg.norm(last)
            gain *= np.sqrt(0.1 + 0.9 * (np.cos(np.pi / 2 * lean) / np.sqrt(1 - lean**2)) ** 2)
        if boresight is not None:
            angle = np.arccos(np.clip(first @ boresight / np.linalg.norm(first), -1, 1))
            gain *= np.sqrt(0.01 + 0.99 * np.cos(angle / 2) ** 14.6)
        return gain * factor * np.exp(-2j * np.pi * carrier * length / C) / spread

    direct = tag - antenna
    total += path(direct, direct, np.linalg.norm(direct), np.linalg.norm(direct), transmission)
    planes = jax.tree.map(lambda x: np.asarray(x, complex if np.iscomplexobj(x) else float), environment.planes)
    for centre, normal, along, half, reflection in zip(
        planes.centre_m, planes.normal, planes.along, planes.half_size_m, planes.reflection, strict=True
    ):
        heights = (antenna - centre) @ normal, (tag - centre) @ normal
        if heights[0] * heights[1] <= 0:
            continue
        mirrored_tag = tag - 2 * heights[1] * normal
        hit = antenna + (mirrored_tag - antenna) * heights[0] / (heights[0] + heights[1])
        across = np.cross(normal, along)
        inside = 1.0
        for axis, reach in zip((along, across), half, strict=True):
            inside /= 1 + np.exp(-(reach - abs((hit - centre) @ axis)) / channel.EDGE_M)
        length = np.linalg.norm(hit - antenna) + np.linalg.norm(tag - hit)
        total += path(hit - antenna, tag - hit, length, length, reflection * inside)
    scatterers = jax.tree.map(lambda x: np.asarray(x, complex if np.iscomplexobj(x) else float), environment.scatterers)
    for place, rcs, reflection, axis, half, radius in zip(
        scatterers.position_m,
        scatterers.rcs_m2,
        scatterers.reflection,
        scatterers.axis,
        scatterers.half_length_m,
        scatterers.radius_m,
        strict=True,
    ):

        def bounce(s, place=place, axis=axis):
            return np.linalg.norm(place + s * axis - antenna) + np.linalg.norm(place + s * axis - tag)

        found = fminbound(bounce, -half, half, xtol=1e-11) if half else 0.0
        point = place + found * axis
        bisector = sum((end - point) / np.linalg.norm(end - point) for end in (antenna, tag))
        point = point + radius * bisector / np.linalg.norm(bisector)
        out, back = np.linalg.norm(point - antenna), np.linalg.norm(tag - point)
        total += path(
            point - antenna, tag - point, out + back, out + back + out * back / np.sqrt(rcs / 4 / np.pi), reflection
        )
    return total


def random_links(count, seed=0):
    rng = np.random.default_rng(seed)
    tag = rng.uniform([-1.8, -2.3, 1.0], [2.8, 2.3, 10.0], (count, 3))
    antenna = rng.uniform([-0.5, -0.5, -0.5], [0.5, 0.5, 0.5], (count, 3))
    return tag, antenna, rng.choice(HOP_TABLES_HZ["fcc"], count), rng.uniform(0, 1, count)


@jax.jit
def furnished_gains(tag, antenna, carrier, transmission):
    def one(t, a, f, s):
        return one_way_gain(
            t,
            a,
            f,
            FURNISHED,
            transmission=s,
            dipole=jnp.asarray(DIPOLE, t.dtype),
            boresight=jnp.asarray(AHEAD, t.dtype),
        )

    return jax.vmap(one)(tag, antenna, carrier, transmission)


def f32(x) -> Any:
    return jnp.asarray(x, jnp.float32)


def single(*arrays) -> Any:
    """As float32 on the device."""
    return tuple(f32(a) for a in arrays)


def angle_between(a, b):
    return np.abs(np.angle(a * np.conj(b)))


def test_gain_agrees_with_numpy_in_float64():
    """Two-way phase of 1e-3 rad where the paths do not cancel; the complex gain against the sum of their sizes always."""
    links = random_links(300)
    found = np.asarray(furnished_gains(*single(*links)), complex)
    expected = np.array([reference_gain(*link, DIPOLE, AHEAD) for link in zip(*links, strict=True)])
    distance = np.linalg.norm(links[0] - links[1], axis=1)
    assert np.max(np.abs(found - expected) * distance) < 3e-4
    strong = np.abs(expected) * distance > 0.2
    assert strong.sum() > 200
    assert np.max(angle_between(found**2, expected**2)[strong]) < 1e-3


def test_float32_keeps_the_phase_at_ten_metres():
    """4 pi f d / c is 383 rad there; positions and carriers as float64 for the reference."""
    rng = np.random.default_rng(1)
    tag = rng.normal(size=(2000, 3))
    tag *= rng.uniform(9.0, 10.0, (2000, 1)) / np.linalg.norm(tag, axis=1, keepdims=True)
    carrier = rng.choice(HOP_TABLES_HZ["china"], 2000)
    gain = free_gains(*single(tag, carrier))
    phase = np.asarray(channel.reported_phase_rad(channel.two_way_gain(gain)), float)
    exact = 4 * np.pi * carrier * np.linalg.norm(tag, axis=1) / C
    error = np.abs(np.angle(np.exp(1j * (phase - exact))))
    assert error.max() < 2e-4


@pytest.mark.parametrize("sign", [1, -1])
def test_free_space_phase_grows_by_4_pi_f_over_c(sign):
    distance = np.linspace(1.0, 2.0, 101)
    tag = np.stack([0 * distance, 0 * distance, distance], axis=1)
    gain = free_gains(*single(tag, np.full(101, F)))
    phase = np.asarray(channel.reported_phase_rad(channel.two_way_gain(gain), phase_sign=sign))
    assert phase.min() >= 0
    assert phase.max() < 2 * np.pi + 1e-6
    slope = np.polyfit(distance, np.unwrap(phase), 1)[0]
    np.testing.assert_allclose(slope, sign * 4 * np.pi * F / C, rtol=1e-5)


def test_free_space_rssi_falls_by_40_db_a_decade():
    gain = free_gains(jnp.diag(jnp.array([1.0, 3.0, 10.0])), jnp.full(3, F))
    rssi = np.asarray(channel.rssi_from_gain_dbm(channel.two_way_gain(gain), at_1m_dbm=-40.0))
    np.testing.assert_allclose(rssi, [-40.0, -40.0 - 40 * np.log10(3), -80.0], atol=1e-4)


def test_image_source_is_the_mirrored_geometry():
    """The path by the wall is the shortest one over its points; tag and antenna may change places."""
    wall = infinite_planes(np.array([[1.0, 2.0, -0.5]]), np.array([4.0]), np.array([-0.6]))
    around = Environment(wall, free_space().scatterers)
    antenna, tag = np.array([0.1, -0.2, 0.3]), np.array([0.4, 0.7, 2.0])
    normal = np.array([1.0, 2.0, -0.5])
    base, first, second = normal * 4 / (normal @ normal), np.array([2.0, -1.0, 0.0]), np.array([0.5, 0.0, 1.0])
    assert abs(first @ normal) + abs(second @ normal) < 1e-12

    def bounce(s):
        point = base + s[0] * first + s[1] * second
        return np.linalg.norm(point - antenna) + np.linalg.norm(point - tag)

    best = minimize(bounce, [0.0, 0.0], tol=1e-12)
    expected = -0.6 * np.exp(-2j * np.pi * F * best.fun / C) / best.fun
    blocked = complex(link_gain(f32(tag), f32(antenna), CARRIER, around, transmission=BLOCKED))
    assert abs(blocked - expected) < 1e-5
    swapped = complex(link_gain(f32(antenna), f32(tag), CARRIER, around, transmission=BLOCKED))
    assert abs(swapped - expected) < 1e-5
    behind = complex(link_gain(f32(tag + 3 * normal), f32(antenna), CARRIER, around, transmission=BLOCKED))
    assert behind == 0


def test_a_rectangle_reflects_only_where_it_is():
    def at(centre):
        plane = Planes([[*centre, 3.0]], [[0.0, 0.0, -1.0]], [[1.0, 0.0, 0.0]], [[0.5, 1.5]], [-1.0])
        around = Environment(plane, free_space().scatterers)
        return abs(complex(link_gain(f32([0.0, 0.0, 1.0]), HERE, CARRIER, around, transmission=BLOCKED)))

    whole = 1 / 5
    np.testing.assert_allclose(at((0.0, 0.0)), whole, rtol=0.02)
    np.testing.assert_allclose(at((0.5, 0.0)), whole / 2, rtol=0.02)
    assert at((1.5, 0.0)) < 1e-4 * whole
    np.testing.assert_allclose(at((0.0, 1.0)), whole, rtol=0.02)  # along the second axis it reaches 1.5 m


def test_blocked_line_of_sight_leaves_the_reflections():
    tag, antenna = single([0.5, 0.2, 3.0], [0.0, 0.0, 0.0])
    full, half, none = (
        complex(link_gain(tag, antenna, CARRIER, FURNISHED, transmission=jnp.float32(s))) for s in (1.0, 0.5, 0.0)
    )
    direct = complex(link_gain(tag, antenna, CARRIER, free_space()))
    np.testing.assert_allclose([full - none, 2 * (full - half)], direct, rtol=1e-4)
    assert 0.02 < abs(none) < 2 * abs(direct)
    assert complex(link_gain(tag, antenna, CARRIER, free_space(), transmission=BLOCKED)) == 0


def test_scatterer_obeys_the_radar_equation_far_and_a_mirror_near():
    def scattered(distance, rcs=1.0):
        scatterers = point_scatterers(np.array([[0.0, 0.0, distance]]), np.array([rcs]))
        around = Environment(free_space().planes, scatterers)
        return abs(complex(link_gain(f32([0.1, 0.0, 0.0]), HERE, CARRIER, around, transmission=BLOCKED)))

    np.testing.assert_allclose(scattered(50.0), np.sqrt(1 / (4 * np.pi)) / 50**2, rtol=0.02)
    np.testing.assert_allclose(scattered(1.0, rcs=1e6), 1 / 2, rtol=0.01)
    assert scattered(1.0, rcs=0.0) == 0


def test_dipole_null_and_patch_beam():
    axis, rays = jnp.array([0.0, 0.0, 1.0]), jnp.array([[1.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 1.0, 1.0]])
    gain = np.asarray(channel.dipole_amplitude(rays, axis))
    forty_five = np.cos(np.pi / 2 * np.sqrt(0.5)) / np.sqrt(0.5)
    np.testing.assert_allclose(40 * np.log10(gain[:2]), [0, -channel.NULL_DB], atol=1e-3)
    np.testing.assert_allclose(gain[2], np.sqrt(0.1 + 0.9 * forty_five**2), rtol=1e-5)
    angle = np.radians([0.0, 35.0, 180.0])
    leaving = jnp.asarray(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1), jnp.float32)
    np.testing.assert_allclose(20 * np.log10(channel.patch_amplitude(leaving, axis)), [0, -3, -20], atol=0.1)
    np.testing.assert_array_equal(channel.patch_amplitude(leaving, HERE), 1.0)


def test_gradients_agree_with_finite_differences(gradients_agree):
    def observed(tag, antenna, transmission, dipole, rcs):
        # Built here, so that it holds float64.
        room = box_room(np.array([-2.0, -2.5, -1.0]), np.array([3.0, 2.5, 6.0]), -0.5 + 0.1j)
        bodies = Scatterers([[0.8, 0.9, 2.0]], jnp.reshape(rcs, (1,)), [-0.7], [[0.0, 1.0, 0.0]], [0.85], [0.15])
        link = one_way_gain(
            tag,
            antenna,
            jnp.asarray(F, tag.dtype),
            Environment(room, bodies),
            transmission=transmission,
            dipole=dipole,
            boresight=jnp.asarray(AHEAD, tag.dtype),
        )
        there = channel.two_way_gain(link)
        return jnp.stack([there.real, there.imag, channel.reported_phase_rad(there), channel.rssi_from_gain_dbm(there)])

    gradients_agree(
        jax.jit(observed), ([0.4, -0.3, 2.2], [0.1, 0.2, 0.0], 0.7, [0.6, 0.0, 0.8], 0.8), rtol=1e-5, atol=1e-5
    )


@eqx.filter_jit
def value_and_gradient(tag, antenna, environment, transmission):
    def observed(tag, antenna, transmission):
        up = jnp.array([0.0, 0.0, 1.0])
        link = one_way_gain(tag, antenna, CARRIER, environment, transmission=transmission, dipole=up, boresight=up)
        there = channel.two_way_gain(link)
        return channel.reported_phase_rad(there) + channel.rssi_from_gain_dbm(there)

    return jax.value_and_grad(observed, argnums=(0, 1, 2))(tag, antenna, transmission)


@pytest.mark.parametrize("place", [[0.0, 0.0, 0.0], [-2.0, 0.5, 3.0], [0.8, 0.9, 2.0], [0.0, 0.0, 2.0]], ids=str)
def test_value_and_gradient_are_finite_at_degenerate_places(place):
    """On the antenna, on a wall, on a cylinder's axis, straight along dipole and beam."""

    for around in (FURNISHED, free_space()):
        for number in jax.tree.leaves(value_and_gradient(f32(place), HERE, around, jnp.float32(1.0))):
            assert np.isfinite(np.asarray(number)).all()


def test_no_signal_is_finite():
    value, gradients = value_and_gradient(f32([0.5, 0.3, 2.0]), HERE, free_space(), BLOCKED)
    assert float(value) == channel.NO_SIGNAL_DBM
    assert all(np.isfinite(np.asarray(g)).all() for g in gradients)


def test_jit_is_eager_and_vmap_is_a_loop():
    links = random_links(6, seed=2)
    batched = furnished_gains(*single(*links))
    arguments = {"dipole": jnp.asarray(DIPOLE, jnp.float32), "boresight": jnp.asarray(AHEAD, jnp.float32)}
    for number, (tag, antenna, carrier, s) in enumerate(zip(*single(*links), strict=True)):
        eager = one_way_gain(tag, antenna, carrier, FURNISHED, transmission=s, **arguments)
        np.testing.assert_allclose(batched[number], eager, atol=2e-5)


# Drawn recordings.

AT_ORIGIN = np.zeros((1, 3))


def still(positions, duration_s=60.0):
    """Tags that stay where they are."""
    time_s = np.linspace(0, duration_s, 31)
    return {f"E{k:03d}": Track(time_s, np.tile(np.asarray(p, float), (31, 1))) for k, p in enumerate(positions)}


def quiet_reader(region="fixed", floor_rad=0.012):
    table = np.asarray(HOP_TABLES_HZ[region])
    return ReaderState(table, np.zeros(len(table)), floor_rad, 0.0)


PLAIN = InventorySettings(
    region="fixed", flip_probability=0.0, dropout=0.0, outages_per_minute=0.0, latency_s=(0.0, 0.0)
)


@pytest.mark.parametrize(("num_tags", "rate", "per_dwell"), [(1, 50, 9), (4, 29, 6), (12, 15, 3), (25, 8, 1.6)])
def test_read_rate_by_number_of_tags(num_tags, rate, per_dwell):
    """Reads a second and tag, and reads of a tag on one channel (rfid-facts 1.9; 1 tag: Tagview's reader)."""
    paths = still([[0.1 * k, 0.0, 1.5] for k in range(num_tags)])
    drawn = simulate_inventory(paths, AT_ORIGIN, free_space(), seed=num_tags)
    reads = drawn.reads
    reads.check()
    count = np.array([np.sum(reads.epc == epc) for epc in paths])
    np.testing.assert_allclose(count.mean() / 60, rate, rtol=0.12)
    assert np.std(count) / count.mean() < 0.4
    hops = np.flatnonzero(np.diff(np.asarray(reads.channel_index)))
    np.testing.assert_allclose(reads.num_reads / num_tags / (len(hops) + 1), per_dwell, rtol=0.12)


def test_gaps_between_reads_of_a_tag():
    """Measured 55, 76 to 100, 145 to 153 ms at 50, 90, 99 % (rfid-facts 1.9), which is the median of 9 tags."""
    drawn = simulate_inventory(still([[0.1 * k, 0.0, 1.5] for k in range(9)]), AT_ORIGIN, free_space(), seed=0)
    gaps = np.concatenate([np.diff(drawn.time_s[drawn.reads.epc == epc]) for epc in drawn.reads.epcs])
    half, most, nearly_all = np.quantile(gaps, [0.5, 0.9, 0.99])
    assert abs(half - 0.055) < 0.005
    assert 0.070 < most < 0.100
    assert 0.100 < nearly_all < 0.160


def test_every_tag_replies_once_per_round_in_random_order():
    slots = draw_schedule(0.0, 30.0, 7, np.random.default_rng(0))
    assert np.diff(slots.time_s).min() > 5e-4
    rounds = [slots.tag[slots.round == r] for r in range(1, slots.round.max() - 1)]
    assert all(sorted(order) == list(range(7)) for order in rounds)
    first = np.bincount([order[0] for order in rounds], minlength=7) / len(rounds)
    np.testing.assert_allclose(first, 1 / 7, atol=0.05)
    begins = np.array([slots.time_s[slots.round == r][0] for r in range(1, slots.round.max() - 1)])
    np.testing.assert_allclose(np.mean(np.diff(begins)), 17.3e-3 + 7 * 4.23e-3, rtol=0.02)


def test_a_tag_out_of_range_takes_no_slot():
    """Six of seven tags go after 10 s: then the rounds are those of one tag; with none there is only the base."""
    when = np.array([0.0, 10.0, 20.0])
    present = np.ones((3, 7, 1), bool)
    present[1, 1:] = False
    present[2] = False
    slots = draw_schedule(0.0, 30.0, 7, np.random.default_rng(0), in_range=(when, present))
    assert set(slots.tag[slots.time_s > 10.1]) == {0}
    assert slots.time_s.max() < 20.1
    for low, high, num in ((0.0, 10.0, 7), (10.1, 20.0, 1)):
        some = (slots.time_s > low) & (slots.time_s < high)
        found = np.sum(some) / num / (high - low)
        np.testing.assert_allclose(found, 1 / (17.3e-3 + num * 4.23e-3), rtol=0.04)
    all_tags = (np.zeros(1), np.ones((1, 7, 1), bool))
    one, other = (draw_schedule(0.0, 30.0, 7, np.random.default_rng(0), in_range=w) for w in (None, all_tags))
    np.testing.assert_array_equal(one.time_s, other.time_s)


def test_antennas_wait_only_for_tags_that_they_reach():
    """A tag that only the second antenna reaches does not lengthen the first one's rounds."""
    present = np.ones((1, 4, 2), bool)
    present[0, 1:, 0] = False
    slots = draw_schedule(0.0, 60.0, 4, np.random.default_rng(1), num_antennas=2, in_range=(np.zeros(1), present))
    assert set(slots.tag[slots.antenna == 0]) == {0}
    assert set(slots.tag[slots.antenna == 1]) == {0, 1, 2, 3}
    rounds = 60.0 / (2 * 17.3e-3 + 5 * 4.23e-3)
    np.testing.assert_allclose(
        [np.sum(slots.antenna == 0), np.sum(slots.antenna == 1)], [rounds, 4 * rounds], rtol=0.04
    )


def test_far_tags_leave_the_reader_to_near_ones():
    """Eleven tags at 30 m are never read; the one at 1 m is read as if it were alone."""
    near, far = [[0.0, 0.0, 1.0]], [[0.5 * k, 0.0, 30.0] for k in range(11)]
    counts = []
    for positions in (near, near + far):
        reads = simulate_inventory(still(positions, 30.0), AT_ORIGIN, free_space(), PLAIN, seed=0).reads
        assert set(reads.epc) == {"E000"}
        counts.append(reads.num_reads)
    np.testing.assert_allclose(counts[1], counts[0], rtol=0.03)


@pytest.fixture(scope="module")
def static_by_rssi():
    """Static tags in free space, one for each RSSI, on one channel."""
    levels = np.array([-46.0, -50, -53, -59, -62, -65, -67])
    distance = 10 ** ((-45.0 - levels) / 40)
    paths = still([[0.0, 0.0, d] for d in distance])
    return levels, simulate_inventory(paths, AT_ORIGIN, free_space(), PLAIN, seed=3, reader=quiet_reader())


def test_phase_noise_by_rssi(static_by_rssi):
    """Measured sigma (rail, rfid-facts 1.5), and the line through it above the recording's floor."""
    levels, drawn = static_by_rssi
    measured = [0.014, 0.017, 0.019, 0.044, 0.052, 0.070, 0.080]
    for epc, level, sigma in zip(drawn.reads.epcs, levels, measured, strict=True):
        phase = drawn.reads.select(epc).phase_rad
        found = np.std(np.angle(np.exp(1j * (phase - phase[0]))))
        assert abs(np.log2(found / sigma)) < 0.7, level
        np.testing.assert_allclose(found, np.hypot(0.012, 10 ** (-0.0374 * level - 3.56)), rtol=0.1)


def test_noise_floor_belongs_to_the_recording():
    paths = still([[0.0, 0.0, 0.5]])
    for floor in (0.012, 0.06):
        drawn = simulate_inventory(paths, AT_ORIGIN, free_space(), PLAIN, seed=0, reader=quiet_reader(floor_rad=floor))
        phase = drawn.reads.phase_rad
        assert abs(np.std(np.angle(np.exp(1j * (phase - phase[0])))) / floor - 1) < 0.25


def test_rssi_level_and_spread(static_by_rssi):
    """Spread 0.1 dB at -46 dBm, 0.3 to 0.4 dB at -62 to -68 (rail, rfid-facts 1.5), in steps of 0.5 dB."""
    levels, drawn = static_by_rssi
    rssi = [drawn.reads.select(epc).rssi_dbm for epc in drawn.reads.epcs]
    np.testing.assert_allclose([np.mean(r) for r in rssi], levels, atol=0.1)
    assert np.std(rssi[0]) < 0.15
    for weak in rssi[-3:]:
        assert 0.2 < np.std(weak) < 0.45
    assert all(np.all(r * 2 == np.rint(r * 2)) for r in rssi)


@pytest.mark.parametrize("probability", [0.0, 0.1])
def test_pi_flips_have_their_probability(probability):
    """0.06 to 0.12 of the reads give the 11 to 21 % of transitions that logs show (rfid-facts 1.4)."""
    settings = dataclasses.replace(PLAIN, flip_probability=probability)
    reads = simulate_inventory(still([[0.0, 0.0, 1.0]], 120.0), AT_ORIGIN, free_space(), settings, seed=0).reads
    estimate = estimate_flip_probability(reads.phase_rad, reads.time_ns * 1e-9, reads.channel_index)
    assert abs(estimate - probability) < 0.012
    assert reads.pi_flips == (probability > 0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_channel_offsets_are_affine(seed):
    """Slope 0.30 to 0.43 rad/MHz, either sign; residual 0.003 to 0.006 rad (rfid-facts 1.8), beside averaged noise."""
    settings = InventorySettings(flip_probability=0.0)
    reads = simulate_inventory(still([[0.0, 0.0, 1.2]], 120.0), AT_ORIGIN, free_space(), settings, seed=seed).reads
    rest = np.exp(1j * (reads.phase_rad - 4 * np.pi * reads.carrier_hz * 1.2 / C))
    carriers = np.unique(reads.carrier_hz)
    assert len(carriers) == 50
    offset = np.unwrap([np.angle(np.sum(rest[reads.carrier_hz == f])) for f in carriers])
    fit = np.polyfit(carriers - carriers.mean(), offset, 1)
    assert 0.295e-6 < abs(fit[0]) < 0.435e-6
    assert np.std(offset - np.polyval(fit, carriers - carriers.mean())) < 0.01


def test_dwell_and_hop_table():
    drawn = simulate_inventory(still([[0.0, 0.0, 1.2]], 120.0), AT_ORIGIN, free_space(), seed=4)
    reads = drawn.reads
    assert np.any(np.diff(reads.hop_table_hz) < 0)
    np.testing.assert_array_equal(reads.carrier_hz, np.asarray(reads.hop_table_hz)[np.asarray(reads.channel_index) - 1])
    assert sorted(reads.hop_table_hz) == list(HOP_TABLES_HZ["fcc"])
    hops = np.flatnonzero(np.diff(np.asarray(reads.channel_index)))
    gone = np.diff(reads.channel_index.astype(int)[np.append(hops, hops[-1] + 1)]) % 50  # an outage may hide hops
    dwell = np.diff(drawn.time_s[hops + 1])
    np.testing.assert_allclose(dwell.sum() / gone[:-1].sum(), 0.203, rtol=0.01)
    assert abs(np.median(dwell) - 0.203) < 0.01


def test_antennas_take_turns_and_each_read_has_its_antenna():
    """The phase, taken back to distance by the read's own antenna, is constant for each tag and antenna."""
    antennas = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.3, 0.0]])
    time_s = np.linspace(0, 40, 401)
    around = [np.stack([0.6 * np.sin(time_s + k), 0.3 * np.cos(time_s), 1.5 + 0 * time_s], axis=1) for k in range(2)]
    paths = {f"E{k}": Track(time_s, place) for k, place in enumerate(around)}
    drawn = simulate_inventory(paths, antennas, free_space(), PLAIN, seed=0, reader=quiet_reader())
    reads = drawn.reads
    np.testing.assert_allclose(np.bincount(reads.antenna)[1:] / reads.num_reads, 0.25, atol=0.02)
    turn_s = np.diff(drawn.time_s[1:][np.diff(reads.antenna) != 0])
    assert 0.03 < np.median(turn_s) < 0.24  # rfid-facts 1.8 and 1.9
    np.testing.assert_allclose(drawn.range_m, np.linalg.norm(drawn.position_m - antennas[reads.antenna - 1], axis=1))
    np.testing.assert_allclose(drawn.multipath_rad, 0, atol=1e-3)
    for epc in paths:
        exact = np.stack(
            [np.interp(drawn.time_s[reads.epc == epc], time_s, column) for column in paths[epc].position_m.T], 1
        )
        np.testing.assert_allclose(drawn.position_m[reads.epc == epc], exact, atol=2e-3)
        for antenna in range(1, 5):
            mine = (reads.epc == epc) & (reads.antenna == antenna)
            rest = np.exp(1j * (reads.phase_rad[mine] - 4 * np.pi * reads.carrier_hz[mine] * drawn.range_m[mine] / C))
            assert abs(np.mean(rest)) > 0.99


@pytest.mark.parametrize(("offset_s", "drift_ppm"), [(0.37, 42.0), (1.5e9, -30.0)])
def test_clock_offset_and_drift_are_recovered(offset_s, drift_ppm):
    """By the importer's audit; reads arrive 5 to 50 ms late. The second clock was never set."""
    settings = InventorySettings(clock_offset_s=offset_s, clock_drift_ppm=drift_ppm)
    origin_ns = 1_700_000_000_000_000_000
    paths = still([[0.0, 0.0, 1.2], [0.3, 0.0, 1.2]], duration_s=90.0)
    drawn = simulate_inventory(paths, AT_ORIGIN, free_space(), settings, seed=1, origin_ns=origin_ns)
    reads = drawn.reads
    reads.check()
    stamps = np.asarray(reads.reader_time_ns)
    assert stamps.min() > 0
    assert np.diff(stamps).min() > 0
    assert np.all(stamps % 1000 == 0)
    audit = to_host_clock(stamps, reads.time_ns).audit
    (piece,) = audit.pieces
    np.testing.assert_allclose(piece.drift_ppm, drift_ppm, atol=5)
    assert piece.drift_interval_ppm is not None
    low, high = piece.drift_interval_ppm
    assert low < drift_ppm < high
    drifted_s = drift_ppm * 1e-6 * (piece.reference_ns - stamps[0]) * 1e-9
    np.testing.assert_allclose(piece.offset_s - offset_s - drifted_s, 0.005, atol=0.002)
    assert audit.reader_epoch == ("unix" if offset_s < 1e6 else "1970")
    late = (reads.time_ns - origin_ns) * 1e-9 - drawn.time_s
    assert late.min() >= 0.005 - 1e-6
    assert late.max() <= 0.050 + 1e-6
    assert np.std(late) > 0.003


def test_clock_without_error_is_the_hosts():
    settings = dataclasses.replace(PLAIN, clock_offset_s=0.0, clock_drift_ppm=0.0)
    host, reader = clock_stamps(np.array([0.0, 0.5, 1.25]), settings, np.random.default_rng(0), origin_ns=7_000)
    np.testing.assert_array_equal(host, [7_000, 500_007_000, 1_250_007_000])
    np.testing.assert_array_equal(reader, host)


def test_weak_and_hidden_tags_are_lost():
    """-77.5 dBm is reached at 10^(32.5 / 40) = 6.5 m in free space; nothing is read where the path is not known."""
    time_s = np.linspace(0, 40, 401)
    place = np.stack([0 * time_s, 0 * time_s, 1.0 + 0.25 * time_s], axis=1)
    place[50:80] = np.nan
    drawn = simulate_inventory({"A": Track(time_s, place)}, AT_ORIGIN, free_space(), PLAIN, seed=0)
    assert drawn.reads.rssi_dbm.min() >= -77.5
    near, beyond = (np.sum((drawn.range_m > low) & (drawn.range_m < low + 0.5)) for low in (6.0, 7.0))
    assert near > 60
    assert beyond < 0.25 * near
    assert drawn.range_m.max() < 8.0
    assert not np.any((drawn.time_s > 4.95) & (drawn.time_s < 7.95))
    assert np.any(drawn.time_s > 8.0)
    far = {"A": Track(time_s, np.tile([0.0, 0.0, 30.0], (401, 1)))}
    assert simulate_inventory(far, AT_ORIGIN, free_space(), PLAIN, seed=0).reads.num_reads == 0


def test_blocking_and_moving_bodies_change_only_their_reads():
    time_s = np.linspace(0, 20, 201)
    paths = {
        name: Track(time_s, np.tile(place, (201, 1))) for name, place in (("A", [0.2, 0.1, 1.0]), ("B", [0.4, 0, 2.0]))
    }
    room = Environment(box_room(np.array([-2.0, -1.5, -0.5]), np.array([2.0, 1.5, 4.0]), -0.4), BODIES)
    antennas = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.0]])
    factor = np.ones((201, 2))
    factor[100:, 0] = 0.05
    settings = dataclasses.replace(PLAIN, sensitivity_dbm=-120.0)  # the same reads in all three
    plain = simulate_inventory(paths, antennas, room, settings, seed=0)
    shadow = simulate_inventory(paths, antennas, room, settings, seed=0, transmission={"A": factor})
    hit = (plain.reads.epc == "A") & (plain.reads.antenna == 1) & (plain.time_s > 10)
    assert plain.reads.num_reads == shadow.reads.num_reads
    np.testing.assert_array_equal(shadow.transmission[hit], 0.05)
    assert np.all(shadow.transmission[~hit & (np.abs(plain.time_s - 9.95) > 0.06)] == 1)
    assert np.median(plain.reads.rssi_dbm[hit]) - np.median(shadow.reads.rssi_dbm[hit]) > 3
    np.testing.assert_array_equal(
        plain.reads.phase_rad[plain.reads.epc == "B"], shadow.reads.phase_rad[shadow.reads.epc == "B"]
    )

    rest = np.asarray(BODIES.position_m, float)
    moved = np.tile(rest, (201, 1, 1))
    moved[:, 0, 0] += np.where(time_s > 10, 0.3 * (time_s - 10), 0.0)
    walking = simulate_inventory(paths, antennas, room, settings, seed=0, scatterer_path=(time_s, moved))
    change = np.abs(walking.multipath_rad - plain.multipath_rad)
    assert change[plain.time_s < 9.9].max() < 1e-4
    assert change[plain.time_s > 11].max() > 0.02


def test_multipath_ripple_is_of_the_measured_size():
    """0.9 m before a patch in a room with walls of 0.3 to 0.8, along 1 m: 0.13 to 0.23 rad (rfid-facts 1.6)."""
    time_s = np.linspace(0, 20, 201)
    place = np.stack([np.linspace(-0.5, 0.5, 201), 0 * time_s, 0.9 + 0 * time_s], axis=1)
    walls = box_room(np.array([-2.0, -1.0, -1.5]), np.array([2.5, 1.6, 3.5]), -0.5)
    ahead = np.array([[0.0, 0.0, 1.0]])
    ripple = []
    for seed in range(3):
        drawn = simulate_inventory(
            {"A": Track(time_s, place + np.array([0.1 * seed, 0, 0]))},
            AT_ORIGIN,
            Environment(walls, free_space().scatterers),
            InventorySettings(region="china"),
            seed=seed,
            boresight=ahead,
        )
        ripple.append(np.std(drawn.multipath_rad))
    assert 0.08 < np.mean(ripple) < 0.3


def test_outages_silence_every_tag():
    settings = dataclasses.replace(PLAIN, outages_per_minute=10.0)
    paths = still([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]], 120.0)
    gaps = [np.diff(simulate_inventory(paths, AT_ORIGIN, free_space(), s, seed=0).time_s) for s in (PLAIN, settings)]
    assert gaps[0].max() < 0.08
    assert 8 <= np.sum(gaps[1] > 0.1) <= 30


def test_orientation_and_sign():
    """A tag that turns its end towards the antenna loses `NULL_DB`; a reader of the other sign counts backwards."""
    paths = still([[0.0, 0.0, 1.0]])
    axis = {"E000": np.tile([0.0, 0.0, 3.0], (31, 1))}
    plain = simulate_inventory(paths, AT_ORIGIN, free_space(), PLAIN, seed=0)
    turned = simulate_inventory(paths, AT_ORIGIN, free_space(), PLAIN, seed=0, dipole=axis)
    np.testing.assert_allclose(
        np.mean(plain.reads.rssi_dbm) - np.mean(turned.reads.rssi_dbm), channel.NULL_DB, atol=0.3
    )
    settings = dataclasses.replace(PLAIN, phase_sign=-1)
    back = simulate_inventory(paths, AT_ORIGIN, free_space(), settings, seed=0).reads
    assert back.phase_sign == -1
    total = (plain.reads.phase_rad + back.phase_rad + 1e-9) % (2 * np.pi)
    np.testing.assert_allclose(total, 0, atol=1e-6)


def test_same_recording_from_the_same_seed():
    paths = still([[0.0, 0.0, 1.0]], 5.0)
    one, same, other = (simulate_inventory(paths, AT_ORIGIN, FURNISHED, seed=s).reads for s in (0, 0, 1))
    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(same, field.name))
    assert one.num_reads != other.num_reads or np.any(one.phase_rad != other.phase_rad)


def test_wrong_input_is_refused_by_name():
    paths = still([[0.0, 0.0, 1.0]])
    with pytest.raises(ValueError, match="no path"):
        simulate_inventory(paths, AT_ORIGIN, free_space(), seed=0, transmission={"X": np.ones(31)})
    with pytest.raises(ValueError, match="expected one of"):
        simulate_inventory(paths, AT_ORIGIN, free_space(), seed=0, transmission={"E000": np.ones((31, 2))})
    with pytest.raises(ValueError, match="at least one tag"):
        simulate_inventory({}, AT_ORIGIN, free_space(), seed=0)
    with pytest.raises(ValueError, match="scatterer_path"):
        simulate_inventory(paths, AT_ORIGIN, free_space(), seed=0, scatterer_path=(np.arange(2.0), np.zeros((2, 1, 3))))
    with pytest.raises(ValueError, match="region"):
        InventorySettings(region="moon")
    with pytest.raises(ValueError, match="latency_s"):
        InventorySettings(latency_s=(0.1, 0.0))
    with pytest.raises(ValueError, match="rounds_per_antenna"):
        InventorySettings(rounds_per_antenna=0)
