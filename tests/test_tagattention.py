"""The tracers: the paper's update step by step, the learnable one's gradients, determinism and degenerate input."""

import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic_clips as synthetic

import tagjax
from tagjax.core.geometry import pixel_rays
from tagjax.radio.reads import RadioWindow
from tagjax.recording import Intrinsics
from tagjax.tagattention import TagAttention, paper_limit
from tagjax.tagattention.backward_message import BackwardMessage
from tagjax.tagattention.frame_trace import describe
from tagjax.tagattention.literal import FLOOR, TagAttentionLiteral
from tagjax.tagattention.motion import empty_motion, push_gather, push_splat
from tagjax.tracing.clips import load_clip
from tagjax.tracing.tracer import Camera, Frame, trace


def _learnable(**changed):
    """For objects that move at a few dm/s and are seen without noise: a narrow kernel, a weak place prior."""
    return TagAttention(**{"cell": 4, "alpha_m2": 1e-3, "prior_weight": 3.0, **changed})


@pytest.fixture(scope="module")
def clip():
    return load_clip(synthetic.recording(24), 0, 24, stride=1)


@pytest.fixture(scope="module")
def found(clip):
    return eqx.filter_jit(trace)(_learnable(), clip.camera, clip.frames)


def _shapes(out, clip):
    num_tags = len(clip.epcs)
    time, height, width = clip.frames.depth_m.shape
    assert out.mask.shape == (time, num_tags, height, width)
    assert bool((out.mask >= 0).all() & (out.mask <= 1).all())
    for leaf in jax.tree.leaves(out):
        assert bool(jnp.isfinite(leaf).all())


def test_the_learnable_tracer_finds_both_objects(clip, found):
    out = found
    _shapes(out, clip)
    for tag, (x0, y0, x1, y1) in enumerate(synthetic.BOXES.values()):
        mask = np.asarray(out.mask[-1, tag]) > 0.5
        inside = np.zeros_like(mask)
        inside[y0 : y1 + 1, x0 : x1 + 1] = True
        assert (mask & inside).sum() / (mask | inside).sum() > 0.6
        assert bool(out.detected[-1, tag])


def test_phases_alone_name_both_objects(clip):
    """Where the radio's distances are unknown, as between reads that are too few to unwrap, the raw phases still speak."""
    unknown = eqx.tree_at(lambda f: f.radio.std_m, clip.frames, jnp.full_like(clip.frames.radio.std_m, jnp.inf))
    tracer = _learnable(phase_weight=1.0)
    spoken = eqx.filter_jit(trace)(tracer, clip.camera, unknown)
    for tag, (x0, y0, x1, y1) in enumerate(synthetic.BOXES.values()):
        covered = np.asarray(spoken.mask[-1, tag])
        assert covered[y0 : y1 + 1, x0 : x1 + 1].mean() > 0.6
        assert covered.sum() - covered[y0 : y1 + 1, x0 : x1 + 1].sum() < 0.3 * covered.sum()
        assert float(spoken.confidence[-1, tag]) > 0.9


def test_step_follows_the_objects_distance(clip, found):
    out = found
    time_s = np.asarray(clip.frames.time_s)
    for tag, label in enumerate(synthetic.BOXES):
        expected = np.diff(synthetic.offset_m(label, time_s))[-8:]
        np.testing.assert_allclose(np.asarray(out.step_m[-8:, tag, 0]), expected, atol=0.02)


