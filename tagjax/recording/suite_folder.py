"""Recordings of a suite on disk: `<suite>/<split>/<suite>-<variant>-<split>-<number>.zarr`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

SPLITS = ("train", "validation", "test")


@dataclasses.dataclass(frozen=True, order=True)
class SuiteRecording:
    """One recording of a suite. The order is by variant, then by number."""

    variant: str
    number: int
    path: Path


def find_recordings(suite_folder: str | Path, split: str, max_recordings: int | None = None) -> list[SuiteRecording]:
    """Recordings of a split, the first `max_recordings` of each variant; an empty list where there is none.

    Raises `ValueError` for a recording whose name does not follow the pattern.
    """
    found = []
    for path in (Path(suite_folder) / split).glob("*.zarr"):
        parts = path.stem.rsplit("-", 3)
        if len(parts) != 4 or not parts[3].isdigit():
            raise ValueError(
                f"{path}: found the name {path.name}, expected a name <suite>-<variant>-<split>-<number>.zarr as "
                "experiments.simulate writes it. Rename the recording or move it away."
            )
        if max_recordings is None or int(parts[3]) < max_recordings:
            found.append(SuiteRecording(parts[1], int(parts[3]), path))
    return sorted(found)
