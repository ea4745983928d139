"""The tracer on segments as a whole: two objects in closed form, a gap in the reads, stationary tags, jit, batches, gradients."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from composed import composed
from synthetic_clips import BOXES, CARRIER_HZ, EPCS, offset_m, recording

from tagjax.core.build import build
from tagjax.core.numerics import SPEED_OF_LIGHT_M_S
from tagjax.recording import Intrinsics, Recording
from tagjax.tagattention.segments import Segmenter, SegmentTracker, TagAttention
from tagjax.tagattention.segments.attention import AttentionEvidence
from tagjax.tagattention.segments.detection import Detection
from tagjax.tagattention.tracer_settings import make_tracer
from tagjax.tracing.clips import load_clip
from tagjax.tracing.live import LiveTracer
from tagjax.tracing.status import Status
from tagjax.tracing.tracer import trace

CONF = Path(__file__).parents[1] / "conf/tracer/tagattention.yaml"
TRACER = TagAttention(segments=SegmentTracker(segmenter=Segmenter(num_segments=512)))


def scene(num_frames: int = 60, scale: int = 2, *, rate_hz: float = 15.0) -> Recording:
    """The scene of `synthetic_clips`, enlarged, one object well behind the other: what is near in space is taken for one."""
    small = recording(num_frames, rate_hz=rate_hz)
    apart = np.where(np.asarray(small.truth.labels) == 2, np.float32(0.8), np.float32(0.0))
    small = dataclasses.replace(small, depth=np.asarray(small.depth) + apart)
    wide = lambda frames: np.repeat(np.repeat(frames, scale, axis=1), scale, axis=2)  # noqa: E731
    height, width = small.intrinsics.height * scale, small.intrinsics.width * scale
    focal = 1e4 * scale
    intrinsics = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    truth = dataclasses.replace(small.truth, labels=wide(small.truth.labels))
    return dataclasses.replace(
        small, colour=wide(small.colour), depth=wide(small.depth), intrinsics=intrinsics, truth=truth
    )


def clip_of(one: Recording, start: int = 0, stop: int | None = None):
    return load_clip(one, start, stop or one.num_frames, stride=1, flow="zero", epcs=list(EPCS))


@pytest.fixture(scope="module")
def clip():
    return clip_of(scene())


@pytest.fixture(scope="module")
def traced(clip):
    return eqx.filter_jit(trace)(TRACER, clip.camera, clip.frames)


def test_two_objects_are_found_and_outlined(traced):
    late = slice(30, None)
    assert bool(jnp.all(traced.detected[late]))
    np.testing.assert_array_equal(traced.status == Status.DETECTED, traced.detected)
    for tag, label in enumerate(EPCS.values()):
        x0, y0, x1, y1 = BOXES[label]
        np.testing.assert_allclose(traced.box_px[late, tag], [[2 * x0, 2 * y0, 2 * x1 + 1, 2 * y1 + 1]] * 30, atol=1.0)
        mask = np.asarray(traced.mask[late, tag]) > 0.5
        true = np.asarray(scene().truth.labels)[late] == label
        assert np.sum(mask & true) / np.sum(mask | true) > 0.9


def test_the_papers_equations_alone_find_both_objects(clip):
    """`tracer=tagattention_equations`: attention in place of dwells, and no other use of the reads."""
    settings = composed("evaluate", "tracer=tagattention_equations", "tracer.segments.segmenter.num_segments=512")
    tracer = make_tracer(settings["tracer"])
    assert isinstance(tracer, TagAttention)
    assert tracer.dwell is tracer.hidden is tracer.free is None
    found = eqx.filter_jit(trace)(tracer, clip.camera, clip.frames)
    assert bool(jnp.all(found.detected[40:]))
    for tag, label in enumerate(EPCS.values()):
        x0, y0, x1, y1 = BOXES[label]
        np.testing.assert_allclose(found.box_px[40:, tag], [[2 * x0, 2 * y0, 2 * x1 + 1, 2 * y1 + 1]] * 20, atol=1.0)


def test_steps_and_places_are_those_of_the_objects(traced, clip):
    true = [np.asarray(scene().truth.tag_range_m[epc]) for epc in EPCS]
    for tag in range(2):
        np.testing.assert_allclose(traced.step_m[30:, tag, 0], np.diff(true[tag])[29:], atol=2e-3)
        np.testing.assert_allclose(traced.centre_m[30:, tag, 2], true[tag][30:] + 0.8 * tag, atol=5e-3)


def test_a_place_without_a_tag_changes_nothing_and_is_never_detected(clip, traced):
    wider = jax.tree.map(
        lambda leaf: jnp.concatenate([leaf, leaf[:, :1]], axis=1), (clip.frames.radio, clip.frames.reads)
    )
    present = jnp.concatenate([clip.frames.present, jnp.zeros((60, 1), bool)], axis=1)
    frames = eqx.tree_at(lambda f: (f.radio, f.reads, f.present), clip.frames, (*wider, present))
    found = eqx.filter_jit(trace)(TRACER, clip.camera, frames)
    np.testing.assert_allclose(found.mask[:, :2], traced.mask, atol=1e-5)
    assert not bool(jnp.any(found.detected[:, 2]))
    assert float(jnp.max(found.confidence[:, 2])) == 0.0
    assert bool(jnp.all(found.status[:, 2] == Status.UNKNOWN))


def test_detections_end_with_the_reads(clip):
    late = clip.frames.time_s[:, None] > 2.0
    valid = clip.frames.arrivals.valid & ~late
    frames = eqx.tree_at(lambda f: f.arrivals.valid, clip.frames, valid)
    tracer = eqx.tree_at(lambda t: t.detection, TRACER, Detection(fresh_s=0.2))
    found = eqx.filter_jit(trace)(tracer, clip.camera, frames)
    assert bool(jnp.all(found.detected[29]))
    assert not bool(jnp.any(found.detected[-5:]))
    assert bool(jnp.all(found.status[-5:] == Status.NOT_READ))


def test_an_object_behind_another_is_occluded_while_its_tag_is_read(clip, traced):
    """A board comes between one object and the camera, and stays; that tag's reads go on."""
    x0, y0, x1, y1 = (2 * edge for edge in BOXES[1])
    depth_m = clip.frames.depth_m.at[40:, y0 - 2 : y1 + 4, x0 - 2 : x1 + 4].set(1.0)
    found = eqx.filter_jit(trace)(TRACER, clip.camera, eqx.tree_at(lambda f: f.depth_m, clip.frames, depth_m))
    np.testing.assert_array_equal(found.status[:40], traced.status[:40])
    assert bool(jnp.all(found.status[42:52, 0] == Status.OCCLUDED))
    assert bool(jnp.all(found.detected[42:, 1]))


