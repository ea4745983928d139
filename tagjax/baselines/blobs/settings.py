"""Settings of the blob tracer."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class BlobSettings:
    """Settings of all stages; chosen by hand on training recordings of `single_static`, `multi_4` and `walkers`."""

    background_s: float = 6.0  # memory of the background in colour and depth
    nearer_m: float = 0.05  # a pixel so much nearer than the background is foreground ...
    nearer_fraction: float = 0.02  # ... or this fraction of its depth, if that is more
    whole_edge_m: float = 0.3  # steps in depth that separate whole bodies
    part_edge_m: float = 0.08  # steps in depth that separate the parts of a body: an object from the arm that holds it
    min_area_m2: float = 0.003
    acceleration_m2_s3: float = 1.2  # of tracks: spectral density of white noise
    position_m: float = 0.02  # of blobs: standard deviation of their centre
    gate_m: float = 0.35  # a blob farther from a track's prediction starts its own
    max_unseen_s: float = 0.5
    confirm_s: float = 0.1  # a track has to be this old
    memory_s: float = 3.0  # reads that are compared
    phase_std_rad: float = 0.3  # of phases, with reflections
    min_evidence: float = 3.0  # nats for a track, against a tag that stays where it is: odds of 20

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} is {value}; expected a positive number.")
        if not self.nearer_fraction < 1:
            raise ValueError(f"nearer_fraction is {self.nearer_fraction}; expected less than 1.")
        if not self.part_edge_m <= self.whole_edge_m:
            raise ValueError(
                f"part_edge_m is {self.part_edge_m}; expected at most whole_edge_m, {self.whole_edge_m}: parts are pieces of "
                "whole bodies."
            )
