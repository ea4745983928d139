"""Estimates of any size, pictures that are checked, weights on disk, named flows and their cache."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import json
import threading
from pathlib import Path
from typing import Any

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors
import safetensors.numpy
import synthetic_clips as synthetic
import yaml
from hydra import compose, initialize_config_dir
from jaxtyping import Array, Float

import tagjax.flow
import tagjax.flow.estimates
import tagjax.flow.weights
from tagjax.core.array_file import named_arrays
from tagjax.flow.cache import pair_flow
from tagjax.flow.estimates import NetworkFlow, consistency, estimate, flow_along, forward_flow, padding
from tagjax.flow.images import check_images, to_uint8
from tagjax.flow.loss_terms import occluded
from tagjax.flow.network import AbstractFlowNetwork
from tagjax.flow.opencv import DISFlow
from tagjax.flow.pyramid import PyramidFlow
from tagjax.flow.registry import CLASSICAL, VARIANTS, flow_key, make_flow
from tagjax.flow.stationary import zero_stationary
from tagjax.flow.weights import load_network, load_weights, save_weights, weights_metadata
from tagjax.recording.store import open_recording, save_recording
from tagjax.tracing.clips import load_clip
from tagjax.training.flow_run import make_network

CONF = Path(__file__).parents[1] / "conf" / "flow"
SETTINGS = {
    "_target_": "tagjax.flow.pyramid.PyramidFlow",
    "widths": [8, 8],
    "radii": [1, 1],
    "iterations": [1, 1],
    "decoder_widths": [[8], [8]],
}
TRACED: list[tuple[int, ...]] = []


def _pictures(count: int, height: int, width: int) -> list[np.ndarray]:
    """One smooth picture, shifted by a pixel more each time."""
    smooth = cv2.GaussianBlur(np.random.default_rng(7).integers(0, 256, (height, width, 3), np.uint8), (0, 0), 2)
    return [np.roll(smooth, number, axis=1) for number in range(count)]


class Painted(AbstractFlowNetwork):
    """Flow that is painted on the first picture: red and green are its components, 20 pixels from 0 to 1."""

    scale_px: Float[Array, ""]
    divisor: int = eqx.field(static=True)

    def encode(self, image: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
        TRACED.append(image.shape)
        return image

    def decode(self, first: Any, second: Any) -> tuple[Float[Array, "_ _ 2"], ...]:
        return (self.scale_px * (first[..., :2] - 0.5),)


PAINTED = Painted(divisor=16, scale_px=jnp.asarray(20.0))


def paint(flow_px: Any, height: int = 40, width: int = 56) -> np.ndarray:
    """The picture on which `PAINTED` reads a flow."""
    picture = np.full((height, width, 3), 0.25, np.float32)
    picture[..., :2] = np.asarray(flow_px, np.float32) / 20 + 0.5
    return picture


def small_network(seed: int = 0, gain: float = 1.0) -> PyramidFlow:
    """A small pyramid, its flow heads enlarged."""
    network = make_network({**SETTINGS, "seed": seed})
    heads = lambda n: [decoder.head.weight for decoder in n.decoders]  # noqa: E731
    return eqx.tree_at(heads, network, [gain * weight for weight in heads(network)])


def texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Smooth noise in colour, uint8."""
    rough = jnp.asarray(np.random.default_rng(seed).uniform(size=(height // 4 + 2, width // 4 + 2, 3)), jnp.float32)
    smooth = jax.image.resize(rough, (height + 8, width + 8, 3), "cubic")[4:-4, 4:-4]
    return np.asarray(jnp.clip(255 * smooth, 0, 255)).astype(np.uint8)


# Pictures


def test_every_kind_of_picture_becomes_the_same_rgb():
    grey = texture(9, 12)[..., 0]
    rgb = np.repeat(grey[..., None], 3, axis=-1)
    for same in (grey, grey[..., None], rgb, np.dstack([rgb, grey])):
        for one in check_images(same, rgb):
            np.testing.assert_array_equal(one, rgb)
            assert one.dtype == np.uint8
    for same in (grey.astype(np.uint16) * 257, grey / 255, (grey / 255).astype(np.float16)):
        first, second = check_images(same, rgb)
        assert first.dtype == second.dtype == np.float32
        np.testing.assert_allclose(first, rgb / 255, atol=1e-3)
        np.testing.assert_allclose(second, rgb / 255, atol=1e-6)
        np.testing.assert_array_equal(to_uint8(second), rgb)


GOOD = np.zeros((8, 9, 3), np.uint8)
HOLED = np.zeros((8, 9))
HOLED[2, 3] = np.nan


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        (GOOD, None, "One image is missing; a flow needs two"),
        (GOOD, GOOD[:, :8], "9 x 8 and 8 x 8 pixels; a flow needs equal sizes"),
        (GOOD, GOOD.transpose(2, 0, 1), r"shape \(3, 8, 9\).*Channels come last"),
        (GOOD[None], GOOD[None], "Give one image at a time"),
        (GOOD[..., :2], GOOD, r"shape \(8, 9, 2\); expected a grey or RGB image"),
        (HOLED, GOOD, "The first image holds 1 values that are not finite"),
        (GOOD, HOLED + np.inf, "The second image holds 72 values"),
        (GOOD.astype(float) + 255, GOOD, "from 255 to 255; expected floats from 0 to 1"),
        (GOOD.astype(float) - 1, GOOD, "from -1 to -1; expected floats"),
        (GOOD.astype(np.int32), GOOD, "int32; expected"),
        (GOOD.astype(bool), GOOD, "bool; expected"),
        (GOOD[:0], GOOD, "is empty"),
        ("a.png", GOOD, "expected a grey or RGB image"),
        ([[1, 2], [3]], GOOD, "expected a grey or RGB image"),
    ],
)
def test_what_is_no_pair_of_pictures_is_refused(first, second, message):
    arrays = isinstance(first, np.ndarray) and isinstance(second, np.ndarray)
    flows = (make_flow("zero"), make_flow("dis_ultrafast"), NetworkFlow(PAINTED)) if arrays else ()
    for flow in (check_images, lambda *pair: estimate(PAINTED, *pair), *flows):
        with pytest.raises(ValueError, match=message):
            flow(first, second)


@pytest.mark.parametrize("name", sorted(CLASSICAL))
def test_classical_flows_take_tiny_grey_and_deep_pictures(name):
    flow = make_flow(name)
    for shape in ((1, 1), (5, 7), (13, 40)):
        picture = texture(*shape)
        found = flow(picture, picture)
        assert found.shape == (*shape, 2)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, 0, atol=0.2)
    before, after = texture(48, 64)[..., 0], np.roll(texture(48, 64)[..., 0], 2, axis=1)
    grey = flow(before, after)
    np.testing.assert_array_equal(flow(np.dstack([before] * 3), np.dstack([after] * 3)), grey)
    np.testing.assert_array_equal(flow(before.astype(np.uint16) * 257, after.astype(np.uint16) * 257), grey)
    assert name == "zero" or abs(np.median(grey[8:-8, 8:-8, 0]) - 2) < 0.3


