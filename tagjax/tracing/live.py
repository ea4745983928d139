"""A tracer fed frame by frame as pictures and reads arrive, with tags that come and go.

The tracer's step is compiled for 1, 2, 4, ..., 256 tags: a new tag takes a free place, and more places are made where there
is none. So no tag that appears compiles anything, unless it is the first beyond one of these numbers.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..core.camera import Intrinsics, working_stride
from ..core.geometry import pixel_rays, range_to_depth
from ..radio.arrivals import Arrivals
from ..recording import RecordingWarning, TagReads
from .arrivals import frame_arrivals
from .clips import MAX_ARRIVALS, subsampled_depth
from .live_step import Fixed, LiveMethod, Sensed, first_state, shifted, step, with_tags
from .recordings import CAMERA_MOVED
from .tracer import Camera

MAX_TAGS = 256
"""Places for tags. Beyond, new tags wait until another one has not been read for some time."""

_NUM_PLACES = (1, 2, 4, 8, 16, 32, 64, 128, 256)
_REBASE_S = 1024.0  # times on the device are float32 seconds from an origin, which is moved so often


@dataclasses.dataclass(frozen=True)
class LiveFrame:
    """The result for one frame: which tag has which place, and the tracer's output for all places."""

    time_ns: int
    places: dict[str, int]  # EPC -> index of the tag axis
    trace: Any  # the output of the tracer's `follow`, on the device
    num_dropped: int  # reads that the frame's buffer did not hold
    num_unused: int  # others: of another antenna or an unknown carrier, not between the last frame and this one, or of a tag without a place


@dataclasses.dataclass(frozen=True)
class Pictures:
    """What the pictures of a frame bring, at the working resolution, on the host: all that can be had before its reads."""

    depth_m: np.ndarray  # (rows, columns), 0 = missing
    backward_px: np.ndarray  # (rows, columns, 2) flow to the picture prepared before it, pixels of this resolution


