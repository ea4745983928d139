"""What happens in a simulated recording: who carries, waves, hides and hands over what, in which room.

Every story is a function of a random generator, a duration and its own settings, and gives a `Filmed` world. `STORIES`
names them; `tell` checks settings against their signatures.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ._doorway import enter_leave
from ._held import handheld, handover, put_down
from ._shop import grid, shop_exit, shop_handover
from ._tabled import tabletop
from ._walked import approach, crowd
from .record import Filmed

STORIES: Mapping[str, Callable[..., Filmed]] = {
    "handheld": handheld,
    "approach": approach,
    "crowd": crowd,
    "enter_leave": enter_leave,
    "handover": handover,
    "put_down": put_down,
    "tabletop": tabletop,
    "shop_exit": shop_exit,
    "shop_handover": shop_handover,
    "grid": grid,
}
"""What can be told, by name."""


def tell(name: str, rng: np.random.Generator, duration_s: float, settings: Mapping[str, Any] | None = None) -> Filmed:
    """The story of a name with its settings; an unknown name or setting raises `ValueError`."""
    if name not in STORIES:
        raise ValueError(f"Unknown story {name!r}; known are {', '.join(STORIES)}.")
    if not duration_s > 0:
        raise ValueError(f"A story of {duration_s} s; a positive duration is needed.")
    known = list(inspect.signature(STORIES[name]).parameters)[2:]
    unknown = sorted(set(settings or {}) - set(known))
    if unknown:
        raise ValueError(f"{name}: unknown setting {', '.join(unknown)}; known are {', '.join(known)}.")
    return STORIES[name](rng, duration_s, **(settings or {}))
