"""The range anchor: the path laid together from windows, the belief over the starting range, and what it says."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.tagattention.anchor import (
    BIN_M,
    LEAK,
    Anchor,
    joined,
    log_density,
    lost_drift_m,
    move_anchor,
    update_belief,
    votes,
)

NUM_BINS, WINDOW = 60, 5
WIDTH, UNSEEN = jnp.asarray(0.2), jnp.asarray(-1.0)


def _fresh() -> Anchor:
    return jax.tree.map(lambda leaf: leaf[0], Anchor.unknown(1, num_window=WINDOW, num_bins=NUM_BINS))


def _windows(path: np.ndarray) -> np.ndarray:
    index = np.maximum(np.arange(len(path))[:, None] - np.arange(WINDOW - 1, -1, -1), 0)
    return (path[index] - path[index[:, :1]]).astype(np.float32)


def test_windows_are_laid_together_to_the_path():
    path = np.cumsum(np.random.default_rng(0).normal(0, 0.05, 40))
    path -= path[0]
    anchor = _fresh()
    for window in _windows(path):
        anchor = move_anchor(anchor, jnp.asarray(window), jnp.asarray(True), jnp.asarray(0.01))
    np.testing.assert_allclose(anchor.travelled_m, path[-WINDOW:], atol=1e-5)


def test_only_the_mean_of_a_steps_errors_adds_up():
    """Independent errors of each window's samples: laying four samples over each other halves what a chain would sum."""
    windows = np.random.default_rng(1).normal(0, 0.01, (60, 60, WINDOW)).astype(np.float32)

    def end(path):
        def laid(anchor, window):
            return move_anchor(anchor, window, jnp.asarray(True), jnp.asarray(0.01)), None

        return jax.lax.scan(laid, _fresh(), path)[0].travelled_m[-1]

    ends = jax.jit(jax.vmap(end))(windows)
    chains = np.sum(windows[..., -1] - windows[..., -2], axis=1)
    assert np.std(ends) < 0.75 * np.std(chains)


def test_an_unread_tag_stays_and_its_belief_spreads():
    anchor = Anchor(jnp.arange(5.0), jnp.log(jnp.full(NUM_BINS, 1e-9).at[30].set(1.0)))
    drift = lost_drift_m(jnp.asarray([0.0, 0.1, 0.2, 0.3, 0.4]))
    moved = move_anchor(anchor, jnp.full(WINDOW, 7.0), jnp.asarray(False), drift)
    np.testing.assert_allclose(moved.travelled_m, [1.0, 2.0, 3.0, 4.0, 4.0])
    probability = np.exp(moved.belief)
    np.testing.assert_allclose(probability.sum(), 1.0, atol=1e-5)
    place = (np.arange(NUM_BINS) - 30) * BIN_M
    kept = np.clip((probability - LEAK / NUM_BINS) / (1 - LEAK), 0, None)
    np.testing.assert_allclose(np.sum(kept * place**2), float(drift) ** 2, rtol=1e-2)


def test_votes_are_the_best_evidence_at_that_range():
    anchor = Anchor(jnp.full(WINDOW, 0.4), _fresh().belief)
    range_m, evidence = jnp.asarray([2.45, 3.45, 4.95]), jnp.asarray([1.0, -2.0, 3.0])
    found = np.asarray(votes(anchor, range_m, evidence, jnp.asarray([True, True, False]), WIDTH, UNSEEN))
    start = (np.arange(NUM_BINS) + 0.5) * BIN_M
    at = {value: int(np.argmin(np.abs(start - value))) for value in (2.05, 3.05, 4.55, 5.5)}
    # Soft maxima lie above the hard ones by at most log(candidates) / sharpness.
    assert found[at[2.05]] == pytest.approx(1.0, abs=0.05)
    for elsewhere in (3.05, 4.55, 5.5):
        assert found[at[elsewhere]] == pytest.approx(-1.0, abs=0.05)
    assert int(found.argmax()) == at[2.05]


def test_the_belief_finds_the_starting_range_among_others():
    """One of four walkers carries the tag; each window's evidence is weak and sometimes wrong."""
    rng = np.random.default_rng(3)
    time = np.arange(60) / 7
    walkers = np.stack([3 + k * 0.5 + 0.8 * np.sin(time * (0.7 + 0.2 * k) + k) for k in range(4)])
    anchor = _fresh()
    for t, window in enumerate(_windows(walkers[2] - walkers[2, 0])):
        evidence = np.where(np.arange(4) == 2, 0.3, -0.3) + rng.normal(0, 0.8, 4)
        anchor = move_anchor(anchor, jnp.asarray(window), jnp.asarray(True), jnp.asarray(0.01))
        vote = votes(
            anchor,
            jnp.asarray(walkers[:, t], jnp.float32),
            jnp.asarray(evidence, jnp.float32),
            jnp.ones(4, bool),
            WIDTH,
            UNSEEN,
        )
        anchor = update_belief(anchor, vote, jnp.asarray(0.3))
    found = (float(np.argmax(anchor.belief)) + 0.5) * BIN_M
    assert found == pytest.approx(walkers[2, 0], abs=0.2)
    density = log_density(anchor, jnp.asarray(walkers[:, -1:], jnp.float32), WIDTH, jnp.asarray(4.0))[:, 0]
    assert int(np.argmax(density)) == 2
    assert float(density[2]) > 1.0


