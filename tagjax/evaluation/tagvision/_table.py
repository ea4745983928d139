"""TagVision on recordings of things that move over a table: blob matching and tracking error (VI.C-D)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ...baselines._interface import HostCamera, host_frames
from ...baselines.tagvision import Match, MatchSettings, PlaneCamera, TagVision, TagVisionSettings, heading, match_tags
from ...recording import Recording
from ...sim.rendering.viewpoint import look_at
from ...sim.suites import Item, item_scenario
from ...sim.world.bodies import STEP_S
from ...sim.world.objects import bounds

SAME_M = 0.15
"""A track whose median distance to an object is more than this is not that object's."""


@dataclasses.dataclass(frozen=True)
class TableTruth:
    """The true camera over a table, and where each tag and its host are at every frame (z up from the table)."""

    camera: PlaneCamera
    area_m: tuple[float, float, float, float]  # x0 y0 x1 y1 of the table top
    hosts_m: Mapping[str, Float[np.ndarray, "frames 3"]]  # middle of the object
    tags_m: Mapping[str, Float[np.ndarray, "frames 3"]]


def table_truth(item: Item, recording: Recording) -> TableTruth:
    """The truth of a recording of a table-top suite, from the simulated world; x y from below the camera.

    Raises `ValueError` where no tagged thing moves, or they do not move on one plane.
    """
    scenario = item_scenario(item)
    view, world = look_at(recording.intrinsics, scenario.camera_position_m, scenario.camera_look_at_m), scenario.world
    hosts = {tag.epc: world.bodies[tag.body] for tag in world.tags}
    lowest = [body.poses.position_m[0, 2] + bounds(body.shapes)[0][2] for body in hosts.values()]
    if not hosts or np.ptp(lowest) > 1e-3 or recording.truth is None:
        raise ValueError(
            f"{item.name}: tagged things stand at {lowest} m; expected some, all on one table, with truth."
        )
    x, y = scenario.camera_position_m[:2]
    origin, turn = np.array([x, y, float(np.mean(lowest))]), view.rotation.T
    camera = PlaneCamera(recording.intrinsics, turn, -turn @ (np.asarray(view.position_m, float) - origin))
    steps, at = np.arange(world.num_steps) * STEP_S, recording.time_ns * 1e-9
    places = {
        epc: np.stack([np.interp(at, steps, column) for column in body.poses.position_m.T], axis=-1) - origin
        for epc, body in hosts.items()
    }
    tags = {epc: camera.to_world(np.asarray(recording.truth.tag_position_m[epc], np.float64)) for epc in hosts}
    return TableTruth(camera, (-0.75, -1.5, 0.75, 1.5), places, tags)


@dataclasses.dataclass(frozen=True)
class TagResult:
    """What became of one tag: was the right track chosen, and how far is that track from the truth."""

    recording: str
    epc: str
    matched: bool  # by the whole recording
    matched_part: Mapping[float, tuple[int, int]]  # window length in s: right ones of so many windows
    followed: tuple[int, int]  # frames in which the right object was claimed, of those with any claim
    error_mm: Float[np.ndarray, " frames"]  # of the matched track, on the plane, from the middle of the tag's host
    error_own_height_mm: Float[np.ndarray, " frames"]  # the same, had the host's own height been known
    tag_error_mm: Float[np.ndarray, " frames"]  # from the tag itself, the lead found added
    lead_mm: float
    score: float
    next_score: float  # of the best other object


@dataclasses.dataclass(frozen=True)
class SeenRecording:
    """The camera's side of a recording, done once: paths of all tracks, and which claims were made on the way."""

    name: str
    time_s: Float[np.ndarray, " frames"]
    paths_m: Mapping[int, Float[np.ndarray, "frames 3"]]
    claimed_m: Mapping[str, Float[np.ndarray, "frames 3"]]  # world, NaN without a claim
    antenna_m: Float[np.ndarray, " 3"]
    camera_m: Float[np.ndarray, " 3"]
    epcs: tuple[str, ...]


def see(
    recording: Recording,
    camera: PlaneCamera,
    settings: TagVisionSettings,
    *,
    on_frame: Callable[[], None] | None = None,
) -> SeenRecording:
    """Run TagVision over a recording; what it claims frame by frame, and the paths of all its tracks."""
    tracer = TagVision(camera, dataclasses.replace(settings, memory_s=1e9))
    epcs = tuple(recording.reads.epcs)
    setup = HostCamera(recording.intrinsics, np.asarray(recording.antennas_m, np.float64), epcs)
    state = tracer.init(setup)
    claimed: dict[str, list[np.ndarray]] = {epc: [] for epc in epcs}
    missing = np.full(3, np.nan)
    for frame in host_frames(recording, epcs):
        state, said = tracer.step(setup, state, frame)
        world = camera.to_world(np.asarray(said.centre_m, np.float64))
        for tag, epc in enumerate(epcs):
            claimed[epc].append(world[tag] if bool(said.detected[tag]) else missing)
        if on_frame is not None:
            on_frame()
    time_s, paths = state.paths()
    antenna = camera.to_world(setup.antennas_m[settings.antenna - 1][None])[0]
    return SeenRecording(
        recording.name,
        time_s,
        paths,
        {epc: np.array(rows) for epc, rows in claimed.items()},
        antenna,
        camera.position_m,
        epcs,
    )


