"""Control reads of a piece: reads that cannot agree with what is seen, so that whatever is detected with them is false."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool

from ...radio.arrivals import Arrivals
from ...recording import Recording, TagReads
from ...recording.controls import foreign_reads, shifted_reads
from ...tracing.arrivals import frame_arrivals
from ...tracing.clips import MAX_ARRIVALS
from ...tracing.tracer import Camera


class ControlReads(eqx.Module):
    """What a control has in place of a piece's own reads; all else is the piece's."""

    arrivals: Arrivals  # (time, reads)
    present: Bool[Array | np.ndarray, "time tag"]


def control_of(recordings: Sequence[Recording], number: int) -> TagReads:
    """The control reads of one of the recordings.

    They are its own, half a recording later, where `number` is even, and those of the next recording (of the last one, the
    first) where it is odd (`tagjax.recording.controls`). So one recording by itself has a control.
    """
    one = recordings[number]
    return shifted_reads(one) if number % 2 == 0 else foreign_reads(one, recordings[(number + 1) % len(recordings)])


def control_reads(recording: Recording, reads: TagReads, camera: Camera, num_tags: int) -> ControlReads:
    """The control's reads at every frame of a recording, by the antennas of its `camera`; NumPy arrays.

    Of the read tags the first `num_tags` are kept, in the order of their EPCs, so that a control has the shapes of its
    piece. Places without a tag are not present.
    """
    places_m = np.asarray(recording.antennas_m, np.float32)
    antennas = [1 + int(np.flatnonzero(np.all(places_m == one, axis=1))[0]) for one in np.asarray(camera.antennas_m)]
    epcs = np.unique(reads.epc).tolist()[:num_tags]
    until_ns = recording.time_ns - int(recording.reversed_from is not None)
    arrivals, _ = frame_arrivals(reads, epcs, antennas, until_ns, int(recording.time_ns[0]), MAX_ARRIVALS)
    present = np.broadcast_to(np.arange(num_tags) < len(epcs), (recording.num_frames, num_tags))
    return ControlReads(arrivals, present.copy())
