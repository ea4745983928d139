"""The result of a trial of faults."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How many faults of a kind were tried, how many of them failed, and the first failures."""

    kind: str
    tried: int
    failed: int
    examples: tuple[str, ...] = ()