@pytest.mark.parametrize(("phase_rad", "reason"), [("zero", Status.STATIONARY), ("random", Status.NOT_FOUND)])
def test_phases_that_no_object_explains_are_no_detection(clip, phase_rad, reason):
    shape = clip.frames.arrivals.phase_rad.shape
    rng = np.random.default_rng(0)
    phases = jnp.zeros(shape) if phase_rad == "zero" else jnp.asarray(rng.uniform(0, 2 * np.pi, shape), jnp.float32)
    frames = eqx.tree_at(lambda f: f.arrivals.phase_rad, clip.frames, phases)
    found = eqx.filter_jit(trace)(TRACER, clip.camera, frames)
    assert float(jnp.mean(found.detected)) <= 0.02
    assert float(jnp.mean(found.status[10:] == reason)) > 0.95


def _followed(one: Recording, epc: str, label: int) -> Recording:
    """The recording with the reads of a tag on this object."""
    own, time_s = one.reads.epc == epc, one.reads.time_ns * 1e-9
    phase_rad = np.mod(4 * np.pi * CARRIER_HZ / SPEED_OF_LIGHT_M_S * offset_m(label, time_s) + 1.0, 2 * np.pi)
    return dataclasses.replace(
        one, reads=dataclasses.replace(one.reads, phase_rad=np.where(own, phase_rad, one.reads.phase_rad))
    )


