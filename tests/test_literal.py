"""The literal tracer: the paper's update step by step, gradients, degenerate input; and what enters a tracer at all."""

import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic_clips as synthetic

import tagjax
from tagjax.radio.reads import RadioWindow
from tagjax.tagattention import TagAttention
from tagjax.tagattention.frame_trace import describe
from tagjax.tagattention.literal import FLOOR, TagAttentionLiteral
from tagjax.tagattention.motion import empty_motion, push_splat
from tagjax.tagattention.segments.hindsight import Hindsight
from tagjax.tracing.clips import load_clip
from tagjax.tracing.tracer import Frame, trace


@pytest.fixture(scope="module")
def clip():
    return load_clip(synthetic.recording(24), 0, 24, stride=1)


@pytest.mark.parametrize("tracer", [TagAttention(), TagAttentionLiteral(cell=4)])
def test_a_step_gives_back_the_state_that_it_takes(clip, tracer):
    """In shape and type, weak or not: else the second frame of a recording compiles the step once more."""
    first = jax.tree.map(lambda leaf: leaf[0], clip.frames)
    taken = jax.eval_shape(tracer.init, clip.camera, first)
    given, _ = jax.eval_shape(tracer.step, clip.camera, taken, first)
    assert jax.tree.structure(given) == jax.tree.structure(taken)
    for one, other in zip(jax.tree.leaves(given), jax.tree.leaves(taken), strict=True):
        assert (one.shape, one.dtype, one.weak_type) == (other.shape, other.dtype, other.weak_type)


@eqx.filter_jit
@functools.partial(eqx.filter_value_and_grad, has_aux=True)
def _total_and_gradient(tracer, camera, frames):
    out = trace(tracer, camera, frames)
    return jnp.mean(out.mask) + jnp.sum(jnp.square(out.step_m)) + jnp.mean(out.confidence), out


def _degenerate(frames: Frame):
    yield "no depth", eqx.tree_at(lambda f: f.depth_m, frames, jnp.zeros_like(frames.depth_m))
    nothing = RadioWindow(jnp.zeros_like(frames.radio.relative_m), jnp.full_like(frames.radio.std_m, jnp.inf))
    yield "no radio", eqx.tree_at(lambda f: f.radio, frames, nothing)
    still = RadioWindow(jnp.zeros_like(frames.radio.relative_m), jnp.zeros_like(frames.radio.std_m))
    yield "standing still", eqx.tree_at(lambda f: f.radio, frames, still)


@pytest.mark.ci
def test_gradients_stay_finite_at_degenerate_input(clip):
    """One compilation for all of it."""
    tracer = TagAttentionLiteral(cell=4)
    (_, _), gradient = _total_and_gradient(tracer, clip.camera, clip.frames)
    assert all(bool(jnp.isfinite(leaf)) for leaf in vars(gradient).values() if isinstance(leaf, jax.Array))
    for what, frames in _degenerate(clip.frames):
        (_, out), gradient = _total_and_gradient(tracer, clip.camera, frames)
        for leaf in (*jax.tree.leaves(out), *jax.tree.leaves(gradient)):
            assert bool(jnp.isfinite(leaf).all()), what
        if what == "no depth":
            assert not out.detected.any()


