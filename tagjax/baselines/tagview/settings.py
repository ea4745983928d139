"""Settings of Tagview's system."""

from __future__ import annotations

import dataclasses

from .detection import DetectorSettings
from .matching import MatchSettings
from .sequences import ReadSettings
from .tracks import SortSettings


@dataclasses.dataclass(frozen=True)
class TagviewSettings:
    """Settings of all stages; each stage's own class marks what is ours and not the paper's."""

    decision_interval_s: float = 0.5
    memory_s: float = 60.0
    min_trace_s: float = 0.4  # a shorter trace is no candidate
    height_m: float | None = None  # of the camera over the plane of the objects' centres; None: estimated by the fit
    detector: DetectorSettings = dataclasses.field(default_factory=DetectorSettings)
    tracks: SortSettings = dataclasses.field(default_factory=SortSettings)
    reads: ReadSettings = dataclasses.field(default_factory=ReadSettings)
    match: MatchSettings = dataclasses.field(default_factory=MatchSettings)

    def __post_init__(self):
        if not (self.memory_s > 0 and self.decision_interval_s >= 0 and self.min_trace_s >= 0):
            raise ValueError(
                f"memory_s {self.memory_s}, decision_interval_s {self.decision_interval_s}, min_trace_s {self.min_trace_s}; "
                "expected a positive time, and two that are not negative."
            )
        if self.height_m is not None and not self.height_m > 0:
            raise ValueError(f"height_m is {self.height_m}; expected a positive height, or None to estimate it.")
