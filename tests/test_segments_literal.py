"""With its other stages off, segments of one pixel and motion by whole pixels, the tracer on segments is the literal one (Eqs. 3-7)."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from segments_scenes import pinhole

from tagjax.radio.arrivals import Arrivals
from tagjax.radio.reads import PhaseReads, RadioWindow
from tagjax.tagattention.literal import FLOOR, TagAttentionLiteral
from tagjax.tagattention.segments import Segmenter, SegmentTracker, TagAttention
from tagjax.tagattention.segments.attention import AttentionEvidence, VelocityGate
from tagjax.tagattention.segments.cut import cut_segments
from tagjax.tracing.tracer import Camera, Frame

HEIGHT, WIDTH, WINDOW, NUM_FRAMES = 18, 24, 5, 17
CAMERA = dataclasses.replace(pinhole(HEIGHT, WIDTH, 30.0), antennas_m=jnp.array([[0.3, -0.2, 0.1]]))
PIXELS = SegmentTracker(
    background=None,
    segmenter=Segmenter(num_segments=HEIGHT * WIDTH + 1, min_side_px=1, max_side_px=1, start_side_px=1, min_pixels=0),
)
EVIDENCE = AttentionEvidence(VelocityGate(threshold_m_s=0.1, width_m_s=1e-7), floor=FLOOR, memory_s=None)
ON_SEGMENTS = TagAttention(
    segments=PIXELS,
    travel=None,
    dwell=None,
    attention=EVIDENCE,
    body=None,
    competition=None,
    whole=None,
    hidden=None,
    free=None,
)
LITERAL = TagAttentionLiteral(refine=False)


def _frames() -> Frame:
    """A block that comes nearer and moves by a pixel a frame, and changes places with what is in front of it.

    Each pixel of block and wall has a motion in depth of its own as well. Two tags: one on the block, and one that rests
    now and then; the first frames and one later have no known range.
    """
    rng = np.random.default_rng(0)
    time_s = np.arange(NUM_FRAMES) / 30.0
    point = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)  # which point of the scene a pixel shows
    speed = rng.normal(0, 0.01, point.size)
    own = point[6:12, 2:10].reshape(-1)
    speed[own] = 0.1 * speed[own] - 0.4
    depth_m, forward, backward = [], [], []
    for t in range(NUM_FRAMES):
        ahead, behind = np.zeros((HEIGHT, WIDTH, 2), np.float32), np.zeros((HEIGHT, WIDTH, 2), np.float32)
        if t and t % 6:  # it pauses in the picture every sixth frame
            left = 2 + sum(1 for earlier in range(1, t) if earlier % 6)
            block = slice(6, 12), slice(left, left + 8)
            ahead[block] = (1, 0)
            ahead[6:12, left + 8] = (-8, 0)
            behind[6:12, left + 1 : left + 9] = (-1, 0)
            behind[6:12, left] = (8, 0)
            row, column = np.mgrid[:HEIGHT, :WIDTH]
            point = point[row, column + behind[..., 0].astype(int)]
        depth_m.append(2.0 + speed[point] * time_s[t])
        forward.append(ahead)
        backward.append(behind)
    own = np.stack([-0.4 * time_s, 0.1 * np.sin(9 * time_s)])
    past = np.maximum(np.arange(NUM_FRAMES)[:, None] + np.arange(1 - WINDOW, 1), 0)
    relative = (own[:, past] - own[:, past[:, :1]]).transpose(1, 0, 2)[:, :, None]
    std = np.zeros_like(relative)
    std[: WINDOW - 1], std[15, 1] = np.inf, np.inf
    nothing, no_read = jnp.zeros((NUM_FRAMES, 2, 1, 1)), jnp.zeros((NUM_FRAMES, 1))
    whole = jnp.zeros((NUM_FRAMES, 1), jnp.int32)
    real = lambda values: jnp.asarray(np.asarray(values), float)  # noqa: E731
    return Frame(
        time_s=real(time_s),
        depth_m=real(depth_m),
        backward_px=real(backward),
        forward_px=real(forward),
        radio=RadioWindow(real(relative), real(std)),
        reads=PhaseReads(nothing, nothing, nothing, nothing, nothing.astype(jnp.int32), nothing > 0),
        arrivals=Arrivals(whole, whole, no_read, no_read, no_read, whole, no_read, valid=whole > 0),
        present=jnp.ones((NUM_FRAMES, 2), bool),
    )


def _run(tracer, frames: Frame, camera: Camera):
    """The states and traces of all frames."""

    @eqx.filter_jit
    def run(tracer, frames):
        first = jax.tree.map(lambda leaf: leaf[0], frames)

        def step(state, frame):
            state, trace = tracer.step(camera, state, frame)
            return state, (state, trace)

        return jax.lax.scan(step, tracer.init(camera, first), frames)[1]

    return run(tracer, frames)


def _double(tree):
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float64) if leaf.dtype == jnp.float32 else leaf, tree)


@pytest.fixture(scope="module")
def both():
    """In float64: the wall's depth changes by 0.3 mm a frame, of which float32 leaves three digits to the correlation."""
    with jax.enable_x64(True):
        frames, camera = _frames(), _double(CAMERA)
        runs = [_run(_double(tracer), frames, camera) for tracer in (ON_SEGMENTS, LITERAL)]
        return jax.tree.map(np.asarray, runs)