# Estimates


@pytest.mark.parametrize("size", [1, 31, 32, 63, 64, 65, 424])
@pytest.mark.parametrize("divisor", [8, 32, 64, 96])
def test_padding_is_the_smallest_that_fits(size, divisor):
    before, after = padding(size, divisor)
    whole = before + size + after
    assert whole % divisor == 0
    assert whole >= 64
    assert 0 <= after - before <= 1
    assert whole - divisor < max(size, 64)


@pytest.mark.parametrize("shape", [(40, 56), (1, 1), (3, 70), (64, 80), (65, 79)])
def test_flow_is_cut_back_to_where_the_picture_lies(shape):
    flow = np.random.default_rng(1).uniform(-9, 9, (*shape, 2))
    first, second = paint(flow, *shape), paint(-flow[::-1], *shape)
    found = estimate(PAINTED, first, second)
    np.testing.assert_allclose(found.forward_px, flow, atol=1e-4)
    np.testing.assert_allclose(found.backward_px, -flow[::-1], atol=1e-4)
    np.testing.assert_allclose(forward_flow(PAINTED, first, second), flow, atol=1e-4)
    np.testing.assert_allclose(NetworkFlow(PAINTED)(first, second), flow, atol=1e-4)
    assert all(np.shape(leaf)[:2] == shape for leaf in jax.tree.leaves(found))


