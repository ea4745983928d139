"""Stories: the actions in a simulated recording, such as walking, waving, hiding and handing over of tagged objects.

Every story is a function of a random generator, a duration and its own settings that returns a `Scenario`. `STORIES`
lists them by name; `build_scenario` checks settings against their signatures.
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
"""The stories by name."""


def build_scenario(
    name: str, rng: np.random.Generator, duration_s: float, settings: Mapping[str, Any] | None = None
) -> Scenario:
    """The scenario of a story with its settings. An unknown name or setting raises `ValueError`."""
    if name not in STORIES:
        raise ValueError(f"story is {name!r}; expected one of {', '.join(STORIES)}.")
    if not duration_s > 0:
        raise ValueError(f"duration_s is {duration_s}; expected a positive duration.")
    known = list(inspect.signature(STORIES[name]).parameters)[2:]
    unknown = sorted(set(settings or {}) - set(known))
    if unknown:
        raise ValueError(f"{name}: unknown setting {', '.join(unknown)}; expected settings among {', '.join(known)}.")
    return STORIES[name](rng, duration_s, **(settings or {}))
