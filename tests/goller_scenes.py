"""Drawn scenes of a shop seen from above, with tags and their reads: for the tests of Goller et al."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from tagjax.baselines.goller import Calibration, GollerSettings
from tagjax.baselines.goller.antennas import AntennaModel, response_db
from tagjax.baselines.goller.detection import BlobSettings
from tagjax.baselines.goller.location import locate, make_grid, make_location
from tagjax.baselines.goller.matching import make_association
from tagjax.recording import Intrinsics, Recording, TagReads, Truth

MEANS = np.array([[0.0, 0.0], [2.1, 0.1], [4.2, -0.1]])


SCALES = np.array([[1.2, 0.9], [1.4, 1.1], [1.0, 0.8]])


SKEWS = np.array([0.0, 0.3, -0.4])


def antennas(floor_dbm: float = -80.0) -> AntennaModel:
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return AntennaModel(
        single(MEANS), single(np.log(SCALES)), single(SKEWS), single(np.log([22.0, 25.0, 20.0])), single(floor_dbm)
    )


def grid_points(spacing: float = 0.5) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-1.0, 5.3, spacing), np.arange(-1.2, 1.3, spacing))
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def location_model(**settings: float):
    return make_location(antennas(), **settings)


FLOOR = make_grid((-2.0, -1.6), (6.2, 1.6), 0.4)


locate_compiled = jax.jit(locate)


def frame_times(num: int) -> jax.Array:
    return jnp.arange(num, dtype=jnp.float32) * 0.1


def rssi_at(path: np.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(lambda p: response_db(antennas(), p))(jnp.asarray(path, jnp.float32))) - 80.0


HEIGHT, WIDTH, FOCAL, CEILING_M = 120, 64, 40.0, 3.0


RATE_HZ = 10.0


LENS = Intrinsics(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)


EXIT = (0.0, 2.1, 0.2)  # camera frame: antenna 1, 0.2 m below the camera


ANTENNAS_M = np.array([EXIT, (0.0, 0.0, 0.2), (0.0, -2.1, 0.2)])


TALL_M = 1.7


def camera_point(room: np.ndarray, height_m: float) -> np.ndarray:
    """Room (x, y) below antenna 1 to the camera frame."""
    return np.array([-room[1], EXIT[1] - room[0], CEILING_M - height_m])


def draw_people(people: list[np.ndarray], colours: list[tuple[int, int, int]], noise: np.random.Generator):
    """Picture and depth of flat squares of 0.6 m at half a person's height, with a shadow beside each."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    floor = (120 + 40 * ((rows // 6 + columns // 6) % 2))[..., None] * np.array([1.0, 0.95, 0.9])
    depth = np.full((HEIGHT, WIDTH), CEILING_M, np.float32)
    boxes = []
    for place, colour in zip(people, colours, strict=True):
        point = camera_point(place, TALL_M / 2)
        u, v = FOCAL * point[:2] / point[2] + (LENS.cx_px, LENS.cy_px)
        half = 0.3 * FOCAL / point[2]
        shade = (np.abs(columns - u - 2 * half) <= half) & (np.abs(rows - v) <= half)
        floor[shade] *= 0.7
        inside = (np.abs(columns - u) <= half) & (np.abs(rows - v) <= half)
        floor[inside] = np.array(colour) * (0.8 + 0.2 * ((rows[inside] // 2) % 2))[:, None]
        depth[inside] = point[2]
        boxes.append(inside)
    picture = np.clip(floor + noise.normal(0, 2, floor.shape), 0, 255).astype(np.uint8)
    return picture, depth, boxes


def drawn_shop(
    walks: dict[str, np.ndarray],
    still: dict[str, tuple[float, float]],
    *,
    num_frames: int = 70,
    strangers: tuple[np.ndarray, ...] = (),
    name: str = "drawn",
    seed: int = 0,
) -> Recording:
    """People with tags on walks (by EPC), still tags, and people without a tag."""
    rng = np.random.default_rng(seed)
    paths = [*walks.values(), *strangers]
    palette = [(200, 40, 40), (30, 60, 200), (30, 160, 60)]
    colour, depth, labels = [], [], []
    for frame in range(num_frames):
        picture, distance, masks = draw_people([path[frame] for path in paths], palette[: len(paths)], rng)
        colour.append(picture)
        depth.append(distance)
        label = np.zeros((HEIGHT, WIDTH), np.uint8)
        for number, mask in enumerate(masks, start=1):
            label[mask] = number
        labels.append(label)
    time_ns = (np.arange(num_frames) / RATE_HZ * 1e9).astype(np.int64)
    where = {**walks, **{epc: np.broadcast_to(place, (num_frames, 2)) for epc, place in still.items()}}
    rows: list[tuple] = []
    for number, (epc, path) in enumerate(where.items()):
        stamp = np.arange(0.003 * number, num_frames / RATE_HZ, 1 / 45)
        place = np.stack([np.interp(stamp, time_ns * 1e-9, path[:, axis]) for axis in (0, 1)], axis=-1)
        level = rssi_at(place)
        for read, second in enumerate(stamp):
            antenna = read // 2 % 3
            rssi = level[read, antenna] + rng.normal(0, 1.0)
            if rssi > -77.5:
                rows.append((epc, int(second * 1e9), antenna + 1, rssi))
    rows.sort(key=lambda row: row[1])
    reads = TagReads(
        epc=np.array([row[0] for row in rows], dtype="<U24"),
        time_ns=np.array([row[1] for row in rows], np.int64),
        antenna=np.array([row[2] for row in rows], np.int16),
        carrier_hz=np.full(len(rows), 915e6),
        phase_rad=np.zeros(len(rows)),
        rssi_dbm=np.array([row[3] for row in rows], np.float32),
        doppler_hz=np.full(len(rows), np.nan, np.float32),
    )
    truth = Truth(
        labels=np.stack(labels),
        tag_to_label={epc: number for number, epc in enumerate(walks, start=1)},
        tag_position_m={epc: np.stack([camera_point(p, 1.0) for p in path]) for epc, path in where.items()},
    )
    return Recording(
        colour=np.stack(colour),
        depth=np.stack(depth),
        time_ns=time_ns,
        intrinsics=LENS,
        reads=reads,
        antennas_m=ANTENNAS_M,
        truth=truth,
        name=name,
    )


def straight(start: tuple[float, float], end: tuple[float, float], num_frames: int = 70, wait: int = 5) -> np.ndarray:
    share = np.clip((np.arange(num_frames) - wait) / (num_frames - wait - 5), 0, 1)[:, None]
    return (1 - share) * np.array(start) + share * np.array(end)


LOOKING_DOWN = GollerSettings(blobs=BlobSettings(position="centre", area_m2=(0.05, 1.0)), cell_m=0.4)


def grid_recording() -> Recording:
    """A tag that is still for 1 s at each point of a grid, without people."""
    places = grid_points(0.7)
    path = np.repeat(places, 11, axis=0)
    recording = drawn_shop({}, {"x": (0.0, 0.0)}, num_frames=2)
    num = len(path)
    made = drawn_shop({}, {}, num_frames=2)
    assert made.reads.num_reads == 0
    rng = np.random.default_rng(5)
    stamp = np.arange(0, num / RATE_HZ, 1 / 60)
    at = path[np.minimum((stamp * RATE_HZ).astype(int), num - 1)]
    antenna = np.arange(len(stamp)) % 3
    rssi = rssi_at(at)[np.arange(len(stamp)), antenna] + rng.normal(0, 1.0, len(stamp))
    received = rssi > -77.5
    count = int(received.sum())
    reads = dataclasses.replace(
        TagReads.empty(),
        epc=np.full(count, "grid", "<U24"),
        time_ns=(stamp[received] * 1e9).astype(np.int64),
        antenna=(antenna[received] + 1).astype(np.int16),
        carrier_hz=np.full(count, 915e6),
        phase_rad=np.zeros(count),
        rssi_dbm=rssi[received].astype(np.float32),
        doppler_hz=np.zeros(count, np.float32),
    )
    return dataclasses.replace(
        recording,
        colour=np.repeat(np.asarray(recording.colour)[:1], num, axis=0),
        depth=np.repeat(np.asarray(recording.depth)[:1], num, axis=0),
        time_ns=(np.arange(num) / RATE_HZ * 1e9).astype(np.int64),
        reads=reads,
        truth=Truth(tag_position_m={"grid": np.stack([camera_point(p, 1.0) for p in path])}),
        name="grid",
    )


def frames_beyond_exit(walk: np.ndarray) -> np.ndarray:
    """Frames of a walker's first metre of the exit region."""
    frames = np.flatnonzero((walk[:, 0] < 0.0) & (walk[:, 0] > -1.0))
    assert len(frames) > 8
    return frames


@functools.cache
def shop() -> Recording:
    """One person with a tag leaves; two tags are still."""
    return drawn_shop({"leaver": straight((4.6, 0.3), (-1.6, 0.3))}, {"shelf": (2.6, -1.0), "near": (0.6, -1.0)})


@functools.cache
def calibration() -> Calibration:
    """The antennas of the scenes, everything else at its initial value."""
    return Calibration(location_model(), make_association(), jnp.asarray(0.5), jnp.asarray(-62.0))