def test_sizes_share_what_is_compiled():
    TRACED.clear()
    network = Painted(divisor=24, scale_px=jnp.asarray(7.0))
    for shape in ((70, 70), (72, 72), (65, 71)):
        estimate(network, paint(0, *shape), paint(0, *shape))
        forward_flow(network, paint(0, *shape), paint(0, *shape))
    # By itself once, and twice in the whole of `forward_flow`.
    assert TRACED == 3 * [(72, 72, 3)]
    estimate(Painted(divisor=24, scale_px=jnp.asarray(8.0)), paint(0, 66, 66), paint(0, 66, 66))
    assert len(TRACED) == 3
    estimate(network, paint(0, 73, 70), paint(0, 73, 70))
    assert TRACED[3:] == [(96, 72, 3)]


def test_what_leaves_the_picture_or_does_not_come_back_is_hidden():
    there = estimate(PAINTED, paint((3.0, -2.0)), paint((-3.0, 2.0)))
    inside = np.zeros((40, 56), bool)
    inside[2:, :-3] = True
    np.testing.assert_array_equal(there.forward_occluded, ~inside)
    np.testing.assert_array_equal(there.backward_occluded, ~inside[::-1, ::-1])
    np.testing.assert_allclose(there.forward_confidence, inside, atol=1e-5)
    # Half a pixel beyond the last pixel's centre still is the picture.
    edge = estimate(PAINTED, paint((0.4, 0.4)), paint((-0.4, -0.4)))
    assert not edge.forward_occluded.any()
    one_sided = estimate(PAINTED, paint((3.0, 0.0)), paint((0.0, 0.0)))
    tolerance = 0.01 * 9 + 0.5
    np.testing.assert_allclose(one_sided.forward_confidence[:, :-3], tolerance / (tolerance + 9), atol=1e-5)
    np.testing.assert_allclose(one_sided.backward_confidence, tolerance / (tolerance + 9), atol=1e-5)
    assert one_sided.forward_occluded.all()


def test_confidence_is_half_where_a_pixel_begins_to_be_hidden():
    rng = np.random.default_rng(2)
    flow = jnp.asarray(rng.uniform(-1, 1, (20, 30, 2)), jnp.float32)
    back = -flow + jnp.asarray(rng.uniform(-1.2, 1.2, (20, 30, 2)), jnp.float32)
    inner = (slice(2, -2), slice(2, -2))
    confidence = consistency(flow, back)
    hidden = np.asarray(occluded(flow, back))[inner]
    np.testing.assert_array_equal(np.asarray(confidence)[inner] <= 0.5, hidden)
    assert 0.2 < hidden.mean() < 0.8
    assert np.all((np.asarray(confidence) >= 0) & (np.asarray(confidence) <= 1))


def test_confidence_has_the_gradient_of_its_formula(gradients_agree):
    rng = np.random.default_rng(3)
    flow = rng.uniform(0.1, 0.4, (4, 5, 2))
    gradients_agree(lambda f, b: consistency(f, b), (flow, -flow + rng.uniform(-0.3, 0.3, (4, 5, 2))))


class Wider(AbstractFlowNetwork):
    """A network whose pictures have to be larger."""

    divisor: int = eqx.field(static=True)
    network: PyramidFlow

    def encode(self, image: Float[Array, "height width 3"]) -> Any:
        return self.network.encode(image)

    def decode(self, first: Any, second: Any) -> tuple[Float[Array, "_ _ 2"], ...]:
        return self.network.decode(first, second)


def test_padding_hardly_changes_the_inside():
    network = small_network(gain=10.0)
    first, second = texture(112, 128, 1), np.roll(texture(112, 128, 1), 2, axis=1)
    plain = NetworkFlow(network)(first, second)
    padded = NetworkFlow(Wider(divisor=72, network=network))(first, second)  # by 16 rows and 8 columns at each end
    gap = padded - plain
    inner = (slice(24, -24), slice(24, -24))
    assert np.std(plain) > 0.3
    assert np.sqrt(np.mean(gap[inner] ** 2)) < 0.1 * np.std(plain)
    assert np.abs(gap).max() > 0.01  # the edges do change


