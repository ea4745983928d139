"""The whole training objective: its gradient by every learnable parameter, against central differences in double precision."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from test_joint import KEY, LOSS, _in_double, _panned, _panning_network

from tagjax.tagattention import TagAttention
from tagjax.tracing.clips import load_clip
from tagjax.training.joint import JointModel
from tagjax.training.objective import TERM_NAMES, ObjectiveSettings
from tagjax.training.step import clip_gradient, clip_loss

SETTINGS = ObjectiveSettings(
    memory=1.0,
    span_frames=6,
    skip_frames=3,
    max_reads=128,
    num_channels=4,
    future_stride=1,
    contrast=1.0,
    coverage=0.3,
    area=0.5,
    compactness=0.5,
    steadiness=0.5,
    calibration=0.2,
)
STEP = 1e-6
SEEN = 1e-7
"""A parameter whose central difference is larger than this is seen by the objective."""

# By design no gradient goes through the place of a frame ago, the centre that mean shift finds, or how far rivalry counts:
# the prior that reads the first, the extent around the second and rivalry are switched off here.
SWITCHED_OFF = {"prior_weight": 1e-12, "extent_m": 1e3, "rivalry": 1e-12}
UNSEEN = {
    "log_prior_reach",
    "log_prior_weight",
    "log_rivalry",
    "logit_inertia",
    "logit_profile",
    "logit_size_rate",
    "rest_doubt",
}
"""Parameters of what is switched off or at its bound. Any other that the objective no longer sees is a defect."""

READ_STOPPED = ("anchor", "range_share", "fate")
"""Parts of names whose parameters work through the place or the common shift, both of which carry no gradient."""


@pytest.mark.ci
def test_every_parameter_that_the_objective_sees_has_the_gradient_of_central_differences() -> None:
    assert set(SETTINGS.weights()) == set(TERM_NAMES)
    clip = load_clip(_panned(), 0, 12, stride=4, colour=True)
    with jax.enable_x64(True):
        tracer = TagAttention(cell=4, v0_m_s=0.3, gate_width_m_s=0.1, **SWITCHED_OFF)
        model = _in_double(JointModel(tracer, _panning_network(), 0.1, LOSS))
        frames, camera = _in_double(clip.frames), _in_double(clip.camera)
        slope = jnp.linspace(0.0, 0.6, frames.depth_m.shape[2])
        frames = eqx.tree_at(lambda f: f.depth_m, frames, frames.depth_m + slope.reshape(1, 1, -1))
        gradient, _ = clip_gradient(model, camera, frames, KEY, SETTINGS)
        loss = lambda model: float(clip_loss(model, camera, frames, KEY, SETTINGS)["loss"])  # noqa: E731
        names = [name for name, leaf in vars(model.tracer).items() if eqx.is_inexact_array(leaf)]
        numeric, exact = {}, {}
        for name in names:
            where = lambda m, name=name: getattr(m.tracer, name)  # noqa: E731
            ends = [loss(eqx.tree_at(where, model, where(model) + sign * STEP)) for sign in (1, -1)]
            numeric[name] = (ends[0] - ends[1]) / (2 * STEP)
            exact[name] = float(where(gradient))
    # Measured: at most 9e-4 apart, and 1.2e-2 for what reads the stopped place or shared shift.
    for name in names:
        stopped = any(part in name for part in READ_STOPPED)
        assert exact[name] == pytest.approx(numeric[name], rel=1.5e-2 if stopped else 2e-3, abs=2 * SEEN), name
    assert {name for name in names if abs(numeric[name]) <= SEEN} == UNSEEN
