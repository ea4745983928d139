"""The compiled functions of a live tracer, and what goes into them from the host."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
from jaxtyping import Array, Int

from ..radio.arrivals import Arrivals
from .tracer import Camera, Frame


@runtime_checkable
class LiveMethod(Protocol):
    """What a tracer must have to run live."""

    def init(self, camera: Camera, frame: Frame) -> Any: ...

    def follow(self, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Any]: ...

    def with_tags(self, camera: Camera, state: Any, source: Int[Array, " tag"]) -> Any: ...

    def shifted(self, state: Any, by_s: Array) -> Any: ...

    def camera_moved(self, state: Any) -> Array | None: ...


class Sensed(NamedTuple):
    """What a frame brings, on the host: the rest of a `Frame` is made on the device."""

    time_s: Any
    depth_m: Any
    backward_px: Any
    arrivals: Arrivals
    present: Any

    def frame(self, num_antennas: int) -> Frame:
        """The tracer's input."""
        return Frame.of_arrivals(self.time_s, self.depth_m, self.backward_px, self.arrivals, self.present, num_antennas)


@dataclasses.dataclass(frozen=True)
class Fixed:
    """Tracer and camera, taken apart once: to do so for every frame takes as long as its depth."""

    arrays: list[Array | None]
    others: Hashable  # a part of the compiled program

    @staticmethod
    def of(tracer: LiveMethod, camera: Camera) -> Fixed:
        """Arrays, and all the rest."""
        leaves, structure = jax.tree.flatten((tracer, camera))
        arrays = [leaf if eqx.is_array(leaf) else None for leaf in leaves]
        return Fixed(arrays, (structure, tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)))


def _joined(others: Any, arrays: list[Array | None]) -> tuple[LiveMethod, Camera]:
    structure, leaves = others
    pairs = zip(arrays, leaves, strict=True)
    return jax.tree.unflatten(structure, [leaf if array is None else array for array, leaf in pairs])


@partial(jax.jit, static_argnums=0)
def first_state(others: Hashable, arrays: list[Array | None], sensed: Sensed) -> Any:
    """The state before the first frame."""
    tracer, camera = _joined(others, arrays)
    return tracer.init(camera, sensed.frame(camera.antennas_m.shape[0]))


@partial(jax.jit, static_argnums=0, donate_argnums=3)
def step(others: Hashable, arrays: list[Array | None], sensed: Sensed, state: Any) -> tuple[Any, Any, Any]:
    """The next state, the output, and whether the camera has moved."""
    tracer, camera = _joined(others, arrays)
    state, trace = tracer.follow(camera, state, sensed.frame(camera.antennas_m.shape[0]))
    return state, trace, tracer.camera_moved(state)


@eqx.filter_jit
def with_tags(tracer: LiveMethod, camera: Camera, state: Any, source: Int[Array, " tag"]) -> Any:
    """The state for other tags: `source` is each one's place among the present ones, -1 for a new tag."""
    return tracer.with_tags(camera, state, source)


@eqx.filter_jit
def shifted(tracer: LiveMethod, state: Any, by_s: Array) -> Any:
    """The state with all of its times later by so many seconds."""
    return tracer.shifted(state, by_s)