@pytest.mark.ci
def test_estimates_go_through_transformations():
    network = small_network(gain=30.0)
    first, second = (jnp.asarray(texture(70, 66, n), jnp.float32) / 255 for n in (1, 2))
    eager = estimate(network, first, second)
    traced = eqx.filter_jit(estimate)(network, first, second)
    for one, other in zip(jax.tree.leaves(eager), jax.tree.leaves(traced), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    np.testing.assert_allclose(forward_flow(network, first, second), eager.forward_px, atol=1e-4)
    gradient = eqx.filter_grad(lambda n: jnp.sum(forward_flow(n, first, second) ** 2))(network)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
    assert any(np.any(leaf != 0) for leaf in jax.tree.leaves(gradient))


def test_one_batch_of_both_ways_is_what_two_calls_are(monkeypatch):
    network = small_network(gain=30.0)
    pictures = texture(64, 64, 1), texture(64, 64, 2)
    there, back = estimate(network, *pictures).forward_px, estimate(network, *pictures).backward_px
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    batch = estimate(network, *pictures)
    np.testing.assert_allclose(batch.forward_px, there, atol=1e-4)
    np.testing.assert_allclose(batch.backward_px, back, atol=1e-4)


def test_a_failure_in_the_second_thread_is_raised(monkeypatch):
    network = small_network(gain=30.0)
    pictures = texture(64, 64, 1), texture(64, 64, 2)
    estimate(network, *pictures)

    def failing(network, picture):
        if threading.current_thread() is not threading.main_thread():
            raise FloatingPointError("found")
        return picture

    monkeypatch.setattr(tagjax.flow.estimates, "_encode", failing)
    key = next(key for key in tagjax.flow.estimates._compiled if key[2][-1] == ((64, 64, 3), jnp.uint8))
    tagjax.flow.estimates._compiled.add((failing, *key[1:]))
    with pytest.raises(FloatingPointError, match="found"):
        estimate(network, *pictures)


def test_a_video_is_encoded_once_and_flows_both_ways(monkeypatch):
    flow = NetworkFlow(small_network(gain=30.0))
    pictures = [texture(66, 70, n) for n in range(4)]
    direct = [(flow(a, b), flow(b, a)) for a, b in itertools.pairwise(pictures)]
    encode, seen = tagjax.flow.estimates._encode, []
    monkeypatch.setattr(tagjax.flow.estimates, "_encode", lambda *args: (seen.append(1), encode(*args))[1])
    for found, expected in zip(flow_along(flow, pictures), direct, strict=True):
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-5)
    assert len(seen) == 4
    dis = make_flow("dis_ultrafast")
    ((there, back),) = flow_along(dis, pictures[:2])
    np.testing.assert_array_equal(there, dis(*pictures[:2]))
    np.testing.assert_array_equal(back, dis(pictures[1], pictures[0]))
    assert list(flow_along(flow, pictures[:1])) == list(flow_along(dis, [])) == []
    with pytest.raises(ValueError, match="a flow needs equal sizes"):
        list(flow_along(flow, [pictures[0], pictures[1][:50]]))


# Weights


@pytest.fixture
def packaged(tmp_path, monkeypatch) -> Path:
    """An empty folder in place of the packaged weights."""
    folder = tmp_path / "weights"
    monkeypatch.setattr(tagjax.flow.weights, "PACKAGED", folder)
    return folder


def _same(one: Any, other: Any) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_weights_come_back_with_their_metadata(tmp_path):
    network, path = small_network(3), tmp_path / "new" / "a.safetensors"
    about = {"flow": SETTINGS, "recipe": {"seed": 3, "sizes": (1, 2)}, "epe_px": np.float32(0.5), "data": ["a"]}
    save_weights(path, network, about)
    _same(load_network(path), network)
    _same(load_weights(small_network(4), str(path)), network)
    found = weights_metadata(path)
    assert found["flow"] == SETTINGS
    assert found["recipe"] == {"seed": 3, "sizes": [1, 2]}
    assert found["epe_px"] == 0.5
    again = tmp_path / "b.safetensors"
    save_weights(again, network, about)
    assert again.read_bytes() == path.read_bytes()
    assert [item.name for item in path.parent.iterdir()] == ["a.safetensors"]
    arrays = safetensors.numpy.load_file(path)
    np.testing.assert_array_equal(arrays["encoders.1.0.weight"], named_arrays(network)["encoders.1.0.weight"])
    save_weights(again, network, about, half=True)
    assert again.stat().st_size < 0.7 * path.stat().st_size
    for a, b in zip(jax.tree.leaves(load_network(again)), jax.tree.leaves(network), strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)


