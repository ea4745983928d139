"""The true camera and true paths of simulated objects that move over a table. Needs the simulator."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ....recording import Recording
from ....sim.rendering.viewpoint import look_at
from ....sim.suites import Item, item_scenario
from ....sim.world.bodies import STEP_S
from ....sim.world.objects import bounds
from ..plane import PlaneCamera

_TABLE_M = (-0.75, -1.5, 0.75, 1.5)
_SAME_HEIGHT_M = 1e-3


@dataclasses.dataclass(frozen=True)
class TableTruth:
    """The true camera over a table, and the position of each tag and its host at every frame (z up from the table)."""

    camera: PlaneCamera
    area_m: tuple[float, float, float, float]  # x0 y0 x1 y1 of the table top
    hosts_m: Mapping[str, Float[np.ndarray, "frames 3"]]  # centre of the object
    tags_m: Mapping[str, Float[np.ndarray, "frames 3"]]


def table_truth(item: Item, recording: Recording) -> TableTruth:
    """The truth of a recording of a table-top suite, from its simulated world; x and y from below the camera.

    Raises `ValueError` where no tagged object moves, or where the objects do not stand on one plane.
    """
    scenario = item_scenario(item)
    view, world = look_at(recording.intrinsics, scenario.camera_position_m, scenario.camera_look_at_m), scenario.world
    hosts = {tag.epc: world.bodies[tag.body] for tag in world.tags}
    lowest = [body.poses.position_m[0, 2] + bounds(body.shapes)[0][2] for body in hosts.values()]
    if not hosts or np.ptp(lowest) > _SAME_HEIGHT_M or recording.truth is None:
        raise ValueError(
            f"{item.name}: found tagged objects standing at heights {lowest} m, expected some, all on one table, with "
            "their truth. Choose a suite of objects on a table."
        )
    x, y = scenario.camera_position_m[:2]
    origin, rotation = np.array([x, y, float(np.mean(lowest))]), view.rotation.T
    camera = PlaneCamera(recording.intrinsics, rotation, -rotation @ (np.asarray(view.position_m, float) - origin))
    steps_s, frames_s = np.arange(world.num_steps) * STEP_S, recording.time_ns * 1e-9
    paths = {
        epc: np.stack([np.interp(frames_s, steps_s, column) for column in body.poses.position_m.T], axis=-1) - origin
        for epc, body in hosts.items()
    }
    tags = {epc: camera.to_world(np.asarray(recording.truth.tag_position_m[epc], np.float64)) for epc in hosts}
    return TableTruth(camera, _TABLE_M, paths, tags)
