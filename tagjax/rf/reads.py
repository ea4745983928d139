"""The fixed-shape buffer in which tag reads reach the device."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int


class PhaseReads(eqx.Module):
    """Reads of one tag in a buffer of fixed length; only elements with `valid` count.

    Phases grow with distance (a reader's opposite sign is turned at the door) and lie in [0, 2 pi). `channel` numbers
    the distinct (antenna, carrier) pairs from 0: phase offsets are constant within a channel only.
    """

    time_s: Float[Array, "*batch reads"]  # from the recording's first frame
    phase_rad: Float[Array, "*batch reads"]
    carrier_hz: Float[Array, "*batch reads"]
    sigma_rad: Float[Array, "*batch reads"]  # thermal phase noise expected at the read's RSSI
    channel: Int[Array, "*batch reads"]
    valid: Bool[Array, "*batch reads"]


class RadioWindow(eqx.Module):
    """What the radio knows of a tag's distance at the frames of a sliding window, oldest first.

    Distances are relative to the first frame of the window (so the first is 0); `std_m` is the standard deviation of
    each against that first one, infinite where nothing is known (no reads yet, or a gap).
    """

    relative_m: Float[Array, "*batch window"]
    std_m: Float[Array, "*batch window"]
