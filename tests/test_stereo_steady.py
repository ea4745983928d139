"""Less noise in depth of two cameras: disparities smoothed by their texture, and pictures averaged where nothing changes."""

from __future__ import annotations

import numpy as np
import pytest

from tagjax.core.settings import ConfigError
from tagjax.stereo.conversion import StereoSettings, _num_averaged
from tagjax.stereo.matching import MatchSettings
from tagjax.stereo.smoothing import smooth_disparity
from tagjax.stereo.steady import MAX_FRAMES, SteadyPictures, steady_mean

HEIGHT, WIDTH = 40, 64


def _two_surfaces() -> tuple[np.ndarray, np.ndarray]:
    """A picture whose right half has another colour, and the disparities of the halves."""
    picture = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    picture[:, WIDTH // 2 :] = 180
    true = np.where(np.arange(WIDTH) < WIDTH // 2, 10.0, 16.0).astype(np.float32)
    return picture, np.broadcast_to(true, (HEIGHT, WIDTH)).copy()


def test_smoothing_averages_noise_and_keeps_edges() -> None:
    picture, true = _two_surfaces()
    noisy = true + np.random.default_rng(0).normal(0, 0.2, true.shape).astype(np.float32)
    found = smooth_disparity(noisy, np.full(true.shape, 50.0, np.float32), picture, 200.0)
    assert found.dtype == np.float32
    assert np.std(found - true) < 0.2 / 5
    beside = slice(WIDTH // 2 - 1, WIDTH // 2 + 1)
    assert np.abs(found[:, beside] - true[:, beside]).max() < 0.15


def test_pixels_without_texture_take_the_disparity_of_their_surface() -> None:
    picture, true = _two_surfaces()
    texture, wrong = np.full(true.shape, 50.0, np.float32), true.copy()
    texture[10:30, 8:24], wrong[10:30, 8:24] = 0.0, 15.0
    found = smooth_disparity(wrong, texture, picture, 200.0)
    assert np.abs(found - true).max() < 0.05
    # With texture, those disparities are a surface of their own, wherever its borders have no edge to stop at.
    seen = smooth_disparity(wrong, np.full(true.shape, 50.0, np.float32), picture, 200.0)
    assert np.abs(seen - true)[18:22, 14:18].min() > 0.3


def test_what_has_no_disparity_keeps_none() -> None:
    picture, true = _two_surfaces()
    true[5:9, 5:20] = 0
    texture = np.where(true > 0, 50.0, 0.0).astype(np.float32)
    found = smooth_disparity(true, texture, picture, 200.0)
    np.testing.assert_array_equal(found > 0, true > 0)
    np.testing.assert_array_equal(smooth_disparity(0 * true, 0 * texture, picture, 200.0), 0 * true)


def _noisy(count: int) -> tuple[np.ndarray, np.ndarray]:
    """A still scene of noise 2 levels, in which a square of 100 levels moves by 4 pixels a frame."""
    rng, scene = np.random.default_rng(1), np.random.default_rng(2).uniform(40, 120, (HEIGHT, WIDTH, 3))
    frames, square = [], np.zeros((count, HEIGHT, WIDTH), bool)
    for number in range(count):
        square[number, 12:24, 4 + 4 * number : 16 + 4 * number] = True
        clean = scene + 100 * square[number, ..., None]
        frames.append(np.rint(clean + rng.normal(0, 2, clean.shape)).clip(0, 255).astype(np.uint8))
    return np.stack(frames), square


def test_still_pixels_are_averaged_and_moving_ones_are_not() -> None:
    frames, square = _noisy(9)
    now = steady_mean(list(frames))
    scene = np.random.default_rng(2).uniform(40, 120, (HEIGHT, WIDTH, 3))
    still = np.logical_not(square.any(axis=0))
    still[10:26] = False  # away from the square by more than the windows
    assert np.std((now - scene)[still]) < 0.55 * 2  # 1/3 but for pixels whose noise looks like a change
    # Nowhere is the square's last place, or where it has just been, mixed with what was seen there before.
    clean = scene + 100 * square[-1, ..., None]
    assert np.abs(now - clean).max() < 12


def test_a_pixel_that_changed_and_returned_is_not_averaged_across() -> None:
    frames = np.full((5, 20, 20, 3), 50, np.uint8)
    frames[0] = 53  # near enough to be the same; beyond a change it does not count
    frames[2, 6:14, 6:14] = 200
    now = steady_mean(list(frames))
    np.testing.assert_array_equal(now[8:12, 8:12], 50)
    np.testing.assert_array_equal(steady_mean(list(frames[:1])), frames[0])


def test_averages_do_not_depend_on_the_order_of_frames() -> None:
    frames, _ = _noisy(7)
    one, other = SteadyPictures(frames, 4), SteadyPictures(frames, 4)
    forwards = [one(frame) for frame in range(7)]
    backwards = [other(frame) for frame in reversed(range(7))][::-1]
    np.testing.assert_array_equal(forwards, backwards)
    np.testing.assert_array_equal(forwards[5], steady_mean(list(frames[2:6])))
    np.testing.assert_array_equal(SteadyPictures(frames, 1)(3), frames[3])
    for count in (0, MAX_FRAMES + 1):
        with pytest.raises(ValueError, match="expected 1 to 10 frames"):
            SteadyPictures(frames, count)


def test_the_average_is_over_a_time() -> None:
    time_ns = (np.arange(10) / 30 * 1e9).astype(np.int64)
    assert _num_averaged(0.27, time_ns) == 9
    assert _num_averaged(0.0, time_ns) == 1
    assert _num_averaged(5.0, time_ns) == MAX_FRAMES
    assert _num_averaged(0.27, 10 * time_ns) == 1
    assert _num_averaged(0.27, time_ns[:1]) == 1
    with pytest.raises(ConfigError, match=r"average_s is -1\.0"):
        StereoSettings(recording="a", average_s=-1.0)
    with pytest.raises(ConfigError, match=r"smoothing is -1\.0"):
        MatchSettings(smoothing=-1.0)
