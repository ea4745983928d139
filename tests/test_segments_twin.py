"""The tracer on segments agrees with its NumPy twin on a simulated clip, frame by frame, from pixels to boxes."""

from __future__ import annotations

import dataclasses
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.benchmarks.segments_numpy import NumpyTracer
from tagjax.sim.record import CaptureSettings, simulate_recording
from tagjax.sim.stories import build_scenario
from tagjax.tagattention.segments import Segmenter, SegmentTracker, TagAttention
from tagjax.tagattention.segments.attention import AttentionEvidence
from tagjax.tracing.clips import load_clip

NUM_FRAMES = 40
TRACER = TagAttention(segments=SegmentTracker(segmenter=Segmenter(num_segments=1024)))


@pytest.fixture(scope="module")
def clip():
    pytest.importorskip("mujoco", reason="needs the sim extra")
    settings = {"kinds": ["box", "bag"], "num_walkers": 1, "stationary_s": 0.3}
    scenario = build_scenario("handheld", np.random.default_rng(0), 3.0, settings)
    capture = CaptureSettings(width=128, frame_rate_hz=15.0, shadows=False)
    recording = simulate_recording(scenario, capture, seed=0, name="twin", num_frames=NUM_FRAMES)
    return load_clip(recording, 0, NUM_FRAMES, stride=1, flow="dis", epcs=list(recording.reads.epcs))


@pytest.mark.parametrize("without", [(), ("whole", "hidden")], ids=["whole tracer", "stages off"])
def test_labels_memberships_and_boxes_are_those_of_numpy(clip, without):
    tracer = dataclasses.replace(TRACER, **dict.fromkeys(without))
    depth_m = clip.frames.depth_m.at[20].set(0.0)  # a frame without depth
    backward_px = clip.frames.backward_px.at[25, :9].set(jnp.nan)
    present = clip.frames.present.at[:10, 1].set(False)
    frames = eqx.tree_at(lambda f: (f.depth_m, f.backward_px, f.present), clip.frames, (depth_m, backward_px, present))
    first = jax.tree.map(lambda leaf: leaf[0], frames)
    _, expected = jax.jit(
        lambda clip: jax.lax.scan(
            lambda state, frame: tracer.follow(clip[0], state, frame), tracer.init(clip[0], first), clip[1]
        )
    )((clip.camera, frames))
    host, expected = jax.tree.map(np.asarray, (frames, expected))
    twin, moving = NumpyTracer(tracer, clip.camera, len(clip.epcs)), 0
    for t in range(NUM_FRAMES):
        frame, own = jax.tree.map(operator.itemgetter(t), (host, expected))
        found = twin.follow(frame)
        np.testing.assert_array_equal(found.labels, own.labels, err_msg=f"frame {t}")
        # Two compilations of the tracer itself, with and without XLA's optimisations, differ by 1e-3 here at frame 6.
        np.testing.assert_allclose(found.membership, own.tags.membership, atol=2e-3, err_msg=f"frame {t}")
        np.testing.assert_array_equal(found.box_px, own.box_px, err_msg=f"frame {t}")
        np.testing.assert_allclose(found.centre_px, own.centre_px, atol=1e-3, err_msg=f"frame {t}")
        np.testing.assert_allclose(found.confidence, own.tags.confidence, atol=1e-3, err_msg=f"frame {t}")
        np.testing.assert_array_equal(found.detected, own.tags.detected, err_msg=f"frame {t}")
        mask = twin.masks(found)
        np.testing.assert_array_equal(mask > 0.5, (own.tags.membership > 0.5)[:, np.maximum(own.labels, 0)])
        moving += int((mask > 0.5).any(axis=(1, 2)).sum())
    assert moving > NUM_FRAMES  # of 2 x 40: there was something to agree on


def test_a_stage_without_a_twin_is_refused(clip):
    with pytest.raises(ValueError, match="attention is on; expected null"):
        NumpyTracer(dataclasses.replace(TRACER, attention=AttentionEvidence()), clip.camera, 1)
