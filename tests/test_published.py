"""TagAttention as published: each step against its plain NumPy twin, gradients, and a moving box that is found."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import published_numpy as plain
import pytest
import synthetic_clips as synthetic

from tagjax.radio.published import fit_quadratic, published_distance, unwrap_slots
from tagjax.radio.reads import PhaseReads
from tagjax.tagattention.published import TagAttentionPublished
from tagjax.tagattention.published.clusters import assign, k_means, refined, seed_centres
from tagjax.tagattention.published.transport import filled, moved, nearest_source
from tagjax.tracing.range_windows import radio_windows
from tagjax.tracing.tracer import trace

HEIGHT, WIDTH = 17, 23


def _scene(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flow, ranges before and after; some missing, some at equal distance."""
    rng = np.random.default_rng(seed)
    flow = rng.normal(0, 2, (HEIGHT, WIDTH, 2)).astype(np.float32)
    before, after = (np.round(rng.uniform(1, 3, (HEIGHT, WIDTH)), 2).astype(np.float32) for _ in range(2))
    before[rng.random(before.shape) < 0.1] = 0
    after[rng.random(after.shape) < 0.1] = 0
    return flow, before, after


@pytest.mark.parametrize("seed", range(6))
def test_pixels_move_as_in_a_loop_over_them(seed: int) -> None:
    flow, before, after = _scene(seed)
    source = nearest_source(jnp.asarray(flow), jnp.asarray(before))
    expected = plain.nearest_source(flow, before)
    np.testing.assert_array_equal(source, expected)
    assert (expected < 0).any()
    found = filled(source, jnp.asarray(before), jnp.asarray(after), jnp.asarray(0.05))
    want = plain.filled(expected, before, after, 0.05)
    np.testing.assert_array_equal(found, want)
    assert (want >= 0).sum() > (expected >= 0).sum()


def test_the_nearer_surface_wins_and_a_box_moves_whole() -> None:
    range_m = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    range_m[5:10, 4:9] = 1.0
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    flow[5:10, 4:9] = (4.2, -1.8)
    source = nearest_source(jnp.asarray(flow), jnp.asarray(range_m))
    image, known = moved(jnp.asarray(range_m)[..., None], source, jnp.zeros(1))
    expected = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    expected[3:8, 8:13] = 1.0
    holes = np.zeros((HEIGHT, WIDTH), bool)
    holes[5:10, 4:9] = True
    holes[3:8, 8:13] = False
    np.testing.assert_array_equal(known, ~holes)
    np.testing.assert_array_equal(np.where(holes, 3.0, image[..., 0]), expected)


def test_repeated_moves_keep_every_pixel_of_a_rigid_box() -> None:
    """What repeated averaging loses: 30 frames, and the box's own mass is whole."""
    height, width = 40, 90
    mass = np.zeros((height, width, 1), np.float32)
    for frame in range(30):
        box = slice(10, 22), slice(5 + 2 * frame, 17 + 2 * frame)
        range_m = np.full((height, width), 3.0, np.float32)
        range_m[box] = 1.0
        if frame == 0:
            mass[box] = 1.0
        flow = np.zeros((height, width, 2), np.float32)
        flow[box] = (2.0, 0.0)
        source = nearest_source(jnp.asarray(flow), jnp.asarray(range_m))
        mass = np.asarray(moved(jnp.asarray(mass), source, jnp.zeros(1))[0])
    end = slice(10, 22), slice(5 + 60, 17 + 60)
    np.testing.assert_array_equal(mass[end], 1.0)
    assert mass.sum() == 144


@pytest.mark.parametrize("seed", range(4))
def test_clusters_are_those_of_lloyds_algorithm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32) + np.array([0, 0, 4], np.float32)
    valid = rng.random((HEIGHT, WIDTH)) < 0.8
    centres = np.array(seed_centres(jnp.asarray(points), jnp.asarray(valid), 12))
    assert centres.shape == (12, 3)
    flat, known = points.reshape(-1, 3), valid.reshape(-1)
    centres[0] = 50.0  # far from everything: stays
    found = k_means(jnp.asarray(flat), jnp.asarray(known), jnp.asarray(centres), num_iterations=3)
    want = plain.k_means(flat, known, centres, 3)
    np.testing.assert_allclose(found, want, atol=2e-5)
    cluster = np.asarray(assign(jnp.asarray(flat), found))
    np.testing.assert_array_equal(cluster, plain.assign(flat, np.asarray(found, np.float64)))
    mask = rng.random(len(flat)) < np.where(cluster % 3 == 0, 0.6, 0.05)
    fractions = {"whole": 0.3, "part": 0.05}
    one = refined(
        jnp.asarray(mask), jnp.asarray(cluster), jnp.asarray(known), 12,
        **{name: jnp.asarray(value) for name, value in fractions.items()},
    )  # fmt: skip
    np.testing.assert_array_equal(one, plain.refined(mask, cluster, known, **fractions))


