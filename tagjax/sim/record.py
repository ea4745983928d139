"""From a simulated world to a `Recording`: pictures, depth, reads, and every truth from the same rays."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ..recording import ClockAudit, Intrinsics, Recording, TagReads, Truth
from ..recording.importers.clock import audit_clocks, to_host_ns
from ..recording.virtual_tags import Track
from .channel import Environment, Planes, Scatterers
from .flow_truth import flow_between
from .inventory import InventorySettings, simulate_inventory
from .raycast import Hits, Stage, look_at
from .rooms import Panel
from .sensors import SENSORS, frame_times, kinect_v2_intrinsics, xtion_intrinsics
from .session import mask_boxes
from .shading import ILLUMINATION, Shader, auto_exposure
from .visibility import steps_every
from .world import STEP_S, World, tag_dipole, tag_path

PERSON_RCS_M2 = 1.0
"""Radar cross section of a standing person at 900 MHz: the upper end of what was measured (see `Scatterers`)."""

_SIGHT_EVERY_S = 0.05
"""Between looks at lines of sight and at where people are; a walker moves by 7 cm in it."""


@dataclasses.dataclass(frozen=True)
class CaptureSettings:
    """The camera and what it makes of the scene; `width` None is the sensor's own."""

    sensor: str = "kinect_v2"
    width: int | None = None
    frame_rate_hz: float = 30.0
    illumination: str = "bright"
    jitter_s: float = 0.002
    drop_share: float = 0.0
    shutter_s: float = 0.0  # motion blur; 0 = none
    shadows: bool = True
    flow: bool = False  # exact flow and occlusion, both ways, in the truth

    def __post_init__(self):
        if self.sensor not in SENSORS:
            raise ValueError(f"Unknown sensor {self.sensor!r}; known are {', '.join(SENSORS)}.")
        if self.illumination not in ILLUMINATION:
            raise ValueError(f"Unknown illumination {self.illumination!r}; known are {', '.join(ILLUMINATION)}.")
        if self.width is not None and self.width < 16:
            raise ValueError(f"width is {self.width}; a picture of at least 16 pixels is needed.")
        if self.frame_rate_hz <= 0 or self.shutter_s < 0:
            raise ValueError(
                f"frame_rate_hz {self.frame_rate_hz}, shutter_s {self.shutter_s}; expected positive, and not negative."
            )

    def intrinsics(self) -> Intrinsics:
        """The sensor's camera at the chosen width."""
        camera = kinect_v2_intrinsics if self.sensor == "kinect_v2" else xtion_intrinsics
        return camera() if self.width is None else camera(self.width)


@dataclasses.dataclass(frozen=True)
class Filmed:
    """A world, and how it is filmed and read: all that a recording is made of. Places in the world frame."""

    world: World
    camera_position_m: tuple[float, float, float]
    camera_look_at_m: tuple[float, float, float]
    antennas_m: tuple[tuple[float, float, float], ...]
    panels: tuple[Panel, ...] = ()
    inventory: InventorySettings = dataclasses.field(default_factory=InventorySettings)
    antenna_axes: tuple[tuple[float, float, float], ...] | None = None  # unit; at camera_look_at_m if None


def room_environment(panels: Sequence[Panel], num_people: int) -> Environment:
    """The room's reflectors, and a cylinder for each person (placed by the path given with it)."""
    rows = [(p.centre_m, p.normal, p.along, p.half_size_m, p.reflection) for p in panels]
    centre, normal, along, half, reflection = zip(*rows, strict=True) if rows else ((), (), (), (), ())
    shape = (len(rows), 3)
    planes = Planes(
        np.reshape(centre, shape), np.reshape(normal, shape), np.reshape(along, shape),
        np.reshape(half, (len(rows), 2)), np.asarray(reflection, float),
    )  # fmt: skip
    people = Scatterers(
        np.zeros((num_people, 3)),
        np.full(num_people, PERSON_RCS_M2),
        np.full(num_people, -0.6),
        np.broadcast_to([0.0, 0.0, 1.0], (num_people, 3)),
        np.full(num_people, 0.5),
        np.full(num_people, 0.16),
    )
    return Environment(planes, people)