def nearest_host(
    path_m: Float[np.ndarray, "frames 3"], hosts_m: Mapping[str, Float[np.ndarray, "frames 3"]]
) -> str | None:
    """The object that a path follows: of smallest median distance on the plane, None if that is over `SAME_M`."""
    known = np.all(np.isfinite(path_m), axis=1)
    if not known.any():
        return None
    away = {epc: _apart_m(path_m[known], host[known]) for epc, host in hosts_m.items()}
    best = min(away, key=lambda epc: float(np.median(away[epc])))
    return best if np.median(away[best]) <= SAME_M else None


def _apart_m(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.linalg.norm(first[..., :2] - second[..., :2], axis=-1)


def judge(
    seen: SeenRecording,
    recording: Recording,
    truth: TableTruth,
    settings: MatchSettings,
    *,
    windows_s: Sequence[float] = (),
) -> list[TagResult]:
    """Match every tag by the whole recording (as the paper does), and by windows of it, and compare with the truth."""
    end_s = float(seen.time_s[-1])
    part: dict[str, dict[float, tuple[int, int]]] = {epc: {} for epc in seen.epcs}
    for length in windows_s:
        for start in np.arange(0.0, end_s - length + 1e-6, length):
            paths, matches, hosts = _matched(seen, recording, truth, settings, float(start), float(start + length))
            for epc in seen.epcs:
                number = matches[epc].track
                right = number >= 0 and nearest_host(paths[number], hosts) == epc
                done = part[epc].get(length, (0, 0))
                part[epc][length] = (done[0] + int(right), done[1] + 1)
    paths, matches, _ = _matched(seen, recording, truth, settings, 0.0, end_s)
    owner = {number: nearest_host(path, truth.hosts_m) for number, path in paths.items()}
    results = []
    for epc in seen.epcs:
        match = matches[epc]
        path = paths.get(match.track, np.full((len(seen.time_s), 3), np.nan))
        error_m = _apart_m(path, truth.hosts_m[epc])
        own_m = _at_height(path, seen.camera_m, truth.hosts_m[epc][:, 2])
        own_error_m = _apart_m(own_m, truth.hosts_m[epc])
        claimed = seen.claimed_m[epc]
        made = np.isfinite(claimed[:, 0])
        away = np.stack([_apart_m(claimed[made], truth.hosts_m[other][made]) for other in seen.epcs])
        right = (np.argmin(away, axis=0) == seen.epcs.index(epc)) & (np.min(away, axis=0) <= SAME_M)
        others = [score for number, score in match.scores.items() if owner[number] not in (None, epc)]
        results.append(
            TagResult(
                recording=seen.name,
                epc=epc,
                matched=owner.get(match.track) == epc,
                matched_part=part[epc],
                followed=(int(np.sum(right)), int(np.sum(made))),
                error_mm=error_m[np.isfinite(error_m)] * 1e3,
                error_own_height_mm=own_error_m[np.isfinite(own_error_m)] * 1e3,
                tag_error_mm=_tag_error_m(seen.time_s, path, match.lead_m, truth.tags_m[epc]) * 1e3,
                lead_mm=match.lead_m * 1e3,
                score=match.score,
                next_score=max(others, default=0.0),
            )
        )
    return results


def _at_height(path_m: np.ndarray, camera_m: np.ndarray, height_m: np.ndarray) -> np.ndarray:
    """The same lines of sight on planes of other heights."""
    away = path_m - camera_m
    return camera_m + away * ((height_m - camera_m[2]) / away[:, 2])[:, None]


def _matched(
    seen: SeenRecording, recording: Recording, truth: TableTruth, settings: MatchSettings, first_s: float, last_s: float
) -> tuple[dict[int, np.ndarray], dict[str, Match], dict[str, np.ndarray]]:
    """Paths, matches and true places between two times."""
    read_time_s = (recording.reads.time_ns - recording.time_ns[0]) * 1e-9
    frames = (seen.time_s >= first_s) & (seen.time_s <= last_s)
    heard = (read_time_s >= first_s) & (read_time_s <= last_s)
    paths = {number: path[frames] for number, path in seen.paths_m.items()}
    paths = {number: path for number, path in paths.items() if np.isfinite(path).any()}
    reads, when = recording.reads[heard], read_time_s[heard]
    matches = match_tags(seen.epcs, seen.time_s[frames], paths, reads, when, seen.antenna_m, settings)
    return paths, matches, {epc: host[frames] for epc, host in truth.hosts_m.items()}


def _tag_error_m(time_s: np.ndarray, path_m: np.ndarray, lead_m: float, tag_m: np.ndarray) -> np.ndarray:
    ahead = heading(time_s, path_m)
    error = _apart_m(path_m + lead_m * ahead, tag_m)
    return error[np.isfinite(error)]
