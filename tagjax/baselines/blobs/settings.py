"""Settings of the blob tracer."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class BlobSettings:
    """Settings of all stages; chosen by hand on training recordings of `walkers` and `single_static`."""

    background_s: float = 6.0  # memory of the background in colour and depth
    nearer_m: float = 0.05  # a pixel so much nearer than the background is foreground ...
    nearer_fraction: float = 0.02  # ... or this fraction of its depth, if that is more
    edge_m: float = 0.08  # neighbours whose depths differ by more belong to different parts
    min_area_m2: float = 0.003
    acceleration_m_s2: float = 6.0  # of tracks: standard deviation of white noise
    position_m: float = 0.02  # of blobs: standard deviation of their centre
    gate_m: float = 0.35  # a blob farther from a track's prediction starts its own
    max_unseen_s: float = 0.5
    confirm_s: float = 0.1  # a track has to be this old
    memory_s: float = 3.0  # reads that are compared
    min_reads: int = 10
    min_gain: float = 0.1  # of coherence, by a track over the hypothesis that the tag is stationary
    min_coherence: float = 0.4

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} is {value}; expected a positive number.")
        for name in ("nearer_fraction", "min_gain", "min_coherence"):
            if not getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected less than 1.")