@pytest.mark.parametrize("seed", range(4))
def test_the_mask_and_the_refined_likelihood_are_those_of_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    valid = rng.random((HEIGHT, WIDTH)) < 0.9
    cluster = rng.integers(0, 48, HEIGHT * WIDTH)
    likelihood = np.where(np.isin(cluster, [3, 4]).reshape(HEIGHT, WIDTH), -1.0, -9.0)
    likelihood = (likelihood + rng.normal(0, 1, likelihood.shape)).astype(np.float32)
    tracer = TagAttentionPublished()
    *_, carried, mask = tracer._masked(jnp.asarray(likelihood), jnp.asarray(valid), jnp.asarray(cluster))
    want, want_mask = plain.masked(likelihood, valid, cluster, cut=0.1, lowest=1e-3, whole=0.3, part=0.1)
    np.testing.assert_array_equal(np.asarray(mask) > 0.5, want_mask)
    assert want_mask.any()
    np.testing.assert_allclose(carried, want, atol=1e-4)


def test_where_nothing_stands_out_there_is_no_mask() -> None:
    tracer, valid = TagAttentionPublished(), jnp.ones((HEIGHT, WIDTH), bool)
    cluster = jnp.zeros(HEIGHT * WIDTH, jnp.int32)
    for constant, known in ((0.0, valid), (-3.0, valid), (0.0, ~valid)):
        *_, likelihood, mask = tracer._masked(jnp.full(valid.shape, constant), known, cluster)
        assert not np.asarray(mask).any()
        assert np.isfinite(np.asarray(likelihood)).all()


def _reads(seed: int, *, num: int = 120, channels: int = 4, flips: float = 0.1) -> tuple[PhaseReads, np.ndarray]:
    rng = np.random.default_rng(seed)
    time_s = np.sort(rng.uniform(0, 3, num))
    channel = (time_s / 0.2).astype(int) % channels
    carrier = 902.75e6 + 5e6 * channel
    path = 2.0 + 0.25 * np.sin(2.2 * time_s)
    offset = rng.uniform(0, 2 * np.pi, channels)[channel]
    phase = 4 * np.pi * carrier / 299_792_458.0 * path + offset + np.pi * (rng.random(num) < flips)
    phase = phase + rng.normal(0, 0.05, num)
    pad = 256 - num

    def padded(values: np.ndarray, fill: float, dtype: type) -> jnp.ndarray:
        return jnp.asarray(np.concatenate([values, np.full(pad, fill)]).astype(dtype))

    reads = PhaseReads(
        padded(time_s, time_s[-1], np.float32),
        padded(np.mod(phase, 2 * np.pi), 0, np.float32),
        padded(carrier, 915e6, np.float32),
        padded(np.full(num, 0.05), 1, np.float32),
        padded(channel, -1, np.int32),
        padded(np.ones(num), 0, np.bool_),
    )
    return reads, path


