"""Flow network and tracer learned together: the same flow as the cache's, true gradients, a run and its evaluation."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic_clips as synthetic
from test_flow_training import small_network

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.flow.losses import FlowLossSettings
from tagjax.flow.pyramid import PyramidFlow
from tagjax.flow.stationary import is_moving, zero_stationary
from tagjax.flow.weights import load_network, save_weights
from tagjax.recording import Recording
from tagjax.recording.store import save_recording
from tagjax.tagattention.literal import TagAttentionLiteral
from tagjax.tracing.clips import Clip, load_clip
from tagjax.training.config import TrainConfig
from tagjax.training.joint import JointModel, network_flow
from tagjax.training.objective import ObjectiveSettings
from tagjax.training.run import make_model, run_training
from tagjax.training.step import clip_gradient, clip_loss

PAN_PX = 2
LOSS = FlowLossSettings(occlusion_after=0)
OBJECTIVE = ObjectiveSettings(memory=1.0, span_frames=6, skip_frames=3, max_reads=128, num_channels=4, future_stride=1)
KEY = jax.random.PRNGKey(0)


def _panned(num_frames: int = 12, **which: Any) -> Recording:
    """The tiny scene, four times as large, with a texture that runs to the left over all of it."""
    whole = synthetic.enlarged(synthetic.recording(num_frames, **which), 4)
    height, width = whole.colour.shape[1:3]
    rng = np.random.default_rng(3)
    texture = rng.uniform(20, 235, (height // 4, (width + PAN_PX * num_frames) // 4 + 1, 3))
    texture = np.kron(texture, np.ones((4, 4, 1)))
    colour = np.stack([texture[:, PAN_PX * t : PAN_PX * t + width] for t in range(num_frames)])
    return dataclasses.replace(whole, colour=np.rint(colour).astype(np.uint8))


def _panning_network(seed: int = 1) -> PyramidFlow:
    """A network of random weights that says about `PAN_PX` to the right, which is the way back in `_panned`."""
    network = small_network(seed)
    biases = lambda n: [decoder.head.bias for decoder in n.decoders]  # noqa: E731
    # In pixels of the levels, 1/4 and 1/8 of the picture's; the rougher one's flow is enlarged and then added to.
    found = [jnp.asarray([0.1 * PAN_PX, 0.02]), jnp.asarray([0.075 * PAN_PX, -0.01])]
    assert [bias.shape for bias in biases(network)] == [(2,), (2,)]
    return eqx.tree_at(biases, network, found)


@pytest.fixture(scope="module")
def clip() -> Clip:
    return load_clip(_panned(), 0, 12, stride=4, colour=True)


def test_what_has_moved_is_what_the_cache_keeps():
    """The function of JAX against OpenCV's warp, which rounds places to 1/32 pixel."""
    rng = np.random.default_rng(0)
    here = _panned(2).colour[0]
    there = _panned(2).colour[1]
    flow = rng.normal((-PAN_PX, 0), 0.4, (*here.shape[:2], 2)).astype(np.float32)
    flow[: here.shape[0] // 2] += 3
    kept = np.any(zero_stationary(flow, here, there) != 0, axis=-1)
    found = eqx.filter_jit(is_moving)(flow, *(np.float32(each) / 255 for each in (here, there)))
    assert 0.2 < kept.mean() < 0.8
    assert np.mean(kept == np.asarray(found)) > 0.995


@pytest.mark.ci
def test_flow_inside_the_objective_is_the_cached_flow(tmp_path: Path, clip):
    network = _panning_network()
    weights = tmp_path / "flow.safetensors"
    settings = {
        "_target_": "tagjax.flow.pyramid.PyramidFlow",
        "widths": [8, 8],
        "radii": [1, 1],
        "decoder_widths": [[8], [8]],
    }
    save_weights(weights, network, {"flow": settings})
    cached = load_clip(_panned(), 0, 12, stride=4, flow=str(weights))
    flow, loss, terms = eqx.filter_jit(network_flow)(network, clip.frames, LOSS)
    moved = np.any(np.asarray(cached.frames.backward_px) != 0, axis=-1)
    assert moved[1:].mean() > 0.5
    for name in ("forward_px", "backward_px"):
        close = np.abs(np.asarray(getattr(flow, name)) - np.asarray(getattr(cached.frames, name))) < 2e-3
        assert close.mean() > 0.995
    assert np.all(np.asarray(clip.frames.backward_px) == 0)
    assert float(loss) > 0
    assert {"flow/data", "flow/smooth_first"} <= set(terms)


def _in_double(tree):
    wide = lambda leaf: leaf.astype(jnp.float64) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf  # noqa: E731
    return jax.tree.map(lambda leaf: wide(leaf) if eqx.is_array(leaf) else leaf, tree)


@pytest.mark.ci
def test_the_loss_moves_as_its_gradient_says(clip):
    """Flow weights, alpha, beta and v0 through one objective, against central differences in x64."""
    with jax.enable_x64(True):
        # The paper's chain, relaxed: the present tracer has its own test, and takes minutes to compile here.
        tracer = TagAttentionLiteral(refine=False, softness=0.3, v0_m_s=0.3)
        model = _in_double(JointModel(tracer, _panning_network(), 0.1, LOSS))
        frames, camera = _in_double(clip.frames), _in_double(clip.camera)
        slope = jnp.linspace(0.0, 0.6, frames.depth_m.shape[2])
        frames = eqx.tree_at(lambda f: f.depth_m, frames, frames.depth_m + slope.reshape(1, 1, -1))
        # Without coverage: it follows pixels to the nearest pixel, and two compiled programs may round a tie differently.
        objective = dataclasses.replace(OBJECTIVE, coverage=0.0, term_norms=True)
        gradient, logged = clip_gradient(model, camera, frames, KEY, objective)
        loss = lambda model: float(clip_loss(model, camera, frames, KEY, objective)["loss"])  # noqa: E731
        assert float(logged["loss"]) == pytest.approx(loss(model), rel=1e-9)
        rng = np.random.default_rng(5)
        network = eqx.filter(model.network, eqx.is_inexact_array)
        direction = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape) * 0.1), network)

        def along(step: float) -> JointModel:
            moved = jax.tree.map(lambda leaf, by: leaf + step * by, network, direction)
            return eqx.tree_at(lambda m: m.network, model, eqx.combine(moved, model.network))

        predicted = sum(
            float(jnp.sum(a * b))
            for a, b in zip(jax.tree.leaves(gradient.network), jax.tree.leaves(direction), strict=True)
        )
        step = 1e-6
        numeric = (loss(along(step)) - loss(along(-step))) / (2 * step)
        assert abs(predicted) > 1e-4
        assert predicted == pytest.approx(numeric, rel=1e-3)
        for name in ("alpha_m2", "beta", "v0_m_s"):
            where = lambda m, name=name: getattr(m.tracer, name)  # noqa: E731
            ends = [loss(eqx.tree_at(where, model, where(model) + sign * step)) for sign in (1, -1)]
            numeric = (ends[0] - ends[1]) / (2 * step)
            assert abs(numeric) > 1e-7, name
            assert float(where(gradient)) == pytest.approx(numeric, rel=1e-3), name
        # The reads teach the network as well, not only its own loss.
        assert float(logged["gradient_norm/contrast/flow"]) > 0