def test_paper_update_is_equation_7(clip):
    """Without the refinement, the likelihood is the running sum of gated log attentions, carried by the flow."""
    tracer = TagAttentionLiteral(refine=False)
    frames = clip.frames
    state = tracer.init(clip.camera, jax.tree.map(lambda leaf: leaf[0], frames))
    rays = np.asarray(clip.camera.rays)
    distance = np.linalg.norm(rays * np.asarray(frames.depth_m)[..., None], axis=-1)
    expected = np.zeros(state.log_likelihood.shape)
    step = eqx.filter_jit(tracer.step)
    for t in range(10):
        state, _ = step(clip.camera, state, jax.tree.map(lambda leaf, t=t: leaf[t], frames))
        for tag in range(2):
            rd = np.asarray(frames.radio.relative_m[t, tag, 0])
            speed = abs(rd[-1] - rd[0]) / float(frames.time_s[t] - frames.time_s[max(t - 4, 0)] + 1e-12)
            if not np.isfinite(np.asarray(frames.radio.std_m[t, tag])).all() or speed <= 0.1:
                continue
            if t < 4:
                attention = np.zeros(distance.shape[1:])
            else:
                rho = distance[t - 4 : t + 1] - distance[t - 4]
                rho = np.moveaxis(rho, 0, -1)
                rbf = np.exp(-np.sum((rho - rd) ** 2, axis=-1) / (2 * 5e-4))
                with np.errstate(invalid="ignore"):
                    centred, other = rho - rho.mean(-1, keepdims=True), rd - rd.mean()
                    norm = np.linalg.norm(centred, axis=-1) * np.linalg.norm(other)
                    corr = np.where(norm > 1e-9, np.sum(centred * other, -1) / np.maximum(norm, 1e-9), 0)
                attention = 0.8 * rbf + 0.2 * np.clip(corr, 0, 1)
            expected[tag] += np.log(attention + FLOOR) - np.log1p(FLOOR)
    still = np.abs(np.asarray(frames.forward_px)).max() < 1e-3
    assert still
    inner = np.s_[:, 2:-2, 2:-2]
    np.testing.assert_allclose(np.asarray(state.log_likelihood)[inner], expected[inner], atol=0.2)


def test_the_soft_tracer_has_the_paper_as_its_limit(clip):
    frames = jax.tree.map(lambda leaf: leaf[:12], clip.frames)
    # Without K-means: at this focal length many pixels are equally near to two centres, so hard assignments are chance.
    run = eqx.filter_jit(trace)
    paper = run(TagAttentionLiteral(refine=False), clip.camera, frames)
    gaps = []
    for softness in (0.3, 1e-2, 1e-7):
        soft = run(TagAttentionLiteral(refine=False, softness=softness), clip.camera, frames)
        gaps.append(float(jnp.mean(jnp.abs(soft.mask - paper.mask))))
    assert gaps[2] < 1e-3
    assert gaps[0] > gaps[2]


def test_motion_maps_follow_a_shift():
    """A textured plane that moves right by 2 px a frame carries its past with it."""
    rng = np.random.default_rng(0)
    world = rng.uniform(1.0, 1.2, (10, 60)).astype(np.float32)
    flow = jnp.broadcast_to(jnp.asarray([2.0, 0.0]), (10, 30, 2))
    motion = empty_motion(10, 30, 4)
    for t in range(4):
        motion = push_splat(motion, flow, jnp.asarray(world[:, 20 - 2 * t : 50 - 2 * t]))
    assert bool(motion.valid[:, 8:, :].all())
    expected = jnp.broadcast_to(jnp.asarray(world[:, 14 + 8 : 44])[..., None], (10, 22, 4))
    np.testing.assert_allclose(motion.distance_m[:, 8:], expected, atol=1e-5)
    assert not motion.valid[:, :2, 2].any()


def test_a_tag_is_detected_where_its_mask_has_a_pixel():
    nothing, known = jnp.zeros((2, 3)), jnp.ones((4, 5), bool)
    mask = jnp.zeros((2, 4, 5)).at[1, 2, 3].set(1.0)
    out = describe(mask, nothing, jnp.zeros((1, 4, 5)), known)
    assert out.detected.tolist() == [False, True]
    assert out.confidence.tolist() == [0.0, 1.0]
    np.testing.assert_array_equal(out.box_px, [[0, 0, 0, 0], [3, 2, 3, 2]])
    soft = describe(0.4 * mask, nothing, jnp.zeros((1, 4, 5)), known)
    assert not soft.detected.any()


def test_only_frames_and_reads_enter(clip):
    """The input of a tracer holds no labels, so its output cannot depend on truth; only error budgets give `objects`.

    `present` says which places hold a tag. `colour` is for flow networks that learn; `later` is what such a pass backwards found.
    """
    assert {
        "time_s",
        "depth_m",
        "backward_px",
        "forward_px",
        "radio",
        "reads",
        "arrivals",
        "present",
        "colour",
        "backward_message",
        "objects",
    } == set(Frame.__dataclass_fields__)
    assert clip.frames.objects is None
    givers = {path.name for path in Path(tagjax.__file__).parent.rglob("*.py") if "frames.objects" in path.read_text()}
    assert givers == {"objects.py"}
    assert {"labels", "evidence", "recent", "free_nats", "body", "member"} == set(Hindsight.__dataclass_fields__)
