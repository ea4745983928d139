"""Losses of unlabelled flow: closed forms, NumPy and SciPy references, what changes nothing, and gradients."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter

from tagjax.flow._layers import enlarge_flow
from tagjax.flow.loss_terms import (
    charbonnier,
    consistency_error_px2,
    crop_margin_px,
    inside,
    occluded,
    self_supervision_term,
    smoothness,
    ssim_distance,
)
from tagjax.flow.losses import (
    FlowLossSettings,
    data_distance,
    data_term,
    distillation_term,
    level_terms,
    sequence_terms,
    total_loss,
    visible_mask,
)
from tagjax.image.census import GREY, census_distance, census_offsets, ternary, to_grey

KINDS = ("census", "photometric", "ssim")
FLOOR = 0.01**0.4  # of the robust function


def _picture(height: int = 24, width: int = 28, seed: int = 0, rough: float = 1.5) -> np.ndarray:
    grey = gaussian_filter(np.random.default_rng(seed).normal(size=(height, width)), rough)
    return (0.5 + 0.15 * grey / grey.std()).astype(np.float32)


def _colour(height: int = 32, width: int = 32, seed: int = 0) -> jnp.ndarray:
    return jnp.asarray(np.stack([_picture(height, width, seed + n) for n in range(3)], axis=-1))


def _flow(height: int, width: int, dx: float = 0.0, dy: float = 0.0) -> jnp.ndarray:
    return jnp.broadcast_to(jnp.asarray([dx, dy], jnp.float32).reshape(1, 1, 2), (height, width, 2))


def _uneven(height: int, width: int, size: float = 1.0, seed: int = 0) -> np.ndarray:
    """A flow whose targets keep away from pixel centres, where bilinear sampling has a kink."""
    rng = np.random.default_rng(seed)
    whole = np.rint(rng.uniform(-size, size, (height, width, 2)))
    return (whole + rng.uniform(0.2, 0.8, (height, width, 2))).astype(np.float32)


# Census


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_census_compares_each_pair_of_neighbours_once(radius):
    offsets = census_offsets(radius)
    opposite = {(-dy, -dx) for dy, dx in offsets}
    reach = range(-radius, radius + 1)
    assert not opposite & set(offsets)
    assert opposite | set(offsets) == {(dy, dx) for dy in reach for dx in reach} - {(0, 0)}
    assert census_offsets(radius, 3) == offsets[::3]


@pytest.mark.parametrize(("radius", "stride"), [(0, 1), (2, 0)])
def test_an_empty_census_is_refused(radius, stride):
    with pytest.raises(ValueError, match="at least 1"):
        census_offsets(radius, stride)
    with pytest.raises(ValueError, match="at least 1"):
        FlowLossSettings(census_radius=radius, census_stride=stride)


def test_ternary_and_its_distance_are_the_papers():
    first, second = _picture(7, 9), _picture(7, 9, seed=1)
    offsets = census_offsets(2)
    signs = np.zeros((2, len(offsets), 7, 9))
    for n, grey in enumerate((first, second)):
        levels = 255 * grey.astype(float)
        for k, (dy, dx) in enumerate(offsets):
            for y in range(7):
                for x in range(9):
                    there = levels[min(max(y + dy, 0), 6), min(max(x + dx, 0), 8)]
                    signs[n, k, y, x] = (there - levels[y, x]) / np.sqrt(0.81 + (there - levels[y, x]) ** 2)
    np.testing.assert_allclose(ternary(jnp.asarray(first), offsets), signs[0], atol=1e-4)
    squared = (signs[0] - signs[1]) ** 2
    expected = (squared / (0.1 + squared)).mean(axis=0)
    np.testing.assert_allclose(census_distance(jnp.asarray(first), jnp.asarray(second), offsets), expected, atol=2e-4)


def test_census_does_not_see_brightness_and_hardly_contrast():
    image, offsets = jnp.asarray(_picture(40, 40)), census_offsets(3)
    moved = jnp.roll(image, 2, axis=1)
    unlike = float(census_distance(image, moved, offsets).mean())
    assert unlike > 0.3
    assert float(census_distance(image, image + 0.1, offsets).max()) < 1e-6
    assert float(census_distance(image, 0.7 * image + 0.1, offsets).mean()) < 0.02 * unlike
    # What it is there for: the photometric distance takes the light for motion.
    assert float(jnp.abs(image - (image + 0.1)).mean()) > 0.8 * float(jnp.abs(image - moved).mean())


def test_grey_is_luma():
    image = _colour(3, 4)
    np.testing.assert_allclose(to_grey(image), np.asarray(image) @ GREY, atol=1e-6)


def test_census_gradient(gradients_agree):
    offsets = census_offsets(2, 3)
    # Fine grey levels: differences of about one, where the soft sign bends.
    images = tuple(0.5 + 0.02 * (_picture(5, 6, seed=n) - 0.5) for n in (0, 1))
    gradients_agree(jax.jit(lambda a, b: census_distance(a, b, offsets)), images, atol=1e-5)


# Structural similarity, the robust function


def test_ssim_agrees_with_scipy():
    first, second = _picture(11, 13), _picture(11, 13, seed=1)
    a, b = first.astype(float), second.astype(float)
    mean = lambda image: uniform_filter(image, 3, mode="nearest")  # noqa: E731
    va, vb, cov = mean(a * a) - mean(a) ** 2, mean(b * b) - mean(b) ** 2, mean(a * b) - mean(a) * mean(b)
    likeness = (2 * mean(a) * mean(b) + 1e-4) * (2 * cov + 9e-4)
    expected = 0.5 * (1 - likeness / ((mean(a) ** 2 + mean(b) ** 2 + 1e-4) * (va + vb + 9e-4)))
    np.testing.assert_allclose(ssim_distance(jnp.asarray(first), jnp.asarray(second)), expected, atol=2e-4)
    np.testing.assert_allclose(ssim_distance(jnp.asarray(first), jnp.asarray(first)), 0, atol=1e-4)


def test_ssim_gradient(gradients_agree):
    gradients_agree(jax.jit(ssim_distance), (_picture(5, 6), _picture(5, 6, seed=1)))


def test_charbonnier(gradients_agree):
    x = np.asarray([-2.0, -0.3, 0.02, 1.7], np.float32)
    np.testing.assert_allclose(charbonnier(jnp.asarray(x), 0.4), (np.abs(x) + 0.01) ** 0.4, rtol=1e-6)
    gradients_agree(lambda x: charbonnier(x, 0.4), (x,))
    assert float(jax.grad(lambda x: charbonnier(x, 0.4))(jnp.zeros(()))) == 0


# Data term


@pytest.mark.parametrize("kind", KINDS)
def test_of_all_whole_shifts_the_true_one_explains_the_picture(kind):
    settings = FlowLossSettings(data=kind)
    first = _picture(30, 30)
    second = np.roll(first, (-2, 1), axis=(0, 1))  # content moves 1 to the right and 2 up
    at = jnp.zeros((30, 30)).at[6:24, 6:24].set(1.0)
    term = jax.jit(lambda flow: data_term(flow, jnp.asarray(first), jnp.asarray(second), at, settings))
    cost = {(dx, dy): float(term(_flow(30, 30, dx, dy))) for dx in range(-3, 4) for dy in range(-3, 4)}
    best, *others = sorted(cost, key=cost.__getitem__)
    assert best == (1, -2)
    assert cost[best] == pytest.approx(FLOOR, abs=0.02 if kind == "ssim" else 1e-4)
    assert min(cost[other] for other in others) > 1.2 * cost[best]


@pytest.mark.parametrize("kind", KINDS)
def test_identical_pictures_and_no_motion_cost_nothing_but_the_floor(kind):
    settings, image = FlowLossSettings(data=kind), jnp.asarray(_picture())
    term = data_term(_flow(24, 28), image, image, jnp.ones((24, 28)), settings)
    assert float(term) == pytest.approx(FLOOR, abs=0.02 if kind == "ssim" else 1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_data_term_gradient(gradients_agree, kind):
    settings = FlowLossSettings(data=kind, census_radius=2)
    first, second = _picture(6, 7), _picture(6, 7, seed=1)
    shown_there = np.random.default_rng(0).uniform(0.2, 1.0, (6, 7))

    def term(flow):
        one, other, mask = (jnp.asarray(each, flow.dtype) for each in (first, second, shown_there))
        return data_term(flow, one, other, mask, settings)

    gradients_agree(jax.jit(term), (_uneven(6, 7),), atol=1e-5)


def test_data_term_gradient_descends_to_the_true_shift():
    image = _picture(40, 40, rough=3.0)
    y, x = np.meshgrid(np.arange(40.0), np.arange(40.0), indexing="ij")
    moved = map_coordinates(image, [y, x - 0.6], order=3, mode="reflect").astype(np.float32)
    mask = jnp.zeros((40, 40)).at[8:32, 8:32].set(1.0)

    def term(shift):
        flow = jnp.broadcast_to(shift.reshape(1, 1, 2), (40, 40, 2))
        return data_term(flow, jnp.asarray(image), jnp.asarray(moved), mask, FlowLossSettings())

    slope = jax.jit(jax.grad(term))
    shift = jnp.zeros(2)
    for _ in range(200):
        shift = shift - 0.002 * slope(shift)
    np.testing.assert_allclose(shift, [0.6, 0.0], atol=0.03)


def test_the_gradient_reaches_neither_the_pictures_that_are_sampled_nor_what_is_hidden():
    first, second = jnp.asarray(_picture()), jnp.asarray(_picture(seed=1))
    mask = jnp.zeros((24, 28)).at[8:16, 8:20].set(1.0)
    flow = jnp.asarray(_uneven(24, 28))
    settings = FlowLossSettings(data="photometric")
    to_flow, to_second = jax.grad(lambda f, s: data_term(f, first, s, mask, settings), argnums=(0, 1))(flow, second)
    assert float(jnp.abs(to_second).max()) == 0
    assert float(jnp.abs(jnp.where(mask[..., None] > 0, 0.0, to_flow)).max()) == 0
    assert float(jnp.abs(to_flow).max()) > 0


@pytest.mark.parametrize("kind", KINDS)
def test_degenerate_pictures_have_finite_gradients(kind):
    settings = FlowLossSettings(data=kind)
    flat, picture = jnp.full((12, 12), 0.5), jnp.asarray(_picture(12, 12))
    dark = jnp.zeros((12, 12))
    slope = jax.jit(jax.value_and_grad(lambda f, a, b, m: data_term(f, a, b, m, settings)))
    for one, other in ((flat, flat), (dark, dark), (flat, picture), (picture, picture)):
        for flow in (_flow(12, 12), _flow(12, 12, 1e4, -1e4), jnp.asarray(_uneven(12, 12))):
            for mask in (jnp.ones((12, 12)), dark):
                value, gradient = slope(flow, one, other, mask)
                assert np.isfinite(value)
                assert np.isfinite(gradient).all()
    assert float(slope(_flow(12, 12), flat, flat, dark)[0]) == 0


# Pictures that reach beyond the crop


def test_what_leaves_the_crop_is_explained_by_the_margin():
    whole = _picture(44, 44)
    later = jnp.asarray(np.roll(whole, 6, axis=1))
    first, ones = jnp.asarray(whole[10:34, 10:34]), jnp.ones((24, 24))
    settings, flow = FlowLossSettings(data="photometric"), _flow(24, 24, 6.0)
    term = jax.jit(lambda second: data_term(flow, first, second, ones, settings))
    assert float(term(later)) == pytest.approx(FLOOR, abs=1e-5)
    # Without a margin those columns are compared with themselves and say nothing of the flow.
    slope = jax.jit(jax.grad(lambda f, s: data_term(f, first, s, ones, settings)))
    off = _flow(24, 24, 6.4)
    leaving = np.s_[2:-2, 19:]
    assert float(jnp.abs(slope(off, later[10:34, 10:34])[leaving]).max()) == 0
    assert float(jnp.abs(slope(off, later)[leaving]).max()) > 0
    np.testing.assert_array_equal(inside(flow, 6), np.ones((24, 24), bool))
    assert int(jnp.sum(~inside(flow, 5))) == 24
    assert int(jnp.sum(~inside(flow))) == 6 * 24


def test_a_margin_of_nothing_is_no_margin():
    first, second = jnp.asarray(_picture(30, 30)), jnp.asarray(_picture(30, 30, seed=1))
    flow = jnp.asarray(_uneven(20, 20, 1.0))
    mask = jnp.zeros((20, 20)).at[6:14, 6:14].set(1.0)
    crop = np.s_[5:25, 5:25]
    beyond = data_term(flow, first[crop], second, mask, FlowLossSettings())
    within = data_term(flow, first[crop], second[crop], mask, FlowLossSettings())
    assert float(beyond) == pytest.approx(float(within), rel=1e-5)


def test_margins_that_are_not_alike_are_refused():
    assert crop_margin_px((20, 30), (26, 36)) == 3
    for whole in ((26, 34), (25, 35), (18, 28)):
        with pytest.raises(ValueError, match="expected the same margin"):
            crop_margin_px((20, 30), whole)


# Occlusion


def _curtain() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A square of 10 x 10 pixels that moves 6 to the right over a still ground: both flows, and what it covers."""
    forward, backward = np.zeros((24, 40, 2), np.float32), np.zeros((24, 40, 2), np.float32)
    forward[7:17, 8:18, 0], backward[7:17, 14:24, 0] = 6, -6
    covered = np.zeros((24, 40), bool)
    covered[7:17, 18:24] = True
    return forward, backward, covered


