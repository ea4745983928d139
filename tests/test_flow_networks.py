"""Flow networks and their parts: sizes, published parameter counts, NumPy references, gradients, equivariance."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_dir
from scipy.ndimage import map_coordinates
from scipy.special import softmax

from tagjax.flow import flownet, raft
from tagjax.flow._layers import Conv, SeparableConv, convex_upsample, enlarge, enlarge_flow, shrink, space_to_depth
from tagjax.flow.cost_volume import cost_volume, normalise_features
from tagjax.flow.flownet import FlowNetC, FlowNetS, strided_cost_volume
from tagjax.flow.network import AbstractFlowNetwork, flow_both_ways
from tagjax.flow.pyramid import PyramidFlow
from tagjax.flow.raft import RAFTSmall, halve, look_up, look_up_products
from tagjax.image.median import median_filter
from tagjax.training.flow_run import make_network

CONF = Path(__file__).parents[1] / "conf" / "flow"

PUBLISHED: dict[str, Callable[[], AbstractFlowNetwork]] = {
    "flownet_s": FlowNetS,
    "flownet_c": FlowNetC,
    "raft_small": RAFTSmall,
    "pyramid": PyramidFlow,
    "pyramid_fine": lambda: PyramidFlow(octaves=(-1, 0, 1, 2), medians=2),
    "pyramid_fast": lambda: make_network(_settings("pyramid_fast")),
}
TINY: dict[str, Callable[[], AbstractFlowNetwork]] = {
    "flownet_s": lambda: FlowNetS(width=1 / 64),
    "flownet_c": lambda: FlowNetC(width=1 / 64),
    "raft_small": lambda: RAFTSmall(updates=2, levels=2, radius=1),
    "raft_small_lean": lambda: RAFTSmall(updates=2, levels=2, radius=1, all_pairs=False),
    "pyramid": lambda: PyramidFlow((6, 8), (1, 2), decoder_widths=((8,), (8,))),
    "pyramid_fine": lambda: PyramidFlow((6, 8), (1, 2), decoder_widths=((8,), (8,)), octaves=(-1, 0, 1, 2), medians=1),
    "pyramid_fast": lambda: PyramidFlow((6, 8), (1, 2), decoder_widths=((8,), (8,)), separable=True, matched=(4, 0)),
}


def _settings(name: str) -> dict[str, Any]:
    with initialize_config_dir(str(CONF.parent), version_base="1.3"):
        return dict(compose("train_flow", [f"flow={name}"]).flow)


@functools.cache
def _tiny(name: str) -> AbstractFlowNetwork:
    return eqx.filter_jit(TINY[name])()


def _noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def _side(name: str) -> int:
    return 32 if name.startswith("raft") else 64


def _pictures(height: int = 64, width: int = 64, count: int = 2, seed: int = 0) -> jax.Array:
    rough = np.random.default_rng(seed).uniform(size=(count, height, width, 3)).astype(np.float32)
    smooth = np.stack([cv2.GaussianBlur(image, (0, 0), 2.0) for image in rough])
    low, high = smooth.min(), smooth.max()
    return jnp.asarray((smooth - low) / (high - low))


def _flows(network: AbstractFlowNetwork, first: jax.Array, second: jax.Array) -> tuple[jax.Array, ...]:
    return network.decode(network.encode(first), network.encode(second))


@functools.cache
def _jitted() -> Any:
    return eqx.filter_jit(_flows)


@functools.cache
def _pulled() -> Any:
    """Gradient of the sum of each estimate times its weight with respect to the network, and the estimates."""

    @eqx.filter_jit
    def pulled(network, first, second, weights):
        learnable, rest = eqx.partition(network, eqx.is_inexact_array)
        flows, pull = jax.vjp(lambda learnable: _flows(eqx.combine(learnable, rest), first, second), learnable)
        weights = [jnp.broadcast_to(weight, flow.shape) for weight, flow in zip(weights, flows, strict=True)]
        return pull(tuple(weights))[0], flows

    return pulled


def _count(network: Any) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(network) if hasattr(leaf, "size"))


# Whole networks.


@pytest.mark.parametrize(
    ("name", "count"),
    [
        # The re-implementation that published 39,175,298 for FlowNetC has the same table; for FlowNetS it says
        # 38,676,504: ten fewer, eight of which are the biases of the four enlarged flows.
        ("flownet_s", 38_676_514),
        ("flownet_c", 39_175_298),
        ("raft_small", 990_162),
        ("pyramid", 691_020),
        ("pyramid_fine", 691_020),
        ("pyramid_fast", 220_864),
    ],
)
def test_parameters_are_as_many_as_published(name, count):
    assert _count(eqx.filter_eval_shape(PUBLISHED[name])) == count


@pytest.mark.parametrize(
    ("name", "strides"),
    [
        ("flownet_s", [64, 32, 16, 8, 4, 1]),
        ("flownet_c", [64, 32, 16, 8, 4, 1]),
        ("raft_small", [8] * 12 + [1]),
        ("pyramid", [32, 16, 8, 4, 1]),
        ("pyramid_fast", [32, 16, 8, 4, 1]),
        ("pyramid_fine", [64, 32, 16, 8, 8, 4, 2, 1, 1]),
    ],
)
def test_estimates_go_from_rough_to_the_pictures_size(name, strides):
    network = eqx.filter_eval_shape(PUBLISHED[name])
    image = jax.ShapeDtypeStruct((128, 192, 3), jnp.float32)
    flows = eqx.filter_eval_shape(_flows, network, image, image)
    assert [flow.shape for flow in flows] == [(128 // n, 192 // n, 2) for n in strides]
    assert all(flow.dtype == jnp.float32 for flow in flows)
    assert 128 % network.divisor == 0


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.ci) if name.startswith("raft") or name == "pyramid_fast" else name
        for name in TINY
    ],
)
def test_from_scratch_the_flow_is_nearly_zero(name):
    first, second = _pictures(_side(name), _side(name))
    for other in (second, first):
        for flow in _jitted()(_tiny(name), first, other):
            assert np.abs(np.asarray(flow)).max() < 0.5


@pytest.mark.ci
@pytest.mark.parametrize(
    "name", ["pyramid", *(pytest.param(name, marks=pytest.mark.ci) for name in ("flownet_c", "raft_small"))]
)
def test_jit_agrees_with_eager_and_vmap_with_a_loop(name):
    network, pictures = _tiny(name), _pictures(_side(name), _side(name), count=3)
    firsts, seconds = pictures[:2], pictures[1:]
    jitted = [_jitted()(network, first, second) for first, second in zip(firsts, seconds, strict=True)]
    batched = eqx.filter_jit(eqx.filter_vmap(_flows, in_axes=(None, 0, 0)))(network, firsts, seconds)
    scale = np.abs(np.asarray(jitted[0][-1])).max()
    assert scale > 0
    for plain, whole in zip(_flows(network, firsts[0], seconds[0]), jitted[0], strict=True):
        np.testing.assert_allclose(plain, whole, atol=1e-4 * scale)
    for n in (0, 1):
        for one, many in zip(jitted[n], batched, strict=True):
            np.testing.assert_allclose(many[n], one, atol=1e-4 * scale)


@pytest.mark.parametrize(
    "name", ["pyramid", *(pytest.param(name, marks=pytest.mark.ci) for name in ("flownet_c", "raft_small"))]
)
def test_gradients_are_finite_on_any_picture_and_reach_every_weight(name):
    network, side = _tiny(name), _side(name)
    first, second = _pictures(side, side)
    weights = [np.float32(1 + n) for n in range(len(_jitted()(network, first, second)))]
    flat, dark = jnp.full((side, side, 3), 0.5), jnp.zeros((side, side, 3))
    for one, other in ((first, first), (flat, flat), (flat, first), (dark, dark), (first, second)):
        gradient, _ = _pulled()(network, one, other, weights)
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(gradient)]
        assert all(np.isfinite(leaf).all() for leaf in leaves)
    # A bias before an instance norm has none.
    assert all(np.abs(leaf).max() > 0 for leaf in leaves if leaf.ndim > 1)


def test_both_ways_are_each_way():
    network = _tiny("pyramid")
    first, second = _pictures()
    there, back = eqx.filter_jit(flow_both_ways)(network, first, second)
    for found, images in ((there, (first, second)), (back, (second, first))):
        expected = _jitted()(network, *images)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-5)


def _loud(network: Any, where: Callable[[Any], Any], gain: float) -> Any:
    return eqx.tree_at(where, network, replace_fn=lambda weight: gain * weight)


@pytest.mark.ci
@pytest.mark.parametrize(
    ("name", "size", "shift"),
    [("pyramid", 128, 16), pytest.param("raft", 192, 8, marks=pytest.mark.ci)],
)
def test_what_moves_with_the_picture_moves_the_flow_along(name, size, shift):
    """A pattern far from the borders, moved by a multiple of the divisor: the same flow, moved."""
    if name == "pyramid":
        network = PyramidFlow((6, 8), (1, 1), decoder_widths=((8,), (8,)))
        network = _loud(network, lambda n: [decoder.head.weight for decoder in n.decoders], 5.0)
    else:
        network = eqx.filter_jit(lambda: RAFTSmall(updates=1, levels=1, radius=1))()
        network = _loud(network, lambda n: n.update.head.weight, 100.0)
    assert shift % network.divisor == 0
    patch = _pictures(24, 24, seed=3)
    left, top = size // 2 - 16, size // 2 - 8

    def scene(dx: int, dy: int) -> jax.Array:
        canvas = jnp.full((2, size, size, 3), 0.3)
        return canvas.at[:, top + dy : top + dy + 24, left + dx : left + dx + 24].set(patch)

    flow = _jitted()(network, *scene(0, 0))[-1]
    moved = _jitted()(network, *scene(shift, -shift))[-1]
    # Compared where neither the border nor the other half of the scene reaches.
    here = np.asarray(flow)[top : top + 24, left : left + 24]
    there = np.asarray(moved)[top - shift : top - shift + 24, left + shift : left + shift + 24]
    assert np.ptp(here) > 1
    np.testing.assert_allclose(there, here, atol=1e-3 * np.ptp(here))


@pytest.mark.parametrize("name", ["flownet_s", "flownet_c"])
def test_the_flownets_own_unit_does_not_leak_out(name):
    """With heads that say (1, -2) in 20 pixels of the picture, each level says it in its own pixels."""
    network = _tiny(name)
    heads = lambda n: [head.weight for head in n.expanding.heads]  # noqa: E731
    biases = lambda n: [head.bias for head in n.expanding.heads]  # noqa: E731
    network = eqx.tree_at(heads, network, replace_fn=jnp.zeros_like)
    network = eqx.tree_at(biases, network, replace_fn=lambda _: jnp.asarray([1.0, -2.0]))
    for stride, flow in zip((64, 32, 16, 8, 4, 1), _jitted()(network, *_pictures()), strict=True):
        np.testing.assert_allclose(flow, np.broadcast_to([20 / stride, -40 / stride], flow.shape), rtol=1e-6)


@pytest.mark.parametrize(
    "octaves", [(0,), (-1, 0), (0, 1), pytest.param((-1, 0, 1, 2), marks=pytest.mark.ci), (-2, -1, 0)]
)
def test_octaves_of_the_pyramid_go_on_from_one_another(octaves):
    """With heads that say (1, -2), every correction counts by the stride of its level on its octave."""
    network = PyramidFlow((6, 8), (1, 2), (2, 3), ((8,), (8,)), octaves)
    network = eqx.tree_at(lambda n: [d.head.weight for d in n.decoders], network, replace_fn=jnp.zeros_like)
    biases = lambda n: [d.head.bias for d in n.decoders]  # noqa: E731
    network = eqx.tree_at(biases, network, replace_fn=lambda _: jnp.asarray([1.0, -2.0]))
    total, expected = 0.0, []
    for octave in octaves:
        for level in (1, 0) if octave == octaves[0] or octave <= 0 else (0,):
            stride = 4 * 2.0 ** (level - octave)
            total += (2, 3)[level] * stride
            expected.append(total / stride)
    side = 8 * 2 ** -octaves[0] * 4
    flows = _jitted()(network, *_pictures(side, side))
    for flow, value in zip(flows, [*expected, total], strict=True):
        np.testing.assert_allclose(flow, np.broadcast_to([value, -2 * value], flow.shape), rtol=1e-5)
    assert flows[-1].shape == (side, side, 2)


@pytest.mark.parametrize("octaves", [(0,), (0, 1)])
def test_the_last_flow_is_median_filtered_and_no_other(octaves):
    settings = {"widths": (6, 8), "radii": (1, 2), "iterations": (1, 1), "decoder_widths": ((8,), (8,)), "seed": 3}
    plain, filtered = (
        _jitted()(_lively(PyramidFlow(**settings, octaves=octaves, medians=count)), *_pictures()) for count in (0, 2)
    )
    for one, other in zip(plain[:-1], filtered[:-1], strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(filtered[-1], median_filter(median_filter(plain[-1], 5), 5))
    assert not np.array_equal(plain[-1], filtered[-1])


def _lively(network: PyramidFlow) -> PyramidFlow:
    """The network with heads whose flow differs from pixel to pixel."""
    heads = lambda n: [d.head.weight for d in n.decoders]  # noqa: E731
    return eqx.tree_at(heads, network, replace_fn=lambda weight: 100 * weight)


@pytest.mark.ci
def test_a_raft_update_answers_for_its_own_correction_only():
    network = _tiny("raft_small")
    for which, answers in (((1.0, 0.0), 1), ((0.0, 1.0), 1), ((1.0, 1.0), 2)):
        weights = [np.float32(weight) for weight in (*which, 0.0)]
        gradient, flows = _pulled()(network, *_pictures(32, 32), weights)
        np.testing.assert_allclose(gradient.update.head.bias, [answers * flows[0][..., 0].size] * 2, rtol=1e-5)


@pytest.mark.ci
def test_raft_without_the_volume_is_raft():
    networks = (_tiny("raft_small"), _tiny("raft_small_lean"))
    loud = [_loud(network, lambda n: n.update.head.weight, 300.0) for network in networks]
    weights = [np.float32(weight) for weight in (1.0, -2.0, 0.1)]
    found, expected = (_pulled()(network, *_pictures(32, 32), weights) for network in loud)
    assert np.abs(np.asarray(expected[1][-1])).max() > 0.5
    leaves, lean_leaves = (jax.tree.leaves(each[0]) for each in (found, expected))
    scale = np.median([np.abs(np.asarray(leaf)).max() for leaf in leaves])
    for one, other in zip(found[1], expected[1], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    for one, other in zip(leaves, lean_leaves, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4 * scale)


@pytest.mark.ci
def test_raft_takes_pictures_smaller_than_its_pyramid():
    flows = eqx.filter_eval_shape(_flows, RAFTSmall(updates=1), *[jax.ShapeDtypeStruct((8, 24, 3), jnp.float32)] * 2)
    assert flows[0].shape == (1, 3, 2)


@pytest.mark.parametrize(
    "make",
    [
        lambda: FlowNetS(width=0.0),
        lambda: FlowNetC(width=-1.0),
        lambda: RAFTSmall(updates=0),
        lambda: RAFTSmall(levels=0),
        lambda: PyramidFlow((8,), (1, 2), decoder_widths=((8,),)),
        lambda: PyramidFlow((8,), (1,), (0,), ((8,),)),
        lambda: PyramidFlow(octaves=()),
        lambda: PyramidFlow(octaves=(0, 2)),
        lambda: PyramidFlow(octaves=(1, 2)),
        lambda: PyramidFlow(octaves=(0, -1)),
        lambda: PyramidFlow(medians=-1),
        lambda: PyramidFlow(matched=(8,)),
        lambda: PyramidFlow(matched=(8, 8, 8, -8)),
    ],
)
def test_settings_that_make_no_network_are_refused(make):
    with pytest.raises(ValueError, match=r"expected|one of each|at least 1"):
        make()


@pytest.mark.parametrize("name", ["flownet_s", "flownet_c", "raft_small"])
def test_the_configuration_names_every_setting(name):
    settings = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    given = {key: value for key, value in settings.items() if key != "_target_"}
    defaults = {key: value.default for key, value in inspect.signature(PUBLISHED[name]).parameters.items()}
    assert given == defaults
    assert _count(eqx.filter_eval_shape(lambda: make_network(settings))) == _count(
        eqx.filter_eval_shape(PUBLISHED[name])
    )


@pytest.mark.ci
@pytest.mark.parametrize("name", ["flownet_s", "flownet_c"])
def test_flownet_at_full_width_runs(name):
    network = eqx.filter_jit(PUBLISHED[name])()
    flows = _jitted()(network, *_pictures())
    assert _count(eqx.filter(network, eqx.is_array)) == _count(eqx.filter_eval_shape(PUBLISHED[name]))
    assert all(np.isfinite(flow).all() and float(jnp.abs(flow).max()) < 1 for flow in flows)
    assert float(jnp.abs(flows[-1]).max()) > 0


# Parts.


def _costs(first: np.ndarray, second: np.ndarray, radius: int, stride: int = 1) -> np.ndarray:
    height, width, _ = first.shape
    reach = range(-radius * stride, radius * stride + 1, stride)
    volume = np.zeros((height, width, len(reach) ** 2))
    for y in range(height):
        for x in range(width):
            for n, (dy, dx) in enumerate((dy, dx) for dy in reach for dx in reach):
                if 0 <= y + dy < height and 0 <= x + dx < width:
                    volume[y, x, n] = np.mean(first[y, x] * second[y + dy, x + dx])
    return volume


@pytest.mark.parametrize(("height", "width", "radius"), [(4, 5, 1), (3, 16, 2), (5, 19, 3), (2, 33, 4)])
def test_cost_volume_is_its_definition(height, width, radius):
    first, second = _noise(height, width, 6), _noise(height, width, 6, seed=1)
    found = cost_volume(jnp.asarray(first), jnp.asarray(second), radius)
    np.testing.assert_allclose(found, _costs(first, second, radius), atol=1e-5)


@pytest.mark.parametrize(("height", "width", "radius", "stride"), [(6, 8, 2, 2), (5, 19, 1, 2), (7, 7, 1, 3)])
def test_strided_cost_volume_is_its_definition(height, width, radius, stride):
    first, second = _noise(height, width, 4), _noise(height, width, 4, seed=1)
    found = jax.jit(strided_cost_volume, static_argnums=(2, 3))(jnp.asarray(first), jnp.asarray(second), radius, stride)
    np.testing.assert_allclose(found, _costs(first, second, radius, stride), atol=1e-5)


def test_flownets_correlation_reaches_twenty_cells_in_steps_of_two():
    assert (flownet._REACH, flownet._STEP) == (20, 2)
    assert eqx.filter_eval_shape(FlowNetC).contracting[0].weight.shape == (3, 3, 21**2 + 32, 256)


def test_cost_volume_gradient(gradients_agree):
    gradients_agree(jax.jit(functools.partial(cost_volume, radius=1)), (_noise(3, 5, 2), _noise(3, 5, 2, seed=1)))


def test_normalised_features_have_mean_0_and_deviation_1_together():
    first, second = normalise_features(jnp.asarray(3 + 2 * _noise(5, 6, 4)), jnp.asarray(_noise(5, 6, 4, seed=1)))
    both = np.concatenate([np.ravel(first), np.ravel(second)])
    np.testing.assert_allclose([both.mean(), both.std()], [0, 1], atol=1e-5)
    flat = normalise_features(jnp.full((2, 2, 3), 7.0), jnp.full((2, 2, 3), 7.0))
    np.testing.assert_allclose(flat[0], 0, atol=1e-3)


def test_convex_upsample_is_its_definition():
    height, width, factor = 3, 4, 2
    flow, logits = _noise(height, width, 2), _noise(height, width, 9 * factor**2, seed=1)
    padded = np.pad(factor * flow, ((1, 1), (1, 1), (0, 0)), mode="edge")
    shares = softmax(logits.reshape(height, width, 9, factor, factor), axis=2)
    expected = np.zeros((height * factor, width * factor, 2))
    for y in range(height * factor):
        for x in range(width * factor):
            (row, fine_row), (column, fine_column) = divmod(y, factor), divmod(x, factor)
            around = padded[row : row + 3, column : column + 3].reshape(9, 2)
            expected[y, x] = shares[row, column, :, fine_row, fine_column] @ around
    np.testing.assert_allclose(convex_upsample(jnp.asarray(flow), jnp.asarray(logits), factor), expected, atol=1e-5)


def test_convex_upsample_of_a_constant_flow_is_that_flow():
    logits = jnp.asarray(50 * _noise(3, 5, 9 * 4**2))
    fine = convex_upsample(jnp.full((3, 5, 2), 1.5), logits, 4)
    np.testing.assert_allclose(fine, np.full((12, 20, 2), 6.0), rtol=1e-5)


def test_convex_upsample_gradient(gradients_agree):
    upsample = jax.jit(functools.partial(convex_upsample, factor=2))
    gradients_agree(upsample, (_noise(2, 2, 2), _noise(2, 2, 36, seed=1)))


def test_space_to_depth_takes_squares():
    image = _noise(6, 4, 3)
    expected = np.array([[image[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].ravel() for x in range(2)] for y in range(3)])
    np.testing.assert_array_equal(space_to_depth(jnp.asarray(image), 2), expected)


@pytest.mark.parametrize(("size", "height", "width"), [(1, 5, 7), (2, 6, 8), (2, 7, 5), (3, 9, 10)])
def test_convolution_of_squares_is_the_convolution(size, height, width):
    layer = Conv(3, 4, size, stride=size, padding=0, key=jax.random.key(0))
    x = jnp.asarray(_noise(height, width, 3))
    expected = jax.lax.conv_general_dilated(
        x[None], layer.weight, (size, size), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    np.testing.assert_allclose(layer(x), expected[0], atol=1e-5)


def test_separable_convolution_is_one_of_each_channel_and_one_of_all():
    layer = SeparableConv(3, 5, key=jax.random.key(1))
    layer = eqx.tree_at(lambda layer: layer.point.bias, layer, jnp.arange(5.0))
    image = _noise(6, 8, 3)
    each = [
        cv2.filter2D(image[..., n], -1, np.asarray(layer.depth[..., n]), borderType=cv2.BORDER_CONSTANT)
        for n in range(3)
    ]
    expected = np.stack(each, axis=-1) @ np.asarray(layer.point.weight[0, 0]) + np.arange(5)
    np.testing.assert_allclose(layer(jnp.asarray(image)), expected, atol=1e-5)


def test_separable_convolution_gradient(gradients_agree):
    layer = SeparableConv(2, 3, key=jax.random.key(2))

    def found(x, depth, weight, bias):
        changed = eqx.tree_at(lambda q: (q.depth, q.point.weight, q.point.bias), layer, (depth, weight, bias))
        return changed(x)

    gradients_agree(found, (_noise(4, 5, 2), layer.depth, layer.point.weight, _noise(3)))


@pytest.mark.parametrize("factor", [1, 2, 3, 4, 8])
def test_enlarging_is_bilinear(factor):
    image = jnp.asarray(_noise(5, 7, 2))
    expected = jax.image.resize(image, (5 * factor, 7 * factor, 2), "linear")
    np.testing.assert_allclose(enlarge(image, factor), expected, atol=1e-6)


def test_enlarging_keeps_centres_and_shrinking_undoes_it():
    x, y = np.meshgrid(np.arange(6, dtype=np.float32), np.arange(5, dtype=np.float32))
    plane = np.stack([0.5 * x - 2 * y + 1, x + y], axis=-1)
    fine_x, fine_y = np.meshgrid((np.arange(24) - 1.5) / 4, (np.arange(20) - 1.5) / 4)
    expected = np.stack([0.5 * fine_x - 2 * fine_y + 1, fine_x + fine_y], axis=-1)
    fine = enlarge(jnp.asarray(plane), 4)
    np.testing.assert_allclose(fine[2:-2, 2:-2], expected[2:-2, 2:-2], atol=1e-5)
    np.testing.assert_allclose(shrink(fine, 4)[1:-1, 1:-1], plane[1:-1, 1:-1], atol=1e-5)
    np.testing.assert_allclose(enlarge_flow(jnp.asarray(plane), 4), 4 * fine, atol=1e-5)
    noise = _noise(4, 6, 2)
    expected = noise.reshape(2, 2, 3, 2, 2).mean((1, 3))
    np.testing.assert_allclose(shrink(jnp.asarray(noise), 2), expected, atol=1e-6)


def test_enlarging_convolution_is_the_transposed_one():
    layer = flownet._Enlarge(3, 4, key=jax.random.key(0))
    x = jnp.asarray(_noise(5, 6, 3))
    expected = jax.lax.conv_general_dilated(
        x[None], layer.weight, (1, 1), [(2, 2), (2, 2)], lhs_dilation=(2, 2), dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    np.testing.assert_allclose(layer(x), expected[0], atol=1e-5)


def test_enlarging_flow_begins_as_bilinear():
    flow = jnp.asarray(_noise(4, 5, 2))
    found = flownet._Enlarge(2, 2, key=None)(flow)
    np.testing.assert_allclose(found[1:-1, 1:-1], enlarge(flow, 2)[1:-1, 1:-1], atol=1e-6)


_PLACES = ([0.3, 2.6, -0.4, 4.7, 3.0, -9.0], [1.2, 0.0, 3.5, -0.6, 2.0, 40.0])


def test_look_up_agrees_with_scipy():
    volume = _noise(6, 4, 5)
    x, y = (np.asarray(place, np.float32) for place in _PLACES)
    found = look_up(jnp.asarray(volume), jnp.asarray(x), jnp.asarray(y), 2)
    down, across = np.meshgrid(np.arange(-2, 3), np.arange(-2, 3), indexing="ij")
    for n in range(6):
        expected = map_coordinates(volume[n], [y[n] + down, x[n] + across], order=1, mode="grid-constant")
        np.testing.assert_allclose(found[n], expected, atol=1e-5)


def test_look_up_gradient(gradients_agree):
    def windows(volume):
        x, y = (jnp.asarray(place, volume.dtype) for place in _PLACES)
        return look_up(volume, x, y, 1)

    gradients_agree(jax.jit(windows), (_noise(6, 3, 4),))


def test_look_up_of_products_is_look_up_of_the_volume():
    first, second = jnp.asarray(_noise(6, 7)), jnp.asarray(_noise(4, 5, 7, seed=1))
    x, y = (jnp.asarray(place, jnp.float32) for place in _PLACES)
    direction = jnp.asarray(_noise(6, 5, 5, seed=2))

    def whole(first, second):
        return look_up(jnp.einsum("nc,hwc->nhw", first, second), x, y, 2)

    def lean(first, second):
        return look_up_products(first, second, x, y, 2)

    np.testing.assert_allclose(lean(first, second), whole(first, second), atol=1e-5)
    gradients = [
        jax.jit(jax.grad(lambda a, b, f=f: jnp.sum(direction * f(a, b)), argnums=(0, 1)))(first, second)
        for f in (whole, lean)
    ]
    for one, other in zip(*gradients, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_halving_takes_means_and_leaves_out_an_odd_rest():
    image = _noise(5, 4, 2)
    expected = [[image[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].mean((0, 1)) for x in range(2)] for y in range(2)]
    np.testing.assert_allclose(halve(jnp.asarray(image)), expected, atol=1e-6)
    np.testing.assert_allclose(halve(jnp.asarray(image[:1])), [[image[0, :2].mean(0), image[0, 2:].mean(0)]], atol=1e-6)


def test_instance_norm_takes_each_channel_to_mean_0_and_deviation_1():
    out = np.asarray(raft._instance_norm(jnp.asarray(3 * _noise(8, 9, 4) + 5)))
    np.testing.assert_allclose(out.mean((0, 1)), 0, atol=1e-5)
    np.testing.assert_allclose(out.std((0, 1)), 1, atol=1e-4)
