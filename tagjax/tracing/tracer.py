"""Tracers: what every tracing system offers, and the one scan that runs any of them over a clip."""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from ..core.numerics import safe_norm
from ..radio.reads import PhaseReads, RadioWindow


class Camera(eqx.Module):
    """The camera at the working resolution, and the antennas around it."""

    rays: Float[Array, "height width 3"]  # ((x - cx) / fx, (y - cy) / fy, 1): point = depth * ray
    antennas_m: Float[Array, "antenna 3"]  # their places, camera frame

    def ranges_m(self, points_m: Float[Array, "*batch 3"]) -> Float[Array, " antenna *batch"]:
        """Distances of points in the camera frame to each antenna, metres."""
        return jax.vmap(lambda antenna: safe_norm(points_m - jnp.broadcast_to(antenna, points_m.shape)))(
            self.antennas_m
        )


class Later(eqx.Module):
    """What all frames after one say of it, for every tag: a pass backwards in time leaves it for one forwards."""

    log_odds: Float[Array, "*time tag height width"]  # of object against background
    anchor: eqx.Module  # (*time, tag, antenna, ...): the tag's range at this frame
    moved: Float[Array, "*time tag antenna"]  # the reads' evidence that the tag moves later on, nats


class Frame(eqx.Module):
    """What a tracer sees at one frame; in a clip every leaf has a leading time axis.

    Flow at t is between frames t - 1 and t, pixels of the working resolution; the first frame's is zero.
    `backward_px` sits on frame t and points to t - 1 (for gathering), `forward_px` sits on t - 1 and points to t (for
    splatting).
    """

    time_s: Float[Array, "*time"]
    depth_m: Float[Array, "*time height width"]  # z, 0 = missing
    backward_px: Float[Array, "*time height width 2"]
    forward_px: Float[Array, "*time height width 2"]
    radio: RadioWindow  # (*time, tag, antenna, window): causal, from reads up to this frame
    reads: PhaseReads  # (*time, tag, antenna, read): the reads that fall into this frame's window
    colour: UInt8[Array, "*time rows columns 3"] | None = None  # the whole picture, where flow is still to be computed
    later: Later | None = None  # where the whole recording is known, as it is not to who watches


class Trace(eqx.Module):
    """What a tracer says of every tag at one frame; `trace` stacks it over time."""

    mask: Float[Array, "*time tag height width"]  # soft mask, 0 to 1
    box_px: Float[Array, "*time tag 4"]  # x0 y0 x1 y1, first and last pixel, at the working resolution
    centre_px: Float[Array, "*time tag 2"]  # x y of the mask's centroid
    centre_m: Float[Array, "*time tag 3"]  # camera frame
    step_m: Float[Array, "*time tag antenna"]  # change of the object's distance to each antenna since the last frame
    confidence: Float[Array, "*time tag"]  # 0 to 1
    found: Bool[Array, "*time tag"]  # an object is claimed at all


class AbstractTracer(eqx.Module):
    """A tracing system as a state machine of fixed shapes: `init`, one `step` a frame, `finish`."""

    one_antenna: ClassVar[bool] = False
    """Whether it knows the distance to one antenna only."""

    @abc.abstractmethod
    def init(self, camera: Camera, frame: Frame) -> Any:
        """The state before the first frame; `frame` (no time axis) tells shapes only."""

    @abc.abstractmethod
    def step(self, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Trace]:
        """The next state, and the `Trace` of this frame."""

    @abc.abstractmethod
    def finish(self, state: Any) -> Any:
        """The state handed on to whoever continues the recording: nothing in it refers to a past frame's buffer."""


class AbstractSmoother(AbstractTracer):
    """A tracer that can also go backwards through a recording and hand what it learns there to a pass forwards."""

    @abc.abstractmethod
    def look_back(self, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Later]:
        """`step` where time runs backwards: the next state, and what all frames that come after this one say of it."""


def trace(tracer: AbstractTracer, camera: Camera, clip: Frame) -> Trace:
    """Run a tracer over a clip (leading time axis) with one `lax.scan`; memory of the state does not grow."""
    first = jax.tree.map(lambda leaf: leaf[0], clip)
    _, out = jax.lax.scan(lambda state, frame: tracer.step(camera, state, frame), tracer.init(camera, first), clip)
    return out