@pytest.mark.parametrize("slots", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_distances_are_unwrapped_as_in_the_twin(seed: int, slots: bool) -> None:
    reads, path = _reads(seed)
    num = len(path)
    found = np.asarray(unwrap_slots(reads, slots=slots))
    columns = [
        np.asarray(c, np.float64)[:num] for c in (reads.time_s, reads.phase_rad, reads.carrier_hz, reads.channel)
    ]
    np.testing.assert_allclose(found[:num], plain.unwrap_slots(*columns, slots=slots), atol=2e-4)
    np.testing.assert_array_equal(found[num:], found[num - 1])


def test_a_walk_without_noise_is_followed_over_hops_and_flips() -> None:
    time_s = np.arange(0, 4, 0.02)
    channel = (time_s / 0.2).astype(int) % 3
    path = 2.0 + 0.5 * time_s
    carrier = 902.75e6 + 5e6 * channel
    phase = np.mod(4 * np.pi * carrier / 299_792_458.0 * path + channel + np.pi * (np.arange(200) % 7 == 0), 2 * np.pi)
    ones = jnp.ones(200)
    time, angle, frequency = (jnp.asarray(column, jnp.float32) for column in (time_s, phase, carrier))
    reads = PhaseReads(time, angle, frequency, ones, jnp.asarray(channel), ones > 0)
    np.testing.assert_allclose(unwrap_slots(reads), path - path[0], atol=2e-3)


def test_an_impossible_slot_goes_on_at_the_velocity_before() -> None:
    time_s = np.arange(70) / 64  # a slot is seven steps: the first for which 0.1 s have passed
    drop_m = -1.9 * np.clip(time_s - 35 / 64, 0, 7 / 64)
    path = 0.3 * time_s + drop_m
    phase = np.mod(4 * np.pi * 915e6 / 299_792_458.0 * path, 2 * np.pi)
    ones = jnp.ones(len(time_s))
    time, angle = (jnp.asarray(column, jnp.float32) for column in (time_s, phase))
    reads = PhaseReads(time, angle, 915e6 * ones, ones, jnp.zeros(len(time_s), jnp.int32), ones > 0)
    with_rule, without = (np.asarray(unwrap_slots(reads, slots=slots)) for slots in (True, False))
    np.testing.assert_allclose(without, path, atol=1e-3)
    np.testing.assert_allclose(with_rule[42:], 0.3 * time_s[42:], atol=1e-3)


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_fits_are_those_of_polyfit(seed: int, causal: bool) -> None:
    reads, path = _reads(seed, num=90)
    query = np.arange(0, 3.3, 1 / 30)
    value, known = published_distance(reads, jnp.asarray(query, jnp.float32), causal=causal)
    time_s = np.asarray(reads.time_s, np.float64)[: len(path)]
    distance = np.asarray(unwrap_slots(reads), np.float64)[: len(path)]
    want, want_known = plain.published_distance(time_s, distance, query, causal=causal)
    np.testing.assert_array_equal(known, want_known)
    np.testing.assert_allclose(np.asarray(value)[want_known], want[want_known], atol=2e-3)
    assert want_known.any()
    assert not want_known.all()


def test_a_fit_needs_three_times() -> None:
    for times, expected in (([0.0, 0.01, 0.02, 0.03], True), ([0.0, 0.0, 0.02, 0.02], False), ([0.0] * 4, False)):
        time_s = jnp.asarray(times, jnp.float32)

        def value(distance: jax.Array, time_s: jax.Array = time_s) -> tuple[jax.Array, jax.Array]:
            return fit_quadratic(time_s, distance, jnp.ones(4, bool), jnp.asarray(0.01), jnp.asarray(0.07))

        gradient, known = jax.grad(value, has_aux=True)(jnp.asarray([0.0, 0.1, 0.4, 0.9]))
        assert bool(known) == expected
        assert np.isfinite(np.asarray(gradient)).all()


def test_nothing_after_a_frame_is_used_by_the_causal_estimator() -> None:
    reads, _ = _reads(0)
    times = jnp.asarray(np.arange(0, 2.0, 1 / 30), jnp.float32)
    later = eqx.tree_at(lambda one: one.phase_rad, reads, jnp.where(reads.time_s > 1.0, 0.3, reads.phase_rad))
    for estimator, ahead_s in (("published_causal", 0.0), ("published", 0.2)):
        one, two = (radio_windows(which, times, 5, estimator) for which in (reads, later))  # pyright: ignore[reportArgumentType]
        same = np.asarray(times) <= 1.0 - ahead_s
        np.testing.assert_array_equal(np.asarray(one.relative_m)[same], np.asarray(two.relative_m)[same])
        assert np.isfinite(np.asarray(one.std_m)).any()


def test_a_moving_box_is_found() -> None:
    clip = synthetic.load(synthetic.recording(40), 0, 40)
    tracer = TagAttentionPublished(num_clusters=24)
    out = trace(tracer, clip.camera, clip.frames)
    labels = np.asarray(synthetic.recording(40).truth.labels)  # pyright: ignore[reportOptionalMemberAccess]
    overlaps = []
    for tag, label in ((0, 1), (1, 2)):
        mask, true = np.asarray(out.mask)[20:, tag] > 0.5, labels[20:40] == label
        overlaps.append(np.sum(mask & true) / np.sum(mask | true))
    assert min(overlaps) > 0.9


def test_jit_is_eager_and_gradients_are_finite() -> None:
    clip = synthetic.load(synthetic.recording(12), 0, 12)
    tracer = TagAttentionPublished(num_clusters=12)
    eager, fast = trace(tracer, clip.camera, clip.frames), eqx.filter_jit(trace)(tracer, clip.camera, clip.frames)
    np.testing.assert_array_equal(eager.mask, fast.mask)

    def last_likelihood(tracer: TagAttentionPublished) -> jax.Array:
        first = jax.tree.map(lambda leaf: leaf[0], clip.frames)
        state, _ = jax.lax.scan(
            lambda state, frame: tracer.step(clip.camera, state, frame),
            tracer.init(clip.camera, first), clip.frames,
        )  # fmt: skip
        return jnp.mean(state.log_likelihood)

    gradient = eqx.filter_jit(eqx.filter_grad(last_likelihood))(tracer)
    values = {name: float(getattr(gradient, name)) for name in ("alpha_m2", "beta", "floor")}
    assert all(np.isfinite(value) for value in values.values())
    assert values["alpha_m2"] != 0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"alpha_m2": 0.0}, "alpha_m2"),
        ({"cut": 1.5}, "cut"),
        ({"v0_m_s": -1.0}, "v0_m_s"),
        ({"num_clusters": 0}, "num_clusters"),
    ],
)
def test_wrong_constants_are_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TagAttentionPublished(**wrong)  # pyright: ignore[reportArgumentType]
