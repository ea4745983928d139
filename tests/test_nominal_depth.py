"""Two planes in place of depth: a square that moves over a background is in front, a shadow is not."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import synthetic_clips as synthetic

from tagjax.flow.nominal_depth import Front, NominalDepth, differs, next_front, without_depth

SIZE, DT_S = 48, 1 / 30


def _texture(seed: int, low: int, high: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(low, high, (SIZE, SIZE, 3)).astype(np.uint8)


def _scene(left: int) -> tuple[np.ndarray, np.ndarray]:
    """A bright square, 12 pixels wide, on a dark background; and its mask."""
    picture, mask = _texture(0, 20, 60), np.zeros((SIZE, SIZE), bool)
    mask[18:30, left : left + 12] = True
    picture[mask] = _texture(1, 160, 220)[18:30, :12].reshape(-1, 3)
    return picture, mask


def _fronts(lefts: list[int], settings: NominalDepth) -> list[tuple[Front, np.ndarray]]:
    """The front at each frame, by the exact backward flow, and the square."""
    picture, mask = _scene(lefts[0])
    found = [(Front.first(picture), mask)]
    for before, left in itertools.pairwise(lefts):
        picture, mask = _scene(left)
        flow = np.zeros((SIZE, SIZE, 2), np.float32)
        flow[mask, 0] = before - left
        found.append((next_front(found[-1][0], picture, flow, DT_S, settings), mask))
    return found


def test_what_moves_is_in_front_and_what_it_uncovers_is_not() -> None:
    front, mask = _fronts([5, *range(6, 30)], NominalDepth())[-1]
    assert front.near[mask].mean() > 0.95
    assert front.near[~mask].mean() < 0.01


def test_a_pause_is_bridged_and_a_stop_is_not() -> None:
    settings = NominalDepth()
    frames = round(settings.pause_s / DT_S)
    found = _fronts([*range(5, 25), *[24] * (2 * frames)], settings)
    for number, expected in ((19 + frames // 2, 1.0), (-1, 0.0)):
        front, mask = found[number]
        assert front.near[mask].mean() == pytest.approx(expected, abs=0.05)


def test_shadows_and_light_have_the_background_s_colour() -> None:
    settings, background = NominalDepth(), _texture(2, 80, 120).astype(np.float32)
    assert not differs(background, background, settings).any()
    assert not differs(0.7 * background, background, settings).any()
    assert not differs(1.15 * background, background, settings).any()
    assert differs(0.3 * background, background, settings).all()
    assert differs(background[..., ::-1] * [1.8, 1.0, 0.3], background, settings).mean() > 0.95


def test_a_recording_has_two_planes_and_keeps_the_rest() -> None:
    one = synthetic.recording(8)
    other = without_depth(one, NominalDepth(near_m=2.0, far_m=4.0))
    other.check()
    planes = np.asarray(other.depth[:])
    assert set(np.unique(planes)) <= {2000, 4000}
    np.testing.assert_array_equal(planes[0], 4000)
    np.testing.assert_array_equal(other.depth[3], planes[3])  # an earlier frame begins anew
    assert other.reads is one.reads
    assert other.depth_kind == "depth"
    bare = dataclasses.replace(one, depth=np.zeros((one.num_frames, *one.image_shape), np.uint16))
    np.testing.assert_array_equal(np.asarray(without_depth(bare).depth[7]) > 3000, planes[7] > 3000)


@pytest.mark.parametrize("values", [{"near_m": 5.0}, {"shadow": 1.2}, {"levels": 0.0}])
def test_errors(values: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        NominalDepth(**values)
