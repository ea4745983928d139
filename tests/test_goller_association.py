"""Goller et al.: association by the HMM forward filter."""

from __future__ import annotations

import equinox as eqx
import goller_scenes as scenes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tagjax.baselines.goller.matching import assignment_row, associate, forward_filter, make_association


def numpy_forward(model, time_s, rows, identity, observed):
    """The forward algorithm with an explicit transition matrix between previous and present states."""
    switch = float(np.exp(model.log_switch_hz))
    out, previous, held = [], None, None
    for t in range(len(time_s)):
        there = np.concatenate([[True], identity[t] > 0])
        num = there.sum()
        elapsed = time_s[t] - time_s[max(t - 1, 0)]
        if previous is None:
            prior = there / num
        else:
            matrix = np.zeros((len(there), len(there)))
            same = np.concatenate([[True], (identity[t] > 0) & (identity[t] == held)])
            for i in range(len(there)):
                matrix[i] = np.eye(len(there))[i] if same[i] else there / num
            prior = previous @ matrix
        stay = np.exp(-switch * elapsed) if num > 1 else 1.0
        mix = np.where(np.eye(len(there), dtype=bool), stay, (1 - stay) / max(num - 1, 1)) * np.outer(there, there)
        alpha = prior @ mix
        alpha = alpha * np.where(there, np.exp(rows[t]) if observed[t] else 1.0, 0.0)
        previous, held = alpha / alpha.sum(), identity[t]
        out.append((previous, np.log(alpha.sum()) if observed[t] else 0.0))
    return np.array([p for p, _ in out]), np.array([e for _, e in out])


def _random_case(rng, num_times=25, num_slots=3):
    identity = rng.integers(0, 4, (num_times, num_slots)) * (rng.random((num_times, num_slots)) < 0.8)
    identity = np.repeat(identity[::4], 4, axis=0)[:num_times]
    rows = rng.normal(scale=2.0, size=(num_times, 1 + num_slots))
    return np.cumsum(rng.uniform(0.02, 0.2, num_times)), rows, identity, rng.random(num_times) < 0.7