def test_occluded_is_what_the_square_covers():
    forward, backward, covered = _curtain()
    np.testing.assert_array_equal(occluded(jnp.asarray(forward), jnp.asarray(backward)), covered)
    uncovered = np.zeros((24, 40), bool)
    uncovered[7:17, 8:14] = True
    np.testing.assert_array_equal(occluded(jnp.asarray(backward), jnp.asarray(forward)), uncovered)
    gap, length = consistency_error_px2(jnp.asarray(forward), jnp.asarray(backward))
    np.testing.assert_allclose(gap, 36.0 * covered, atol=1e-5)
    np.testing.assert_allclose(length, 36.0 * covered + 72.0 * (forward[..., 0] > 0), atol=1e-5)


def test_hiding_begins_at_its_step_and_has_no_gradient():
    forward, backward, covered = (jnp.asarray(each) for each in _curtain())
    settings = FlowLossSettings()
    on, off = jnp.ones(()), jnp.zeros(())
    np.testing.assert_array_equal(visible_mask(forward, backward, off, settings), np.ones((24, 40)))
    np.testing.assert_array_equal(visible_mask(forward, backward, on, settings), ~np.asarray(covered))
    never = dataclasses.replace(settings, occlusion=False)
    np.testing.assert_array_equal(visible_mask(forward, backward, on, never), np.ones((24, 40)))
    # What leaves for the margin has no way back to check.
    leaving = _flow(24, 40, 5.0)
    assert float(jnp.sum(1 - visible_mask(leaving, _flow(24, 40), on, settings, 5))) == 24 * 35
    assert float(jnp.sum(visible_mask(leaving, -leaving, on, settings))) == 24 * 35
    for gradient in jax.grad(lambda f, b: jnp.sum(visible_mask(f, b, on, settings)), argnums=(0, 1))(forward, backward):
        assert float(jnp.abs(gradient).max()) == 0


