"""Flow pairs: the flow moves the pictures into each other, occlusion is the layers' order, everything by key."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.image.warp import gather, pixel_grid
from tagjax.sim.flow_pairs import FlowPairSettings, flow_pair, flow_pairs
from tagjax.sim.flow_pairs import layers as geometry
from tagjax.sim.flow_pairs.random_scenes import draw_scene

NOISY = FlowPairSettings(height=48, width=64, num_layers=(1, 4), radius_px=(5.0, 20.0),
                         static_scene_probability=0.2)  # fmt: skip
CLEAN = dataclasses.replace(NOISY, lighting_change_probability=0.0, blur_px=0.0, noise=0.0)
BATCH = 24


@pytest.fixture(scope="module")
def pairs():
    return jax.device_get(flow_pairs(CLEAN, BATCH, key=jax.random.key(1)))


@pytest.fixture(scope="module")
def scenes():
    keys = jax.random.split(jax.random.key(1), BATCH)
    return jax.jit(jax.vmap(lambda key: draw_scene(CLEAN, key=jax.random.split(key, 3)[0])))(keys)


def _points():
    x, y = pixel_grid(CLEAN.height, CLEAN.width)
    return x - (CLEAN.width - 1) / 2, y - (CLEAN.height - 1) / 2


def _warp_error(image, other, flow, occluded):
    warped, covered = jax.vmap(gather)(jnp.asarray(other), jnp.asarray(flow))
    used = np.asarray(covered) & ~occluded
    return float(np.abs(np.asarray(warped) - image)[used].mean())


def test_flow_warps_either_picture_into_the_other(pairs):
    both = ((pairs.first, pairs.second, pairs.forward_px, pairs.occluded_first),
            (pairs.second, pairs.first, pairs.backward_px, pairs.occluded_second))  # fmt: skip
    for image, other, flow, occluded in both:
        # Measured 0.002: bilinear interpolation of fine grain, and the mixed pixels of edges. Half a pixel more in
        # any direction costs at least 0.012, low because many layers are dull.
        assert _warp_error(image, other, flow, occluded) < 0.004
        for shift in ([0.5, 0.0], [0.0, 0.5], [-0.5, 0.0]):
            assert _warp_error(image, other, flow + np.float32(shift), occluded) > 0.008


def test_motions_are_exact_inverses_of_each_other(scenes):
    points = _points()

    def round_trip(camera, motion):
        dx, dy = geometry.displacement(camera, motion, points, back=False)
        bx, by = geometry.displacement(camera, motion, (points[0] + dx, points[1] + dy), back=True)
        return jnp.maximum(jnp.abs(dx + bx), jnp.abs(dy + by)), jnp.hypot(dx, dy)

    layers = jax.vmap(jax.vmap(round_trip, in_axes=(None, 0)))
    error, length = layers(scenes.camera, scenes.motion)
    assert float(length.max()) > 10.0
    assert float(error.max()) < 1e-3


def test_forward_and_backward_flow_agree_where_visible(pairs):
    """Their sum at nearest pixels; it is not zero where the target is rounded across a steep change of flow."""
    columns, rows = pixel_grid(CLEAN.height, CLEAN.width)
    to_x = np.asarray(columns) + pairs.forward_px[..., 0]
    to_y = np.asarray(rows) + pairs.forward_px[..., 1]
    u = np.clip(np.rint(to_x).astype(int), 0, CLEAN.width - 1)
    v = np.clip(np.rint(to_y).astype(int), 0, CLEAN.height - 1)
    there = pairs.backward_px[np.arange(BATCH)[:, None, None], v, u]
    gap = np.linalg.norm(pairs.forward_px + there, axis=-1)
    visible = ~pairs.occluded_first
    assert np.mean(gap[visible] < 0.5) > 0.95
    hidden = pairs.occluded_first & (to_x >= 0) & (to_x <= CLEAN.width - 1) & (to_y >= 0) & (to_y <= CLEAN.height - 1)
    assert hidden.sum() > 200
    assert np.mean(gap[hidden] < 0.5) < 0.5


@jax.jit
def _covers(scene, layer, x, y):
    motion = jax.tree.map(lambda leaf: leaf[layer], scene.motion)
    outline = jax.tree.map(lambda leaf: leaf[layer - 1], scene.outline)
    return geometry.outline_value(outline, geometry.to_local(motion, (x, y))) <= 0


@jax.jit
def _forward(scene, layer, x, y):
    motion = jax.tree.map(lambda leaf: leaf[layer], scene.motion)
    return geometry.displacement(scene.camera, motion, (x, y), back=False)


def _inside(scene, layer, x, y):
    return np.asarray(_covers(scene, layer, np.float32(x), np.float32(y)))


def _ahead(scene, layer, x, y):
    return [np.asarray(d, np.float64) for d in _forward(scene, layer, np.float32(x), np.float32(y))]


def _origin(scene, layer, x, y):
    """Invert the forward motion without its inverse: damped fixed-point iteration."""
    sx, sy = x, y
    for _ in range(60):
        dx, dy = _ahead(scene, layer, sx, sy)
        sx, sy = sx + 0.7 * (x - dx - sx), sy + 0.7 * (y - dy - sy)
    return sx, sy


def test_flow_and_occlusion_are_those_of_a_z_order_check(pairs, scenes):
    """Painter's loops in NumPy that use the forward motions and the outlines only."""
    x, y = (np.asarray(p, np.float64) for p in _points())
    half_width, half_height = CLEAN.width / 2, CLEAN.height / 2
    layers = range(1, CLEAN.num_layers[1] + 1)
    for i in range(4):
        scene = jax.tree.map(lambda leaf, i=i: leaf[i], scenes)
        label = np.zeros(x.shape, int)
        label_after = np.zeros(x.shape, int)
        flow, back = np.stack(_ahead(scene, 0, x, y), -1), np.stack([x, y], -1)
        back = np.stack(_origin(scene, 0, x, y), -1) - back
        for layer in layers:
            here = _inside(scene, layer, x, y)
            flow[here] = np.stack(_ahead(scene, layer, x, y), -1)[here]
            label[here] = layer
            origin = _origin(scene, layer, x, y)
            after = _inside(scene, layer, *origin)
            back[after] = (np.stack(origin, -1) - np.stack([x, y], -1))[after]
            label_after[after] = layer
        hidden, hidden_after = [
            (np.abs(x + f[..., 0]) > half_width) | (np.abs(y + f[..., 1]) > half_height) for f in (flow, back)
        ]
        for layer in layers:
            covered = _inside(scene, layer, *_origin(scene, layer, x + flow[..., 0], y + flow[..., 1]))
            hidden |= covered & (layer > label)
            hidden_after |= _inside(scene, layer, x + back[..., 0], y + back[..., 1]) & (layer > label_after)
        # A pixel within rounding (1e-4 px) of an outline may fall on either side.
        assert np.mean(np.linalg.norm(flow - pairs.forward_px[i], axis=-1) > 1e-2) < 1e-3
        assert np.mean(np.linalg.norm(back - pairs.backward_px[i], axis=-1) > 1e-2) < 1e-3
        assert np.mean(hidden != pairs.occluded_first[i]) < 1e-3
        assert np.mean(hidden_after != pairs.occluded_second[i]) < 1e-3