def _run_filter(model, time_s, rows, identity, observed):
    return forward_filter(
        model,
        jnp.asarray(time_s, jnp.float32),
        jnp.asarray(rows, jnp.float32),
        jnp.asarray(identity, jnp.int32),
        jnp.asarray(observed),
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_filter_is_the_forward_algorithm(seed):
    model = make_association(switch_hz=0.7)
    case = _random_case(np.random.default_rng(seed))
    found = _run_filter(model, *case)
    probability, evidence = numpy_forward(model, *case)
    np.testing.assert_allclose(found.probability, probability, atol=2e-5)
    np.testing.assert_allclose(found.log_evidence, evidence, atol=2e-4)
    np.testing.assert_allclose(np.sum(found.probability, axis=1), 1.0, rtol=1e-5)


def test_without_observations_two_states_relax_to_equal_probability():
    model = make_association(switch_hz=0.5)
    time_s = np.arange(40) * 0.1
    observed = np.arange(40) == 0
    rows = np.broadcast_to([0.0, 3.0], (40, 2))
    found = _run_filter(model, time_s, rows, np.ones((40, 1), int), observed)
    start = 1 / (1 + np.exp(3.0)) - 0.5
    # Eigenvalue of a two-state chain: each frame keeps 2 exp(-switch dt) - 1 of what is above one half.
    expected = 0.5 + start * (2 * np.exp(-0.05) - 1) ** np.arange(40)
    np.testing.assert_allclose(found.probability[:, 0], expected, atol=1e-5)


def test_the_state_changes_with_the_evidence():
    model = make_association(switch_hz=0.2)
    rows = np.full((60, 3), -4.0)
    rows[:30, 1] = rows[30:, 2] = 0.0
    found = np.asarray(
        _run_filter(model, np.arange(60) * 0.1, rows, np.tile([7, 9], (60, 1)), np.ones(60, bool)).probability
    )
    assert found[29, 1] > 0.99
    assert found[-1, 2] > 0.99
    # One contrary observation does not change the most probable state; two do.
    assert found[30, 1] > 0.5
    assert np.argmax(found[:, 2] > 0.5) in (31, 32)


def test_the_probability_of_a_lost_blob_is_distributed_evenly():
    model = make_association(switch_hz=1e-6)
    rows = np.zeros((3, 3))
    rows[0] = [-9.0, 9.0, -9.0]
    observed = np.array([True, False, False])
    gone = _run_filter(model, np.arange(3) * 0.1, rows, np.array([[1, 2], [0, 2], [0, 2]]), observed).probability
    np.testing.assert_allclose(gone[1], [0.5, 0.0, 0.5], atol=1e-4)
    replaced = _run_filter(model, np.arange(3) * 0.1, rows, np.array([[1, 2], [3, 2], [3, 2]]), observed).probability
    np.testing.assert_allclose(replaced[1], [1 / 3] * 3, atol=1e-4)
    kept = _run_filter(model, np.arange(3) * 0.1, rows, np.array([[1, 2]] * 3), observed).probability
    np.testing.assert_allclose(kept[1], [0.0, 1.0, 0.0], atol=1e-4)


def test_empty_slots_change_nothing():
    model = make_association()
    time_s, rows, identity, observed = _random_case(np.random.default_rng(3), num_slots=2)
    found = _run_filter(model, time_s, rows, identity, observed)
    wide = _run_filter(
        model,
        time_s,
        np.concatenate([rows, np.full((len(rows), 3), 50.0)], axis=1),
        np.concatenate([identity, np.zeros((len(rows), 3), int)], axis=1),
        observed,
    )
    np.testing.assert_allclose(wide.probability[:, :3], found.probability, atol=1e-6)
    np.testing.assert_array_equal(wide.probability[:, 3:], 0)


def test_without_blobs_every_tag_is_background():
    found = _run_filter(
        make_association(), np.arange(4) * 0.1, np.zeros((4, 3)), np.zeros((4, 2), int), np.ones(4, bool)
    )
    np.testing.assert_allclose(found.probability, np.tile([1.0, 0.0, 0.0], (4, 1)), atol=1e-6)


def test_a_row_is_the_gaussians_of_distance_and_speed():
    model = make_association(distance_m=(0.6, 0.9), speed_m_s=0.4, clutter=1e-30)
    row = assignment_row(
        model, jnp.asarray([1.0, 0.5]), jnp.asarray([0.3, -0.2]), jnp.asarray([[0.7, 0.4], [3.0, 0.0]])
    )
    still = multivariate_normal([0, 0], np.diag([0.16, 0.16])).logpdf([0.3, -0.2])
    near = multivariate_normal([0, 0], np.diag([0.36, 0.81]))
    np.testing.assert_allclose(row, [still, near.logpdf([0.3, 0.1]), near.logpdf([-2.0, 0.5])], rtol=1e-5)


def test_outliers_stay_finite_and_decide_nothing():
    model = make_association(clutter=1e-3)
    tag = jnp.asarray([[1e6, -1e6]] * 3)
    held = lambda m, t, v: associate(  # noqa: E731
        m, scenes.frame_times(3), t, v, jnp.ones(3, bool), jnp.zeros((3, 2, 2)), jnp.tile(jnp.asarray([1, 2]), (3, 1))
    )
    found = jax.jit(held)(model, tag, tag)
    np.testing.assert_allclose(found.probability, 1 / 3, rtol=1e-3)
    gradient = jax.jit(jax.grad(lambda *x: jnp.sum(held(*x).log_evidence), argnums=(0, 1, 2)))(model, tag, tag)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(gradient))
    zero = jnp.zeros((3, 2))
    gradient = jax.jit(jax.grad(lambda *x: held(*x).probability[-1, 1], argnums=(0, 1, 2)))(model, zero, zero)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(gradient))


def test_gradients_of_the_filter(gradients_agree):
    rng = np.random.default_rng(1)
    time_s, _, identity, observed = _random_case(rng, num_times=9, num_slots=2)
    tag, velocity, blob = rng.normal(size=(9, 2)), rng.normal(size=(9, 2)), rng.normal(size=(9, 2, 2))
    start = make_association()

    def held(distance, speed, switch, clutter, tag, velocity, blob):
        model = eqx.tree_at(
            lambda m: (m.log_distance_m, m.log_speed_m_s, m.log_switch_hz, m.log_clutter),
            start,
            (distance, speed, switch, clutter),
        )
        times = jnp.asarray(time_s).astype(tag.dtype)
        out = associate(model, times, tag, velocity, jnp.asarray(observed), blob, jnp.asarray(identity, jnp.int32))
        return jnp.concatenate([out.probability, out.log_evidence[:, None]], axis=1)

    widths = (np.log([0.7, 1.1]), np.log(0.5), np.log(0.4), np.log(0.01))
    gradients_agree(jax.jit(held), (*widths, tag, velocity, blob), atol=1e-5, rtol=1e-4)


def test_jit_is_eager_and_vmap_is_a_loop():
    model = make_association()
    cases = [_random_case(np.random.default_rng(seed)) for seed in range(3)]
    eager = [_run_filter(model, *case) for case in cases]
    columns = [jnp.asarray(np.stack(column)) for column in zip(*cases, strict=True)]
    kinds = (jnp.float32, jnp.float32, jnp.int32, bool)
    columns = [column.astype(kind) for column, kind in zip(columns, kinds, strict=True)]
    mapped = jax.jit(jax.vmap(forward_filter, in_axes=(None, 0, 0, 0, 0)))(model, *columns)
    for number, one in enumerate(eager):
        np.testing.assert_allclose(mapped.probability[number], one.probability, atol=1e-5)
        np.testing.assert_allclose(mapped.log_evidence[number], one.log_evidence, atol=1e-4)