# Smoothness


def test_smoothness_closed_forms():
    grey = jnp.full((9, 11, 3), 0.5)
    ramp = jnp.asarray(np.stack(np.broadcast_arrays(0.3 * np.arange(11.0)[None], np.zeros((9, 1))), -1), jnp.float32)
    tiny = 1e-3
    assert float(smoothness(_flow(9, 11, 4.0, 2.0), grey, 50.0, 1)) == pytest.approx(2 * tiny, rel=1e-4)
    # Down: nothing changes in either component; across: one changes by 0.3 a pixel.
    assert float(smoothness(ramp, grey, 50.0, 1)) == pytest.approx((2 * tiny + 0.3 + tiny) / 2, rel=1e-4)
    assert float(smoothness(ramp, grey, 50.0, 2)) == pytest.approx(2 * tiny, rel=1e-3)
    step = jnp.zeros((8, 10, 2)).at[:, 5:, 0].set(2.0)
    edge = jnp.full((8, 10, 3), 0.5).at[:, 5:].set(0.55)
    at_edge = np.exp(-50.0 * 0.05) * (2.0 + tiny)
    expected = (2 * tiny + (at_edge + 8 * 2 * tiny) / 9) / 2
    assert float(smoothness(step, edge, 50.0, 1)) == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("order", [1, 2])
