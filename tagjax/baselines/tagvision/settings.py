"""Settings of TagVision's system."""

from __future__ import annotations

import dataclasses

from .detection import BlobSettings
from .matching import MatchSettings
from .tracks import TrackSettings


@dataclasses.dataclass(frozen=True)
class TagVisionSettings:
    """Settings of all stages; each stage's own class marks what is ours and not the paper's."""

    height_m: float = 0.0  # of the plane in which the objects' centres move, above the calibrated plane
    antenna: int = 1
    decision_interval_s: float = 0.2
    memory_s: float = 30.0
    blobs: BlobSettings = dataclasses.field(default_factory=BlobSettings)
    tracks: TrackSettings = dataclasses.field(default_factory=TrackSettings)
    match: MatchSettings = dataclasses.field(default_factory=MatchSettings)

    def __post_init__(self):
        if self.antenna < 1:
            raise ValueError(f"antenna is {self.antenna}; antennas are counted from 1.")
        if not (self.memory_s > 0 and self.decision_interval_s >= 0):
            raise ValueError(
                f"memory_s {self.memory_s}, decision_interval_s {self.decision_interval_s}; expected a positive time, and "
                "one that is not negative."
            )
