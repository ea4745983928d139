"""Detection: a closed form, what it does without reads, and its gradients."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.radio.arrivals import Arrivals
from tagjax.tagattention.segments import Detection
from tagjax.tagattention.segments.detection import RecentReads
from tagjax.tracing.status import Status


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


def recent(number: list[float], nats: list[float]) -> RecentReads:
    return RecentReads(jnp.asarray(number, jnp.float32), jnp.asarray(nats, jnp.float32))


def test_the_confidence_is_that_of_three_hypotheses():
    detection = Detection(temperature_nats=2.0, stationary=1.0, elsewhere=-1.0)
    body, still = np.array([10.0, 3.0, -30.0]), np.array([4.0, 20.0, -60.0])
    number, nats = [3.0, 50.0, 20.0], [2.0, 2.0, 8.0]
    found = detection.confidence(jnp.asarray(body, jnp.float32), jnp.asarray(still, jnp.float32), recent(number, nats))
    odds = np.exp(body / 2), np.exp(still / 2 + 1), np.exp((body - nats) / 2 - 1)
    expected = odds[0] / sum(odds) * (1 - np.exp(-np.array(number)))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_the_probabilities_add_up_to_one_and_the_first_is_the_confidence():
    detection, number = Detection(), [0.5, 8.0, 1e-6, 0.0]
    given = (
        jnp.array([3.0, -7.0, 300.0, 0.0]),
        jnp.array([1.0, 40.0, 290.0, 0.0]),
        recent(number, [2.0, -9.0, 1.0, 0.0]),
    )
    found = detection.probabilities(*given)
    np.testing.assert_allclose(jnp.sum(found, axis=0), 1.0, rtol=1e-6)
    np.testing.assert_array_equal(found[0], detection.confidence(*given))
    np.testing.assert_allclose(found[3], np.exp(-np.asarray(number)), rtol=1e-6)


def test_recent_reads_decide_whether_a_body_still_carries_the_tag():
    detection, still, body = Detection(), jnp.full(2, -90.0), jnp.array([80.0, -20.0])
    left, on_it = detection.confidence(body, still, recent([20.0, 20.0], [-20.0, 20.0]))
    assert float(left) < 0.01  # much evidence of seconds ago, and phases at random since
    assert float(on_it) > 0.99  # a new body inherits evidence against it, and explains all that was read since


BODY, STILL, ELSEWHERE, UNREAD = np.eye(4)


@pytest.mark.parametrize(
    ("probabilities", "in_view", "hidden", "expected"),
    [
        (0.9 * BODY + 0.1 * STILL, True, False, Status.DETECTED),
        (0.4 * BODY + 0.35 * UNREAD + 0.25 * STILL, True, False, Status.NOT_READ),
        (0.4 * BODY + 0.25 * UNREAD + 0.35 * STILL, True, False, Status.STATIONARY),
        (0.4 * BODY + 0.35 * ELSEWHERE + 0.25 * UNREAD, True, False, Status.NOT_FOUND),
        (0.9 * BODY + 0.1 * STILL, True, True, Status.OCCLUDED),
        (0.9 * BODY + 0.1 * STILL, False, True, Status.OCCLUDED),
        (0.9 * BODY + 0.1 * STILL, False, False, Status.NOT_FOUND),
        (0.3 * BODY + 0.7 * UNREAD, True, True, Status.NOT_READ),
        (0.3 * BODY + 0.7 * STILL, True, True, Status.STATIONARY),
    ],
)
def test_the_status_is_the_most_probable_reason(probabilities, in_view, hidden, expected):
    detection, terms = Detection(), jnp.asarray(probabilities, jnp.float32)[:, None]
    shown = jnp.array([in_view]), jnp.array([hidden])
    detected = detection.detected(terms[0]) & shown[0] & ~shown[1]
    found = detection.status(terms, detected, *shown)
    assert found.dtype == jnp.int8
    assert Status(int(found[0])) is expected


def test_a_status_leaves_gradients_alone_and_is_the_same_in_a_compiled_batch():
    detection = Detection()
    rng = np.random.default_rng(0)
    given = tuple(jnp.asarray(rng.uniform(*ends, (5, 3)), jnp.float32) for ends in ((-9, 9), (-9, 9), (0, 3)))
    shown = tuple(jnp.asarray(rng.uniform(size=(5, 3)) < 0.5) for _ in range(2))

    def both(body, still, reads, in_view, hidden):
        terms = detection.probabilities(body, still, RecentReads(reads, 2.0 * body))
        status = detection.status(terms, detection.detected(terms[0]) & in_view & ~hidden, in_view, hidden)
        return jnp.sum(terms[0]), status

    eager = [both(*(one[row] for one in (*given, *shown)))[1] for row in range(5)]
    of_batch = jax.jit(jax.vmap(jax.value_and_grad(both, argnums=(0, 1, 2), has_aux=True)))
    (_, status), gradient = of_batch(*given, *shown)
    np.testing.assert_array_equal(status, eager)
    assert set(np.unique(status)) >= {Status.DETECTED, Status.OCCLUDED, Status.STATIONARY}

    def confidences(body, still, reads):
        of_batch = jax.vmap(
            lambda body, still, reads: detection.confidence(body, still, RecentReads(reads, 2.0 * body))
        )
        return jnp.sum(of_batch(body, still, reads))

    alone = jax.grad(confidences, argnums=(0, 1, 2))(*given)
    for found, expected in zip(gradient, alone, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


def test_recent_reads_are_counted_for_their_tag():
    detection = Detection(fresh_s=0.5)
    given = arrivals([0, 2, 0, 1], [9.9, 10.0, 9.95, 10.0], [True, True, True, False])
    before, added = recent([4.0, 4.0, 0.0], [6.0, -2.0, 0.0]), jnp.array([1.0, 0.0, 3.0])
    found = detection.received(before, given, added, jnp.asarray(9.9), jnp.asarray(10.0))
    kept = np.exp(-0.1 / 0.5)
    np.testing.assert_allclose(found.number, [4 * kept + np.exp(-0.2) + np.exp(-0.1), 4 * kept, 1.0], rtol=1e-4)
    np.testing.assert_allclose(found.nats, [6 * kept + 1, -2 * kept, 3.0], rtol=1e-4)


def test_a_tag_is_lost_without_reads_however_sure_it_was():
    detection, reads = Detection(), recent([40.0], [40.0])
    sure = jnp.array([500.0]), jnp.array([-500.0])
    assert bool(detection.detected(detection.confidence(*sure, reads))[0])
    for frame in range(150):  # five seconds
        none, times = arrivals([0], [0.0], [False]), (jnp.asarray(frame / 30), jnp.asarray((frame + 1) / 30))
        reads = detection.received(reads, none, jnp.zeros(1), *times)
    assert float(detection.confidence(*sure, reads)[0]) < 0.1


def test_a_tag_that_does_not_move_and_one_that_was_never_read_are_not_detected():
    detection, sixty = Detection(), jnp.full(1, 60.0)
    assert not bool(detection.detected(detection.confidence(sixty, sixty, recent([30.0], [20.0])))[0])
    assert not bool(detection.detected(detection.confidence(jnp.zeros(1), jnp.zeros(1), recent([0.0], [0.0])))[0])


@pytest.mark.parametrize("nats", [(0.0, 0.0, 0.0), (1e4, -1e4, 1e3), (-1e4, 1e4, 1e3)])
def test_gradients_are_finite(nats):
    def confidence(detection, body, still, reads):
        return jnp.sum(detection.confidence(body, still, RecentReads(reads, body)))

    gradient = jax.grad(confidence, argnums=(0, 1, 2, 3))(Detection(), *(jnp.full(1, value) for value in nats))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("name", ["temperature_nats", "fresh_s", "threshold"])
def test_values_that_no_stage_can_have_are_refused(name):
    with pytest.raises(ValueError, match="expected"):
        Detection(**{name: 0.0})
