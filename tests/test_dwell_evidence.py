"""Dwell evidence of segments against a NumPy twin in complex float64, and closed forms."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from tagjax.radio.arrivals import Arrivals
from tagjax.radio.noise import thermal_sigma_rad
from tagjax.radio.reader_model import ReaderModel
from tagjax.tagattention.segments.dwell import DwellEvidence, DwellState

C = 299_792_458.0
FRAME_S = 1 / 30
NUM_SEGMENTS = 20
DEPTH_M = np.linspace(1.0, 4.0, NUM_SEGMENTS)
NO_NEWBORN = jnp.full(NUM_SEGMENTS, -2, jnp.int32)
NEVER_FORGOTTEN = DwellEvidence(memory_s=1e12)


@jax.jit
def _step(evidence, reader, state, arrivals, increment_m, newborn_source, since_s, now_s):
    return evidence.step(reader, state, arrivals, increment_m, _depth_m(increment_m), newborn_source, since_s, now_s)


def _depth_m(increment_m):
    return jnp.asarray(DEPTH_M, increment_m.dtype)


def _log_i0(x):
    return np.log(special.ive(0, x)) + np.abs(x)


class Twin:
    """The same likelihood in float64 with complex phasors of absolute distances, read by read and slot by slot."""

    def __init__(self, num_tags, num_antennas, num_segments, reader: ReaderModel, memory_s: float):
        rows = (num_tags, num_antennas, num_segments)
        self.phasor, self.read, self.distance = np.zeros(rows, complex), np.zeros(rows), np.zeros(rows[1:])
        self.evidence, self.channel = np.zeros((num_tags, num_segments)), np.full(rows[:2], -1)
        self.reader, self.memory_s = reader, memory_s

    def step(self, reads, increment, source, since, now):
        old = [part.copy() for part in (self.phasor, self.read, self.distance, self.evidence)]
        for slot, one in enumerate(source):
            if one > -2:
                for part, before in zip((self.phasor, self.read, self.distance, self.evidence), old, strict=True):
                    part[..., slot] = before[..., max(one, 0)]
        increment = np.where(np.arange(increment.shape[1]) == 0, 0.0, increment)
        self.evidence *= np.exp(-(now - since) / self.memory_s)
        for slot in [slot for slot, one in enumerate(source) if slot and one in (-1, 0)]:
            self.evidence[:, slot] = np.maximum(self.evidence[:, slot], 0)
        m, q = (2 if self.reader.modulo_pi else 1), float(self.reader.outlier.value)
        for tag, antenna, time_s, phase, carrier, channel, rssi in reads:
            at = self.distance[antenna] + (time_s - since) / (now - since) * increment[antenna]
            wave = 4 * np.pi * carrier / C
            if channel != self.channel[tag, antenna]:
                self.phasor[tag, antenna], self.read[tag, antenna] = 0, at
                self.channel[tag, antenna] = channel
            way = np.abs(at - self.read[tag, antenna])
            variance = (m * wave) ** 2 * float(self.reader.drift_m.value) * DEPTH_M**2 * way
            before = self.phasor[tag, antenna] / (1 + np.abs(self.phasor[tag, antenna]) * variance)
            self.read[tag, antenna] = at
            speed = increment[antenna] / (float(now) - float(since))
            still, spread = (float(getattr(self.reader, f"{name}spread_rad").value) for name in ("still_", ""))
            moving = speed**2 / (speed**2 + float(self.reader.moving_m_s.value) ** 2)
            beside = still**2 + (spread**2 - still**2) * moving
            weight = 1 / (m**2 * (thermal_sigma_rad(np.array([float(rssi)])) ** 2 + beside))
            own = weight * np.exp(1j * m * (phase - wave * at))
            gain = _log_i0(np.abs(before + own)) - _log_i0(np.abs(before)) - _log_i0(weight)
            each = np.logaddexp(np.log1p(-q) + gain, np.log(q))
            self.phasor[tag, antenna] = before + own * np.exp(np.log1p(-q) + gain - each)
            self.evidence[tag] += each * np.exp(-(now - time_s) / self.memory_s)
        self.distance += increment
        return self.evidence


def _arrivals(reads, length: int = 16, dtype=jnp.float32) -> Arrivals:
    """A buffer of (tag, antenna, time_s, phase_rad, carrier_hz, channel, rssi_dbm)."""
    columns = list(zip(*reads, strict=True)) if reads else [()] * 7
    names = ("tag", "antenna", "time_s", "phase_rad", "carrier_hz", "channel", "rssi_dbm")
    fills = (0, 0, 0.0, 0.0, 915e6, -1, -60.0)
    made = {}
    for name, column, fill in zip(names, columns, fills, strict=True):
        kind = jnp.int32 if name in ("tag", "antenna", "channel") else dtype
        made[name] = jnp.asarray([*column, *[fill] * (length - len(reads))], kind)
    return Arrivals(**made, valid=jnp.arange(length) < len(reads))


def _frames(rng, num_frames=10, num_reads=10, num_tags=3, num_antennas=2):
    """Reads, increments and newborn slots of some frames, in numbers that float32 has."""
    frames, alive = [], 2.0 + rng.uniform(0, 1, num_antennas)
    speed = rng.normal(0, 0.01, (num_antennas, NUM_SEGMENTS))
    for frame in range(num_frames):
        since, now = np.float32(frame * FRAME_S), np.float32((frame + 1) * FRAME_S)
        reads = []
        for time_s in np.sort(rng.uniform(since + 1e-4, now, num_reads)):
            tag, antenna, channel = rng.integers(num_tags), rng.integers(num_antennas), (frame // 4) * 3
            carrier = np.float32(902.75e6 + 5e5 * channel)
            distance = alive[antenna] + speed[antenna, 1 + tag] * time_s / FRAME_S
            phase = np.mod(4 * np.pi * carrier * distance / C + 1.3 * channel + rng.normal(0, 0.1), 2 * np.pi)
            rssi = np.float32(rng.uniform(-70, -50))
            reads.append((tag, antenna, float(np.float32(time_s)), float(np.float32(phase)), carrier, channel, rssi))
        source = np.full(NUM_SEGMENTS, -2)
        if frame:
            slots = rng.choice(np.arange(1, NUM_SEGMENTS), 4, replace=False)
            source[slots] = [-1, slots[0], slots[3], rng.integers(1, NUM_SEGMENTS)]  # sources that are newborn, too
        increment = (speed + rng.normal(0, 0.002, speed.shape)).astype(np.float32)
        frames.append((reads, increment, source, since, now))
    return frames


def _run(frames, evidence, reader, num_tags=3, num_antennas=2, **buffer):
    state, outs = DwellState.nothing(num_tags, num_antennas, NUM_SEGMENTS), []
    for reads, increment, source, since, now in frames:
        state, out = _step(
            evidence, reader, state, _arrivals(reads, **buffer), jnp.asarray(increment),
            jnp.asarray(source, jnp.int32), jnp.asarray(since), jnp.asarray(now),
        )  # fmt: skip
        outs.append(out)
    return state, np.stack(outs)


@pytest.mark.parametrize("modulo_pi", [True, False])
def test_the_evidence_is_the_twins(modulo_pi):
    frames, reader = _frames(np.random.default_rng(0)), ReaderModel(modulo_pi=modulo_pi)
    assert sum(len(frame[0]) for frame in frames) == 100
    evidence = DwellEvidence(memory_s=0.5)
    twin = Twin(3, 2, NUM_SEGMENTS, reader, float(evidence.memory_s.value))
    expected = np.stack([twin.step(*frame).copy() for frame in frames])
    state, ours = _run(frames, evidence, reader)
    assert np.ptp(expected[-1]) > 10  # the segments differ in what they explain
    # Modulo 2 pi concentrations are four times as large, and so is what float32 makes of an angle.
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-4 if modulo_pi else 4e-4)
    np.testing.assert_allclose(state.moved_m, twin.distance[None] - twin.read, atol=1e-6)
    np.testing.assert_allclose(np.hypot(state.real, state.imaginary), np.abs(twin.phasor), rtol=1e-5)


def test_a_dwell_without_outliers_has_the_closed_form():
    """log I0(|S|) - sum log I0(w), for 30 reads of one tag on one carrier, of segments at constant speeds."""
    rng = np.random.default_rng(1)
    speed = np.concatenate([[0.0], rng.uniform(-0.5, 0.5, NUM_SEGMENTS - 1)])
    time_s = np.sort(rng.uniform(1e-3, 5 * FRAME_S, 30)).astype(np.float32)
    phase = np.mod(4 * np.pi * 915e6 * speed[1] * time_s / C + rng.normal(0, 0.1, 30) + 1, 2 * np.pi)
    frames = []
    for frame in range(5):
        since, now = np.float32(frame * FRAME_S), np.float32((frame + 1) * FRAME_S)
        chosen = np.flatnonzero((time_s > since) & (time_s <= now))
        reads = [(0, 0, float(time_s[i]), phase[i], 915e6, 7, -55.0) for i in chosen]
        frames.append((reads, (speed[None] * FRAME_S).astype(np.float32), np.full(NUM_SEGMENTS, -2), since, now))
    reader = ReaderModel(outlier=1e-12, drift_m=1e-12)
    ours = _run(frames, NEVER_FORGOTTEN, reader, num_tags=1, num_antennas=1)[1][-1, 0]
    moved = speed[:, None] * (time_s - time_s[0])[None].astype(float)
    wave = 4 * np.pi * 915e6 / C
    beside = 0.03**2 + (0.064**2 - 0.03**2) * (speed**2 / (speed**2 + 0.06**2))[:, None]
    weight = 1 / (4 * (thermal_sigma_rad(np.array([-55.0])) ** 2 + beside))
    weight = np.broadcast_to(weight, moved.shape)
    phasor = np.sum(weight * np.exp(2j * (phase - wave * moved)), axis=1)
    expected = _log_i0(np.abs(phasor)) - np.sum(_log_i0(weight), axis=1)
    explained = expected > -25  # of a read that fits worse than the outliers' 1e-12 the mixture counts no more
    assert 3 < explained.sum() < NUM_SEGMENTS
    assert ours[1] > 30
    np.testing.assert_allclose(ours[explained], expected[explained], atol=2e-4)


def _still(phase_rad, spacing_s: float = 0.01, **row):
    """Reads of tag 0 with these phases, and the time of the last."""
    made = {"tag": 0, "antenna": 0, "carrier": 915e6, "channel": 0, "rssi": -55.0, **row}
    names = ("carrier", "channel", "rssi")
    return [
        (made["tag"], made["antenna"], spacing_s * (i + 1), phase, *(made[name] for name in names))
        for i, phase in enumerate(phase_rad)
    ]


def _once(reads, reader=None, evidence=NEVER_FORGOTTEN, increment_m=None, now_s=0.2, state=None, **buffer):
    increment_m = jnp.zeros((2, NUM_SEGMENTS)) if increment_m is None else increment_m
    state = DwellState.nothing(3, 2, NUM_SEGMENTS) if state is None else state
    reader = ReaderModel() if reader is None else reader
    return _step(
        evidence, reader, state, _arrivals(reads, **buffer), increment_m, NO_NEWBORN,
        jnp.asarray(0.0), jnp.asarray(now_s),
    )  # fmt: skip


def test_a_wrong_read_costs_at_most_an_outlier_and_leaves_the_phasor():
    before, clean = _once(_still([1.0] * 10))
    after, found = _once(_still([1.0] * 10 + [1.0 + np.pi / 2]))
    np.testing.assert_allclose(found[0] - clean[0], np.log(0.04), atol=1e-3)
    np.testing.assert_allclose(after.real, before.real, rtol=1e-6)
    np.testing.assert_allclose(after.imaginary, before.imaginary, rtol=1e-6)


def test_with_outliers_alone_reads_are_no_evidence():
    _, found = _once(_still([1.0, 2.0, 0.5, 0.5]), ReaderModel(outlier=1 - 1e-6))
    np.testing.assert_allclose(found, 0.0, atol=1e-4)


def test_the_first_read_of_a_dwell_is_no_evidence():
    np.testing.assert_allclose(_once(_still([1.0]))[1], 0.0, atol=3e-5)
    state, one = _once(_still([1.0, 1.0, 1.0]))
    _, two = _once([*_still([1.0, 1.0, 1.0]), (0, 0, 0.1, 2.5, 902.75e6, 4, -55.0)])
    np.testing.assert_allclose(two, one, atol=3e-5)  # another carrier, another offset
    assert state.channel.tolist() == [[0, -1], [-1, -1], [-1, -1]]


def test_the_order_of_reads_of_different_tags_does_not_matter():
    frames, reader = _frames(np.random.default_rng(2)), ReaderModel()
    by_tag = [(sorted(reads, key=lambda read: read[:2]), *rest) for reads, *rest in frames]
    assert by_tag[0][0] != frames[0][0]
    one, other = (_run(each, DwellEvidence(), reader) for each in (frames, by_tag))
    np.testing.assert_allclose(one[1], other[1], atol=2e-5)


def test_padding_does_not_matter():
    frames, reader = _frames(np.random.default_rng(3)), ReaderModel()
    short, long = (_run(frames, DwellEvidence(), reader, length=length) for length in (10, 23))
    for ours, other in zip(jax.tree.leaves(short), jax.tree.leaves(long), strict=True):
        np.testing.assert_array_equal(ours, other)


@pytest.mark.parametrize("num_existing", [0, 200, 600])
def test_slots_without_a_segment_change_nothing(num_existing):
    num, rng, step = 700, np.random.default_rng(5), eqx.filter_jit(DwellEvidence().step)
    slots = np.sort(rng.choice(np.arange(1, num), num_existing, replace=False))
    exists = jnp.zeros(num, bool).at[slots].set(True)  # nowhere: a frame without depth
    taken = np.append(0, slots) if num_existing else np.arange(num)
    state = other = DwellState.nothing(3, 2, num)
    found = every = jnp.zeros((3, num))
    for reads, _, _, since, now in _frames(rng, num_frames=4):
        increment_m = jnp.asarray(rng.normal(0, 0.01, (2, num)), jnp.float32)
        source = np.full(num, -2, np.int32)
        source[taken[-9:]] = [-1, *rng.choice(taken, 8)]
        depth_m = jnp.linspace(1.0, 4.0, num)
        given = _arrivals(reads), increment_m, depth_m, jnp.asarray(source), jnp.asarray(since), jnp.asarray(now)
        state, found = step(ReaderModel(), state, *given, exists)
        other, every = step(ReaderModel(), other, *given)
        np.testing.assert_allclose(found[:, taken], every[:, taken], atol=1e-5)
        for name in ("real", "imaginary", "read_m", "distance_m"):
            one, two = (np.asarray(getattr(each, name))[..., taken] for each in (state, other))
            np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-5, err_msg=name)
        np.testing.assert_array_equal(state.channel, other.channel)
    assert float(jnp.max(jnp.abs(every))) > 1
    if num_existing == 200:  # and they are left out
        assert bool(jnp.any(found != every))


@pytest.mark.parametrize("num_newborn", [0, 9, 400])
def test_newborn_segments_of_many_tags_have_the_rows_of_their_sources(num_newborn):
    num, num_tags, rng = 700, 24, np.random.default_rng(11)
    state = DwellState.nothing(num_tags, 1, num)
    names = ("real", "imaginary", "read_m")
    for name in names:
        values = jnp.asarray(rng.normal(size=(num_tags, 1, num)), jnp.float32)
        state = eqx.tree_at(lambda one, name=name: getattr(one, name), state, values)
    source, rows = np.full(num, -2), np.arange(num)
    newborn = rng.choice(np.arange(1, num), num_newborn, replace=False)
    source[newborn] = rng.integers(-1, num, num_newborn)  # some sources are newborn, too
    rows[newborn] = np.maximum(source[newborn], 0)
    after, _ = eqx.filter_jit(DwellEvidence().step)(
        ReaderModel(), state, _arrivals([]), jnp.zeros((1, num)), jnp.ones(num), jnp.asarray(source, jnp.int32),
        jnp.asarray(1.0), jnp.asarray(1.1),
    )  # fmt: skip
    for name in names:
        np.testing.assert_array_equal(getattr(after, name), np.asarray(getattr(state, name))[..., rows], err_msg=name)


def test_evidence_of_two_antennas_adds_up():
    first, second = _still([1.0, 1.02, 0.98]), _still([2.0, 2.02, 1.98, 2.4], antenna=1)
    both = _once(sorted(first + second, key=lambda read: read[2]))[1]
    np.testing.assert_allclose(both, _once(first)[1] + _once(second)[1], atol=1e-5)
    assert float(both[0, 1]) > 3
    assert not np.any(np.asarray(both[1:]))  # other tags have no read


def test_the_background_stays_in_place():
    moving = jnp.full((2, NUM_SEGMENTS), 0.1)
    state, found = _once(_still([1.0] * 10), increment_m=moving, evidence=NEVER_FORGOTTEN)
    rests = _once(_still([1.0] * 10), increment_m=jnp.zeros_like(moving))[1]
    np.testing.assert_allclose(rests[0], found[0, 0], atol=1e-4)  # what rests is as probable as the background
    assert float(state.distance_m[0, 0]) == 0.0
    np.testing.assert_allclose(state.distance_m[:, 1:], 0.1)
    assert float(found[0, 0]) > float(found[0, 1]) + 5


def test_newborn_segments_inherit_from_the_last_frame():
    rng = np.random.default_rng(4)
    state = jax.tree.map(
        lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype), DwellState.nothing(3, 2, NUM_SEGMENTS)
    )
    state = eqx.tree_at(lambda s: s.channel, state, jnp.zeros((3, 2), jnp.int32))
    source = np.full(NUM_SEGMENTS, -2)
    source[[3, 4, 5, 0]] = [7, 3, -1, 9]
    after, found = _step(
        NEVER_FORGOTTEN, ReaderModel(), state, _arrivals([]), jnp.zeros((2, NUM_SEGMENTS)),
        jnp.asarray(source, jnp.int32), jnp.asarray(1.0), jnp.asarray(1.03),
    )  # fmt: skip
    slots = np.arange(NUM_SEGMENTS)
    slots[[3, 4, 5]] = [7, 3, 0]  # 4 has what 3 was; 0 is never newborn
    for name in ("real", "imaginary", "read_m", "distance_m", "log_likelihood"):
        expected = np.array(getattr(state, name))[..., slots]
        if name == "log_likelihood":
            expected[:, 5] = np.maximum(expected[:, 5], 0.0)  # out of the background
        np.testing.assert_allclose(getattr(after, name), expected, rtol=1e-6)
    np.testing.assert_array_equal(found, after.log_likelihood)


@pytest.mark.parametrize("num_existing", [0, 7])
def test_nothing_speaks_against_what_comes_into_view(num_existing):
    """The background's evidence against a tag does not count for it; evidence for it does, and so does a mover's past."""
    evidence, num_segments = DwellEvidence(memory_s=2.0), 600
    of_slots = np.zeros((2, num_segments))
    of_slots[0, :4], of_slots[1, :4] = [-400.0, -90.0, -50.0, -60.0], [40.0, -90.0, -50.0, -60.0]
    state = DwellState.nothing(2, 1, num_segments)
    state = eqx.tree_at(lambda one: one.log_likelihood, state, jnp.asarray(of_slots, jnp.float32))
    source = np.full(num_segments, -2)
    source[[3, 4, 5, 6]] = [0, -1, 1, -1]
    now_s, exists = jnp.asarray(1.5), np.arange(num_segments) < num_existing
    _, found = evidence.step(
        ReaderModel(), state, _arrivals([]), jnp.zeros((1, num_segments)), jnp.ones(num_segments),
        jnp.asarray(source, jnp.int32), now_s - 0.5, now_s, jnp.asarray(exists),
    )  # fmt: skip
    kept = np.exp(-0.25)
    expected = [[-400 * kept, -90 * kept, -50 * kept, 0, 0, -90 * kept, 0], [40 * kept, -90 * kept, -50 * kept]]
    expected[1] += [40 * kept, 40 * kept, -90 * kept, 40 * kept]
    np.testing.assert_allclose(found[:, :7], expected, rtol=1e-5)


def test_evidence_decays_by_its_age():
    forgetful = DwellEvidence(memory_s=4.0)
    reads = _still([1.0, 1.0])
    kept, faded = _once(reads)[1], _once(reads, evidence=forgetful, now_s=2.02)[1]
    np.testing.assert_allclose(faded, kept * np.exp(-2.0 / 4.0), rtol=1e-5, atol=1e-6)  # the second read is of 0.02 s
    state, now = _once(reads, evidence=forgetful)
    later, _ = _step(
        forgetful, ReaderModel(), state, _arrivals([]), jnp.zeros((2, NUM_SEGMENTS)), NO_NEWBORN,
        jnp.asarray(0.2), jnp.asarray(1.2),
    )  # fmt: skip
    np.testing.assert_allclose(later.log_likelihood, now * np.exp(-1.0 / 4.0), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(later.real, state.real)  # phasors are not forgotten


def test_the_frame_rate_does_not_matter():
    """The same reads in one frame or in ten, at constant speeds."""
    rng, evidence, reader = np.random.default_rng(5), DwellEvidence(memory_s=0.3), ReaderModel()
    speed = rng.uniform(-0.3, 0.3, (2, NUM_SEGMENTS)).astype(np.float32)
    reads = _still(np.mod(rng.normal(1, 0.3, 12), 2 * np.pi), spacing_s=0.015)
    _, at_once = _once(reads, reader, evidence, increment_m=jnp.asarray(speed * np.float32(0.2)))
    frames = []
    for frame in range(10):
        since, now = np.float32(0.02 * frame), np.float32(0.02 * (frame + 1))
        own = [read for read in reads if since < read[2] <= now]
        frames.append((own, speed * np.float32(0.02), np.full(NUM_SEGMENTS, -2), since, now))
    np.testing.assert_allclose(_run(frames, evidence, reader)[1][-1], at_once, atol=2e-4)


def test_jit_is_eager_and_vmap_is_a_loop():
    (reads, increment, source, since, now), *_ = _frames(np.random.default_rng(7))
    evidence, reader, state = DwellEvidence(), ReaderModel(), DwellState.nothing(3, 2, NUM_SEGMENTS)
    rest = jnp.asarray(source, jnp.int32), jnp.asarray(since), jnp.asarray(now)
    steps = jnp.stack([jnp.asarray(increment), -jnp.asarray(increment)])
    eager = [evidence.step(reader, state, _arrivals(reads), step, _depth_m(step), *rest) for step in steps]
    compiled = [_step(evidence, reader, state, _arrivals(reads), step, *rest) for step in steps]
    mapped = jax.vmap(lambda step: evidence.step(reader, state, _arrivals(reads), step, _depth_m(step), *rest))(steps)
    mapped = [jax.tree.map(lambda leaf, i=i: leaf[i], mapped) for i in range(2)]
    for other in (compiled, mapped):
        for ours, theirs in zip(jax.tree.leaves(eager), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)


def test_gradients_are_those_of_finite_differences():
    """Through three frames with newborn segments, for increments and all parameters of reader and memory."""
    frames = _frames(np.random.default_rng(8), num_frames=3, num_reads=6)
    with jax.enable_x64(True):
        models = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), (DwellEvidence(memory_s=0.2), ReaderModel()))
        increments = jnp.asarray(np.stack([frame[1] for frame in frames]), jnp.float64)
        chosen = jnp.asarray(np.random.default_rng(9).normal(size=(3, 3, NUM_SEGMENTS)))
        arrivals = [_arrivals(reads, 8, jnp.float64) for reads, *_ in frames]
        given = (
            jax.tree.map(lambda *leaves: jnp.stack(leaves), *arrivals),
            jnp.asarray(np.stack([source for _, _, source, _, _ in frames]), jnp.int32),
            *(jnp.asarray([frame[i] for frame in frames], jnp.float64) for i in (3, 4)),
        )

        @jax.jit
        def score(models, increments):
            evidence, reader = models

            def frame(state, each):
                (reads, source, since, now), increment = each
                return evidence.step(reader, state, reads, increment, _depth_m(increment), source, since, now)

            found = jax.lax.scan(frame, DwellState.nothing(3, 2, NUM_SEGMENTS), (given, increments))[1]
            return jnp.sum(chosen * found)

        gradient = jax.jit(jax.grad(score, argnums=(0, 1)))(models, increments)
        leaves, tree = jax.tree.flatten((models, increments))
        h = 1e-6
        for i, (leaf, ours) in enumerate(zip(leaves, jax.tree.leaves(gradient), strict=True)):
            assert np.any(ours != 0), i  # every parameter matters
            for at in [()] if leaf.ndim == 0 else [(0, 0, 1), (0, 1, 7), (1, 0, 2), (2, 1, 3), (1, 1, 0)]:
                ends = [
                    score(*tree.unflatten([*leaves[:i], leaf.at[at].add(s * h), *leaves[i + 1 :]])) for s in (1, -1)
                ]
                change = float(ends[0] - ends[1]) / (2 * h)
                assert float(ours[at]) == pytest.approx(change, rel=1e-5, abs=1e-6), (i, at)
        assert float(gradient[1][1, 1, 0]) == 0.0  # the background does not move


def test_gradients_are_finite_from_nothing():
    """Without reads, at phasors of zero, between frames of the same time, and where a second phase is opposite."""

    @jax.jit
    def gradient(arrivals):
        def score(models, state, increment):
            evidence, reader = models
            after, found = evidence.step(
                reader, state, arrivals, increment, _depth_m(increment), NO_NEWBORN, jnp.asarray(0.0), jnp.asarray(0.0)
            )
            return jnp.sum(found) + jnp.sum(after.real + after.imaginary) + jnp.sum(after.moved_m)

        inexact, rest = eqx.partition(DwellState.nothing(3, 2, NUM_SEGMENTS), eqx.is_inexact_array)
        return jax.grad(lambda *at: score(at[0], eqx.combine(at[1], rest), at[2]), argnums=(0, 1, 2))(
            (DwellEvidence(), ReaderModel()), inexact, jnp.zeros((2, NUM_SEGMENTS))
        )

    for reads in ([], _still([1.0]), _still([1.0, 1.0]), _still([1.0, 1.0 + np.pi / 2])):
        leaves = jax.tree.leaves(gradient(_arrivals(reads)))
        assert len(leaves) == 15
        assert all(np.isfinite(leaf).all() for leaf in leaves)
