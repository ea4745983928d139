"""Simulate a scenario: a `Recording` with pictures, depth, reads and the complete ground truth.

Ray casting, and with it MuJoCo (the `sim` extra), is imported when the first recording is simulated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ..recording import ClockAudit, Intrinsics, Recording, RecordingError, SecondCamera, TagReads, Truth
from ..recording.importers.clock import to_host_clock
from ..recording.recording import MAX_BASELINE_M, MIN_BASELINE_M
from .propagation import propagation
from .radio.inventory import simulate_inventory
from .rendering.exact_flow import FlowTruth, flow_between
from .rendering.exposure import ILLUMINATION, auto_exposure
from .rendering.hits import Hits
from .rendering.sensors import SENSORS, frame_times, kinect_v2_intrinsics, xtion_intrinsics
from .rendering.viewpoint import Viewpoint, look_at, moved_right
from .stories.scenario import Scenario
from .world.bodies import STEP_S, World, tag_path


@dataclasses.dataclass(frozen=True)
class CaptureSettings:
    """The simulated camera. `width` None is the sensor's native width."""

    sensor: str = "kinect_v2"
    width: int | None = None
    frame_rate_hz: float = 30.0
    illumination: str = "bright"
    jitter_s: float = 0.002  # standard deviation of frame times
    drop_probability: float = 0.0  # of a frame
    shutter_s: float = 0.0  # exposure time that causes motion blur; 0 = none
    shadows: bool = True
    flow: bool = False  # exact forward and backward flow with occlusion in the truth
    # Of a second colour camera to the right of the first, rectified, with the same intrinsics; None: one camera. It is left
    # out of texts that describe a recording of one camera: those stay what they were.
    stereo_baseline_m: float | None = dataclasses.field(default=None, repr=False)

    def __post_init__(self):
        if self.sensor not in SENSORS:
            raise ValueError(f"sensor is {self.sensor!r}; expected one of {', '.join(SENSORS)}.")
        if self.illumination not in ILLUMINATION:
            raise ValueError(f"illumination is {self.illumination!r}; expected one of {', '.join(ILLUMINATION)}.")
        if self.width is not None and self.width < 16:
            raise ValueError(f"width is {self.width}; expected at least 16 pixels.")
        if self.frame_rate_hz <= 0 or self.shutter_s < 0:
            raise ValueError(
                f"frame_rate_hz is {self.frame_rate_hz} and shutter_s {self.shutter_s}; expected a positive rate and a "
                "shutter time of at least 0."
            )
        if self.stereo_baseline_m is not None and not MIN_BASELINE_M <= self.stereo_baseline_m <= MAX_BASELINE_M:
            raise ValueError(
                f"stereo_baseline_m is {self.stereo_baseline_m}; expected {MIN_BASELINE_M:g} to {MAX_BASELINE_M:g} m between the "
                "cameras, or null for one camera."
            )

    def __str__(self) -> str:
        """The settings as a text; the second camera is named only where there is one."""
        second = "" if self.stereo_baseline_m is None else f", stereo_baseline_m={self.stereo_baseline_m}"
        return f"{repr(self)[:-1]}{second})"

    def intrinsics(self) -> Intrinsics:
        """The sensor's camera at the chosen width."""
        camera = kinect_v2_intrinsics if self.sensor == "kinect_v2" else xtion_intrinsics
        return camera() if self.width is None else camera(self.width)


