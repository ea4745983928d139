"""Whole simulated recordings: people walk through a room, some of them tagged, and every truth is known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from rich.progress import track

from ..radio.reader import ReaderSettings
from ..recording import Intrinsics, Recording, TagReads, Truth
from ..recording.virtual_tags import Track, attach_virtual_tags
from .motion import chest
from .renderer import Hits, cast, corner_camera, exact_flow, sense_depth, shade
from .scene import build_scene

_SUBSTEPS_S = 0.01


@dataclasses.dataclass(frozen=True)
class SceneSettings:
    """What a simulated recording shows. Focal length as an Xtion's (534 px at 640 px width)."""

    width: int = 160
    height: int = 120
    num_frames: int = 90
    frame_rate_hz: float = 10.0
    num_people: int = 3
    num_tags: int | None = None  # people who carry a tag; all if None
    jitter_s: float = 0.004  # standard deviation of frame times
    flow: bool = False  # with exact flow and occlusion in the truth
    reader: ReaderSettings = dataclasses.field(default_factory=ReaderSettings)


def simulate_recording(settings: SceneSettings | None = None, *, seed: int, progress: bool = False) -> Recording:
    """Simulate a recording; the same settings and seed give the same recording.

    Truth: label masks (person number), boxes, tag positions and ranges, and flow if asked for. A tag is read through
    the whole recording: bodies do not block it here.
    """
    settings = settings or SceneSettings()
    rng = np.random.default_rng(seed)
    duration_s = (settings.num_frames + 1) / settings.frame_rate_hz + 0.5
    scene = build_scene(settings.num_people, duration_s, _SUBSTEPS_S, rng)
    focal = 534.0 * settings.width / 640
    view = corner_camera(
        Intrinsics(focal, focal, (settings.width - 1) / 2, (settings.height - 1) / 2, settings.width, settings.height),
        rng,
    )
    stamps = np.arange(settings.num_frames) / settings.frame_rate_hz
    stamps = stamps + np.clip(rng.normal(0, settings.jitter_s, len(stamps)), -0.4 / settings.frame_rate_hz, None)
    stamps = np.maximum.accumulate(stamps - stamps[0])
    steps = np.rint(stamps / _SUBSTEPS_S).astype(int)
    stamps = steps * _SUBSTEPS_S
    colour, depth, labels, flows, hidden = [], [], [], [], []
    previous: Hits | None = None
    for step in track(steps, description=f"simulating seed {seed}", disable=not progress, transient=True):
        scene.pose(int(step))
        hits = cast(scene, view)
        colour.append(shade(scene, hits, rng))
        depth.append(sense_depth(hits, view, rng))
        labels.append(np.where(hits.geom >= 0, scene.geom_label[np.maximum(hits.geom, 0)], 0).astype(np.uint8))
        if settings.flow and previous is not None:
            flow, occluded = exact_flow(previous, hits, scene, view)
            flows.append(flow)
            hidden.append(occluded)
        previous = hits
    if settings.flow:
        flows.append(np.full((settings.height, settings.width, 2), np.nan, np.float32))
        hidden.append(np.zeros((settings.height, settings.width), bool))
    masks = np.stack(labels)
    truth = Truth(
        labels=masks,
        boxes_px=mask_boxes(masks, settings.num_people),
        visible={person.label: np.any(masks == person.label, axis=(1, 2)) for person in scene.people},
        flow_px=np.stack(flows) if settings.flow else None,
        occluded=np.stack(hidden) if settings.flow else None,
    )
    recording = Recording(
        colour=np.stack(colour),
        depth=np.stack(depth),
        time_ns=np.rint(stamps * 1e9).astype(np.int64),
        intrinsics=view.intrinsics,
        reads=TagReads.empty(),
        antennas_m=np.array([[0.0, 0.12, 0.0]]),
        truth=truth,
        name=f"simulated-{seed}",
        source=f"simulated, seed {seed}, {settings}",
    )
    # Tracks at 100 Hz: a tag moves between frames as the body does, not as an interpolation of frames.
    fine = np.arange(steps[-1] + 1)
    tagged = scene.people[: settings.num_people if settings.num_tags is None else settings.num_tags]
    tracks = {
        person.label: Track(
            fine * _SUBSTEPS_S,
            view.to_camera(np.stack([chest(person.walk, int(step), person.height_m) for step in fine])),
        )
        for person in tagged
    }
    return attach_virtual_tags(recording, tracks, settings.reader, seed=seed) if tracks else recording


def mask_boxes(labels: np.ndarray, num_labels: int) -> np.ndarray:
    """Boxes x0 y0 x1 y1 (inclusive) of labels 1 .. num_labels, float32 (frames, labels, 4), NaN where unseen."""
    out = np.full((len(labels), num_labels, 4), np.nan, np.float32)
    for t, frame in enumerate(labels):
        for label in range(1, num_labels + 1):
            rows, columns = np.nonzero(frame == label)
            if rows.size:
                out[t, label - 1] = columns.min(), rows.min(), columns.max(), rows.max()
    return out


def small_training_set(
    folder: str | Path, settings: SceneSettings | None = None, *, num_recordings: int = 3, seed: int = 0
) -> list[Path]:
    """Simulate recordings into `folder`, one Zarr each; those that are there already are kept."""
    from ..recording.store import save_recording

    paths = []
    for number in range(num_recordings):
        path = Path(folder) / f"simulated-{seed + number}.zarr"
        if not path.exists():
            save_recording(simulate_recording(settings, seed=seed + number, progress=True), path)
        paths.append(path)
    return paths