def test_weights_with_metadata_of_another_network_are_not_written(tmp_path):
    path = tmp_path / "a.safetensors"
    for about, message in (
        ({}, "expected `flow`"),
        ({"flow": {**SETTINGS, "widths": [8, 9]}}, "build another network"),
        ({"flow": {**SETTINGS, "radii": [1]}}, "does not take the settings"),
        ({"flow": {**SETTINGS, "_target_": "os.system"}}, "expected a network of tagjax.flow"),
        ({"flow": SETTINGS, "data": {1, 2}}, "expected numbers, strings"),
    ):
        with pytest.raises(ValueError, match=message):
            save_weights(path, small_network(), about)
    broken = eqx.tree_at(lambda n: n.upsampler.bias, small_network(), jnp.full((36,), jnp.nan))
    with pytest.raises(ValueError, match=r"upsampler\.bias is not finite"):
        save_weights(path, broken, {"flow": SETTINGS})
    assert not list(tmp_path.iterdir())


def _rewritten(
    source: Path, target: Path, *, metadata: Any = None, arrays: dict[str, np.ndarray | None] | None = None
) -> Path:
    """A copy of a weights file with other metadata, or with some arrays replaced, added or (None) left out."""
    with safetensors.safe_open(source, framework="numpy") as file:
        header, names = file.metadata(), file.keys()
        content = {name: file.get_tensor(name) for name in names}
    content |= arrays or {}
    header = header if metadata is None else {"tagjax": json.dumps(metadata)}
    kept = {name: array for name, array in content.items() if array is not None}
    target.write_bytes(safetensors.numpy.save(kept, header))
    return target


