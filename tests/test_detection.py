"""Detection: its closed form, what it does without reads, the reasons that it gives, and its gradients."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expit

from tagjax.radio.arrivals import Arrivals
from tagjax.tagattention.segments import Detection
from tagjax.tagattention.segments.detection import Explanations, RecentReads, best_of_segments
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


def recent(number: list[float], free_nats: list[float]) -> RecentReads:
    return RecentReads(*(jnp.asarray(values, jnp.float32) for values in (number, free_nats)))


def evidence(body: Any, stationary: Any, free: Any = 0.0) -> Explanations:
    shape = np.broadcast_shapes(*(np.shape(nats) for nats in (body, stationary, free)))
    return Explanations(*(jnp.asarray(np.broadcast_to(nats, shape), jnp.float32) for nats in (body, stationary, free)))


def test_the_confidence_is_what_the_body_explains_better_than_its_rivals():
    detection = Detection(
        temperature_nats=5.0,
        stationary=0.25,
        free=0.75,
        free_recent=2.0,
        level=1.0,
        moves_nats=3.0,
        moves_level=0.5,
    )
    body, still, free = np.array([60.0, 30.0, -30.0]), np.array([4.0, 20.0, -60.0]), np.array([40.0, 0.0, 9.0])
    number, free_nats = np.array([3.0, 50.0, 20.0]), np.array([5.0, -1.0, 3.0])
    found = detection.confidence(evidence(body, still, free), recent(number, free_nats))
    better = body - 0.25 * np.minimum(still, 0) - 0.75 * free - 2 * np.maximum(free_nats, 0)
    moves = np.maximum(body, free) - np.maximum(still, 0)
    expected = expit(moves / 3 - 0.5) * expit(better / 5 - 1) * (1 - np.exp(-number))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_each_rival_that_explains_the_reads_lowers_the_confidence():
    detection, reads = Detection(), recent([20.0], [10.0])
    alone = float(detection.confidence(evidence([80.0], [-90.0], [10.0]), reads)[0])
    assert alone > 0.8
    assert float(detection.confidence(evidence([80.0], [78.0], [10.0]), reads)[0]) < alone - 0.02
    assert float(detection.confidence(evidence([80.0], [-90.0], [90.0]), reads)[0]) < alone - 0.02
    free_of_late = recent([20.0], [60.0])
    assert float(detection.confidence(evidence([80.0], [-90.0], [10.0]), free_of_late)[0]) < alone - 0.02


@pytest.mark.parametrize(
    ("nats", "number", "in_view", "hidden", "expected"),
    [
        ((90.0, -50.0, 10.0), 20.0, True, False, Status.DETECTED),
        ((90.0, -50.0, 10.0), 0.1, True, False, Status.NOT_READ),
        ((40.0, 50.0, 30.0), 20.0, True, False, Status.STATIONARY),
        ((-20.0, 5.0, -5.0), 20.0, True, False, Status.STATIONARY),
        ((0.0, -50.0, 60.0), 20.0, True, False, Status.NOT_FOUND),
        ((10.0, 20.0, 60.0), 20.0, True, False, Status.NOT_FOUND),
        ((90.0, -50.0, 10.0), 20.0, True, True, Status.OCCLUDED),
        ((90.0, -50.0, 10.0), 20.0, False, True, Status.OCCLUDED),
        ((90.0, -50.0, 10.0), 20.0, False, False, Status.NOT_FOUND),
        ((90.0, -50.0, 10.0), 0.1, True, True, Status.NOT_READ),
        ((40.0, 50.0, 30.0), 20.0, True, True, Status.STATIONARY),
    ],
)
def test_the_status_is_the_reason(nats, number, in_view, hidden, expected):
    detection, shown = Detection(), (jnp.array([in_view]), jnp.array([hidden]))
    given = evidence(*([value] for value in nats)), recent([number], [10.0])
    detected = detection.detected(detection.confidence(*given)) & shown[0] & ~shown[1]
    found = detection.status(*given, detected, *shown)
    assert found.dtype == jnp.int8
    assert Status(int(found[0])) is expected


def test_a_status_leaves_gradients_alone_and_is_the_same_in_a_compiled_batch():
    detection = Detection()
    rng = np.random.default_rng(0)
    ends = (-90, 180), (-90, 90), (-90, 90), (0, 3)
    given = tuple(jnp.asarray(rng.uniform(*one, (5, 3)), jnp.float32) for one in ends)
    shown = tuple(jnp.asarray(rng.uniform(size=(5, 3)) < 0.5) for _ in range(2))

    def both(body, still, free, reads, in_view, hidden):
        nats, around = Explanations(body, still, free), RecentReads(reads, 0.1 * free)
        confidence = detection.confidence(nats, around)
        detected = detection.detected(confidence) & in_view & ~hidden
        return jnp.sum(confidence), detection.status(nats, around, detected, in_view, hidden)

    eager = [both(*(one[row] for one in (*given, *shown)))[1] for row in range(5)]
    of_batch = jax.jit(jax.vmap(jax.value_and_grad(both, argnums=(0, 1, 2, 3), has_aux=True)))
    (_, status), gradient = of_batch(*given, *shown)
    np.testing.assert_array_equal(status, eager)
    assert set(np.unique(status)) >= {Status.DETECTED, Status.OCCLUDED, Status.STATIONARY}

    def confidences(body, still, free, reads):
        of_batch = jax.vmap(
            lambda body, still, free, reads: detection.confidence(
                Explanations(body, still, free), RecentReads(reads, 0.1 * free)
            )
        )
        return jnp.sum(of_batch(body, still, free, reads))

    alone = jax.grad(confidences, argnums=(0, 1, 2, 3))(*given)
    for found, expected in zip(gradient, alone, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


def test_the_best_segment_moves_and_without_one_its_evidence_is_none() -> None:
    nats = jnp.asarray([[9.0, -3.0, 2.0], [9.0, -1.0, -4.0]])
    np.testing.assert_allclose(best_of_segments(nats, jnp.asarray([False, True, True])), [2.0, -1.0])
    np.testing.assert_allclose(best_of_segments(nats, jnp.zeros(3, bool)), [0.0, 0.0])


def test_recent_reads_are_counted_for_their_tag():
    detection = Detection(fresh_s=0.5)
    given = arrivals([0, 2, 0, 1], [9.9, 10.0, 9.95, 10.0], [True, True, True, False])
    before, added = recent([4.0, 4.0, 0.0], [1.0, 2.0, 0.0]), jnp.array([2.0, 0.0, 6.0])
    found = detection.received(before, given, added, jnp.asarray(9.9), jnp.asarray(10.0))
    kept = np.exp(-0.1 / 0.5)
    np.testing.assert_allclose(found.number, [4 * kept + np.exp(-0.2) + np.exp(-0.1), 4 * kept, 1.0], rtol=1e-4)
    np.testing.assert_allclose(found.free_nats, [kept + 2, 2 * kept, 6.0], rtol=1e-4)


def test_a_tag_is_lost_without_reads_however_sure_it_was():
    detection, reads = Detection(), recent([40.0], [20.0])
    sure = evidence([500.0], [-500.0])
    assert bool(detection.detected(detection.confidence(sure, reads))[0])
    for frame in range(150):  # five seconds
        none, times = arrivals([0], [0.0], [False]), (jnp.asarray(frame / 30), jnp.asarray((frame + 1) / 30))
        reads = detection.received(reads, none, jnp.zeros(1), *times)
    assert float(detection.confidence(sure, reads)[0]) < 0.1


def test_a_tag_that_does_not_move_and_one_that_was_never_read_are_not_detected():
    detection = Detection()
    still = evidence([61.0], [60.0], [30.0])
    assert not bool(detection.detected(detection.confidence(still, recent([30.0], [10.0])))[0])
    assert not bool(detection.detected(detection.confidence(evidence([0.0], [0.0]), recent([0.0], [0.0])))[0])


@pytest.mark.parametrize("nats", [(0.0, 0.0, 0.0), (1e4, -1e4, 1e3), (-1e4, 1e4, 1e3)])
def test_gradients_are_finite(nats):
    def confidence(detection, body, still, reads):
        return jnp.sum(detection.confidence(Explanations(body, still, body), RecentReads(reads, still)))

    gradient = jax.grad(confidence, argnums=(0, 1, 2, 3))(Detection(), *(jnp.full(1, value) for value in nats))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