class LiveTracer:
    """Holds a tracer's state between frames. `process` takes the next frame; frames come in order of time.

    `process` is `prepare` and then `follow`. One thread may prepare a frame while another follows the one before: flow takes
    about as long as the tracer's step. Each frame that is prepared must then be followed, in the same order.

    `flow` gives the flow from the first picture to the second, (height, width, 2) pixels; `stride` keeps every n-th pixel, None about 256 columns;
    `antennas` are the numbers (from 1) of those at `antennas_m`, of which reads are used. A tag that has not been read for
    `forget_s` gives its place to a new one; there are `num_places` from the start. Warns (`RecordingWarning`), once each, of
    more tags than places and of a camera that moves (`camera_moved`). Raises `ValueError` for a stride below 1, for antennas
    without a position, and for a number of places that is not 1, 2, 4, ..., 256.
    """

    def __init__(
        self,
        tracer: LiveMethod,
        intrinsics: Intrinsics,
        antennas_m: np.ndarray,
        *,
        flow: Callable[[np.ndarray, np.ndarray], np.ndarray],
        stride: int | None = None,
        antennas: tuple[int, ...] = (1,),
        depth_kind: str = "depth",
        num_reads: int = MAX_ARRIVALS,
        num_places: int = 1,
        forget_s: float = 30.0,
    ):
        stride = working_stride(intrinsics.width, stride)
        if num_places not in _NUM_PLACES:
            raise ValueError(f"num_places is {num_places}; expected one of {', '.join(map(str, _NUM_PLACES))}.")
        self._tracer, self._intrinsics, self._flow, self._stride = tracer, intrinsics, flow, stride
        positions_m = np.asarray(antennas_m, np.float32)
        known = {place + 1 for place, at_m in enumerate(positions_m) if np.all(np.isfinite(at_m))}
        if not antennas or len(set(antennas)) < len(antennas) or not set(antennas) <= known:
            raise ValueError(
                f"antennas is {antennas}; expected numbers of antennas that have a position, each once: "
                f"{', '.join(map(str, sorted(known))) or 'none has'}."
            )
        self._antennas, self._range = antennas, depth_kind == "range"
        self._num_reads, self._forget_ns = num_reads, int(forget_s * 1e9)
        chosen = positions_m[np.array(antennas) - 1]
        self._camera = Camera(
            rays=jnp.asarray(pixel_rays(intrinsics.scaled(stride))), antennas_m=jnp.asarray(chosen, jnp.float32)
        )
        self._fixed = Fixed.of(tracer, self._camera)
        self._places: list[str | None] = [None] * num_places
        self._last_read_ns: dict[str, int] = {}
        self._state: Any = None
        self._colour: np.ndarray | None = None
        self._time_ns, self._origin_ns, self._begun_ns = 0, 0, 0
        self._crowded = False
        self._moved: Any = None  # whether the camera has moved, as of the last frame
        self.camera_moved = False

    def process(self, colour: np.ndarray, depth_m: np.ndarray, time_ns: int, reads: TagReads) -> LiveFrame:
        """Trace one frame: colour (height, width, 3) uint8, depth in metres (0 = missing), and the reads since the last one.

        Reads that are later than the frame, or not later than the last one, are not used. Depth that is not finite is
        missing. Raises `ValueError` for a frame that is not later than the last, and for pictures of another size; the frame
        is then left out, and the next may follow.
        """
        self._check_time(time_ns)
        return self.follow(self.prepare(colour, depth_m), time_ns, reads)

    def prepare(self, colour: np.ndarray, depth_m: np.ndarray) -> Pictures:
        """Flow since the last frame that was prepared, and depth, of the next frame. Raises `ValueError` for pictures of another size."""
        height, width = self._intrinsics.height, self._intrinsics.width
        if colour.shape[:2] != (height, width) or depth_m.shape != (height, width):
            raise ValueError(
                f"Found colour {colour.shape} and depth {depth_m.shape}; expected {height} x {width} as the intrinsics say."
            )
        depth_m = range_to_depth(depth_m[None], self._intrinsics)[0] if self._range else depth_m
        depth_m = subsampled_depth(depth_m[None], self._stride)[0]
        before, self._colour = self._colour, colour
        if before is None:
            return Pictures(depth_m, np.zeros((*depth_m.shape, 2), np.float32))
        every = self._stride
        return Pictures(depth_m, np.asarray(self._flow(colour, before))[::every, ::every] / np.float32(every))

    def follow(self, pictures: Pictures, time_ns: int, reads: TagReads) -> LiveFrame:
        """Trace a prepared frame with the reads since the last one; as `process`. Raises `ValueError` for a time that is not later."""
        self._check_time(time_ns)
        first = self._state is None
        if first:
            self._begun_ns = self._origin_ns = self._time_ns = time_ns
        self._admit(reads, time_ns)
        epcs = [epc if epc is not None else f"\0{place}" for place, epc in enumerate(self._places)]
        arrivals, unused = frame_arrivals(
            reads, epcs, self._antennas, np.array([time_ns]), self._origin_ns, self._num_reads,
            since_ns=self._time_ns if not first else None,
        )  # fmt: skip
        sensed = self._sensed((time_ns - self._origin_ns) * 1e-9, pictures, arrivals)
        if first:
            self._state = first_state(self._fixed.others, self._fixed.arrays, sensed)
        self._warn_of_motion()
        self._state, trace, self._moved = step(self._fixed.others, self._fixed.arrays, sensed, self._state)
        self._time_ns = time_ns
        if (later_s := (time_ns - self._origin_ns) * 1e-9 // _REBASE_S * _REBASE_S) > 0:
            self._state = shifted(self._tracer, self._state, jnp.asarray(-later_s, jnp.float32))
            self._origin_ns += int(later_s * 1e9)
        places = {epc: place for place, epc in enumerate(self._places) if epc is not None}
        num_dropped = int(unused.num_dropped.sum())
        num_unused = reads.num_reads - num_dropped - int(np.sum(arrivals.valid))
        return LiveFrame(time_ns, places, trace, num_dropped, num_unused)

    def _check_time(self, time_ns: int) -> None:
        if self._state is not None and time_ns <= self._time_ns:
            raise ValueError(f"Found a frame at {time_ns} ns after one at {self._time_ns} ns; expected a later time.")

    def _warn_of_motion(self) -> None:
        """Warn where the camera has moved before this frame: what the last one says is on the host by now."""
        if self.camera_moved or self._moved is None or not bool(self._moved):
            return
        self.camera_moved = True
        at_s = (self._time_ns - self._begun_ns) * 1e-9
        warnings.warn(CAMERA_MOVED.format(f"{at_s:.1f} s after the first frame"), RecordingWarning, stacklevel=3)

    def warm_up(self) -> float:
        """Compile all that a frame needs on blank ones, before the first frame comes; the seconds that it took."""
        begun = time.perf_counter()
        height, width, _ = self._camera.rays.shape
        arrivals, _ = frame_arrivals(
            TagReads.empty(), [f"\0{place}" for place in range(len(self._places))], self._antennas, np.array([0]), 0,
            self._num_reads,
        )  # fmt: skip
        blank = np.zeros((self._intrinsics.height, self._intrinsics.width, 3), np.uint8)
        self._flow(blank, blank)
        nothing = Pictures(np.zeros((height, width), np.float32), np.zeros((height, width, 2), np.float32))
        sensed = self._sensed(0.0, nothing, arrivals)
        state = first_state(self._fixed.others, self._fixed.arrays, sensed)
        state, _, _ = step(self._fixed.others, self._fixed.arrays, sensed, state)
        places = jnp.arange(len(self._places), dtype=jnp.int32)
        jax.block_until_ready(with_tags(self._tracer, self._camera, state, places))
        jax.block_until_ready(shifted(self._tracer, state, jnp.zeros((), jnp.float32)))
        return time.perf_counter() - begun

    def _sensed(self, time_s: float, pictures: Pictures, arrivals: Arrivals) -> Sensed:
        return Sensed(
            time_s=np.float32(time_s),
            depth_m=np.asarray(pictures.depth_m, np.float32),
            backward_px=np.asarray(pictures.backward_px, np.float32),
            arrivals=jax.tree.map(lambda leaf: leaf[0], arrivals),
            present=np.array([epc is not None for epc in self._places]),
        )

    def _admit(self, reads: TagReads, time_ns: int) -> None:
        """Give every tag that was read a place."""
        used = reads[(reads.time_ns <= time_ns) & np.isin(reads.antenna, self._antennas)]
        for epc, stamp in zip(used.epc.tolist(), used.time_ns.tolist(), strict=True):
            self._last_read_ns[epc] = max(stamp, self._last_read_ns.get(epc, stamp))
        for epc, stamp in list(self._last_read_ns.items()):
            if time_ns - stamp > self._forget_ns:
                self._places = [None if one == epc else one for one in self._places]
                del self._last_read_ns[epc]
        known = set(self._places)
        new = [epc for epc in dict.fromkeys(used.epc.tolist()) if epc not in known]
        if not new:
            return
        places: list[str | None] = list(self._places)
        for epc in new:
            if None not in places:
                if len(places) == MAX_TAGS:
                    self._warn_of_tags()
                    break
                places += [None] * len(places)
            places[places.index(None)] = epc
        if places == self._places:
            return
        if self._state is not None:
            source = [self._places.index(one) if one in known and one is not None else -1 for one in places]
            self._state = with_tags(self._tracer, self._camera, self._state, jnp.asarray(source, jnp.int32))
        self._places = places

    def _warn_of_tags(self) -> None:
        if not self._crowded:
            self._crowded = True
            warnings.warn(
                f"found more than {MAX_TAGS} tags; the first {MAX_TAGS} are traced. Another takes a place when one has not been "
                f"read for {self._forget_ns * 1e-9:g} s (forget_s). Mask the tags that are of no interest at the reader.",
                RecordingWarning,
                stacklevel=4,
            )
