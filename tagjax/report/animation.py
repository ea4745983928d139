"""Animated pictures, which a page shows like any other picture: WebP, GIF or PNG (APNG). Needs the viz extra."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from ..core.files import atomic_path
from ..core.settings import ConfigError

FORMATS = {".webp": "WEBP", ".gif": "GIF", ".png": "PNG"}
"""Format of a file by its suffix, as Pillow names it."""

_FASTEST_MS = 20
"""Browsers show frames that are to last less for 100 ms."""


def animation_format(path: Path) -> str:
    """The format of an animation by the suffix of its file. Raises `ConfigError` for another suffix."""
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"found {path}; expected a file that ends in {', '.join(FORMATS)}.")
    return FORMATS[path.suffix.lower()]


def write_animation(
    path: Path,
    images: Sequence[UInt8[np.ndarray, "height width 3"]],
    *,
    rate_hz: float,
    hold_s: float = 0.0,
    quality: int = 70,
) -> None:
    """Write RGB pictures as an animation that repeats, the last one shown `hold_s` longer. It appears whole or not at all.

    `quality`, 0 to 100, is of WebP; GIF has 256 colours a picture, and PNG loses nothing. Raises `ConfigError` for another
    suffix, and `ValueError` without a picture.
    """
    kind = animation_format(path)
    if not images:
        raise ValueError("found no picture; expected at least one.")
    pictures = [Image.fromarray(one) for one in images]
    durations_ms = [max(_FASTEST_MS, round(1e3 / rate_hz))] * len(pictures)
    durations_ms[-1] += round(1e3 * hold_s)
    options: dict[str, Any] = {"quality": quality, "method": 4} if kind == "WEBP" else {}
    with atomic_path(path) as partial:
        pictures[0].save(
            partial, kind, save_all=True, append_images=pictures[1:], duration=durations_ms, loop=0, **options
        )