def test_smoothness_gradient(gradients_agree, order):
    image = np.asarray(_colour(5, 6))
    gradients_agree(
        jax.jit(lambda flow: smoothness(flow, jnp.asarray(image, flow.dtype), 10.0, order)), (_uneven(5, 6),)
    )


@pytest.mark.parametrize("order", [1, 2])
def test_a_constant_flow_has_a_finite_gradient_and_wants_no_change(order):
    slope = jax.grad(lambda flow: smoothness(flow, _colour(8, 8), 50.0, order))(_flow(8, 8, 3.0))
    np.testing.assert_allclose(slope, 0, atol=1e-7)


# Teaching


def test_teaching_is_the_mean_gap_where_only_the_teacher_is_sure():
    teacher, student = _flow(10, 12, 2.0, -1.0), _flow(6, 8, 0.5, 1.0)
    teacher_hidden = jnp.zeros((10, 12), bool).at[4, 5].set(True)
    student_hidden = jnp.zeros((6, 8), bool).at[1:4, 2:6].set(True)
    # 12 pixels that the student cannot see, less the one that the teacher cannot either; a gap of 1.5 and 2.
    expected = 11 * (1.5 + 2.0) / 48
    found = self_supervision_term(student, teacher, student_hidden, teacher_hidden, 2)
    assert float(found) == pytest.approx(expected, rel=1e-5)
    nobody = jnp.zeros((6, 8), bool)
    assert float(self_supervision_term(student, teacher, nobody, teacher_hidden, 2)) == 0