def test_a_still_scene_has_zero_flow_and_equal_pictures(pairs, scenes):
    still = ~np.asarray(scenes.camera.ahead).any(axis=(1, 2)) & ~np.asarray(scenes.motion.shift_x).any(axis=1)
    assert 2 <= still.sum() < BATCH / 2
    for leaf in (pairs.forward_px, pairs.backward_px, pairs.occluded_first, pairs.occluded_second):
        assert not leaf[still].any()
    # Their positions are the same to the bit; the light of a mixed pixel is rounded.
    np.testing.assert_allclose(pairs.first[still], pairs.second[still], atol=1e-5)
    assert pairs.first[still].std(axis=(1, 2)).min() > 0.001
    assert pairs.forward_px[~still].any(axis=(1, 2, 3)).mean() > 0.8  # the rest hide or lack what moves


def test_vmap_is_a_loop(pairs):
    one = jax.jit(lambda key: flow_pair(CLEAN, key=key))
    for i, key in enumerate(jax.random.split(jax.random.key(1), BATCH)[:4]):
        for a, b in zip(jax.tree.leaves(one(key)), jax.tree.leaves(pairs), strict=True):
            # Rounding that differs may move a pixel at an outline from one layer to the other.
            assert np.mean(np.abs(np.asarray(a, np.float32) - b[i].astype(np.float32)) > 1e-3) < 1e-3


