"""Small RGB-D recordings in every format that can be imported, made from the same pictures."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tagjax.recording.importers.settings import ImportSettings, import_recording
from tagjax.recording.recording import Recording
from tagjax.recording.store import open_recording

HEIGHT, WIDTH = 48, 64
CAMERA = {"fx_px": 61.0, "fy_px": 60.0, "cx_px": 31.5, "cy_px": 23.5, "width": WIDTH, "height": HEIGHT}
START_NS = 1_700_000_000_123_456_789


def colour(number: int, shape: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    """Noise, RGB: no two pictures, rows or channels are alike."""
    return np.random.default_rng(number).integers(0, 256, (*shape, 3)).astype(np.uint8)


def smooth(number: int) -> np.ndarray:
    """A picture that lossy codecs keep, unlike in its channels."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([x * 3, y * 4, np.full((HEIGHT, WIDTH), 30 + 8 * number)], -1).astype(np.uint8)


def depth_mm(number: int, shape: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    """A noisy wall, uint16, some of it missing."""
    found = np.random.default_rng(1000 + number).integers(1000, 3000, shape).astype(np.uint16)
    found[:3, :5] = 0
    return found


def write_camera(path: Path, **changes: Any) -> Path:
    """A camera file of a registered camera, with changes; None removes a key."""
    values = {"colour": CAMERA, "depth_unit_m": 0.001, "depth_registered": True, **changes}
    path.write_text(json.dumps({key: value for key, value in values.items() if value is not None}))
    return path


def write_pictures(folder: Path, colour_ns: list[int], depth_ns: list[int]) -> Path:
    """colour/ and depth/ with the times in seconds as names, and camera.json."""
    for name, times, make in (("colour", colour_ns, colour), ("depth", depth_ns, depth_mm)):
        (folder / name).mkdir(parents=True)
        for number, time_ns in enumerate(times):
            stem = f"{time_ns // 10**9}.{time_ns % 10**9:09d}"
            image = make(number)
            cv2.imwrite(str(folder / name / f"{stem}.png"), image[..., ::-1] if image.ndim == 3 else image)
    write_camera(folder / "camera.json")
    return folder


def imported(video: Path, out: Path, **settings: Any) -> Recording:
    """The stored recording of a video without reads."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*no tag read.*")
        import_recording(ImportSettings(video=str(video), out=str(out), **settings))
        return open_recording(out)


def cut(path: Path, fraction: float) -> Path:
    """The file without its end."""
    path.write_bytes(path.read_bytes()[: int(fraction * path.stat().st_size)])
    return path