def test_two_tags_of_one_object_both_find_it(traced):
    """The competition between tags is one of different objects."""
    clip = clip_of(_followed(scene(), "tag-a", 2))
    found = eqx.filter_jit(trace)(TRACER, clip.camera, clip.frames)
    assert bool(jnp.all(found.detected[30:]))
    for tag in range(2):
        np.testing.assert_allclose(found.box_px[30:, tag], traced.box_px[30:, 1], atol=1.0)


def test_a_tag_alone_is_traced_as_it_is_among_others(clip, traced):
    alone = jnp.broadcast_to(jnp.asarray([True, False]), clip.frames.present.shape)
    valid = clip.frames.arrivals.valid & (clip.frames.arrivals.tag == 0)
    frames = eqx.tree_at(lambda f: (f.present, f.arrivals.valid), clip.frames, (alone, valid))
    found = eqx.filter_jit(trace)(TRACER, clip.camera, frames)
    assert not bool(jnp.any(found.detected[:, 1]))
    np.testing.assert_array_equal(found.detected[30:, 0], traced.detected[30:, 0])
    np.testing.assert_array_equal(found.mask[30:, 0] > 0.5, traced.mask[30:, 0] > 0.5)


def test_tags_in_another_order_are_traced_alike(clip, traced):
    turned = jax.tree.map(lambda leaf: leaf[:, ::-1], (clip.frames.radio, clip.frames.reads, clip.frames.present))
    of = lambda f: (f.radio, f.reads, f.present, f.arrivals.tag)  # noqa: E731
    frames = eqx.tree_at(of, clip.frames, (*turned, 1 - clip.frames.arrivals.tag))
    found = eqx.filter_jit(trace)(TRACER, clip.camera, frames)
    np.testing.assert_array_equal(found.status[:, ::-1], traced.status)
    np.testing.assert_allclose(found.mask[:, ::-1], traced.mask, atol=1e-4)
    np.testing.assert_allclose(found.confidence[:, ::-1], traced.confidence, atol=1e-4)


def test_the_time_of_the_first_frame_does_not_matter(clip, traced):
    later = jax.tree.map(lambda leaf: leaf + 8.0, (clip.frames.time_s, clip.frames.arrivals.time_s))
    frames = eqx.tree_at(lambda f: (f.time_s, f.arrivals.time_s), clip.frames, later)
    found = eqx.filter_jit(trace)(TRACER, clip.camera, frames)
    np.testing.assert_array_equal(found.status, traced.status)
    np.testing.assert_allclose(found.mask, traced.mask, atol=1e-2)
    np.testing.assert_allclose(found.box_px, traced.box_px, atol=1e-2)


def test_without_reads_nothing_is_detected(clip):
    frames = eqx.tree_at(lambda f: f.arrivals.valid, clip.frames, jnp.zeros_like(clip.frames.arrivals.valid))
    found = eqx.filter_jit(trace)(TRACER, clip.camera, frames)
    assert not bool(jnp.any(found.detected))
    assert bool(jnp.all(found.status == Status.NOT_READ))


def test_a_given_object_is_outlined_as_it_is_given(clip, traced):
    """One object's segments are given: its mask is exactly that, and the other object is traced as before."""
    labels = np.asarray(scene().truth.labels)
    objects = jnp.asarray(np.where(labels == 1, 3, 0), jnp.int32)  # any number
    frames = eqx.tree_at(lambda f: f.objects, clip.frames, objects, is_leaf=lambda leaf: leaf is None)
    found = eqx.filter_jit(trace)(TRACER, clip.camera, frames)
    assert bool(jnp.all(found.detected[30:]))
    np.testing.assert_array_equal(found.mask[30:, 0] > 0.5, labels[30:] == 1)
    np.testing.assert_array_equal(found.mask[30:, 1] > 0.5, traced.mask[30:, 1] > 0.5)