def test_teaching_gradient_reaches_the_student_only(gradients_agree):
    student_hidden = np.random.default_rng(1).uniform(size=(3, 4)) < 0.7
    teacher_hidden = np.random.default_rng(2).uniform(size=(7, 8)) < 0.3
    teacher, student = _uneven(7, 8), _uneven(3, 4, seed=3)

    def term(student, teacher):
        return self_supervision_term(student, teacher, jnp.asarray(student_hidden), jnp.asarray(teacher_hidden), 2)

    gradients_agree(lambda s: term(s, jnp.asarray(teacher, s.dtype)), (student,))
    to_teacher = jax.grad(term, argnums=1)(jnp.asarray(student), jnp.asarray(teacher))
    assert float(jnp.abs(to_teacher).max()) == 0
    same = jax.grad(term)(jnp.asarray(teacher)[2:5, 2:6], jnp.asarray(teacher))
    np.testing.assert_allclose(same, 0, atol=1e-6)


# The whole


def _imitated(levels, teacher, **changes):
    return distillation_term(levels, teacher, dataclasses.replace(SETTINGS, **changes))


def test_imitation_is_the_weighted_robust_distance_from_the_teachers_flow():
    teacher = _uneven(8, 12, 3.0)
    levels = (jnp.asarray(_uneven(2, 3, seed=1)), jnp.asarray(_uneven(8, 12, seed=2)))
    rough = 4 * np.asarray(levels[0]) - teacher.reshape(2, 4, 3, 4, 2).mean((1, 3))
    errors = [np.sqrt(np.sum(gap**2, -1) + 1e-4) for gap in (np.asarray(levels[1]) - teacher, rough)]
    expected = sum(w * np.mean((e + 0.01) ** 0.7) for w, e in zip((1.0, 0.3), errors, strict=True))
    found = _imitated(levels, jnp.asarray(teacher), robustness=0.7, level_weights=(1.0, 0.3, 9.0))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert float(_imitated((jnp.asarray(teacher),), jnp.asarray(teacher))) < float(
        _imitated(levels[1:], jnp.asarray(teacher))
    )


