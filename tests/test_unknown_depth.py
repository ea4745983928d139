"""Evidence without depth: simulated reads of a tag, its own ray against others, with one antenna and with several."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.radio.arrivals import Arrivals
from tagjax.radio.reader_model import ReaderModel
from tagjax.tagattention import TagAttention
from tagjax.tagattention.segments.attention import AttentionEvidence
from tagjax.tagattention.segments.unknown_depth import RayMotion, UnknownDepth

ANTENNAS_M = np.array([[0.0, 0.9, 0.1], [0.8, 0.7, 0.1], [-0.8, 0.7, 0.1], [0.0, -0.3, 0.1]])
FRAME_S, NUM_FRAMES, READS = 1 / 30, 120, 2
C = 299_792_458.0
NO_NEWBORN = jnp.full(4, -2, jnp.int32)


def _scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frame times, and places (frames, 4, 3): the background, the tag, one that moves against it, and one at another speed."""
    time_s = np.arange(NUM_FRAMES) * FRAME_S
    swing = np.maximum(time_s - 0.5, 0.0)
    x, y, z = 0.3 * np.sin(2.2 * swing), 0.2 * np.sin(3.1 * swing), 2.2 + 0.15 * np.sin(1.7 * swing)
    tag = np.stack([x, y, z], axis=-1)
    other = np.stack([-x + 0.4, y + 0.3, 2.2 + 0 * z], axis=-1)
    slower = np.stack([0.5 * x - 0.3, 0.5 * y, z], axis=-1)
    return time_s, np.stack([np.tile([0.0, 0.0, 4.0], (NUM_FRAMES, 1)), tag, other, slower], axis=1), tag