def _pictures(state) -> np.ndarray:
    """Log likelihoods of the segments as pictures: (time, tag, height, width)."""
    labels, table = np.asarray(state.segments.segments.labels), np.asarray(state.tags.attention.log_likelihood)
    return np.stack([of_frame[:, slots] for of_frame, slots in zip(table, labels, strict=True)])


def test_log_odds_are_the_literal_ones(both):
    """Within what the parameters' float32 logarithms leave, 1e-7 of the value."""
    (ours, _), (theirs, _) = both
    found, want = _pictures(ours), np.asarray(theirs.log_likelihood)
    assert want.min() < -50
    assert np.unique(want[-1]).size > 400
    np.testing.assert_allclose(found, want, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(np.exp(found), np.exp(want), atol=1e-8)


def test_masks_and_boxes_are_the_literal_ones(both):
    (_, ours), (_, theirs) = both
    np.testing.assert_array_equal(ours.mask, theirs.mask)
    some = np.sum(theirs.mask, axis=(2, 3)) > 0
    assert some[WINDOW:].all()
    np.testing.assert_allclose(np.asarray(ours.box_px)[some], np.asarray(theirs.box_px)[some])
    np.testing.assert_allclose(np.asarray(ours.centre_px)[some], np.asarray(theirs.centre_px)[some], rtol=1e-5)
    np.testing.assert_allclose(np.asarray(ours.centre_m)[some], np.asarray(theirs.centre_m)[some], atol=1e-6)


def test_a_stage_that_is_off_has_no_state(both):
    (state, _), _ = both
    off = state.tags.dwell, state.tags.body, state.tags.hidden, state.tags.travel, state.segments.background
    assert jax.tree.leaves(off) == []
    assert set(ON_SEGMENTS.physical()) < set(TagAttention(attention=EVIDENCE).physical())
    assert ON_SEGMENTS.with_physical(ON_SEGMENTS.physical()).body is None


def test_the_cut_is_the_segments_beyond_the_last_corner():
    likelihood = jnp.log(jnp.array([[0.99, 0.995, 1.0, 0.1, 0.1, 0.11, 0.1, 1.0]]))
    exists = jnp.array([True] * 7 + [False])
    np.testing.assert_array_equal(cut_segments(likelihood, exists), [[1, 1, 1, 0, 0, 0, 0, 0]])
    np.testing.assert_array_equal(cut_segments(jnp.zeros((1, 8)), exists), jnp.zeros((1, 8)))
    assert not np.any(cut_segments(likelihood, jnp.zeros(8, bool)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dwell": None, "hidden": None}, "dwell and attention are both off"),
        ({"dwell": None, "attention": EVIDENCE}, "Set hidden to null"),
        ({"body": None}, "Set whole to null"),
        ({"travel": None}, "body is on and travel is off"),
    ],
)
def test_stages_that_need_each_other(settings, message):
    with pytest.raises(ValueError, match=message):
        TagAttention(**settings)