@pytest.mark.ci
def test_neither_other_tags_nor_a_deaf_antenna_disturb(clip):
    """Without rivalry any number of tags and antennas are as one: each tag is traced by what was heard of it alone."""
    tracer = _learnable(rivalry=1e-12)
    found = eqx.filter_jit(trace)(tracer, clip.camera, clip.frames)
    alone = load_clip(synthetic.recording(24), 0, 24, stride=1, epcs=[clip.epcs[1]])
    frames = alone.frames
    twice = lambda part: jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf], axis=2), part)  # noqa: E731
    radio, reads = twice(frames.radio), twice(frames.reads)
    deaf = eqx.tree_at(
        lambda f: (f.radio, f.reads),
        frames,
        (
            RadioWindow(radio.relative_m.at[:, :, 1].set(0.0), radio.std_m.at[:, :, 1].set(jnp.inf)),
            eqx.tree_at(lambda r: r.valid, reads, reads.valid.at[:, :, 1].set(False)),
        ),
    )
    camera = eqx.tree_at(lambda c: c.antennas_m, alone.camera, jnp.asarray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5]]))
    single = eqx.filter_jit(trace)(tracer, camera, deaf)
    np.testing.assert_allclose(found.mask[:, 1], single.mask[:, 0], atol=1e-4)
    np.testing.assert_allclose(found.step_m[:, 1, 0], single.step_m[:, 0, 0], atol=1e-4)


@pytest.mark.ci
def test_two_tags_of_one_thing_both_find_it(clip):
    """Rivalry tells tags of different things apart; it keeps none from a thing that it shares."""
    frames = eqx.tree_at(
        lambda f: (f.radio, f.reads),
        clip.frames,
        jax.tree.map(lambda leaf: leaf[:, jnp.asarray([1, 1, 0])], (clip.frames.radio, clip.frames.reads)),
    )
    out = eqx.filter_jit(trace)(_learnable(), clip.camera, frames)
    for tag, (x0, y0, x1, y1) in enumerate(list(synthetic.BOXES.values())[label] for label in (1, 1, 0)):
        covered = np.asarray(out.mask[-1, tag])
        assert covered[y0 : y1 + 1, x0 : x1 + 1].mean() > 0.6
        assert covered.sum() - covered[y0 : y1 + 1, x0 : x1 + 1].sum() < 0.3 * covered.sum()
        assert bool(out.detected[-1, tag])


@pytest.mark.ci
def test_reads_show_that_a_tag_has_moved(clip):
    """Evidence against rest grows for a tag that moves, not for one whose phases never change, and raises doubt of it."""
    reads = clip.frames.reads
    constant = 1.0 + reads.channel[:, 1].astype(jnp.float32)
    rests = eqx.tree_at(lambda f: f.reads.phase_rad, clip.frames, reads.phase_rad.at[:, 1].set(constant))

    @eqx.filter_jit
    def run(tracer):
        first = jax.tree.map(lambda leaf: leaf[0], rests)
        return jax.lax.scan(
            lambda state, frame: tracer.step(clip.camera, state, frame), tracer.init(clip.camera, first), rests
        )

    state, doubted = run(_learnable(rest_doubt=5.0))
    _, believed = run(_learnable())
    moved = np.asarray(state.phases.moved[:, 0])
    assert moved[0] > 20.0
    assert moved[1] < 1.0
    assert bool(jnp.all(state.phases.moving <= state.phases.moved))
    # The radio's path still says that both move, as it might by mistake: doubt takes five from the log odds of the one that
    # rests.
    gap = jax.scipy.special.logit(believed.confidence[-1]) - jax.scipy.special.logit(doubted.confidence[-1])
    np.testing.assert_allclose(gap, [0.0, 5.0 * np.exp(-moved[1] / 2.0)], atol=0.3)


def _side_by_side() -> tuple[Camera, Frame, np.ndarray]:
    """Two boxes that come and go alike, as far left of the middle as right; each carries a tag.

    To an antenna in the middle both are always equally far; as one at the side sees it, one comes while the other goes.
    """
    height, width = 24, 32
    time_s = np.arange(24) / 10.0
    rays = pixel_rays(Intrinsics(20.0, 20.0, 15.5, 11.5, width, height))
    boxes = np.zeros((2, height, width), bool)
    boxes[0, 6:18, 3:12] = boxes[1, 6:18, 20:29] = True
    depth = np.full((len(time_s), height, width), 4.0)
    depth[:, boxes.any(axis=0)] = (2.0 + 0.4 * np.cos(2.5 * time_s))[:, None]
    antennas = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 2.0]])
    ranges = np.linalg.norm(rays[None, None] * depth[None, ..., None] - antennas[:, None, None, None], axis=-1)
    of_tag = np.stack([ranges[:, :, 12, 7], ranges[:, :, 12, 24]])  # tag, antenna, frame: at the middles
    np.testing.assert_allclose(of_tag[0, 0], of_tag[1, 0], atol=1e-12)
    frames = synthetic.unread_frames(time_s, depth, of_tag, np.zeros((len(time_s), height, width, 2)))
    return Camera(jnp.asarray(rays), jnp.asarray(antennas, jnp.float32)), frames, boxes


