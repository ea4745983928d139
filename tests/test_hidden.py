"""The last body of a tag: remembered, predicted, and whether the camera sees its place."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from segments_scenes import pinhole, scalar

from tagjax.tagattention.segments.hidden import HiddenBody, HiddenState

HEIGHT, WIDTH, FOCAL_PX = 24, 32, 20.0
CAMERA = pinhole(HEIGHT, WIDTH, FOCAL_PX)
PLACE_M = np.array([0.4, -0.2, 2.0], np.float32)
DT_S = 0.1


def state(place_m: np.ndarray = PLACE_M, velocity_m_s: tuple[float, ...] = (0.0, 0.0, 0.0)) -> HiddenState:
    rows = HiddenState.nothing(1)
    return dataclasses.replace(
        rows,
        evidence_nats=jnp.array([50.0]),
        centre_m=jnp.asarray(place_m)[None],
        velocity_m_s=jnp.asarray(velocity_m_s, jnp.float32)[None],
    )


def unseen(depth_m: np.ndarray, labels: np.ndarray, own: bool = False, of: HiddenState | None = None) -> bool:
    membership = jnp.zeros((1, 3)).at[0, 2].set(1.0 if own else 0.0)
    given = jnp.asarray(depth_m, jnp.float32), jnp.asarray(labels, jnp.int32), membership, scalar(DT_S)
    return bool(HiddenBody().out_of_view(CAMERA, state() if of is None else of, *given)[0])


def scene(at_m: float) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """A wall at 3 m, a surface of slot 2 around the pixel of the place, and that pixel."""
    depth_m, labels = np.full((HEIGHT, WIDTH), 3.0), np.zeros((HEIGHT, WIDTH), int)
    x, y = (float(one) for one in CAMERA.pixels_of(jnp.asarray(PLACE_M)))
    row, column = round(y), round(x)
    depth_m[row - 1 : row + 2, column - 1 : column + 2] = at_m
    labels[row - 1 : row + 2, column - 1 : column + 2] = 2
    return depth_m, labels, (row, column)


def test_pixels_of_points_are_those_whose_rays_lead_to_them():
    rng = np.random.default_rng(0)
    row, column, depth_m = rng.integers(0, HEIGHT, 9), rng.integers(0, WIDTH, 9), rng.uniform(0.5, 5.0, 9)
    points_m = np.asarray(CAMERA.rays)[row, column] * depth_m[:, None]
    x, y = CAMERA.pixels_of(jnp.asarray(points_m, jnp.float32))
    np.testing.assert_allclose(x, column, atol=1e-3)
    np.testing.assert_allclose(y, row, atol=1e-3)
    assert np.all(np.isfinite(np.asarray(CAMERA.pixels_of(jnp.zeros((2, 3))))))


def test_a_place_is_out_of_view_behind_something_else_or_out_of_the_picture():
    depth_m, labels, at = scene(1.5)
    assert unseen(depth_m, labels)  # something else is in front
    assert not unseen(depth_m, labels, own=True)  # the body's own arm is
    for surface_m in (1.97, 2.0, 3.0, 0.0):  # the body itself, nothing, and no depth
        assert not unseen(*scene(surface_m)[:2])
    labels[at] = -1  # the border between two surfaces
    assert unseen(depth_m, labels)
    for outside_m in ((9.0, 0.0, 2.0), (0.0, -9.0, 2.0), (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)):
        assert unseen(*scene(3.0)[:2], of=state(np.array(outside_m, np.float32)))


def test_the_place_goes_on_with_the_last_velocity():
    depth_m, labels, _ = scene(1.5)
    moving = state(PLACE_M - np.array([0.3, 0.0, 0.0], np.float32), (3.0 / np.exp(-DT_S / 0.3), 0.0, 0.0))
    assert unseen(depth_m, labels, of=moving)
    place_m, velocity_m_s = HiddenBody(stop_s=0.3).predicted(moving, scalar(DT_S))
    np.testing.assert_allclose(place_m[0], PLACE_M, atol=1e-5)
    np.testing.assert_allclose(velocity_m_s[0], [3.0, 0.0, 0.0], rtol=1e-5)


def test_the_last_body_is_remembered_while_it_explains_the_reads_better():
    stage, kept = HiddenBody(margin_nats=10.0), scalar(0.98)

    def after(body_nats: float, in_view: bool = True) -> tuple[HiddenState, bool]:
        zero = jnp.zeros((1, 3))
        out, remembered = stage.step(
            state(), jnp.array([body_nats]), jnp.array([in_view]), zero, zero, kept, scalar(DT_S)
        )
        return out, bool(remembered[0])

    out, remembered = after(38.0)
    assert remembered
    assert float(out.evidence_nats[0]) == np.float32(0.98) * np.float32(50.0)
    np.testing.assert_allclose(out.centre_m[0], PLACE_M)
    out, remembered = after(40.0)
    assert not remembered
    assert float(out.evidence_nats[0]) == 40.0
    assert after(60.0, in_view=False)[1]