def test_a_clip_without_pictures_is_refused():
    bare = load_clip(synthetic.recording(4), 0, 4, stride=2, flow="zero")
    with pytest.raises(ValueError, match="colour=True"):
        network_flow(small_network(), bare.frames, LOSS)


def test_settings_that_no_joint_run_can_have():
    least = {"flow": {"_target_": "tagjax.flow.pyramid.PyramidFlow"}, "optimizer": {"_target_": "optax.sgd"}}
    base = {"tracer": {"_target_": "tagjax.tagattention.TagAttention"}, "optimizer": {"_target_": "optax.sgd"}}
    with pytest.raises(ConfigError, match="weight is -1"):
        from_mapping(TrainConfig, {**base, "joint": {**least, "weight": -1}})
    with pytest.raises(ConfigError, match="self_supervision"):
        from_mapping(TrainConfig, {**base, "joint": {**least, "loss": {"self_supervision": 0.3}}})


@pytest.mark.ci
def test_a_joint_run_learns_both_resumes_exactly_and_is_evaluated_with_its_own_flow(tmp_path: Path):
    from tagjax.evaluation.run import restore_state

    small = {"widths": [8, 8], "radii": [1, 1], "decoder_widths": [[8], [8]]}
    # Pictures that change: between equal ones there is no flow, and nothing for a network to learn.
    paths = [str(tmp_path / f"scene{seed}.zarr") for seed in range(2)]
    for seed, path in enumerate(paths):
        save_recording(_panned(24, seed=seed, name=f"scene{seed}"), path)
    values = {
        "tracer": {"_target_": "tagjax.tagattention.literal.TagAttentionLiteral", "refine": False, "softness": 0.3},
        "optimizer": {"_target_": "optax.adam", "learning_rate": 0.01},
        "joint": {
            "flow": {"_target_": "tagjax.flow.pyramid.PyramidFlow", **small},
            "optimizer": {"_target_": "optax.adam", "learning_rate": 1e-3},
            "init": None,
        },
        "objective": {},
        "data": {
            "recordings": paths[:1],
            "validation": paths[1:],
            "clips": {"stride": 4, "length": 8, "flow": "zero"},
        },
        "loop": {"num_steps": 2, "checkpoint_every": 1, "validate_every": 2, "progress": False},
        "logger": {"mode": "disabled"},
        "scores": {"num_pictures": 1},
    }
    config = from_mapping(TrainConfig, values)
    run_training(config, tmp_path / "whole")
    first = from_mapping(TrainConfig, {**values, "loop": {**values["loop"], "num_steps": 1}})
    run_training(first, tmp_path / "parts")
    run_training(config, tmp_path / "parts")
    whole, parts = (restore_state(tmp_path / name, config).model for name in ("whole", "parts"))
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        np.testing.assert_array_equal(one, other)
    fresh = make_model(config)
    for part in ("tracer", "network"):
        before, after = (jax.tree.leaves(eqx.filter(getattr(m, part), eqx.is_inexact_array)) for m in (fresh, whole))
        assert any(np.any(np.asarray(a) != np.asarray(b)) for a, b in zip(before, after, strict=True))
    assert isinstance(whole, JointModel)
    kept = load_network(tmp_path / "whole" / "flow.safetensors")
    for one, other in zip(jax.tree.leaves(kept), jax.tree.leaves(whole.network), strict=True):
        np.testing.assert_array_equal(one, other)
    # The held-out recording holds the flow of the untrained network and of those after one step and two.
    caches = [path.name for path in (Path(paths[1]) / "cache" / "flow").glob("PyramidFlow-*")]
    assert len(caches) == 3
