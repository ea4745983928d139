"""Detection: a closed form, what it does without reads, and its gradients."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.radio.arrivals import Arrivals
from tagjax.tagattention.segments import Detection


def arrivals(tag: list[int], time_s: list[float], valid: list[bool] | None = None) -> Arrivals:
    number = len(tag)
    return Arrivals(
        tag=jnp.asarray(tag, jnp.int32),
        antenna=jnp.zeros(number, jnp.int32),
        time_s=jnp.asarray(time_s, jnp.float32),
        phase_rad=jnp.zeros(number),
        carrier_hz=jnp.full(number, 915e6),
        channel=jnp.zeros(number, jnp.int32),
        rssi_dbm=jnp.full(number, -60.0),
        valid=jnp.asarray([True] * number if valid is None else valid),
    )


def test_the_confidence_is_that_of_three_hypotheses():
    detection = Detection(temperature_nats=2.0, stationary=1.0, elsewhere=-1.0)
    body, still, reads = jnp.array([10.0, 3.0]), jnp.array([4.0, 20.0]), jnp.array([3.0, 50.0])
    found = detection.confidence(body, still, reads)
    odds = np.exp([5.0, 1.5]), np.exp([3.0, 11.0]), np.exp([-1.0, -1.0])
    expected = odds[0] / sum(odds) * (1 - np.exp([-3.0, -50.0]))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_recent_reads_are_counted_for_their_tag():
    detection = Detection(fresh_s=0.5)
    given = arrivals([0, 2, 0, 1], [9.9, 10.0, 9.95, 10.0], [True, True, True, False])
    found = detection.received(jnp.array([4.0, 4.0, 0.0]), given, jnp.asarray(9.9), jnp.asarray(10.0))
    kept = 4.0 * np.exp(-0.1 / 0.5)
    np.testing.assert_allclose(found, [kept + np.exp(-0.2) + np.exp(-0.1), kept, 1.0], rtol=1e-4)


def test_a_tag_is_lost_without_reads_however_sure_it_was():
    detection, reads = Detection(), jnp.array([40.0])
    sure = jnp.array([500.0]), jnp.array([-500.0])
    assert bool(detection.detected(detection.confidence(*sure, reads))[0])
    for frame in range(150):  # five seconds
        reads = detection.received(
            reads, arrivals([0], [0.0], [False]), jnp.asarray(frame / 30), jnp.asarray((frame + 1) / 30)
        )
    assert float(detection.confidence(*sure, reads)[0]) < 0.1


def test_a_tag_that_does_not_move_and_one_that_was_never_read_are_not_detected():
    detection, many, none = Detection(), jnp.full(1, 30.0), jnp.zeros(1)
    assert not bool(detection.detected(detection.confidence(jnp.full(1, 60.0), jnp.full(1, 60.0), many))[0])
    assert not bool(detection.detected(detection.confidence(jnp.zeros(1), jnp.zeros(1), none))[0])


@pytest.mark.parametrize("nats", [(0.0, 0.0, 0.0), (1e4, -1e4, 1e3), (-1e4, 1e4, 1e3)])
def test_gradients_are_finite(nats):
    def confidence(detection, body, still, reads):
        return jnp.sum(detection.confidence(body, still, reads))

    gradient = jax.grad(confidence, argnums=(0, 1, 2, 3))(Detection(), *(jnp.full(1, value) for value in nats))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("name", ["temperature_nats", "fresh_s", "threshold"])
def test_values_that_no_stage_can_have_are_refused(name):
    with pytest.raises(ValueError, match="expected"):
        Detection(**{name: 0.0})
