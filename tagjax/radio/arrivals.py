"""The reads that arrived since the last frame, of all tags and antennas, in one buffer of fixed length."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

if TYPE_CHECKING:
    _HostOrDevice = Array
else:
    _HostOrDevice = Array | np.ndarray


class Arrivals(eqx.Module):
    """Reads in order of time in a buffer of fixed length; only elements with `valid` are used.

    Tags and antennas are numbered from 0 in the order of the tracer's tags and antennas. Phases grow with distance (the
    opposite sign of a reader is converted on import into the buffer) and are in [0, 2 pi). Phase offsets of a tag and an
    antenna are constant within a channel only. Arrays may be NumPy arrays, for reads that are still on the host.
    """

    tag: Int[_HostOrDevice, "*batch reads"]
    antenna: Int[_HostOrDevice, "*batch reads"]
    time_s: Float[_HostOrDevice, "*batch reads"]  # from the recording's first frame
    phase_rad: Float[_HostOrDevice, "*batch reads"]
    carrier_hz: Float[_HostOrDevice, "*batch reads"]
    channel: Int[_HostOrDevice, "*batch reads"]  # one number for each carrier: kHz
    rssi_dbm: Float[_HostOrDevice, "*batch reads"]
    valid: Bool[_HostOrDevice, "*batch reads"]