def _reads(num_antennas: int, *, still: bool, hop_s: float = 0.2) -> Arrivals:
    """Reads of the tag, antennas in turn, at 60 reads/s, on channels with offsets that all antennas share."""
    rng = np.random.default_rng(0)
    time_s, _, tag = _scene()
    offsets, own = rng.uniform(0, 2 * np.pi, 64), rng.uniform(0, 2 * np.pi, 4)
    shape = (NUM_FRAMES, READS)
    when = time_s[:, None] - FRAME_S * (0.75 - 0.5 * np.arange(READS))[None]
    antenna = (np.arange(NUM_FRAMES * READS) // 3 % num_antennas).reshape(shape)
    dwell = np.maximum(when / hop_s, 0).astype(int)
    carrier = np.array([915.25e6, 920.25e6, 905.25e6, 925.75e6])[dwell % 4]
    place = np.stack([np.interp(when, time_s, axis) for axis in tag.T], axis=-1)
    place = np.broadcast_to(tag[0], place.shape) if still else place
    range_m = np.linalg.norm(place - ANTENNAS_M[antenna], axis=-1)
    phase = 4 * np.pi * carrier * range_m / C + offsets[dwell] + own[antenna] + 0.05 * rng.normal(size=shape)
    phase = phase + np.pi * (rng.random(shape) < 0.08)
    return Arrivals(
        tag=jnp.zeros(shape, jnp.int32),
        antenna=jnp.asarray(antenna, jnp.int32),
        time_s=jnp.asarray(when, jnp.float32),
        phase_rad=jnp.asarray(np.mod(phase, 2 * np.pi), jnp.float32),
        carrier_hz=jnp.asarray(carrier, jnp.float32),
        channel=jnp.asarray(carrier * 1e-3, jnp.int32),
        rssi_dbm=jnp.full(shape, -50.0),
        valid=jnp.asarray(when > 0),
    )


@eqx.filter_jit
def _traced(antennas_m, begin, inputs):
    stage, reader, none = UnknownDepth(num_depths=4), ReaderModel(), (jnp.zeros(4), jnp.full(4, jnp.inf))

    def step(carry, one):
        state, last_s = carry
        arrivals, ray, turn, now_s = one
        motion, memory_s = RayMotion(ray, turn, *none), jnp.array(4.0)
        state, evidence = stage.step(reader, memory_s, state, arrivals, antennas_m, motion, NO_NEWBORN, last_s, now_s)
        return (state, now_s), evidence[0]

    return jax.lax.scan(step, begin, inputs)[1]


@functools.cache
def _evidence(num_antennas: int, *, still: bool = False) -> np.ndarray:
    """(frames, segment)."""
    time_s, places, _ = _scene()
    rays = jnp.asarray(places[..., :2] / places[..., 2:], jnp.float32)
    turns, times = jnp.diff(rays, axis=0, prepend=rays[:1]), jnp.asarray(time_s, jnp.float32)
    begin = UnknownDepth(num_depths=4).init(1, num_antennas, 4), times[0]
    antennas_m = jnp.asarray(ANTENNAS_M[:num_antennas], jnp.float32)
    return np.asarray(_traced(antennas_m, begin, (_reads(num_antennas, still=still), rays, turns, times)))


def test_four_antennas_find_the_ray_of_the_tag() -> None:
    evidence = _evidence(4)[-1]
    assert np.isfinite(_evidence(4)).all()
    assert evidence[1] > 0
    assert evidence[1] > np.delete(evidence, 1).max() + 8.0
    assert evidence[0] < 0  # the tag does not rest


def test_one_antenna_cannot_tell_rays_apart() -> None:
    """A motion in depth explains the phases at one antenna for any ray (TagAttention, section V-F, option 1)."""
    one, four = _evidence(1)[-1], _evidence(4)[-1]
    assert one[1] > 0
    assert one[1:].min() > 0.8 * one[1]
    assert (one[1] - one[2:].max()) / one[1] < 0.3 * (four[1] - four[2:].max()) / four[1]


def test_a_tag_at_rest_is_on_the_background() -> None:
    evidence = _evidence(4, still=True)[-1]
    assert evidence[0] > 50.0
    assert evidence[0] > evidence[1:].max() + 20.0


def test_rays_of_nominal_and_of_true_depth_are_the_same() -> None:
    before, after = np.array([0.4, -0.2, 2.0]), np.array([0.5, -0.1, 2.3])
    motion = RayMotion.of(jnp.asarray(after)[None], jnp.asarray(after - before)[None])
    np.testing.assert_allclose(motion.ray[0], after[:2] / after[2], rtol=1e-6)
    np.testing.assert_allclose(motion.turn[0], after[:2] / after[2] - before[:2] / before[2], atol=1e-6)
    assert np.isinf(motion.rate_variance).all()


@pytest.mark.parametrize("nearer_m", [0.0, 1e-20, -0.3])
def test_a_segment_out_of_view_has_a_finite_ray(nearer_m: float) -> None:
    """Its place is 0, its remembered displacement is not: a ray of 1e19 became the NaN of every segment's scale."""
    motion = RayMotion.of(jnp.zeros((1, 3)), jnp.array([[0.02, -0.01, -nearer_m]]))
    assert np.all(np.abs(motion.ray) < 1.0)
    assert np.all(np.abs(motion.turn) < 1.0)


def test_new_segments_of_the_background_may_have_any_depth() -> None:
    stage = UnknownDepth()
    state = stage.init(1, 4, 4)
    source = jnp.array([-2, 0, -1, -2], jnp.int32)
    got = stage._started(eqx.tree_at(lambda s: s.log_likelihood, state, jnp.array([[3.0, 1.0, 1.0, 1.0]])), source)
    np.testing.assert_allclose(got.log_hypothesis[0, :, 1], 3.0)
    np.testing.assert_allclose(got.log_hypothesis[0, :, 3], 0.0)
    assert float(got.belief.covariance[0, 0, 0, 0, 1]) > 0
    assert float(got.belief.covariance[0, 0, 0, 0, 0]) == 0


def test_errors() -> None:
    with pytest.raises(ValueError, match="expected at least 1 depth, and min_m below max_m"):
        UnknownDepth(min_m=4.0, max_m=2.0)
    with pytest.raises(ValueError, match="unknown_depth is on and dwell is off"):
        TagAttention(unknown_depth=UnknownDepth(), dwell=None, hidden=None, free=None, attention=AttentionEvidence())