def test_pixels_without_the_teachers_flow_have_no_loss():
    whole = _uneven(8, 8, 2.0)
    teacher = whole.copy()
    teacher[:4] = np.nan
    levels = (jnp.asarray(_uneven(4, 4, seed=1)), jnp.asarray(_uneven(8, 8, seed=2)))
    found, pull = jax.jit(jax.value_and_grad(_imitated))(levels, jnp.asarray(teacher))
    assert np.isfinite(found)
    assert all(np.isfinite(leaf).all() for leaf in pull)
    assert not np.any(pull[1][:4])
    assert not np.any(pull[0][:2])
    assert np.all(np.any(pull[1][4:], axis=-1))
    lower = _imitated(tuple(level[level.shape[0] // 2 :] for level in levels), jnp.asarray(whole[4:]))
    np.testing.assert_allclose(found, lower / 2, rtol=1e-5)
    assert float(_imitated(levels, jnp.full((8, 8, 2), jnp.nan))) == 0.0


def test_imitation_gradient(gradients_agree):
    teacher = _uneven(4, 4, 2.0)
    gradients_agree(
        lambda rough, fine: _imitated((rough, fine), jnp.asarray(teacher, rough.dtype), robustness=0.7),
        (_uneven(2, 2, seed=1), _uneven(4, 4, seed=2)),
    )


def _pyramid(seed: int = 0) -> tuple[jax.Array, ...]:
    return tuple(jnp.asarray(_uneven(side, side, 1.0, seed + side)) for side in (8, 16, 32))


SETTINGS = FlowLossSettings(data="photometric", level_weights=(1.0, 0.5), smooth_second=0.3, self_supervision=0.2)


@functools.partial(jax.jit, static_argnames=("settings", "of"))
def _terms(forward, backward, first, second, settings=SETTINGS, of=level_terms):
    return of(forward, backward, first, second, jnp.ones(()), settings)


@pytest.mark.ci
def test_the_terms_are_summed_over_levels_by_their_weights():
    forward, backward = _pyramid(), _pyramid(seed=9)
    first, second = _colour(seed=0), _colour(seed=5)
    found = _terms(forward, backward, first, second)
    small = [np.asarray(image).reshape(16, 2, 16, 2, 3).mean((1, 3)) for image in (first, second)]
    expected = 0.0
    for level, (weight, flow, back, one, other) in enumerate(
        ((1.0, forward[2], backward[2], first, second), (0.5, forward[1], backward[1], *map(jnp.asarray, small)))
    ):
        visible = visible_mask(flow, back, jnp.ones(()), SETTINGS)
        warped = np.stack(
            [
                map_coordinates(
                    np.asarray(to_grey(other)),
                    [
                        np.arange(len(one))[:, None] + np.asarray(flow[..., 1]),
                        np.arange(len(one))[None] + np.asarray(flow[..., 0]),
                    ],
                    order=1,
                    mode="nearest",
                )
            ]
        )[0]
        warped = jnp.where(inside(flow), jnp.asarray(warped, jnp.float32), to_grey(one))
        distance = (np.abs(np.asarray(data_distance(to_grey(one), warped, SETTINGS, level))) + 0.01) ** 0.4
        expected += weight * float((distance * visible).sum() / visible.sum())
    assert float(found["data"]) == pytest.approx(expected, rel=1e-4)
    assert float(found["smooth_first"]) == pytest.approx(float(smoothness(forward[1], jnp.asarray(small[0]), 50.0, 1)))
    assert float(found["occluded_fraction"]) == pytest.approx(
        1 - float(visible_mask(forward[2], backward[2], jnp.ones(()), SETTINGS).mean())
    )
    total = total_loss({**found, "self_supervision": jnp.asarray(2.0)}, SETTINGS)
    parts = (found["data"], found["smooth_first"], 0.3 * found["smooth_second"], 0.2 * 2.0)
    assert float(total) == pytest.approx(sum(map(float, parts)), rel=1e-6)


@pytest.mark.ci
def test_jit_agrees_with_eager_and_vmap_with_a_loop():
    ways = [(_pyramid(seed), _pyramid(seed + 9)) for seed in (0, 1)]
    first, second = _colour(seed=0), _colour(seed=5)
    jitted = jax.jit(lambda f, b: _terms(f, b, first, second))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *ways)
    batched = jax.jit(jax.vmap(lambda f, b: _terms(f, b, first, second)))(*stacked)
    for n, way in enumerate(ways):
        eager = level_terms(*way, first, second, jnp.ones(()), SETTINGS)
        for name, value in eager.items():
            np.testing.assert_allclose(jitted(*way)[name], value, rtol=1e-5)
            np.testing.assert_allclose(batched[name][n], value, rtol=1e-5)


def test_the_whole_loss_has_the_gradient_of_its_parts(gradients_agree):
    backward = _pyramid(seed=9)[:1]
    first, second = np.asarray(_colour(8, 8)), np.asarray(_colour(8, 8, seed=5))

    def loss(flow):
        pictures = (jnp.asarray(each, flow.dtype) for each in (first, second))
        back = tuple(jnp.asarray(each, flow.dtype) for each in backward)
        return total_loss(_terms((flow,), back, *pictures), SETTINGS)

    gradients_agree(jax.jit(loss), (_uneven(8, 8, seed=8),), atol=1e-5)


def test_a_margin_must_fit_every_level():
    forward, first = _pyramid(), _colour()
    wide = _colour(38, 38, seed=3)
    _terms(forward[2:], forward[2:], first, wide)
    with pytest.raises(ValueError, match=r"margin .* is 3 pixels; expected a multiple of 2"):
        _terms(forward, forward, first, wide)


# Sequences


def _sequence(count: int = 3, seed: int = 0) -> tuple[jax.Array, ...]:
    updates = [jnp.asarray(_uneven(8, 8, 0.4, seed + n)) for n in range(count)]
    return (*updates, enlarge_flow(updates[-1], 4))


def test_a_sequence_counts_each_update_by_its_age():
    settings = FlowLossSettings(data="photometric", sequence_decay=0.5, occlusion=False)
    forward, backward = _sequence(), _sequence(seed=7)
    first, second = _colour(seed=0), _colour(seed=5)
    found = _terms(forward, backward, first, second, settings, of=sequence_terms)
    data, smooth = 0.0, 0.0
    for weight, update in zip((0.25, 0.5, 1.0), forward[:-1], strict=True):
        fine = enlarge_flow(update, 4)
        # An update is seen where it and the last one stay within the picture.
        seen = (inside(fine) & inside(enlarge_flow(forward[-2], 4))).astype(jnp.float32)
        data += weight * float(data_term(fine, to_grey(first), to_grey(second), seen, settings))
        rough = jnp.asarray(np.asarray(first).reshape(8, 4, 8, 4, 3).mean((1, 3)))
        smooth += weight * float(smoothness(update, rough, 50.0, 1))
    assert float(found["data"]) == pytest.approx(data, rel=1e-5)
    assert float(found["smooth_first"]) == pytest.approx(smooth, rel=1e-5)


def test_sequence_gradient_reaches_every_update_and_agrees():
    settings = FlowLossSettings(data="photometric", sequence_decay=0.5)
    forward, backward = _sequence(), _sequence(seed=7)
    first, second = _colour(seed=0), _colour(seed=5)

    def loss(updates):
        return _terms((*updates, forward[-1]), backward, first, second, settings, of=sequence_terms)["data"]

    with jax.enable_x64(True):
        forward, backward, first, second = jax.tree.map(
            lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), (forward, backward, first, second)
        )
        settings = dataclasses.replace(settings, occlusion=False)
        gradient = jax.jit(jax.grad(loss))(forward[:-1])
        slope = jax.jit(loss)
        for n, way in enumerate(gradient):
            assert float(jnp.abs(way).max()) > 0
            direction = np.random.default_rng(n).normal(size=(8, 8, 2))
            ends = [
                float(slope(tuple(u + sign * 1e-7 * direction if m == n else u for m, u in enumerate(forward[:-1]))))
                for sign in (1, -1)
            ]
            numeric = (ends[0] - ends[1]) / 2e-7
            assert numeric == pytest.approx(float(jnp.sum(way * direction)), rel=1e-4, abs=1e-5)


def test_a_pyramid_is_no_sequence():
    with pytest.raises(ValueError, match="one shape before the last"):
        _terms(_pyramid(), _pyramid(), _colour(), _colour(), of=sequence_terms)


@pytest.mark.parametrize(
    "wrong",
    [{"level_weights": ()}, {"level_weights": (0.0,)}, {"robustness": 0.0}, {"sequence_decay": 1.5}],
)
def test_settings_that_make_no_loss_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        FlowLossSettings(**wrong)