@pytest.mark.ci
def test_a_second_antenna_splits_what_one_cannot():
    camera, frames, boxes = _side_by_side()
    mask = np.asarray(eqx.filter_jit(trace)(_learnable(), camera, frames).mask[-1]) > 0.5
    for tag in range(2):
        assert (mask[tag] & boxes[tag]).sum() / (mask[tag] | boxes[tag]).sum() > 0.6
    with pytest.raises(ValueError, match=r"one antenna; the clip has 2"):
        TagAttentionLiteral().init(camera, jax.tree.map(lambda leaf: leaf[0], frames))


@pytest.mark.ci
def test_scan_is_the_loop_of_steps(clip):
    tracer = _learnable()
    few = jax.tree.map(lambda leaf: leaf[:5], clip.frames)
    scanned = eqx.filter_jit(trace)(tracer, clip.camera, few)
    state = tracer.init(clip.camera, jax.tree.map(lambda leaf: leaf[0], few))
    shapes = jax.tree.map(jnp.shape, state)
    step = eqx.filter_jit(tracer.step)
    for t in range(5):
        state, found = step(clip.camera, state, jax.tree.map(lambda leaf, t=t: leaf[t], few))
        np.testing.assert_allclose(found.mask, scanned.mask[t], atol=1e-4)
    assert jax.tree.map(jnp.shape, tracer.finish(state)) == shapes


@pytest.mark.parametrize("tracer", [_learnable(), TagAttentionLiteral(cell=4)])
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


@pytest.mark.parametrize(
    "tracer",
    [
        pytest.param(_learnable(rest_doubt=0.3), id="learnable", marks=pytest.mark.ci),
        pytest.param(TagAttentionLiteral(cell=4), id="paper", marks=pytest.mark.ci),
    ],
)
def test_gradients_reach_every_parameter_and_stay_finite_at_degenerate_input(clip, tracer):
    """One compilation for all of it."""
    (_, _), gradient = _total_and_gradient(tracer, clip.camera, clip.frames)
    leaves = {name: leaf for name, leaf in vars(gradient).items() if isinstance(leaf, jax.Array)}
    assert all(bool(jnp.isfinite(leaf)) for leaf in leaves.values())
    if isinstance(tracer, TagAttention):
        # No gradient goes through the place a frame ago; and nothing here moves so that the prior's prediction ahead
        # would differ.
        through_place = {"logit_inertia", "logit_size_rate"}
        assert {name for name, leaf in leaves.items() if float(leaf) == 0.0} <= through_place
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
    # Without K-means, whose hard assignments tie in a scene seen through so long a lens.
    run = eqx.filter_jit(trace)
    paper = run(TagAttentionLiteral(refine=False), clip.camera, frames)
    gaps = []
    for softness in (0.3, 1e-2, 1e-7):
        soft = run(TagAttentionLiteral(refine=False, softness=softness), clip.camera, frames)
        gaps.append(float(jnp.mean(jnp.abs(soft.mask - paper.mask))))
    assert gaps[2] < 1e-3
    assert gaps[0] > gaps[2]


