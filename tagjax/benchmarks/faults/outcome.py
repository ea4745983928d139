"""What a trial of faults found."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One kind of fault: how many were tried, how many of them failed, and a few of the failures."""

    kind: str
    tried: int
    failed: int
    examples: tuple[str, ...] = ()
