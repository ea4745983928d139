"""A scenario: a world with its camera, its antennas and its reader. Stories build it; `record` simulates it."""

from __future__ import annotations

import dataclasses

from ..radio.inventory import InventorySettings
from ..world.bodies import World
from ..world.furniture import Panel


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A world with its camera, antennas and reader: all that a recording depends on. Positions are in the world frame."""

    world: World
    camera_position_m: tuple[float, float, float]
    camera_look_at_m: tuple[float, float, float]
    antennas_m: tuple[tuple[float, float, float], ...]
    panels: tuple[Panel, ...] = ()
    inventory: InventorySettings = dataclasses.field(default_factory=InventorySettings)
    antenna_axes: tuple[tuple[float, float, float], ...] | None = None  # unit; at camera_look_at_m if None
