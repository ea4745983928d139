"""Properties of the warps for any picture and flow: adjointness, identity, integer shifts, conservation of mass."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tagjax.image import warp

HEIGHT, WIDTH = 6, 7  # one shape, so that each function is compiled once
BORDER = 2

gather, splat = jax.jit(warp.gather), jax.jit(warp.splat)


@jax.jit
def received(flow_px):
    """Total bilinear weight that each pixel receives by the forward warp: the transpose of the gather, applied to 1."""
    image = jnp.zeros((HEIGHT, WIDTH, 1))
    return jax.grad(lambda image: jnp.sum(gather(image, flow_px)[0]))(image)[..., 0]


def pictures(channels: int = 1):
    values = st.floats(-100.0, 100.0, width=32, allow_subnormal=False)  # XLA takes subnormal numbers for 0
    return arrays(np.float32, (HEIGHT, WIDTH, channels), elements=values)


@st.composite
def flows_inside(draw):
    """Flow that leaves no pixel's target outside of the picture."""
    fraction = draw(
        arrays(np.float32, (HEIGHT, WIDTH, 2), elements=st.floats(0.0, 1.0, width=32, allow_subnormal=False))
    )
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    target = fraction * np.array([WIDTH - 1, HEIGHT - 1], np.float32)
    near = np.clip(target - np.stack([x, y], axis=-1), -BORDER, BORDER)
    return near.astype(np.float32)


@given(pictures(2), pictures(2))
def test_zero_flow_is_the_identity_for_both_warps(image, other):
    zero = jnp.zeros((HEIGHT, WIDTH, 2))
    for way in (gather, splat):
        for picture in (image, other):
            out, covered = way(jnp.asarray(picture), zero)
            np.testing.assert_array_equal(out, picture)
            assert bool(covered.all())


@given(pictures(), st.integers(-WIDTH - 1, WIDTH + 1), st.integers(-HEIGHT - 1, HEIGHT + 1))
def test_integer_shifts_are_exact(image, right, down):
    flow = jnp.broadcast_to(jnp.asarray([right, down], jnp.float32), (HEIGHT, WIDTH, 2))
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for way, sign in ((gather, 1), (splat, -1)):
        from_y, from_x = y + sign * down, x + sign * right
        inside = (from_y >= 0) & (from_y < HEIGHT) & (from_x >= 0) & (from_x < WIDTH)
        expected = np.where(
            inside[..., None], image[np.clip(from_y, 0, HEIGHT - 1), np.clip(from_x, 0, WIDTH - 1)], 0.0
        )
        out, covered = way(jnp.asarray(image), flow)
        np.testing.assert_array_equal(np.asarray(covered), inside)
        np.testing.assert_array_equal(np.asarray(out), expected)


@given(pictures(), pictures(), flows_inside())
def test_splat_is_the_adjoint_of_gather(image, other, flow):
    """<received * splat(image), other> = <image, gather(other)>: `splat` averages, so its sum is weight times average."""
    flow = jnp.asarray(flow)
    moved, filled = splat(jnp.asarray(image), flow)
    sampled, covered = gather(jnp.asarray(other), flow)
    weight = np.asarray(received(flow), np.float64)
    assert bool(covered.all())
    # A pixel that receives next to nothing may count as a hole.
    np.testing.assert_array_equal(np.asarray(filled)[weight > 1e-6], True)
    np.testing.assert_array_equal(np.asarray(filled)[weight == 0.0], False)
    left = np.sum(weight[..., None] * np.asarray(moved, np.float64) * other)
    right = np.sum(image.astype(np.float64) * np.asarray(sampled))
    scale = HEIGHT * WIDTH * max(1.0, np.abs(image).max()) * max(1.0, np.abs(other).max())
    np.testing.assert_allclose(left, right, atol=1e-6 * scale)


@given(pictures(), flows_inside())
def test_splat_conserves_mass_where_nothing_leaves_the_picture(image, flow):
    moved, _ = splat(jnp.asarray(image), jnp.asarray(flow))
    weight = np.asarray(received(jnp.asarray(flow)), np.float64)
    scale = HEIGHT * WIDTH * max(1.0, np.abs(image).max())
    np.testing.assert_allclose(weight.sum(), HEIGHT * WIDTH, rtol=1e-5)
    np.testing.assert_allclose(
        np.sum(weight * np.asarray(moved)[..., 0]), image.sum(dtype=np.float64), atol=1e-6 * scale
    )


@given(pictures(), flows_inside())
def test_splat_stays_within_the_range_of_what_it_averages(image, flow):
    moved, filled = splat(jnp.asarray(image), jnp.asarray(flow))
    inside = np.asarray(moved)[np.asarray(filled)]
    margin = 1e-4 * max(1.0, np.abs(image).max())
    assert inside.size > 0
    assert inside.min() >= image.min() - margin
    assert inside.max() <= image.max() + margin
