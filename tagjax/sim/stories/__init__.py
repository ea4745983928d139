"""What happens in a simulated recording: who carries, waves, hides and hands over what, in which room.

Every story is a function of a random generator, a duration and its own settings, and gives a `Scenario` world. `STORIES`
names them; `build_scenario` checks settings against their signatures.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .doorway import enter_leave
from .handheld import handheld, handover, put_down
from .scenario import Scenario
from .shop import grid, shop_exit, shop_handover
from .tabletop import tabletop
from .walking import approach, crowd, walkers

STORIES: Mapping[str, Callable[..., Scenario]] = {
    "handheld": handheld,
    "approach": approach,
    "crowd": crowd,
    "walkers": walkers,
    "enter_leave": enter_leave,
    "handover": handover,
    "put_down": put_down,
    "tabletop": tabletop,
    "shop_exit": shop_exit,
    "shop_handover": shop_handover,
    "grid": grid,
}
"""What can be told, by name."""


def build_scenario(
    name: str, rng: np.random.Generator, duration_s: float, settings: Mapping[str, Any] | None = None
) -> Scenario:
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