def test_damaged_foreign_and_unfit_files_are_refused_in_words(tmp_path):
    good, bad = tmp_path / "good.safetensors", tmp_path / "bad.safetensors"
    save_weights(good, small_network(), {"flow": SETTINGS})
    content, name = good.read_bytes(), "upsampler.bias"
    metadata = weights_metadata(good)

    def refused(message: str) -> None:
        for load in (load_network, lambda path: load_weights(small_network(), path), make_flow):
            with pytest.raises(ValueError, match=message) as error:
                load(str(bad))
            assert "\n" not in str(error.value)

    for cut in (0, 4, 10, len(content) // 2, len(content) - 1):
        bad.write_bytes(content[:cut])
        refused("no readable weights of a flow network")
    bad.write_bytes((2**40).to_bytes(8, "little") + content[8:])
    refused("a header of 1099511627776 bytes; expected at most 4000000")
    bad.write_bytes(content[:-40] + bytes([content[-40] ^ 1]) + content[-39:])
    refused("do not have the checksum of the header|not finite")
    np.savez(tmp_path / "other.npz", weight=np.zeros(3))
    bad.write_bytes((tmp_path / "other.npz").read_bytes())
    refused("no readable weights of a flow network")
    bad.write_bytes(safetensors.numpy.save({"weight": np.zeros(3)}))
    refused("a safetensors file, but no weights")
    for other, message in (
        ({**metadata, "format": "other"}, "a safetensors file, but no weights"),
        ({**metadata, "version": 7}, "version 7; this release reads version 2"),
        ([1], "a safetensors file, but no weights"),
    ):
        _rewritten(good, bad, metadata=other)
        refused(message)
    for array, message in (
        (np.zeros(35, np.float32), r"upsampler.bias is float32 of shape \(35,\); this network has .*\(36,\)"),
        (np.zeros(36, np.int64), "upsampler.bias is I64"),
        (np.full(36, np.inf, np.float32), "upsampler.bias holds values that are not finite"),
        (np.ones(36, np.float32), "do not have the checksum of the header"),
        (None, r"1 arrays are missing \(upsampler.bias\), 0 are unknown"),
    ):
        _rewritten(good, bad, arrays={name: array})
        refused(message)
    _rewritten(good, bad, arrays={"more": np.zeros(1, np.float32)})
    refused(r"0 arrays are missing \(\), 1 are unknown \(more\)")
    with pytest.raises(ValueError, match="No weights at"):
        load_network(tmp_path / "none.safetensors")


def test_settings_of_a_file_name_nothing_but_networks(tmp_path):
    good, bad = tmp_path / "good.safetensors", tmp_path / "bad.safetensors"
    save_weights(good, small_network(), {"flow": SETTINGS})
    found = weights_metadata(good)
    for target in (
        "os.system",
        "tagjax.flow.pyramid._Decoder",
        "tagjax.flow.estimates.NetworkFlow",
        "tagjax.flow.weights.Path",
        "tagjax.flow.network.AbstractFlowNetwork",
        "tagjax.flow.none.PyramidFlow",
        "tagjax.flow.pyramid",
        None,
    ):
        flow = {**SETTINGS, "_target_": target}
        _rewritten(good, bad, metadata={**found, "flow": flow})
        with pytest.raises(ValueError, match="expected a network of tagjax"):
            load_network(bad)
    # Neither memory nor time is spent on a network that no file holds.
    for changed in (
        {"widths": [8, 10**7]},
        {"widths": [8] * 10**5},
        {"medians": 10**400},
        {"radii": [2, float("inf")]},
    ):
        _rewritten(good, bad, metadata={**found, "flow": {**SETTINGS, **changed}})
        with pytest.raises(ValueError, match=f"{next(iter(changed))} too large; expected at most 1024"):
            load_network(bad)


def test_packaged_weights_are_found_by_name_and_by_network(packaged):
    with pytest.raises(
        ValueError, match=r"No weights are packaged for tagjax.flow.pyramid.PyramidFlow \(packaged are: none"
    ):
        load_weights(small_network())
    with pytest.raises(
        ValueError, match=r"Unknown optical flow 'pyramid'; expected one of zero, dis.*weights \(none\)"
    ):
        make_flow("pyramid")
    save_weights(packaged / "pyramid.safetensors", small_network(5), {"flow": SETTINGS})
    _same(load_weights(small_network()), small_network(5))
    _same(load_weights(small_network(), "pyramid"), small_network(5))
    flow = make_flow("pyramid")
    assert isinstance(flow, NetworkFlow)
    _same(flow.network, small_network(5))
    assert make_flow("pyramid") is flow
    fine = make_flow("pyramid_fine")
    assert isinstance(fine, NetworkFlow)
    _same(fine.network, make_network({**SETTINGS, "seed": 5, "octaves": [-1, 0, 1, 2], "medians": 2}))
    assert make_flow("pyramid_fine") is fine
    assert flow_key("pyramid_fine") != flow_key("pyramid")
    assert make_flow("pyramid") is flow
    with pytest.raises(ValueError, match="Unknown optical flow 'pyramids'"):
        flow_key("pyramids")


def test_of_packaged_weights_of_one_class_those_that_fit_are_taken(packaged):
    apart = {**SETTINGS, "separable": True, "matched": [4, 4]}
    split = make_network({**apart, "seed": 3})
    save_weights(packaged / "a.safetensors", split, {"flow": apart})
    save_weights(packaged / "b.safetensors", small_network(5), {"flow": SETTINGS})
    _same(load_weights(small_network()), small_network(5))
    _same(load_weights(make_network(apart)), split)
    _same(load_network("a"), split)
    with pytest.raises(ValueError, match="weights of a flow network that do not fit this network"):
        load_weights(make_network({**SETTINGS, "widths": [8, 16]}))


# Named flows


@pytest.fixture
def stored(tmp_path) -> Path:
    """A recording on disk whose pictures change."""
    made = synthetic.enlarged(synthetic.recording(6), 3)
    colour = np.stack([np.roll(texture(72, 96), 2 * t, axis=1) for t in range(6)])
    save_recording(dataclasses.replace(made, colour=colour), tmp_path / "a.zarr")
    return tmp_path / "a.zarr"


def test_kept_flow_is_that_of_the_weights(stored, tmp_path):
    one, other = tmp_path / "one.safetensors", tmp_path / "other.safetensors"
    save_weights(one, small_network(1, 30.0), {"flow": SETTINGS})
    save_weights(other, small_network(2, 30.0), {"flow": SETTINGS})
    recording = open_recording(stored)
    first = pair_flow(recording, 1, 6, str(one))
    second = pair_flow(recording, 1, 6, str(other))
    assert np.abs(first[0] - second[0]).max() > 0.05
    keys = {flow_key(str(path)) for path in (one, other)}
    assert len(keys) == 2
    assert {folder.name for folder in (stored / "cache" / "flow").iterdir()} == keys
    assert all(key.startswith("PyramidFlow-") for key in keys)
    flow = NetworkFlow(load_network(one))
    pictures = np.asarray(recording.colour[0:2])
    there, back = flow(pictures[0], pictures[1]), flow(pictures[1], pictures[0])
    np.testing.assert_allclose(first[0][0], zero_stationary(there, pictures[0], pictures[1]), atol=2e-3, rtol=2e-3)
    np.testing.assert_allclose(first[1][0], zero_stationary(back, pictures[1], pictures[0]), atol=2e-3, rtol=2e-3)
    assert np.any(first[0][0] != 0, axis=-1).mean() > 0.1
    # Another training in the same file gives another flow, not the kept one.
    save_weights(one, small_network(2, 30.0), {"flow": SETTINGS})
    np.testing.assert_array_equal(pair_flow(recording, 1, 6, str(one))[0], second[0])
    with pytest.raises(ValueError, match="No weights at"):
        pair_flow(recording, 1, 6, str(tmp_path / "none.safetensors"))


def test_a_flow_at_rest_is_the_flow_where_rest_explains_less():
    """Noise around a square that moves: there DIS is kept, elsewhere nothing is; and the key tells the two apart."""
    rng = np.random.default_rng(0)
    still = cv2.GaussianBlur(rng.uniform(0, 255, (96, 128)), (0, 0), 2.0)
    square = 3 * cv2.GaussianBlur(rng.uniform(-128, 128, (30, 30)), (0, 0), 1.5) + 128
    pictures = []
    for shift in (0, 3, 6):
        picture = 3 * (still - still.mean()) + 128 + rng.normal(0, 2, still.shape)
        picture[30:60, 30 + shift : 60 + shift] = square
        pictures.append(np.repeat(np.clip(picture, 0, 255).astype(np.uint8)[..., None], 3, axis=-1))
    plain, rested = make_flow("dis"), make_flow("dis+rest")
    here, there = pictures[:2]
    flow, kept = plain(here, there), rested(here, there)
    np.testing.assert_array_equal(kept[36:54, 36:54], flow[36:54, 36:54])
    around = np.ones((96, 128), bool)
    around[16:74, 16:77] = False
    assert np.any(kept[around] != 0, axis=-1).mean() < 0.02 < np.any(flow[around] != 0, axis=-1).mean()
    np.testing.assert_array_equal(rested(here / np.float32(255), there / np.float32(255)), kept)
    for (ahead, back), one, other in zip(flow_along(rested, iter(pictures)), pictures[:-1], pictures[1:], strict=True):
        np.testing.assert_array_equal(ahead, rested(one, other))
        np.testing.assert_array_equal(back, rested(other, one))
    assert flow_key("dis+rest").startswith("dis+rest")
    with pytest.raises(ValueError, match=r"Unknown optical flow 'diss'.*\+rest may follow"):
        make_flow("diss+rest")


def test_clips_take_any_named_flow(stored, tmp_path):
    path = tmp_path / "w.safetensors"
    save_weights(path, small_network(1, 30.0), {"flow": SETTINGS})
    recording = open_recording(stored)
    assert not np.any(load_clip(recording, 0, 6, stride=2, flow="zero").frames.forward_px)
    clip = load_clip(recording, 0, 6, stride=2, flow=str(path))
    np.testing.assert_array_equal(clip.frames.forward_px[0], 0)
    expected = pair_flow(recording, 2, 3, str(path))[0][0, ::2, ::2] / 2
    np.testing.assert_allclose(clip.frames.forward_px[2], expected, atol=1e-6)


@pytest.mark.parametrize("name", sorted(VARIANTS))
def test_a_variant_differs_by_its_octaves_and_medians_only(name):
    with initialize_config_dir(str(CONF.parent), version_base="1.3"):
        plain, fine = (compose("train_flow", [f"flow={which}"]).flow for which in ("pyramid", name))
    assert {**fine, "octaves": plain.octaves, "medians": plain.medians} == plain
    changes = {"octaves": tuple(fine.octaves), "medians": fine.medians}
    assert VARIANTS[name] == ("pyramid", changes)


def test_the_file_of_the_pyramid_names_every_setting():
    settings = yaml.safe_load((CONF / "pyramid.yaml").read_text())
    built = eqx.filter_eval_shape(make_network, settings)
    assert eqx.tree_equal(built, eqx.filter_eval_shape(PyramidFlow))
    assert set(settings) - {"_target_"} == set(inspect.signature(PyramidFlow).parameters) - {"seed"}


@pytest.mark.parametrize("name", ["pyramid", "pyramid_fast"])
def test_packaged_weights_are_those_of_the_configured_network(name):
    with initialize_config_dir(str(CONF.parent), version_base="1.3"):
        network = eqx.filter_eval_shape(make_network, dict(compose("train_flow", [f"flow={name}"]).flow))
    _same(load_weights(network), load_network(name))


def test_the_packaged_fast_flow_sees_a_picture_move():
    pictures = texture(64, 96), np.roll(texture(64, 96), (1, 3), axis=(0, 1))
    error_px = np.linalg.norm(make_flow("pyramid_fast")(*pictures)[16:-16, 16:-16] - [3, 1], axis=-1)
    assert error_px.mean() < 0.5


@pytest.mark.parametrize(
    "name",
    ["zero", "dis_ultrafast", "dis+wls"]
    + [pytest.param(name, marks=pytest.mark.ci) for name in ("pyramid_fast", "pyramid+rest")]
    + [pytest.param(name, marks=pytest.mark.ci) for name in ("pyramid", "pyramid_mid")],
)
def test_equal_pictures_have_no_flow_whatever_they_show(name: str) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (70, 90, 3), np.uint8)
    flow = make_flow(name)
    for picture in (np.full_like(noise, 128), cv2.GaussianBlur(noise, (0, 0), 6), noise):
        found = estimate(flow, picture, picture.copy())
        assert not np.asarray(found.forward_px).any()
        assert not np.asarray(found.backward_px).any()
        assert not found.forward_occluded.any()
        assert float(found.backward_confidence.min()) == 1.0
        assert not flow(picture, picture.copy()).any()
        assert not any(way.any() for ways in flow_along(flow, [picture, picture.copy()]) for way in ways)


