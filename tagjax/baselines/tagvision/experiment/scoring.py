"""TagVision on recordings of objects that move over a table: blob matching and tracking error (VI.C-D)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ....recording import Recording
from ...host_tracer import HostCamera, host_frames
from ..matching import Match, MatchSettings, match_tags
from ..pairing import motion_direction
from ..plane import PlaneCamera
from ..settings import TagVisionSettings
from ..tracer import TagVisionTracer
from .table_truth import TableTruth

SAME_OBJECT_M = 0.15
"""A track whose median distance to an object is larger does not follow that object."""


@dataclasses.dataclass(frozen=True)
class TagResult:
    """The result for one tag: whether the right track was chosen, and the error of that track."""

    recording: str
    epc: str
    matched: bool  # by the whole recording
    matched_windows: Mapping[float, tuple[int, int]]  # window length in s: correct windows, all windows
    detections: tuple[int, int]  # frames with a detection of the right object, frames with any detection
    error_mm: Float[np.ndarray, " frames"]  # of the matched track, on the plane, from the centre of the tag's host
    error_own_height_mm: Float[np.ndarray, " frames"]  # the same with the host's own height
    tag_error_mm: Float[np.ndarray, " frames"]  # from the tag itself, with the estimated offset of the tag added
    tag_offset_mm: float
    score: float
    next_score: float  # of the best other object


@dataclasses.dataclass(frozen=True)
class TrackedRecording:
    """The camera's part of a recording, done once: paths of all tracks, and the online detections."""

    name: str
    time_s: Float[np.ndarray, " frames"]
    paths_m: Mapping[int, Float[np.ndarray, "frames 3"]]
    detected_m: Mapping[str, Float[np.ndarray, "frames 3"]]  # world, NaN without a detection
    antenna_m: Float[np.ndarray, " 3"]
    camera_m: Float[np.ndarray, " 3"]
    epcs: tuple[str, ...]


def track_recording(recording: Recording, camera: PlaneCamera, settings: TagVisionSettings) -> TrackedRecording:
    """Run TagVision over a recording; its detections frame by frame, and the paths of all its tracks."""
    tracer = TagVisionTracer(camera, dataclasses.replace(settings, memory_s=1e9))
    epcs = tuple(recording.reads.epcs)
    setup = HostCamera(recording.intrinsics, np.asarray(recording.antennas_m, np.float64), epcs)
    state = tracer.init(setup)
    detected: dict[str, list[np.ndarray]] = {epc: [] for epc in epcs}
    missing = np.full(3, np.nan)
    for frame in host_frames(recording, epcs):
        state, trace = tracer.step(setup, state, frame)
        world = camera.to_world(np.asarray(trace.centre_m, np.float64))
        for tag, epc in enumerate(epcs):
            detected[epc].append(world[tag] if bool(trace.detected[tag]) else missing)
    time_s, paths = state.paths()
    return TrackedRecording(
        recording.name,
        time_s,
        paths,
        {epc: np.array(rows) for epc, rows in detected.items()},
        camera.to_world(setup.antennas_m[settings.antenna - 1][None])[0],
        camera.position_m,
        epcs,
    )


def nearest_host(
    path_m: Float[np.ndarray, "frames 3"], hosts_m: Mapping[str, Float[np.ndarray, "frames 3"]]
) -> str | None:
    """The object that a path follows: of smallest median distance on the plane; None beyond `SAME_OBJECT_M`."""
    known = np.all(np.isfinite(path_m), axis=1)
    if not known.any():
        return None
    median_m = {epc: float(np.median(_distance_m(path_m[known], host[known]))) for epc, host in hosts_m.items()}
    best = min(median_m, key=lambda epc: median_m[epc])
    return best if median_m[best] <= SAME_OBJECT_M else None


def score_tags(
    tracked: TrackedRecording,
    recording: Recording,
    truth: TableTruth,
    settings: MatchSettings,
    *,
    windows_s: Sequence[float] = (),
) -> list[TagResult]:
    """Match every tag by the whole recording (as the paper does), and by windows of it, and compare with the truth."""
    end_s = float(tracked.time_s[-1])
    windows = _score_windows(tracked, recording, truth, settings, windows_s)
    paths, matches, _ = _match_part(tracked, recording, truth, settings, 0.0, end_s)
    object_of = {number: nearest_host(path, truth.hosts_m) for number, path in paths.items()}
    results = []
    for epc in tracked.epcs:
        match, host = matches[epc], truth.hosts_m[epc]
        path = paths.get(match.track, np.full((len(tracked.time_s), 3), np.nan))
        own_height_m = _at_height(path, tracked.camera_m, host[:, 2])
        ahead = path + match.tag_offset_m * motion_direction(tracked.time_s, path)
        others = [score for number, score in match.scores.items() if object_of[number] not in (None, epc)]
        results.append(
            TagResult(
                recording=tracked.name,
                epc=epc,
                matched=object_of.get(match.track) == epc,
                matched_windows=windows[epc],
                detections=_score_detections(tracked, truth, epc),
                error_mm=_known_mm(_distance_m(path, host)),
                error_own_height_mm=_known_mm(_distance_m(own_height_m, host)),
                tag_error_mm=_known_mm(_distance_m(ahead, truth.tags_m[epc])),
                tag_offset_mm=match.tag_offset_m * 1e3,
                score=match.score,
                next_score=max(others, default=0.0),
            )
        )
    return results


