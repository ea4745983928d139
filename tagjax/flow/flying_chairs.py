"""FlyingChairs (Dosovitskiy et al., ICCV 2015): a folder of independent pairs of pictures with their true flow.

Pair n is `<n>_img1.ppm` and `<n>_img2.ppm` with the flow `<n>_flow.flo`, n in five digits, 512 x 384 pixels as published.
`FlyingChairs_train_val.txt`, in the folder or the one above, splits them: one line for each pair, 1 for training and 2 for
validation.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from ..recording import RecordingError
from ..recording.image_files import read_colour
from .flo_files import read_flo

SPLIT_FILE = "FlyingChairs_train_val.txt"
"""Name of the file with the split."""

_IMAGE = re.compile(r"(\d+)_img[12]\.ppm")
_MAX_LISTED = 3
_MARKS = {"training": "1", "validation": "2"}


def is_flying_chairs(folder: Path) -> bool:
    """Whether a folder holds pictures with the names of FlyingChairs."""
    return folder.is_dir() and any(_IMAGE.fullmatch(path.name) for path in folder.iterdir())


class FlyingChairs:
    """The pairs of one split of a FlyingChairs folder, (pair, 2, height, width, 3), uint8 RGB, read when indexed.

    Without the file of the split both splits are all pairs. When it is opened the names are checked, and one picture is
    read for the size. Raises `RecordingError` for an incomplete pair, for a split that does not fit, and, when a pair is
    read, for a picture that cannot be read or has another size.
    """

    def __init__(self, folder: Path, split: Literal["training", "validation"]):
        names = {path.name for path in folder.iterdir()}
        numbers = sorted({match[1] for match in map(_IMAGE.fullmatch, names) if match}, key=int)
        _check_complete(folder, names, [f"{number}_img{k}.ppm" for number in numbers for k in (1, 2)])
        self.split_file = _split_file(folder)
        if self.split_file is not None:
            numbers = _of_split(self.split_file, numbers, split)
        self._folder, self._names, self.numbers = folder, names, tuple(numbers)
        self.shape = (len(numbers), 2, *read_colour(self._path(numbers[0], "img1.ppm")).shape)
        self.dtype = np.dtype(np.uint8)

    def __getitem__(self, index: Any) -> UInt8[np.ndarray, "2 height width 3"]:
        """Both pictures of a pair."""
        number = self.numbers[int(index)]
        return np.stack([self._picture(number, name) for name in ("img1.ppm", "img2.ppm")])

    def check_flow(self) -> None:
        """Raises `RecordingError` if a pair of the split has no file of flow."""
        _check_complete(self._folder, self._names, [f"{number}_flow.flo" for number in self.numbers])

    def flow_px(self, index: int) -> Float[np.ndarray, "height width 2"]:
        """The true flow of a pair, first to second picture, pixels. Raises `RecordingError` if it has another size."""
        path = self._path(self.numbers[index], "flow.flo")
        flow = read_flo(path)
        self._check_size(path, flow.shape)
        return flow

    def _path(self, number: str, name: str) -> Path:
        return self._folder / f"{number}_{name}"

    def _picture(self, number: str, name: str) -> np.ndarray:
        path = self._path(number, name)
        picture = read_colour(path)
        self._check_size(path, picture.shape)
        return picture

    def _check_size(self, path: Path, shape: Sequence[int]) -> None:
        height, width = self.shape[2:4]
        if tuple(shape[:2]) != (height, width):
            raise RecordingError(
                f"{path} has {shape[1]} x {shape[0]} pixels; expected {width} x {height}, the size of "
                f"{self._path(self.numbers[0], 'img1.ppm').name}. Copy it again."
            )


def _check_complete(folder: Path, names: set[str], expected: Sequence[str]) -> None:
    missing = [name for name in expected if name not in names]
    if missing:
        more = f" and {len(missing) - _MAX_LISTED} more" if len(missing) > _MAX_LISTED else ""
        raise RecordingError(
            f"{folder}: {', '.join(missing[:_MAX_LISTED])}{more} missing; expected <n>_img1.ppm, <n>_img2.ppm and "
            "<n>_flow.flo of every pair of FlyingChairs. Unpack the data set again, or remove the rest of these pairs."
        )


def _split_file(folder: Path) -> Path | None:
    places = (folder / SPLIT_FILE, folder.resolve().parent / SPLIT_FILE)
    return next((path for path in places if path.is_file()), None)


def _of_split(file: Path, numbers: Sequence[str], split: str) -> list[str]:
    marks = file.read_text(errors="replace").split()
    if len(marks) != len(numbers) or not set(marks) <= set(_MARKS.values()):
        others = sorted(set(marks) - set(_MARKS.values()))[:_MAX_LISTED]
        found = f"{len(marks)} lines" + (f", some of them {', '.join(map(repr, others))}" if others else "")
        raise RecordingError(
            f"{file} holds {found}; expected {len(numbers)}, one for each pair of the folder: 1 for training, 2 for "
            "validation. Copy it again, or remove it to use all pairs for both."
        )
    chosen = [number for number, mark in zip(numbers, marks, strict=True) if mark == _MARKS[split]]
    if not chosen:
        raise RecordingError(
            f"{file} has no pair for {split}; expected at least one line {_MARKS[split]}. Remove it to use all pairs."
        )
    return chosen
