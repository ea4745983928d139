"""Pictures of optical flow: the usual colour wheel, error maps, and a panel of several flows of one pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt8

from ..flow.pictures import as_bytes

_ARCS = (15, 6, 4, 11, 13, 6)
"""Steps from red to yellow, green, cyan, blue, magenta, and back to red."""

_UNKNOWN = 128
_GAP = 4
_TITLE = 18
_TILE_WIDTH = 320

Tile = tuple[str, UInt8[np.ndarray, "_ _ 3"]]
"""A title and the picture under it."""


def colour_wheel() -> UInt8[np.ndarray, "55 3"]:
    """The 55 hues of Baker et al. (IJCV 2011), by direction, finer where the eye is more sensitive."""
    primaries = np.array([[255, 0, 0], [255, 255, 0], [0, 255, 0], [0, 255, 255], [0, 0, 255], [255, 0, 255]])
    arcs = []
    for start, end, steps in zip(primaries, np.roll(primaries, -1, axis=0), _ARCS, strict=True):
        weight = np.arange(steps)[:, None] / steps
        arcs.append(np.floor((1 - weight) * start + weight * end))
    return np.concatenate(arcs).astype(np.uint8)


def flow_colours(
    flow_px: Float[np.ndarray, "height width 2"], largest_px: float
) -> UInt8[np.ndarray, "height width 3"]:
    """Direction as hue, length as saturation: no motion is white, `largest_px` full colour, more darker; NaN grey."""
    known = np.all(np.isfinite(flow_px), axis=-1)
    u, v = (np.where(known, flow_px[..., k], 0.0).astype(np.float64) / max(largest_px, 1e-6) for k in (0, 1))
    length = np.hypot(u, v)[..., None]
    wheel = colour_wheel().astype(np.float64) / 255
    place = (np.arctan2(-v, -u) / np.pi + 1) / 2 * (len(wheel) - 1)
    low = np.floor(place).astype(int)
    weight = (place - low)[..., None]
    hue = (1 - weight) * wheel[low] + weight * wheel[(low + 1) % len(wheel)]
    colour = np.where(length <= 1, 1 - length * (1 - hue), 0.75 * hue)
    return np.where(known[..., None], np.floor(255 * colour), _UNKNOWN).astype(np.uint8)


def error_colours(error: Float[np.ndarray, "height width"], largest: float) -> UInt8[np.ndarray, "height width 3"]:
    """Black for no error to pale yellow for `largest` or more; NaN grey."""
    known = np.isfinite(error)
    level = np.clip(np.where(known, error, 0) / largest, 0, 1)
    colour = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1]
    return np.where(known[..., None], colour, _UNKNOWN).astype(np.uint8)


def tiled(rows: Sequence[Sequence[Tile]]) -> UInt8[np.ndarray, "rows columns 3"]:
    """Rows of titled pictures on white."""
    drawn = []
    for row in rows:
        tiles = [_titled(title, picture) for title, picture in row]
        gap = np.full((tiles[0].shape[0], _GAP, 3), 255, np.uint8)
        drawn.append(np.concatenate([part for tile in tiles for part in (tile, gap)][:-1], axis=1))
    width = max(row.shape[1] for row in drawn)
    return np.concatenate([np.pad(r, ((0, _GAP), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in drawn])


def _titled(title: str, picture: np.ndarray) -> np.ndarray:
    height = max(1, round(picture.shape[0] * _TILE_WIDTH / picture.shape[1]))
    shrinks = picture.shape[1] > _TILE_WIDTH
    tile = cv2.resize(picture, (_TILE_WIDTH, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST)
    bar = np.full((_TITLE, _TILE_WIDTH, 3), 255, np.uint8)
    cv2.putText(bar, title, (2, _TITLE - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (30, 30, 30), 1, cv2.LINE_AA)
    return np.concatenate([bar, tile])


def flow_panel(
    first: Shaped[np.ndarray, "height width 3"],
    second: Shaped[np.ndarray, "height width 3"],
    truth_px: Float[np.ndarray, "height width 2"] | None,
    flows_px: Mapping[str, Float[np.ndarray, "height width 2"]],
    errors: Mapping[str, Float[np.ndarray, "height width"]],
    *,
    largest_error: float,
    unit: str,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Both pictures and the true flow, each flow in the same colours, and under it its error, all with their means."""
    drawn = list(flows_px.values()) if truth_px is None else [truth_px]
    lengths = np.concatenate([np.linalg.norm(flow, axis=-1).ravel() for flow in drawn])
    largest_px = max(1.0, float(np.percentile(lengths[np.isfinite(lengths)], 99))) if lengths.size else 1.0
    top: list[Tile] = [("first", as_bytes(first)), ("second", as_bytes(second))]
    if truth_px is not None:
        top.append((f"true flow, full colour at {largest_px:.1f} px", flow_colours(truth_px, largest_px)))
    names = list(flows_px)
    middle: list[Tile] = [(name, flow_colours(flows_px[name], largest_px)) for name in names]
    bottom: list[Tile] = [
        (
            f"{name}: {np.nanmean(errors[name]):.2f} {unit}, white at {largest_error:g}",
            error_colours(errors[name], largest_error),
        )
        for name in names
    ]
    return tiled([top, middle, bottom])
