"""The fixed-shape buffer in which tag reads reach the device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

if TYPE_CHECKING:
    _HostOrDevice = Array
else:
    _HostOrDevice = Array | np.ndarray


class PhaseReads(eqx.Module):
    """Reads of one tag in a buffer of fixed length; only elements with `valid` are used.

    Phases grow with distance (the opposite sign of a reader is converted on import into the buffer) and are in [0, 2
    pi). `channel` numbers the distinct (antenna, carrier) pairs from 0: phase offsets are constant within a channel
    only. Arrays may be NumPy arrays, for reads that are still on the host; compiled functions take both.
    """

    time_s: Float[_HostOrDevice, "*batch reads"]  # from the recording's first frame
    phase_rad: Float[_HostOrDevice, "*batch reads"]
    carrier_hz: Float[_HostOrDevice, "*batch reads"]
    sigma_rad: Float[_HostOrDevice, "*batch reads"]  # thermal phase noise expected at the read's RSSI
    channel: Int[_HostOrDevice, "*batch reads"]
    valid: Bool[_HostOrDevice, "*batch reads"]


class RadioWindow(eqx.Module):
    """A tag's distance, estimated from reads, at the frames of a sliding window, oldest first.

    Distances are relative to the first frame of the window (so the first is 0); `std_m` is the standard deviation of
    each difference, infinite where it is unknown (no reads yet, or a gap).
    """

    relative_m: Float[Array, "*batch window"]
    std_m: Float[Array, "*batch window"]
