"""The tracer interface, its inputs and outputs, and the scan that runs a tracer over a clip."""

from __future__ import annotations

import abc
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int, Int8, UInt8

from ..core.numerics import safe_norm
from ..radio.arrivals import Arrivals
from ..radio.reads import PhaseReads, RadioWindow

MAX_OBJECTS = 32
"""Objects that a frame can give, numbered from 1; each is a segment in place of the tracer's own."""


STORED = "stored"
"""Name of the values of a step that training stores for the backward pass; it computes all others again."""

TreeT = TypeVar("TreeT")


def stored(values: TreeT) -> TreeT:
    """The values themselves, which are small but costly, marked as `STORED`."""
    return checkpoint_name(values, STORED)


class Camera(eqx.Module):
    """The camera at the working resolution, and the antennas around it."""

    rays: Float[Array, "height width 3"]  # ((x - cx) / fx, (y - cy) / fy, 1): point = depth * ray
    antennas_m: Float[Array, "antenna 3"]  # their places, camera frame

    def ranges_m(self, points_m: Float[Array, "*batch 3"]) -> Float[Array, " antenna *batch"]:
        """Distances from points in the camera frame to each antenna, metres."""
        return jax.vmap(lambda antenna: safe_norm(points_m - jnp.broadcast_to(antenna, points_m.shape)))(
            self.antennas_m
        )

    def pixels_of(self, points_m: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
        """Pixel coordinates x, y of points in the camera frame; points at z = 0 count as 1 mm before the camera."""
        height, width, _ = self.rays.shape
        first, last = self.rays[0, 0], self.rays[-1, -1]
        z = jnp.where(jnp.abs(points_m[..., 2]) < 1e-3, 1e-3, points_m[..., 2])

        def along(axis: int, number: int) -> Float[Array, "*batch"]:
            step = (last[axis] - first[axis]) / max(number - 1, 1)
            return (points_m[..., axis] / z - first[axis]) / jnp.where(step == 0, 1.0, step)

        return along(0, width), along(1, height)


class Frame(eqx.Module):
    """The input of a tracer at one frame; in a clip every leaf has a leading time axis.

    Flow at t is between frames t - 1 and t, pixels of the working resolution; it is zero at the first frame.
    `backward_px` lies on the pixels of frame t and points to t - 1 (for gathering); `forward_px` lies on those of t - 1
    and points to t (for splatting).
    """

    time_s: Float[Array, "*time"]
    depth_m: Float[Array, "*time height width"]  # z, 0 = missing
    backward_px: Float[Array, "*time height width 2"]
    forward_px: Float[Array, "*time height width 2"]
    radio: RadioWindow  # (*time, tag, antenna, window): causal, from reads up to this frame
    reads: PhaseReads  # (*time, tag, antenna, read): the reads within this frame's window
    colour: UInt8[Array, "*time rows columns 3"] | None = None  # full-size picture, for tracers that compute the flow
    arrivals: Arrivals | None = None  # (*time, reads): of all tags and antennas, later than the last frame
    present: Bool[Array, "*time tag"] | None = None  # false for places that hold no tag
    backward_message: Any | None = None  # offline smoothing only: of `AbstractSmoother.backward_step`
    objects: Int[Array, "*time height width"] | None = None  # error budgets only: given objects, 0 = none

    @staticmethod
    def of_arrivals(
        time_s: Float[Array, ""],
        depth_m: Float[Array, "height width"],
        backward_px: Float[Array, "height width 2"],
        arrivals: Arrivals,
        present: Bool[Array, " tag"],
        num_antennas: int,
    ) -> Frame:
        """A frame for tracers that use each read as it arrives: no forward flow, and an empty window of reads."""
        rows = present.shape[0], num_antennas
        none = jnp.zeros((*rows, 1))
        return Frame(
            time_s=time_s,
            depth_m=depth_m,
            backward_px=backward_px,
            forward_px=jnp.zeros_like(backward_px),
            radio=RadioWindow(jnp.zeros((*rows, 2)), jnp.full((*rows, 2), jnp.inf)),
            reads=PhaseReads(none, none, none, none, none.astype(jnp.int32), none > 0),
            arrivals=arrivals,
            present=present,
        )


class Evidence(eqx.Module):
    """Log likelihoods of a tag's recent reads, nats against phases at random: of three explanations, and of one segment."""

    body: Float[Array, "*time tag"]  # the tag moves with the body that its mask shows; 0 without one
    stationary: Float[Array, "*time tag"]  # it stays in place
    free: Float[Array, "*time tag"]  # it moves on a smooth path of its own, whatever is in view
    best_segment: Float[Array, "*time tag"]  # it moves with the segment that explains its reads best; 0 without one


class Trace(eqx.Module):
    """The output of a tracer at one frame, for every tag; `trace` stacks it over time."""

    mask: Float[Array, "*time tag height width"]  # soft mask, 0 to 1
    box_px: Float[Array, "*time tag 4"]  # x0 y0 x1 y1, inclusive pixel indices, at the working resolution
    centre_px: Float[Array, "*time tag 2"]  # x y of the mask's centroid
    centre_m: Float[Array, "*time tag 3"]  # camera frame
    step_m: Float[Array, "*time tag antenna"]  # change of the object's range to each antenna since the last frame
    confidence: Float[Array, "*time tag"]  # 0 to 1
    detected: Bool[Array, "*time tag"]  # the confidence exceeds the detection threshold
    status: Int8[Array, "*time tag"] | None = None  # codes of `Status`; None: the tracer gives no reasons
    evidence: Evidence | None = None  # None: the tracer compares no explanations


class AbstractTracer(eqx.Module):
    """A tracing system as a state machine of fixed shapes: `init`, one `step` a frame, `finish`."""

    @abc.abstractmethod
    def init(self, camera: Camera, frame: Frame) -> Any:
        """The state before the first frame; only the shapes of `frame` (no time axis) are used."""

    @abc.abstractmethod
    def step(self, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Trace]:
        """The next state, and the `Trace` of this frame."""

    @abc.abstractmethod
    def finish(self, state: Any) -> Any:
        """The state from which a later part of the recording continues; it holds no reference to a past frame's buffer."""

    def camera_moved(self, state: Any) -> Bool[Array, ""] | None:
        """Whether the camera has moved so far, which misleads a method that expects it at rest; None: it does not find out."""
        return None


class AbstractSmoother(AbstractTracer):
    """A tracer with a backward pass, whose messages the forward pass of offline smoothing uses.

    A message is of the tracer's own type: a Module of arrays, the evidence of all later frames and reads. `step` finds it in
    `frame.backward_message`, None online. A read at the very time of a frame belongs to the forward pass.
    """

    @abc.abstractmethod
    def backward_step(self, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Any]:
        """`step` on the time-reversed recording: the next state, and the message for the forward pass at this frame."""

    def compact(self, message: Any) -> Any:
        """The message in the types in which it is stored from one pass to the next; `step` gets its floats as float32."""
        return message


def trace(tracer: AbstractTracer, camera: Camera, clip: Frame) -> Trace:
    """Run a tracer over a clip (leading time axis) with one `lax.scan`; the state has a fixed size."""
    first = jax.tree.map(lambda leaf: leaf[0], clip)
    _, out = jax.lax.scan(lambda state, frame: tracer.step(camera, state, frame), tracer.init(camera, first), clip)
    return out