@pytest.mark.ci
def test_pictures_that_differ_keep_their_flow() -> None:
    """Equal but for one small thing that moves on a flat ground."""
    ground = np.full((96, 128, 3), 90, np.uint8)
    first, second = ground.copy(), ground.copy()
    thing = np.random.default_rng(1).integers(0, 256, (16, 16, 3), np.uint8)
    first[40:56, 50:66], second[40:56, 54:70] = thing, thing
    found = estimate(make_flow("pyramid_mid"), first, second)
    assert float(found.forward_px[48, 58, 0]) == pytest.approx(4.0, abs=1.0)


@pytest.mark.parametrize("name", ["dis", "pyramid_fast", "pyramid_fast+rest"])
def test_any_flow_by_name_comes_with_what_is_hidden(name: str) -> None:
    first, second = _pictures(2, 64, 96)  # which need no padding
    flow = make_flow(name)
    found = estimate(flow, first, second)
    np.testing.assert_allclose(found.forward_px, flow(first, second), atol=1e-4)
    np.testing.assert_allclose(found.backward_px, flow(second, first), atol=1e-4)
    whole = consistency(found.forward_px, found.backward_px)
    np.testing.assert_allclose(found.forward_confidence, whole, atol=1e-5)
    np.testing.assert_array_equal(found.forward_occluded, np.asarray(whole) <= 0.5)


