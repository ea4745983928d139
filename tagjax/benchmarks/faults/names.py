"""Names from elsewhere: every text becomes a file name in its folder, and what can be no name is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from ...core.errors import RecordingError
from ...core.names import safe_file_name
from ...recording import Intrinsics, Recording, TagReads
from .outcome import Outcome, outcome

_PIECES = (
    "a",
    "Z9",
    "../",
    "/",
    "\\",
    "\0",
    "$\\foo{$",
    "x[/b]",
    "=1+1",
    "\n",
    "..",
    "é",
    "\u202e",
    " ",
    "<b>",
    "%00",
    "'",
    '"',
)


def trial(number: int, seed: int, folder: Path) -> list[Outcome]:
    """`number` random texts as the name of a recording and of a file in `folder`."""
    rng = np.random.default_rng(seed)
    escaped, passed = [], []
    for _ in range(number):
        text = "".join(rng.choice(_PIECES, size=int(rng.integers(0, 40))))
        stays = (folder / safe_file_name(text)).resolve().parent == folder.resolve()
        escaped.append(None if stays else repr(text))
        odd = set(text) & set("/\\\0$[]={}\n<>%'\"\u202e")
        passed.append(repr(text) if odd and _is_accepted(text) else None)
    return [
        outcome("names, file names stay in their folder", escaped),
        outcome("names, odd ones are refused", passed),
    ]


def _is_accepted(name: str) -> bool:
    recording = Recording(
        colour=np.zeros((2, 4, 4, 3), np.uint8),
        depth=np.full((2, 4, 4), 1000, np.uint16),
        time_ns=np.array([0, 10**8]),
        intrinsics=Intrinsics(4.0, 4.0, 1.5, 1.5, 4, 4),
        reads=dataclasses.replace(
            TagReads.empty(),
            epc=np.array(["A"]),
            time_ns=np.array([0]),
            antenna=np.array([1], np.int16),
            carrier_hz=np.array([920e6]),
            phase_rad=np.array([1.0]),
            rssi_dbm=np.array([-50], np.float32),
            doppler_hz=np.array([0], np.float32),
        ),
        name=name,
    )
    try:
        recording.check()
    except RecordingError:
        return False
    return True