def simulate_recording(
    scenario: Scenario,
    capture: CaptureSettings | None = None,
    *,
    seed: int,
    name: str,
    num_frames: int | None = None,
    on_frame: Callable[[], None] | None = None,
) -> Recording:
    """Render the pictures of a scenario and read its tags. The same arguments give the same bytes on one machine.

    `num_frames` None renders to the end of the world. Raises `ValueError` where the world is shorter than `num_frames`.
    """
    capture = capture or CaptureSettings()
    world = scenario.world
    rng = np.random.default_rng([seed, 2])
    longest = int((world.num_steps - 1) * STEP_S * capture.frame_rate_hz * (1 - capture.drop_probability)) + 1
    wanted = longest if num_frames is None else num_frames
    if not 1 <= wanted <= longest:
        raise ValueError(f"{name}: num_frames is {wanted}; expected 1 to {longest}, the length of the world.")
    times = frame_times(
        wanted, capture.frame_rate_hz, rng, jitter_s=capture.jitter_s, drop_probability=capture.drop_probability
    )
    steps = np.minimum(times / STEP_S, world.num_steps - 1)
    view = look_at(capture.intrinsics(), scenario.camera_position_m, scenario.camera_look_at_m)
    people, person_of_body = carriers(world)
    frames, flow = _render(
        world, view, capture, steps, rng, on_frame, person_of_body, second_rng=np.random.default_rng([seed, 2, 1])
    )
    reads, clock, sight = _read_tags(scenario, seed)
    antennas = view.to_camera(np.asarray(scenario.antennas_m, float))
    position = {tag.epc: _at_steps(view.to_camera(tag_path(world, tag)), steps) for tag in world.tags}
    labels = frames["labels"]
    carrier_boxes = mask_boxes(frames["carriers"], len(people))
    num_labels = max((body.label for body in world.bodies), default=0)
    return Recording(
        colour=frames["colour"],
        depth=frames["depth"],
        time_ns=np.rint(times * 1e9).astype(np.int64),
        intrinsics=view.intrinsics,
        reads=reads,
        antennas_m=antennas,
        clock=clock,
        truth=Truth(
            labels=labels,
            tag_to_label={tag.epc: world.bodies[tag.body].label for tag in world.tags if world.bodies[tag.body].label},
            boxes_px=mask_boxes(labels, num_labels),
            tag_range_m={epc: np.linalg.norm(path - antennas[0], axis=1) for epc, path in position.items()},
            tag_position_m=position,
            visible={label: np.any(labels == label, axis=(1, 2)) for label in range(1, num_labels + 1)},
            carrier_box_px={
                tag.epc: carrier_boxes[:, people.index(holder)]
                for tag in world.tags
                if (holder := world.bodies[tag.body].holder)
            },
            line_of_sight={epc: _at_steps(kept[:, None], steps)[:, 0] for epc, kept in sight.items()},
            **flow,
        ),
        second=None
        if "second" not in frames
        else SecondCamera(frames["second"], float(capture.stereo_baseline_m or 0)),
        name=name,
        source=f"simulated: {world.note or name}, seed {seed}, {capture}",
    )


