"""Settings of a site that Goller et al.'s system does not fit."""

from __future__ import annotations

import dataclasses

from .detection import BlobSettings


@dataclasses.dataclass(frozen=True)
class GollerSettings:
    """Settings of the system, beside what `calibrate` and `fit_association` find."""

    blobs: BlobSettings = dataclasses.field(default_factory=BlobSettings)
    period_s: float = 0.5  # of RSSI means: the reader switches through all antennas within it
    cell_m: float = 0.2  # of the floor grid
    margin_m: tuple[float, float] = (2.0, 1.6)  # of the floor beyond the antennas, x and y
    num_slots: int = 6  # largest number of blobs at a time
    exit_x_m: float = 0.0  # the exit region lies below this x: beyond antenna 1
    exit_antenna: int = 1  # of the RFID-only rule
