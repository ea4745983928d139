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
    """Reads of one tag in a buffer of fixed length; only elements with `valid` count.

    Phases grow with distance (a reader's opposite sign is turned at the door) and lie in [0, 2 pi). `channel` numbers
    the distinct (antenna, carrier) pairs from 0: phase offsets are constant within a channel only. NumPy arrays are
    reads that have not been to a device yet; compiled functions take them.
    """

    time_s: Float[_HostOrDevice, "*batch reads"]  # from the recording's first frame
    phase_rad: Float[_HostOrDevice, "*batch reads"]
    carrier_hz: Float[_HostOrDevice, "*batch reads"]
    sigma_rad: Float[_HostOrDevice, "*batch reads"]  # thermal phase noise expected at the read's RSSI
    channel: Int[_HostOrDevice, "*batch reads"]
    valid: Bool[_HostOrDevice, "*batch reads"]


class RadioWindow(eqx.Module):
    """What the radio knows of a tag's distance at the frames of a sliding window, oldest first.

    Distances are relative to the first frame of the window (so the first is 0); `std_m` is the standard deviation of
    each against that first one, infinite where nothing is known (no reads yet, or a gap).
    """

    relative_m: Float[Array, "*batch window"]
    std_m: Float[Array, "*batch window"]