@pytest.mark.parametrize("broken", ["depth", "flow"])
def test_a_frame_without_depth_or_flow_is_survived(clip, broken):
    if broken == "depth":
        frames = eqx.tree_at(lambda f: f.depth_m, clip.frames, clip.frames.depth_m.at[40].set(0.0))
    else:
        frames = eqx.tree_at(lambda f: f.backward_px, clip.frames, clip.frames.backward_px.at[40].set(jnp.nan))
    found = eqx.filter_jit(trace)(TRACER, clip.camera, frames)
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(found) if leaf.dtype == jnp.float32)
    assert bool(jnp.all(found.detected[-5:]))


def test_a_batch_is_a_loop(clip, traced):
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (clip.camera, clip.frames))
    found = eqx.filter_jit(eqx.filter_vmap(lambda camera, frames: trace(TRACER, camera, frames)))(*both)
    np.testing.assert_allclose(found.mask[1], traced.mask, atol=1e-4)


@pytest.mark.ci
def test_every_stage_has_a_finite_gradient(clip):
    frames = jax.tree.map(lambda leaf: leaf[:24], clip.frames)
    tracer = eqx.tree_at(lambda t: t.attention, TRACER, AttentionEvidence(), is_leaf=lambda leaf: leaf is None)

    @eqx.filter_jit
    @eqx.filter_grad
    def gradient(both):
        one, backward_px = both
        found = trace(one, clip.camera, eqx.tree_at(lambda f: f.backward_px, frames, backward_px))
        return jnp.sum(found.confidence) + jnp.mean(found.mask) + jnp.sum(found.step_m**2)

    found, flow = gradient((tracer, frames.backward_px))
    values = found.physical()
    assert all(np.isfinite(value) for value in values.values())
    assert bool(jnp.all(jnp.isfinite(flow)))
    moved = {name.split(".")[0] for name, value in values.items() if value != 0}
    assert {"reader", "dwell", "attention", "body", "detection"} <= moved
    assert bool(jnp.any(flow != 0))


def test_live_is_the_same_tracer(clip, traced):
    one = scene()
    no_flow = lambda first, _: np.zeros((*first.shape[:2], 2), np.float32)  # noqa: E731
    live = LiveTracer(TRACER, one.intrinsics, one.antennas_m, flow=no_flow, stride=1, num_places=2)
    last, out = -1, None
    for number in range(one.num_frames):
        now = int(one.time_ns[number])
        new = one.reads[(one.reads.time_ns > last) & (one.reads.time_ns <= now)]
        out = live.process(np.asarray(one.colour[number]), one.depth_metres(number), now, new)
        last = now
    assert out is not None
    places = [out.places[epc] for epc in EPCS]
    np.testing.assert_allclose(out.trace.box_px[jnp.array(places)], traced.box_px[-1], atol=1e-3)
    np.testing.assert_allclose(out.trace.tags.confidence[jnp.array(places)], traced.confidence[-1], atol=1e-2)
    with pytest.raises(ValueError, match="expected a later time"):
        live.process(np.asarray(one.colour[0]), one.depth_metres(0), last, one.reads[:0])


def test_a_live_tracer_compiles_its_step_once(clip):
    """The types of the state, weak ones as well, are the same before the first frame and after it."""

    def types(state):
        return [(leaf.shape, leaf.dtype, leaf.weak_type) for leaf in jax.tree.leaves(state)]

    first = jax.tree.map(lambda leaf: leaf[0], clip.frames)
    tracer = eqx.tree_at(lambda t: t.attention, TRACER, AttentionEvidence(), is_leaf=lambda leaf: leaf is None)
    begin = eqx.filter_eval_shape(tracer.init, clip.camera, first)
    other = eqx.filter_eval_shape(tracer.with_tags, clip.camera, begin, jnp.arange(2))
    later = eqx.filter_eval_shape(tracer.shifted, begin, jnp.zeros(()))
    after, _ = eqx.filter_eval_shape(tracer.follow, clip.camera, begin, first)
    for state in (other, later, after):
        assert types(state) == types(begin)


def test_the_configuration_is_the_default():
    settings = {name: value for name, value in yaml.safe_load(CONF.read_text()).items() if name != "clips"}
    built = build(settings, {settings["_target_"]: TagAttention}, where="tracer")
    assert eqx.tree_equal(built, TagAttention())