def _render(
    world: World,
    view: Viewpoint,
    capture: CaptureSettings,
    steps: np.ndarray,
    rng: np.random.Generator,
    on_frame: Callable[[], None] | None,
    person_of_body: np.ndarray,
    second_rng: np.random.Generator,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Colour, depth, labels and carriers of every frame, and the fields of `Truth` that hold exact flow (none unless asked for).

    Carriers are pictures of `person_of_body` at the body that each pixel shows. A second camera has noise of its own
    (`second_rng`), so that the pictures of the first do not depend on it.
    """
    from .rendering.raycast import Raycaster
    from .rendering.shading import Shader, Surface

    raycaster = Raycaster(world)
    shader, sensor, lamp = Shader(raycaster), SENSORS[capture.sensor], ILLUMINATION[capture.illumination]
    frames: dict[str, list[np.ndarray]] = {"colour": [], "depth": [], "labels": [], "carriers": []}
    flows = []
    second = None if capture.stereo_baseline_m is None else moved_right(view, capture.stereo_baseline_m)
    if second is not None:
        frames["second"] = []

    def light_of(hits: Hits, surface: Surface | None, step: float) -> np.ndarray:
        if capture.shutter_s > 0:
            return shader.blurred(hits.view, step, capture.shutter_s / STEP_S, shadows=capture.shadows)
        return shader.radiance(hits, surface, shadows=capture.shadows)

    previous: Hits | None = None
    exposure = 0.0
    for step in steps:
        raycaster.pose(step)
        hits = raycaster.cast(view)
        surface = shader.surface(hits)
        light = light_of(hits, surface, step)
        exposure = exposure or auto_exposure(light)
        frames["colour"].append(lamp.expose(light, rng, exposure=exposure))
        frames["depth"].append(sensor.measure(hits, surface.reflectance, surface.shine, rng))
        frames["labels"].append(raycaster.labels(hits))
        shown = person_of_body[raycaster.geom_body[np.maximum(hits.geom, 0)]]
        frames["carriers"].append(np.where(hits.geom >= 0, shown, 0))
        if capture.flow and previous is not None:
            flows.append(flow_between(previous, hits))
        previous = hits
        if second is not None:
            seen = light_of(raycaster.cast(second), None, step)
            frames["second"].append(lamp.expose(seen, second_rng, exposure=exposure))
        if on_frame is not None:
            on_frame()
    pictures = {key: np.stack(values) for key, values in frames.items()}
    if not capture.flow:
        return pictures, {}
    return pictures, _flow_fields(flows, (view.intrinsics.height, view.intrinsics.width))


def _flow_fields(flows: Sequence[FlowTruth], shape: tuple[int, int]) -> dict[str, np.ndarray]:
    """The fields of `Truth` that hold exact flow: there is none from the last frame on, nor back from the first."""
    missing, nothing = np.full((*shape, 2), np.nan, np.float32), np.zeros(shape, bool)
    return {
        "flow_px": np.stack([*(flow.forward_px for flow in flows), missing]),
        "occluded": np.stack([*(flow.forward_occluded for flow in flows), nothing]),
        "backward_flow_px": np.stack([missing, *(flow.backward_px for flow in flows)]),
        "backward_occluded": np.stack([nothing, *(flow.backward_occluded for flow in flows)]),
    }


def carriers(world: World) -> tuple[list[str], np.ndarray]:
    """Names of the people who hold an object throughout, and for each body the number of its person (from 1), uint8.

    What a person holds is part of the carrier, as its limbs are. Other bodies have 0.
    """
    people = list(dict.fromkeys(body.holder for body in world.bodies if body.holder))
    owners = [body.name if body.role == "person" else body.holder for body in world.bodies]
    return people, np.array([people.index(owner) + 1 if owner in people else 0 for owner in owners], np.uint8)


def mask_boxes(labels: np.ndarray, num_labels: int) -> np.ndarray:
    """Boxes x0 y0 x1 y1 (inclusive) of labels 1 .. num_labels, float32 (frames, labels, 4), NaN where not visible."""
    out = np.full((len(labels), num_labels, 4), np.nan, np.float32)
    for t, frame in enumerate(labels):
        for label in range(1, num_labels + 1):
            rows, columns = np.nonzero(frame == label)
            if rows.size:
                out[t, label - 1] = columns.min(), rows.min(), columns.max(), rows.max()
    return out


def _at_steps(path: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """A path (num_steps, dims) at fractional steps."""
    index = np.arange(len(path))
    return np.stack([np.interp(steps, index, column) for column in path.T], axis=-1)


def _read_tags(scenario: Scenario, seed: int) -> tuple[TagReads, ClockAudit | None, dict[str, np.ndarray]]:
    """The reads on the host's clock, and for each tag the field ratio that its line of sight to the first antenna keeps.

    The ratio is (num_steps,): 1 for a free line of sight, 0 behind metal.
    """
    if not scenario.world.tags:
        return TagReads.empty(), None, {}
    around = propagation(scenario)
    inventory = simulate_inventory(
        around.paths,
        around.antennas_m,
        around.environment,
        scenario.inventory,
        seed=seed,
        transmission=around.transmission,
        dipole=around.dipole,
        boresight=around.boresight,
        scatterer_path=around.scatterer_path,
    )
    sight = {epc: ratio[:, 0] for epc, ratio in around.transmission.items()}
    reads = inventory.reads
    if reads.reader_time_ns is None or reads.num_reads < 2:
        return reads, None, sight
    # As importers do: times of the reader's clock, converted to the host's clock.
    try:
        converted = to_host_clock(reads.reader_time_ns, reads.time_ns)
    except RecordingError:  # too few reads to compare the clocks: importers would take the times of arrival
        return dataclasses.replace(reads, arrival_time_ns=reads.time_ns), None, sight
    reads = dataclasses.replace(reads, time_ns=converted.time_ns, arrival_time_ns=reads.time_ns)
    return reads[converted.usable], converted.audit, sight