def film(
    filmed: Filmed,
    capture: CaptureSettings | None = None,
    *,
    seed: int,
    name: str,
    num_frames: int | None = None,
    on_frame: Callable[[], None] | None = None,
) -> Recording:
    """Render, sense and read a world; the same arguments give the same recording, byte for byte on one machine.

    `num_frames` None films to the end of the world. Raises `ValueError` where the world is shorter than asked.
    """
    capture = capture or CaptureSettings()
    world = filmed.world
    rng = np.random.default_rng([seed, 2])
    most = int((world.num_steps - 1) * STEP_S * capture.frame_rate_hz * (1 - capture.drop_share)) + 1
    wanted = most if num_frames is None else num_frames
    if wanted < 1 or wanted > most:
        raise ValueError(f"{name}: {wanted} frames asked for; the world lasts for {most}.")
    stamps = frame_times(wanted, capture.frame_rate_hz, rng, jitter_s=capture.jitter_s, drop_share=capture.drop_share)
    steps = np.minimum(stamps / STEP_S, world.num_steps - 1)
    stage = Stage(world)
    view = look_at(capture.intrinsics(), filmed.camera_position_m, filmed.camera_look_at_m)
    shader, sensor, lamp = Shader(stage), SENSORS[capture.sensor], ILLUMINATION[capture.illumination]
    frames: dict[str, list[np.ndarray]] = {key: [] for key in ("colour", "depth", "labels")}
    flows: dict[str, list[np.ndarray]] = {key: [] for key in ("ahead", "ahead_hidden", "back", "back_hidden")}
    previous: Hits | None = None
    exposure = 0.0
    for step in steps:
        stage.pose(step)
        hits = stage.cast(view)
        surface = shader.surface(hits)
        light = (
            shader.blurred(view, step, capture.shutter_s / STEP_S, shadows=capture.shadows)
            if capture.shutter_s > 0
            else shader.radiance(hits, surface, shadows=capture.shadows)
        )
        exposure = exposure or auto_exposure(light)
        frames["colour"].append(lamp.expose(light, rng, exposure=exposure))
        frames["depth"].append(sensor.measure(hits, surface.reflectance, surface.shine, rng))
        frames["labels"].append(stage.labels(hits))
        if capture.flow and previous is not None:
            truth = flow_between(previous, hits)
            flows["ahead"].append(truth.forward_px)
            flows["ahead_hidden"].append(truth.forward_occluded)
            flows["back"].append(truth.backward_px)
            flows["back_hidden"].append(truth.backward_occluded)
        previous = hits
        if on_frame is not None:
            on_frame()
    reads, clock, sight = _read_tags(filmed, stage, seed)
    in_camera = {tag.epc: view.to_camera(tag_path(world, tag)) for tag in world.tags}
    antennas = view.to_camera(np.asarray(filmed.antennas_m, float))
    place = {epc: _at_steps(path, steps) for epc, path in in_camera.items()}
    labels = np.stack(frames["labels"])
    height, width = view.intrinsics.height, view.intrinsics.width
    missing, nothing = np.full((height, width, 2), np.nan, np.float32), np.zeros((height, width), bool)
    flow = {}
    if capture.flow:
        flow = {
            "flow_px": np.stack([*flows["ahead"], missing]),
            "occluded": np.stack([*flows["ahead_hidden"], nothing]),
            "backward_flow_px": np.stack([missing, *flows["back"]]),
            "backward_occluded": np.stack([nothing, *flows["back_hidden"]]),
        }
    most_label = max((body.label for body in world.bodies), default=0)
    return Recording(
        colour=np.stack(frames["colour"]),
        depth=np.stack(frames["depth"]),
        time_ns=np.rint(stamps * 1e9).astype(np.int64),
        intrinsics=view.intrinsics,
        reads=reads,
        antennas_m=antennas,
        clock=clock,
        truth=Truth(
            labels=labels,
            tag_to_label={tag.epc: world.bodies[tag.body].label for tag in world.tags if world.bodies[tag.body].label},
            boxes_px=mask_boxes(labels, most_label),
            tag_range_m={epc: np.linalg.norm(path - antennas[0], axis=1) for epc, path in place.items()},
            tag_position_m=place,
            visible={label: np.any(labels == label, axis=(1, 2)) for label in range(1, most_label + 1)},
            line_of_sight={epc: _at_steps(share[:, None], steps)[:, 0] for epc, share in sight.items()},
            **flow,
        ),
        name=name,
        source=f"simulated: {world.note or name}, seed {seed}, {capture}",
    )


def _at_steps(path: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """A path (num_steps, dims) at fractional steps."""
    index = np.arange(len(path))
    return np.stack([np.interp(steps, index, column) for column in path.T], axis=-1)


def _read_tags(filmed: Filmed, stage: Stage, seed: int) -> tuple[TagReads, ClockAudit | None, dict[str, np.ndarray]]:
    """The reads, on the host's clock; and each tag's share of the first antenna's field that its line of sight keeps."""
    world = filmed.world
    if not world.tags:
        return TagReads.empty(), None, {}
    antennas = np.asarray(filmed.antennas_m, float)
    time_s = np.arange(world.num_steps) * STEP_S
    checked = steps_every(world, _SIGHT_EVERY_S)
    paths, transmission, dipole = {}, {}, {}
    for tag in world.tags:
        path = tag_path(world, tag)
        kept = []
        for antenna in antennas:
            start = np.broadcast_to(antenna, (len(checked), 3))
            sight = stage.line_of_sight(start, path[checked], steps=checked, exclude=(tag.body,))
            kept.append(np.interp(np.arange(world.num_steps), checked, 10.0 ** (-sight.loss_db / 20)))
        paths[tag.epc] = Track(time_s, path)
        transmission[tag.epc] = np.stack(kept, axis=-1)
        dipole[tag.epc] = tag_dipole(world, tag)
    people = _people(world)
    moving = (time_s[checked], np.stack([path[checked] for path in people], axis=1)) if people else None
    boresight = np.asarray(filmed.camera_look_at_m, float) - antennas
    if filmed.antenna_axes is not None:
        boresight = np.asarray(filmed.antenna_axes, float)
    done = simulate_inventory(
        paths,
        antennas,
        room_environment(filmed.panels, len(people)),
        filmed.inventory,
        seed=seed,
        transmission=transmission,
        dipole=dipole,
        boresight=boresight / np.linalg.norm(boresight, axis=1, keepdims=True),
        scatterer_path=moving,
    )
    sight = {epc: share[:, 0] for epc, share in transmission.items()}
    reads = done.reads
    if reads.reader_time_ns is None or reads.num_reads < 2:
        return reads, None, sight
    # As the importers do: what the reader's clock says, on the host's.
    audit = audit_clocks(reads.reader_time_ns, reads.time_ns)
    return dataclasses.replace(reads, time_ns=to_host_ns(reads.reader_time_ns, audit)), audit, sight


def _people(world: World) -> list[np.ndarray]:
    """The middle of every person at every step: the mean of all limbs."""
    limbs: dict[str, list[np.ndarray]] = {}
    for body in world.bodies:
        if body.role == "person":
            path = body.poses.position_m
            limbs.setdefault(body.name, []).append(np.broadcast_to(path, (world.num_steps, 3)))
    return [np.mean(parts, axis=0) for parts in limbs.values()]
