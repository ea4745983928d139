"""A second antenna: what it adds to the tracer, and that the published methods refuse it."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic_clips import CARRIER_HZ
from test_segment_tracer import TRACER, clip_of, scene

from tagjax.core.geometry import pixel_rays
from tagjax.core.numerics import SPEED_OF_LIGHT_M_S
from tagjax.recording import Intrinsics, Recording, TagReads
from tagjax.tagattention import TagAttention
from tagjax.tagattention.literal import TagAttentionLiteral
from tagjax.tagattention.published import TagAttentionPublished
from tagjax.tagattention.segments import Segmenter, SegmentTracker
from tagjax.tracing.clips import Clip, load_clip
from tagjax.tracing.tracer import AbstractTracer, trace

HEIGHT, WIDTH, FOCAL_PX = 48, 64, 40.0
ANTENNAS_M = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 2.0]])
LENS = Intrinsics(FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
NUM_FRAMES = 45
EPCS = ["left", "right"]


def _boxes() -> np.ndarray:
    boxes = np.zeros((2, HEIGHT, WIDTH), bool)
    boxes[0, 12:36, 6:24] = boxes[1, 12:36, 40:58] = True
    return boxes


def _depth_m(time_s: np.ndarray) -> np.ndarray:
    return 2.0 + 0.4 * np.cos(2.5 * time_s)


def _side_by_side(num_frames: int = NUM_FRAMES) -> Recording:
    """Two boxes that come and go alike, as far left of the middle as right; each carries a tag.

    To an antenna in the middle both are always equally far; as one at the side sees it, one comes while the other goes.
    """
    time_s = np.arange(num_frames) / 15
    read_s = np.arange(0, time_s[-1], 1 / 120)
    rays = pixel_rays(LENS)
    depth = np.full((num_frames, HEIGHT, WIDTH), 4.0, np.float32)
    depth[:, _boxes().any(axis=0)] = _depth_m(time_s)[:, None]
    middles = np.stack([rays[[23, 24], columns].mean(axis=0) for columns in (14, 49)])
    points = middles[:, None] * _depth_m(read_s)[None, :, None]
    range_m = np.linalg.norm(points[:, None] - ANTENNAS_M[None, :, None], axis=-1)  # tag, antenna, read
    np.testing.assert_allclose(range_m[0, 0], range_m[1, 0], atol=1e-9)
    order = np.arange(len(read_s))
    tag, antenna = order % 2, order // 2 % 2
    phase_rad = 4 * np.pi * CARRIER_HZ / SPEED_OF_LIGHT_M_S * range_m[tag, antenna, order] + tag + 2.0 * antenna
    reads = TagReads(
        epc=np.array(EPCS)[tag],
        time_ns=np.rint(read_s * 1e9).astype(np.int64),
        antenna=(antenna + 1).astype(np.int16),
        carrier_hz=np.full(len(order), CARRIER_HZ),
        phase_rad=np.mod(phase_rad, 2 * np.pi),
        rssi_dbm=np.full(len(order), -55, np.float32),
        doppler_hz=np.full(len(order), np.nan, np.float32),
    )
    return Recording(
        colour=np.full((num_frames, HEIGHT, WIDTH, 3), 90, np.uint8),
        depth=depth,
        time_ns=np.rint(time_s * 1e9).astype(np.int64),
        intrinsics=LENS,
        reads=reads,
        antennas_m=ANTENNAS_M,
    )


def _clip() -> Clip:
    return load_clip(_side_by_side(), 0, NUM_FRAMES, stride=1, flow="zero", epcs=EPCS, antennas="all")


@pytest.mark.ci
def test_a_second_antenna_splits_what_one_cannot() -> None:
    clip = _clip()
    tracer = TagAttention(segments=SegmentTracker(segmenter=Segmenter(num_segments=256)))
    found = eqx.filter_jit(trace)(tracer, clip.camera, clip.frames)
    assert np.asarray(found.detected[-1]).all()
    for mask, box in zip(np.asarray(found.mask[-1]) > 0.5, _boxes(), strict=True):
        assert (mask & box).sum() / (mask | box).sum() > 0.6


@pytest.mark.ci
def test_an_antenna_without_reads_changes_nothing() -> None:
    clip, run = clip_of(scene(30)), eqx.filter_jit(trace)
    twice = lambda part: jax.tree.map(lambda leaf: np.concatenate([leaf, leaf], axis=2), part)  # noqa: E731
    frames = eqx.tree_at(lambda f: (f.radio, f.reads), clip.frames, twice((clip.frames.radio, clip.frames.reads)))
    camera = eqx.tree_at(lambda c: c.antennas_m, clip.camera, jnp.asarray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5]]))
    one, two = run(TRACER, clip.camera, clip.frames), run(TRACER, camera, frames)
    assert bool(jnp.all(one.detected[-1]))
    np.testing.assert_array_equal(two.status, one.status)
    np.testing.assert_allclose(two.mask, one.mask, atol=1e-4)
    np.testing.assert_allclose(two.confidence, one.confidence, atol=1e-4)


@pytest.mark.parametrize("tracer", [TagAttentionLiteral(), TagAttentionPublished()])
def test_the_published_methods_refuse_a_second_antenna(tracer: AbstractTracer) -> None:
    clip = _clip()
    with pytest.raises(ValueError, match="one antenna; the clip has 2"):
        tracer.init(clip.camera, jax.tree.map(lambda leaf: leaf[0], clip.frames))