def test_without_information_the_likelihood_is_flat():
    found = log_density(_fresh(), jnp.linspace(0.0, 9.0, 50)[None], WIDTH, jnp.asarray(4.0))
    np.testing.assert_allclose(found, 0.0, atol=1e-4)


def test_the_density_is_bounded_and_continuous():
    belief = jax.nn.log_softmax(jnp.zeros(NUM_BINS).at[20].set(40.0))
    anchor = Anchor(jnp.zeros(WINDOW), belief)
    found = np.asarray(log_density(anchor, jnp.linspace(-1.0, 9.0, 2001)[None], WIDTH, jnp.asarray(4.0)))[0]
    assert found.max() <= 4.0
    assert found.min() >= -4.0
    assert np.abs(np.diff(found)).max() < 0.2
    assert np.linspace(-1.0, 9.0, 2001)[found.argmax()] == pytest.approx(20.5 * BIN_M, abs=BIN_M)


def _normal(mean_m: float, std_m: float) -> jax.Array:
    start = (jnp.arange(NUM_BINS, dtype=jnp.float32) + 0.5) * BIN_M
    return jax.nn.log_softmax(-0.5 * jnp.square((start - mean_m) / std_m))


def test_two_anchors_meet_at_the_range_that_both_allow():
    """Of two normal beliefs of the range now the product is normal, by precision; each counts from a start of its own."""
    past = Anchor(jnp.full(WINDOW, 0.4), _normal(2.1, 0.4))  # range now 2.5
    later = Anchor(jnp.full(WINDOW, -0.83), _normal(3.93, 0.3))  # 3.1
    found = joined(past, later)
    range_m = float(found.travelled_m[-1]) + (np.arange(NUM_BINS) + 0.5) * BIN_M
    probability = np.exp(found.belief)
    precision = 0.4**-2 + 0.3**-2
    mean = (2.5 * 0.4**-2 + 3.1 * 0.3**-2) / precision
    np.testing.assert_allclose(probability.sum(), 1.0, atol=1e-5)
    np.testing.assert_allclose(probability @ range_m, mean, atol=0.01)
    np.testing.assert_allclose(
        probability @ np.square(range_m - mean), 1.0 / precision, rtol=0.04
    )  # between bins: linear


def test_an_anchor_that_knows_nothing_changes_none():
    known = Anchor(jnp.full(WINDOW, 0.3), _normal(2.0, 0.4))
    found = joined(known, _fresh())
    np.testing.assert_allclose(jnp.exp(found.belief), jnp.exp(known.belief), atol=1e-3)
    # Where they contradict each other some range is left, so that something can still be the object.
    against = joined(known, Anchor(jnp.zeros(WINDOW), _normal(5.0, 0.1)))
    assert float(jnp.max(log_density(against, jnp.linspace(0.0, 6.0, 61)[None], WIDTH, jnp.asarray(4.0)))) > 1.0


def test_gradients(gradients_agree):
    anchor = _fresh()
    shift = jnp.asarray(np.random.default_rng(0).normal(size=NUM_BINS))

    def through(relative_m, range_m, evidence, width_m):
        dtype = relative_m.dtype
        start = jax.tree.map(lambda leaf: leaf.astype(dtype), anchor)
        moved = move_anchor(start, relative_m, jnp.asarray(True), jnp.asarray(0.02, dtype))
        vote = votes(moved, range_m, evidence, jnp.ones(3, bool), width_m, jnp.asarray(-1.0, dtype))
        updated = update_belief(moved, vote + 0.3 * shift.astype(dtype), jnp.asarray(0.5, dtype))
        return log_density(updated, range_m[None], width_m, jnp.asarray(4.0, dtype))

    gradients_agree(
        through, ([0.0, 0.01, 0.03, 0.02, 0.05], [2.0, 3.33, 4.07], [0.3, -0.2, 0.9], 0.25), atol=1e-5, rtol=1e-3
    )


def test_jit_and_vmap_change_nothing():
    rng = np.random.default_rng(5)
    range_m = jnp.asarray(rng.uniform(1, 5, (3, 7)), jnp.float32)
    evidence = jnp.asarray(rng.normal(size=(3, 7)), jnp.float32)

    def vote(range_m, evidence):
        return votes(_fresh(), range_m, evidence, jnp.ones(7, bool), WIDTH, UNSEEN)

    together = jax.jit(jax.vmap(vote))(range_m, evidence)
    alone = jnp.stack([vote(a, b) for a, b in zip(range_m, evidence, strict=True)])
    np.testing.assert_allclose(together, alone, atol=1e-5)