@pytest.mark.ci
def test_eager_is_jitted():
    small = dataclasses.replace(NOISY, height=16, width=16, num_layers=(2, 2))
    key = jax.random.key(2)
    eager, jitted = flow_pair(small, key=key), jax.jit(lambda key: flow_pair(small, key=key))(key)
    for a, b in zip(jax.tree.leaves(eager), jax.tree.leaves(jitted), strict=True):
        assert np.mean(np.abs(np.asarray(a, np.float32) - np.asarray(b, np.float32)) > 1e-3) < 5e-3


@pytest.mark.ci
def test_light_noise_and_photographs_change_the_pictures_and_not_the_flow(pairs):
    photographs = jax.random.bits(jax.random.key(9), (2, 20, 30, 3), jnp.uint8)
    noisy = jax.device_get(flow_pairs(NOISY, BATCH, photographs, key=jax.random.key(1)))
    assert np.mean(np.abs(noisy.forward_px - pairs.forward_px) > 1e-3) < 1e-3
    assert np.abs(noisy.second - pairs.second).mean() > 0.03
    assert noisy.first.dtype == np.float32
    assert 0.0 <= noisy.first.min() <= noisy.first.max() <= 1.0
    again = jax.device_get(flow_pairs(NOISY, BATCH, photographs, key=jax.random.key(1)))
    for a, b in zip(jax.tree.leaves(noisy), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    # Different keys give different pictures.
    assert len({a.tobytes() for a in noisy.first}) == BATCH


@pytest.mark.ci
def test_motion_is_mostly_small_partly_zero_and_sometimes_large():
    """Over 256 default pairs at 1/4 of the pixels; the bounds leave room for other random numbers."""
    settings = FlowPairSettings()
    x, y = pixel_grid(64, 80)
    points = (2 * x - 79.5, 2 * y - 63.5)

    def lengths(key):
        scene = draw_scene(settings, key=key)
        label = jnp.zeros((64, 80), jnp.int32)
        length = jnp.hypot(*geometry.displacement(scene.camera, _row(scene.motion, 0), points, back=False))
        for layer in range(1, settings.num_layers[1] + 1):
            motion = _row(scene.motion, layer)
            inside = geometry.outline_value(_row(scene.outline, layer - 1), geometry.to_local(motion, points)) <= 0
            label = jnp.where(inside, layer, label)
            own = jnp.hypot(*geometry.displacement(scene.camera, motion, points, back=False))
            length = jnp.where(inside, own, length)
        return length, label

    def _row(tree, number):
        return jax.tree.map(lambda leaf: leaf[number], tree)

    length, label = jax.device_get(jax.jit(lambda keys: jax.lax.map(lengths, keys, batch_size=16))(
        jax.random.split(jax.random.key(0), 256)))  # fmt: skip
    assert 0.30 < np.mean(length == 0) < 0.55
    assert 0.05 < np.mean(label > 0) < 0.6
    low, middle, high, extreme = np.quantile(length[length > 0], [0.1, 0.5, 0.9, 0.999])
    print(f"moving pixels: 10 % {low:.2f}, median {middle:.2f}, 90 % {high:.2f}, 99.9 % {extreme:.2f} px")
    assert low < 0.7
    assert 1.5 < middle < 4.0
    assert 4.5 < high < 10.0
    assert 14.0 < extreme < 30.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"height": 8}, "at least 16 pixels"),
        ({"num_layers": (0, 3)}, "num_layers"),
        ({"num_layers": (4, 3)}, "num_layers"),
        ({"bend_probability": 1.5}, "bend_probability.*probability"),
        ({"motion_px": (0.0, 3.0)}, "motion_px.*log-uniform"),
        ({"radius_px": (9.0, 3.0)}, "radius_px"),
        ({"noise": -0.1}, "noise.*at least 0"),
        ({"shadow": float("nan")}, "shadow.*finite"),
        ({"camera_tilt": 0.5}, "camera_tilt.*degenerate"),
    ],
)
def test_impossible_settings_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(NOISY, **change)