def test_the_learnable_tracer_has_the_paper_as_its_limit():
    """At `paper_limit` likelihood and mask are those of the paper's tracer, and they part when a step is relaxed."""
    clip = load_clip(synthetic.recording(24), 0, 24, stride=1, estimator="literal")
    first = jax.tree.map(lambda leaf: leaf[0], clip.frames)
    paper = TagAttentionLiteral(refine=False)

    def run(tracer, like):
        def one(state, frame):
            state, out = tracer.step(clip.camera, state, frame)
            return state, (like(state), out.mask)

        return jax.lax.scan(one, tracer.init(clip.camera, first), clip.frames)[1]

    expected, mask = eqx.filter_jit(run)(paper, lambda state: state.log_likelihood)
    # Before a window is full the paper gives every pixel the floor, the learnable tracer nothing: alike for all pixels.
    inner = np.s_[6:, :, 2:-2, 2:-2]
    level = lambda values: values - np.max(values, axis=(2, 3), keepdims=True)  # noqa: E731

    learnable = eqx.filter_jit(functools.partial(run, like=lambda state: state.log_odds))

    def gap(**changed):
        found, soft = learnable(TagAttention(**{**paper_limit(), **changed}))
        worst = np.abs(level(np.asarray(found)[inner]) - level(np.asarray(expected)[inner])).max()
        return worst, np.abs(np.asarray(soft)[inner] - np.asarray(mask)[inner]).mean()

    assert np.ptp(np.asarray(expected)[inner]) > 10
    likelihood, masks = gap()
    assert likelihood < 0.01
    assert masks < 1e-3
    for relaxed in (
        {"profile": 1.0},
        {"memory_s": 0.5},
        {"slack": 0.5},
        {"rest": 0.9, "background": 0.3},
        {"background": 0.3, "floor": 0.02},
        {"anchor_limit": 4.0, "anchor_rate": 0.3},
    ):
        assert gap(**relaxed)[0] > 0.1, relaxed
    assert gap(cut_width=0.01)[1] > masks


def test_motion_maps_follow_a_shift_either_way():
    """A textured plane that moves right by 2 px a frame: gather and splat carry the same past."""
    rng = np.random.default_rng(0)
    world = rng.uniform(1.0, 1.2, (10, 60)).astype(np.float32)
    flow = jnp.broadcast_to(jnp.asarray([2.0, 0.0]), (10, 30, 2))
    one, other = empty_motion(10, 30, 4), empty_motion(10, 30, 4)
    for t in range(4):
        seen = jnp.asarray(world[:, 20 - 2 * t : 50 - 2 * t])
        one = push_splat(one, flow, seen)
        other = push_gather(other, -flow, seen, jnp.asarray(0.5))
    for motion in (one, other):
        assert bool(motion.valid[:, 8:, :].all())
        expected = jnp.broadcast_to(jnp.asarray(world[:, 14 + 8 : 44])[..., None], (10, 22, 4))
        np.testing.assert_allclose(motion.distance_m[:, 8:], expected, atol=1e-5)
        assert not motion.valid[:, :2, 2].any()


def test_gathering_does_not_cross_a_depth_edge():
    depth = jnp.where(jnp.arange(20) < 10, 1.0, 3.0)[None].repeat(6, axis=0)
    motion = push_gather(empty_motion(6, 20, 3), jnp.zeros((6, 20, 2)), depth, jnp.asarray(0.3))
    half = jnp.full((6, 20, 2), 0.5).at[..., 1].set(0.0)
    moved = push_gather(motion, half, depth, jnp.asarray(0.3))
    known = np.asarray(moved.valid[..., 1])
    past = np.asarray(moved.distance_m[..., 1])
    np.testing.assert_allclose(past[known], np.asarray(depth)[known], atol=1e-6)
    assert known[:, 9].all()


def test_even_odds_are_no_claim():
    mask, nothing = jnp.ones((3, 4, 5)), jnp.zeros((3, 3))
    confidence = jnp.asarray([0.5, 0.503, 0.51])
    out = describe(mask, nothing, jnp.zeros((1, 4, 5)), jnp.ones((4, 5), bool), confidence, 0.0)
    assert out.detected.tolist() == [False, False, True]
    empty = describe(0.0 * mask, nothing, jnp.zeros((1, 4, 5)), jnp.ones((4, 5), bool), confidence, 0.0)
    assert not empty.detected.any()


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
    assert {"log_odds", "anchor", "moved"} == set(BackwardMessage.__dataclass_fields__)