def _score_windows(
    tracked: TrackedRecording,
    recording: Recording,
    truth: TableTruth,
    settings: MatchSettings,
    windows_s: Sequence[float],
) -> dict[str, dict[float, tuple[int, int]]]:
    """Correct windows and all windows, by tag and window length."""
    counts: dict[str, dict[float, tuple[int, int]]] = {epc: {} for epc in tracked.epcs}
    for length_s in windows_s:
        for start_s in np.arange(0.0, float(tracked.time_s[-1]) - length_s + 1e-6, length_s):
            part = _match_part(tracked, recording, truth, settings, float(start_s), float(start_s + length_s))
            paths, matches, hosts = part
            for epc in tracked.epcs:
                number = matches[epc].track
                correct = number >= 0 and nearest_host(paths[number], hosts) == epc
                before = counts[epc].get(length_s, (0, 0))
                counts[epc][length_s] = (before[0] + int(correct), before[1] + 1)
    return counts


def _score_detections(tracked: TrackedRecording, truth: TableTruth, epc: str) -> tuple[int, int]:
    """Frames with a detection of the right object, and frames with any."""
    detected = tracked.detected_m[epc]
    made = np.isfinite(detected[:, 0])
    distance = np.stack([_distance_m(detected[made], truth.hosts_m[other][made]) for other in tracked.epcs])
    right = (np.argmin(distance, axis=0) == tracked.epcs.index(epc)) & (np.min(distance, axis=0) <= SAME_OBJECT_M)
    return int(np.sum(right)), int(np.sum(made))


def _match_part(
    tracked: TrackedRecording,
    recording: Recording,
    truth: TableTruth,
    settings: MatchSettings,
    first_s: float,
    last_s: float,
) -> tuple[dict[int, np.ndarray], dict[str, Match], dict[str, np.ndarray]]:
    """Paths, matches and true positions between two times."""
    read_time_s = (recording.reads.time_ns - recording.time_ns[0]) * 1e-9
    frames = (tracked.time_s >= first_s) & (tracked.time_s <= last_s)
    inside = (read_time_s >= first_s) & (read_time_s <= last_s)
    paths = {number: path[frames] for number, path in tracked.paths_m.items()}
    paths = {number: path for number, path in paths.items() if np.isfinite(path).any()}
    reads, times_s = recording.reads[inside], read_time_s[inside]
    matches = match_tags(tracked.epcs, tracked.time_s[frames], paths, reads, times_s, tracked.antenna_m, settings)
    return paths, matches, {epc: host[frames] for epc, host in truth.hosts_m.items()}


def _at_height(
    path_m: Float[np.ndarray, "frames 3"], camera_m: Float[np.ndarray, " 3"], height_m: Float[np.ndarray, " frames"]
) -> Float[np.ndarray, "frames 3"]:
    """The same rays on planes of other heights."""
    ray = path_m - camera_m
    return camera_m + ray * ((height_m - camera_m[2]) / ray[:, 2])[:, None]


def _distance_m(first: Float[np.ndarray, "points 3"], second: Float[np.ndarray, "points 3"]) -> np.ndarray:
    """Distances on the plane."""
    return np.linalg.norm(first[..., :2] - second[..., :2], axis=-1)


def _known_mm(error_m: Float[np.ndarray, " frames"]) -> Float[np.ndarray, " known"]:
    return error_m[np.isfinite(error_m)] * 1e3


def summarise(tags: Sequence[TagResult]) -> dict[str, Any]:
    """Figures over tags, None where there is none. Errors are of correctly matched tags unless named otherwise."""
    matched = [tag for tag in tags if tag.matched]
    several = [tag for tag in tags if sum(other.recording == tag.recording for other in tags) > 1]

    def mean(kind: str, chosen: Sequence[TagResult]) -> float | None:
        values = np.concatenate([getattr(tag, kind) for tag in chosen] or [np.zeros(0)])
        return float(values.mean()) if len(values) else None

    by_window = {}
    for length_s in sorted({length for tag in tags for length in tag.matched_windows}):
        counts = [tag.matched_windows[length_s] for tag in several or tags if length_s in tag.matched_windows]
        total = sum(count for _, count in counts)
        by_window[f"{length_s:g}"] = sum(correct for correct, _ in counts) / total if total else float("nan")
    num_detections = sum(tag.detections[1] for tag in tags)
    ratios = [tag.score / tag.next_score for tag in several if tag.next_score > 0]
    return {
        "num_tags": len(tags),
        "blob_matching": float(np.mean([tag.matched for tag in tags])) if tags else None,
        "num_tags_among_several": len(several),
        "blob_matching_among_several": float(np.mean([tag.matched for tag in several])) if several else None,
        "matching_by_seconds": by_window,
        "detections_correct": sum(tag.detections[0] for tag in tags) / num_detections if num_detections else None,
        "num_detections": num_detections,
        "tracking_error_mm": mean("error_mm", matched),
        "tracking_error_own_height_mm": mean("error_own_height_mm", matched),
        "tracking_error_all_tags_mm": mean("error_mm", tags),
        "tag_error_mm": mean("tag_error_mm", matched),
        "min_score_ratio": float(min(ratios)) if ratios else None,
    }
