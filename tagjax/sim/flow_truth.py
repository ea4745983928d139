"""The exact flow of a simulated recording, cast again from its world: for recordings that were made without it."""

from __future__ import annotations

import dataclasses
import tempfile

import numpy as np

from ..recording import Recording, RecordingError, Truth
from .rendering.exact_flow import flow_between
from .rendering.hits import Hits
from .rendering.viewpoint import look_at
from .suites import Item, item_scenario
from .world.bodies import STEP_S

_SAME_DISTANCE_M = 1e-3


def with_exact_flow(item: Item, recording: Recording) -> Recording:
    """The recording with exact forward and backward flow in its truth; unchanged where it holds both.

    The world of the item is built again and cast at the recording's frame times. The flow lies in an unnamed temporary file.
    Raises `RecordingError` where the world is not the recording's.
    """
    truth = recording.truth or Truth()
    if truth.flow_px is not None and truth.backward_flow_px is not None:
        return recording
    from .rendering.raycast import Raycaster

    scenario = item_scenario(item)
    world = scenario.world
    view = look_at(recording.intrinsics, scenario.camera_position_m, scenario.camera_look_at_m)
    antennas_m = view.to_camera(np.asarray(scenario.antennas_m, float))
    epcs = {tag.epc for tag in world.tags}
    same = antennas_m.shape == recording.antennas_m.shape and np.allclose(
        antennas_m, recording.antennas_m, atol=_SAME_DISTANCE_M
    )
    if not same or epcs != set(truth.tag_range_m):
        raise RecordingError(
            f"{recording.name}: found another world than that of {item.name} (seed {item.seed}); exact flow needs the world that "
            "the recording was simulated from. Simulate the suite again in another folder."
        )
    shape = (recording.num_frames, *recording.image_shape, 2)
    forward, backward = (_temporary(shape) for _ in range(2))
    raycaster = Raycaster(world)
    previous: Hits | None = None
    for number, step in enumerate(np.minimum(recording.time_ns * 1e-9 / STEP_S, world.num_steps - 1)):
        raycaster.pose(step)
        hits = raycaster.cast(view)
        if previous is not None:
            flow = flow_between(previous, hits)
            forward[number - 1], backward[number] = flow.forward_px, flow.backward_px
        previous = hits
    forward[-1], backward[0] = np.nan, np.nan  # no flow from the last frame on, nor back from the first
    return dataclasses.replace(recording, truth=dataclasses.replace(truth, flow_px=forward, backward_flow_px=backward))


def _temporary(shape: tuple[int, ...]) -> np.ndarray:
    """An array in an unnamed file, which is deleted together with it."""
    with tempfile.TemporaryFile() as file:
        return np.memmap(file, np.float32, "w+", shape=shape)