@pytest.mark.ci
def test_networks_without_weights_and_variants_of_a_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'raft_small' has no packaged weights.*flow=raft_small"):
        make_flow("raft_small")
    mine = tmp_path / "mine.safetensors"
    mine.write_bytes((tagjax.flow.weights.PACKAGED / "pyramid.safetensors").read_bytes())
    assert flow_key(f"pyramid_fine:{mine}") == flow_key("pyramid_fine") != flow_key(f"pyramid_mid:{mine}+rest")
    first, second = _pictures(2, 70, 80)
    np.testing.assert_array_equal(
        make_flow(f"pyramid_mid:{mine}")(first, second), make_flow("pyramid_mid")(first, second)
    )
    with pytest.raises(ValueError, match=r"No weights at 'none\.safetensors'"):
        make_flow("pyramid_mid:none.safetensors")


def test_the_package_gives_flows_by_name() -> None:
    assert tagjax.flow.make_flow is make_flow
    assert tagjax.flow.estimate is estimate
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        tagjax.flow.nothing  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.ci
def test_documented_flow_of_two_pictures_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[1] / "docs" / "flow.md").read_text()
    code = text.split("```python\n")[1].split("```")[0]
    for name, picture in zip(("a.png", "b.png"), _pictures(2, 70, 80), strict=True):
        cv2.imwrite(str(tmp_path / name), picture)
    monkeypatch.chdir(tmp_path)
    exec(code, {})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"refinements": -1}, "refinements is -1; expected at least 0"),
        ({"patch_stride": 9}, "patch_stride is 9; expected 1 to 8 pixels"),
        ({"preset": "slow"}, "Unknown DIS preset 'slow'; expected one of ultrafast, fast, medium"),
    ],
)
def test_dis_refuses_impossible_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DISFlow(**settings)
