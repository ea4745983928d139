"""What the radio links of a scenario depend on: paths and dipoles of tags, lines of sight, antennas, reflectors, people."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from ..recording.virtual_tags import Track
from .radio.environment import Environment, room_environment
from .rendering.visibility import sampled_steps
from .stories.scenario import Scenario
from .world.bodies import STEP_S, World, tag_dipole, tag_path
from .world.sightline import line_of_sight

_SIGHT_PERIOD_S = 0.05
"""Sampling period of lines of sight and of people's positions for the radio; a walker moves by 7 cm in it."""


@dataclasses.dataclass(frozen=True)
class Propagation:
    """The geometry of all links in the world frame. Dictionaries are by EPC, with one row for each step of the world."""

    paths: dict[str, Track]
    transmission: dict[str, Float[np.ndarray, "steps antennas"]]  # field ratio of the line of sight: 1 free, 0 metal
    dipole: dict[str, Float[np.ndarray, "steps 3"]]
    antennas_m: Float[np.ndarray, "antennas 3"]
    boresight: Float[np.ndarray, "antennas 3"]  # unit
    environment: Environment
    scatterer_path: tuple[np.ndarray, np.ndarray] | None  # times (samples,) and places (samples, people, 3)
    sampled: Int[np.ndarray, " samples"]  # steps at which lines of sight and people are known; linear in between


def propagation(scenario: Scenario) -> Propagation:
    """The links of every tag of a scenario. A tag's own body never blocks its line of sight."""
    world = scenario.world
    antennas = np.asarray(scenario.antennas_m, float)
    time_s = np.arange(world.num_steps) * STEP_S
    sampled = sampled_steps(world, _SIGHT_PERIOD_S)
    paths, transmission, dipole = {}, {}, {}
    for tag in world.tags:
        path = tag_path(world, tag)
        kept = []
        for antenna in antennas:
            start = np.broadcast_to(antenna, (len(sampled), 3))
            sight = line_of_sight(world, start, path[sampled], sampled, exclude=(tag.body,))
            kept.append(np.interp(np.arange(world.num_steps), sampled, 10.0 ** (-sight.loss_db / 20)))
        paths[tag.epc] = Track(time_s, path)
        transmission[tag.epc] = np.stack(kept, axis=-1)
        dipole[tag.epc] = tag_dipole(world, tag)
    people = _people(world)
    boresight = np.asarray(scenario.camera_look_at_m, float) - antennas
    if scenario.antenna_axes is not None:
        boresight = np.asarray(scenario.antenna_axes, float)
    return Propagation(
        paths,
        transmission,
        dipole,
        antennas,
        boresight / np.linalg.norm(boresight, axis=1, keepdims=True),
        room_environment(scenario.panels, len(people)),
        (time_s[sampled], np.stack([path[sampled] for path in people], axis=1)) if people else None,
        sampled,
    )


def _people(world: World) -> list[np.ndarray]:
    """The centre of every person at every step, (num_steps, 3): the mean over the limbs."""
    limbs: dict[str, list[np.ndarray]] = {}
    for body in world.bodies:
        if body.role == "person":
            path = body.poses.position_m
            limbs.setdefault(body.name, []).append(np.broadcast_to(path, (world.num_steps, 3)))
    return [np.mean(parts, axis=0) for parts in limbs.values()]
