"""A traced recording in a file of plain arrays, so that a figure is drawn again without tracing again."""

from __future__ import annotations

import dataclasses
import io
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.files import atomic_path
from ...metrics.recordings import Picture
from ...metrics.tags import FrameScores


@dataclasses.dataclass(frozen=True)
class Traced:
    """Scores of every labelled tag by EPC, and the tracer's output at every frame (none where it was not kept)."""

    frames: dict[str, FrameScores]
    pictures: Sequence[Picture]


def write_traced(path: Path, traced: Traced) -> None:
    """Write the scores, and the masks as bits, as an npz file of plain arrays."""
    arrays: dict[str, Any] = {"epcs": np.array(list(traced.frames), dtype=np.str_)}
    for number, frames in enumerate(traced.frames.values()):
        for field in dataclasses.fields(FrameScores):
            arrays[f"tag{number}.{field.name}"] = np.asarray(getattr(frames, field.name))
    if traced.pictures:
        first = traced.pictures[0]
        arrays["picture.epcs"] = np.array(first.epcs, dtype=np.str_)
        arrays["picture.shape"] = np.array(first.masks.shape)
        arrays["picture.frame"] = np.array([one.frame for one in traced.pictures])
        arrays["picture.masks"] = np.stack([np.packbits(one.masks) for one in traced.pictures])
        for name in ("boxes_px", "confidence", "detected", "status"):
            arrays[f"picture.{name}"] = np.stack([getattr(one, name) for one in traced.pictures])
    with atomic_path(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_traced(path: Path, *, pictures: bool) -> Traced | None:
    """What `write_traced` wrote; None where there is no such file, it is damaged, or has no pictures although wanted."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            names = set(file.files)
            if pictures and "picture.frame" not in names:
                return None
            arrays = {name: file[name] for name in names if pictures or not name.startswith("picture.")}
        frames = {str(epc): _scores(arrays, number) for number, epc in enumerate(arrays["epcs"])}
        return Traced(frames, _pictures(arrays) if pictures else [])
    except (OSError, ValueError, TypeError, zipfile.BadZipFile, zlib.error, EOFError, KeyError):
        return None


def _scores(arrays: dict[str, np.ndarray], number: int) -> FrameScores:
    values: dict[str, Any] = {
        field.name: arrays[f"tag{number}.{field.name}"] for field in dataclasses.fields(FrameScores)
    }
    return FrameScores(**{**values, "label": int(values["label"]), "moves": bool(values["moves"])})


def _pictures(arrays: dict[str, np.ndarray]) -> list[Picture]:
    shape, epcs = tuple(arrays["picture.shape"].tolist()), tuple(str(epc) for epc in arrays["picture.epcs"])
    count = int(np.prod(shape))
    return [
        Picture(
            frame=int(frame),
            epcs=epcs,
            masks=np.unpackbits(arrays["picture.masks"][index], count=count).reshape(shape).astype(bool),
            boxes_px=arrays["picture.boxes_px"][index],
            confidence=arrays["picture.confidence"][index],
            detected=arrays["picture.detected"][index],
            status=arrays["picture.status"][index],
        )
        for index, frame in enumerate(arrays["picture.frame"])
    ]
