"""Flow that explains no more than rest does is nought: noise, motion, and a camera that moves."""

from __future__ import annotations

import numpy as np
import pytest

from tagjax.flow.registry import make_flow
from tagjax.flow.stationary import zero_stationary

_INSIDE = np.s_[36:64, 38:62]


def _picture(rng: np.random.Generator, *, noise: float, shift: int = 0) -> np.ndarray:
    """A smooth slope with a textured square of 40 pixels, moved right by `shift`, under fresh noise."""
    picture = np.tile(np.linspace(80, 140, 120)[None], (100, 1))
    picture[30:70, 30 + shift : 70 + shift] = np.random.default_rng(7).uniform(40, 220, (40, 40))
    picture = picture + rng.normal(0, noise, picture.shape)
    return np.repeat(np.clip(np.rint(picture), 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


@pytest.mark.parametrize("noise", [0.0, 1.0, 4.0])
def test_flow_that_follows_noise_is_nought(noise):
    """Of a still scene no flow is left, neither one drawn at random nor what DIS makes of the noise."""
    rng = np.random.default_rng(0)
    here, there = _picture(rng, noise=noise), _picture(rng, noise=noise)
    drawn = rng.normal(0, 2, (100, 120, 2)).astype(np.float32)
    assert np.any(zero_stationary(drawn, here, there) != 0, axis=-1).mean() < 0.01
    found = make_flow("dis")(here, there)
    assert np.any(zero_stationary(found, here, there) != 0, axis=-1).mean() < 0.02
    if noise == 4.0:
        assert np.linalg.norm(found, axis=-1).max() > 0.5  # so there was something to take away


@pytest.mark.parametrize("noise", [0.0, 1.0, 4.0])
def test_true_motion_is_kept_and_false_motion_around_it_is_not(noise):
    rng = np.random.default_rng(1)
    here, there = _picture(rng, noise=noise), _picture(rng, noise=noise, shift=2)
    flow = np.full((100, 120, 2), (2.0, 0.0), np.float32)
    kept = zero_stationary(flow, here, there)
    np.testing.assert_array_equal(kept[_INSIDE], flow[_INSIDE])
    around = np.ones((100, 120), bool)
    around[24:76, 24:78] = False
    assert np.any(kept[around] != 0, axis=-1).mean() < 0.01
    back = zero_stationary(-flow, there, here)
    np.testing.assert_array_equal(back[_INSIDE], -flow[_INSIDE])


def test_a_camera_that_moves_keeps_its_flow():
    texture = np.random.default_rng(2).integers(0, 255, (100, 130), dtype=np.uint8)
    here, there = (np.repeat(texture[:, i : i + 120, None], 3, axis=-1) for i in (3, 0))
    flow = np.full((100, 120, 2), (3.0, 0.0), np.float32)
    assert np.all(zero_stationary(flow, here, there)[:, :112] == flow[:, :112])


def test_a_wrong_flow_is_no_better_than_rest():
    texture = np.random.default_rng(3).integers(0, 255, (60, 70, 3), dtype=np.uint8)
    other = np.random.default_rng(4).integers(0, 255, (60, 70, 3), dtype=np.uint8)
    flow = np.full((60, 70, 2), 5.0, np.float32)
    assert np.any(zero_stationary(flow, texture, other) != 0, axis=-1).mean() < 0.05
