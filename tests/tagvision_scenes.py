"""Discs that move over a drawn ground under a camera, and reads of tags on them: for the tests of TagVision."""

from __future__ import annotations

import cv2
import numpy as np

from tagjax.baselines.tagvision.experiment.simulated_calibration import overhead
from tagjax.recording import Intrinsics, Recording, TagReads, Truth

C = 299_792_458.0
EPCS = ("E001", "E002")
HEIGHT, WIDTH = 144, 192
FLAT = Intrinsics(160.0, 160.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
OVER = overhead(FLAT, (0.0, 0.0, 2.5))
RADIUS_M = 0.14
COLOURS = np.array([[230, 60, 50], [40, 90, 220], [50, 200, 60]], dtype=float)


def ground_colours() -> np.ndarray:
    rng = np.random.default_rng(13)
    coarse = cv2.resize(rng.uniform(-14, 14, (18, 24)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return np.array([170.0, 160.0, 150.0]) + coarse[..., None]


GROUND = ground_colours()


def picture(places_m: np.ndarray, rng: np.random.Generator, *, shadow_px: float = 0.0) -> np.ndarray:
    """Textured discs on the ground, with or without shadows beside them."""
    picture = GROUND.copy()
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    centres = OVER.to_picture(np.column_stack([places_m, np.zeros(len(places_m))]))
    radius = RADIUS_M * FLAT.fx_px / 2.5
    if shadow_px:
        for cx, cy in centres:
            picture[np.hypot(x - cx - shadow_px, y - cy) < radius] *= 0.65
    for (cx, cy), colour in zip(centres, COLOURS, strict=False):
        inside = np.clip(radius + 0.5 - np.hypot(x - cx, y - cy), 0, 1)[..., None]
        pattern = 1 + 0.25 * np.sin(0.9 * (x - cx)) * np.cos(0.9 * (y - cy))
        picture = picture * (1 - inside) + inside * (colour * pattern[..., None])
    return np.clip(np.rint(picture + rng.normal(0, 1.5, picture.shape)), 0, 255).astype(np.uint8)


def make_reads(
    paths_m: dict[str, np.ndarray], time_s: np.ndarray, antenna_m: np.ndarray, seed: int = 0, rate_hz: float = 60.0
) -> tuple[TagReads, np.ndarray]:
    """Reads of tags on paths, one carrier, an unknown offset each, the paper's noise."""
    rng = np.random.default_rng(seed)
    rows = []
    for epc, path in paths_m.items():
        when = np.sort(rng.uniform(time_s[0], time_s[-1], int(rate_hz * (time_s[-1] - time_s[0]))))
        place = np.stack([np.interp(when, time_s, column) for column in path.T], axis=-1)
        distance = np.linalg.norm(place - antenna_m, axis=1)
        phase = 4 * np.pi * 922e6 * distance / C + rng.uniform(0, 2 * np.pi) + rng.normal(0, 0.1, len(when))
        rows += [(t, epc, p) for t, p in zip(when, np.mod(phase, 2 * np.pi), strict=True)]
    rows.sort()
    when = np.array([row[0] for row in rows])
    count = len(rows)
    return TagReads(
        epc=np.array([row[1] for row in rows]),
        time_ns=np.rint(when * 1e9).astype(np.int64),
        antenna=np.ones(count, np.int16),
        carrier_hz=np.full(count, 922e6),
        phase_rad=np.array([row[2] for row in rows]),
        rssi_dbm=np.full(count, -50, np.float32),
        doppler_hz=np.full(count, np.nan, np.float32),
    ), when


ANTENNA = np.array([1.4, -0.3, 0.2])


def curves(count: int, num_frames: int = 120) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    time_s = np.arange(num_frames) / 30
    paths = {}
    for number in range(count):
        angle = (0.5 + 0.25 * number) * time_s + number
        paths[number] = np.column_stack(
            [0.6 * np.cos(angle) - 0.1 * number, 0.5 * np.sin(1.3 * angle), np.zeros(num_frames)]
        )
    return time_s, paths


def drawn_recording(num_frames: int = 75) -> Recording:
    """Two tagged discs and one without a tag on curves, drawn, with the labels that scoring needs."""
    time_s, rng = np.arange(num_frames) / 30, np.random.default_rng(19)
    paths = {}
    for number, (x, y, rate) in enumerate(((-0.9, 0.3, 1.1), (0.1, -0.45, 1.5), (0.85, 0.4, -1.3))):
        angle = rate * time_s + 2 * number
        paths[number] = np.column_stack([x + 0.35 * np.cos(angle), y + 0.35 * np.sin(angle), np.zeros(num_frames)])
    colour = np.stack([picture(np.stack([paths[k][t, :2] for k in range(3)]), rng) for t in range(num_frames)])
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    labels = np.zeros((num_frames, HEIGHT, WIDTH), np.uint8)
    for t in range(num_frames):
        for k in range(3):
            cx, cy = OVER.to_picture(paths[k][t : t + 1])[0]
            labels[t][np.hypot(x - cx, y - cy) < RADIUS_M * 64] = k + 1
    reads, _ = make_reads({EPCS[0]: paths[1], EPCS[1]: paths[0]}, time_s, ANTENNA, rate_hz=50)
    place = {EPCS[0]: OVER.to_camera(paths[1]), EPCS[1]: OVER.to_camera(paths[0])}
    return Recording(
        colour=colour,
        depth=np.full((num_frames, HEIGHT, WIDTH), 2500, np.uint16),
        time_ns=np.rint(time_s * 1e9).astype(np.int64),
        intrinsics=FLAT,
        reads=reads,
        antennas_m=OVER.to_camera(ANTENNA[None]),
        truth=Truth(labels=labels, tag_to_label={EPCS[0]: 2, EPCS[1]: 1}, tag_position_m=place),
        name="drawn",
    )
