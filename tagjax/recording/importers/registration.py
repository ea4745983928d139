"""Residual depth-to-colour misregistration, measured and mended from the recording itself.

What is compared are outlines: where something stands in front of something farther, the depth map jumps and the
colour picture has an edge. Only outlines of what moves are used, against colour edges that the still scene does not
have: the texture of furniture is an edge in colour alone and would draw the outlines to itself. The camera must stand
still.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import scipy.optimize
from jaxtyping import UInt8, UInt16

from ...core.errors import RecordingError
from ..picture_files import in_order, read_colour
from .rgbd_folder import DepthToColour, load_calibration, read_mat_depth

NO_CORRECTION = (0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0)
"""The correction that changes nothing, in the order of `DepthToColour.corrected`."""

PRIOR_SPREAD = (0.01, 0.01, 0.01, 0.01, 0.01, 12.0, 12.0)
"""How far a calibration is likely to be off: metres (3), focal factors (2), pixels (2). Keeps apart what the data
cannot: a shift of the principal point and one of the translation differ only by depth."""

PRIOR_WEIGHT = 0.04
"""Loss of mean edge strength (0 to 1) that a deviation of one spread is worth, were there one moving thing; with more,
the data weigh more. Held-out errors differ by at most 0.3 px from a quarter to four times of it."""

SEARCH_PX = 24
"""Largest misalignment that is looked for, in each direction."""

BLURS_PX = (6.0, 3.0, 1.5)
"""Blur of the colour edges, coarse to fine: wide enough at first to be felt from afar."""

NUM_DIRECTIONS = 4
"""Edge directions that are told apart (every 45 degrees): an upright outline must not settle on a table's edge."""

EDGE_HALF = 20.0
"""Colour gradient, grey levels a pixel, that counts as half an edge; stronger ones count little more."""

MAX_GAP_PX = 16
"""Width of the shadow (no depth) that an outline may have beside it: the projector's baseline opens one."""

MIN_POINTS = 400
"""Outline points without which no correction is estimated."""

MIN_BLOBS = 5
"""Moving things with a clear best shift without which nothing is said of the misalignment."""

MAX_POINTS = 20_000
"""Outline points used by the estimate; evenly thinned if there are more."""

BLOB_POINTS = 300
"""Outline points used of each moving thing where its own shift is measured."""

FOLDER_FRAMES = 40
"""Frames of a folder that are looked at: about 15 s on two slow cores, and a peak of 0.9 GB."""


@dataclasses.dataclass(frozen=True)
class Misalignment:
    """How far projected depth outlines lie from the colour edges, over moving things that have one clear best shift."""

    median_px: float  # of the shifts' lengths
    p90_px: float
    mean_shift_px: tuple[float, float]  # medians of the shifts in x and y: what to add to the projected outline
    num_clear: int  # moving things that were counted
    num_seen: int  # and those that had enough of an outline


@dataclasses.dataclass(frozen=True)
class ResidualCorrection:
    """What was estimated, in the order of `DepthToColour.corrected`, with the misalignment before and after."""

    correction: tuple[float, float, float, float, float, float, float]
    before: Misalignment
    after: Misalignment

    def line(self) -> str:
        """One line for people."""
        numbers = ", ".join(f"{value:.6g}" for value in self.correction)
        return (
            f"Residual registration: {self.before.median_px:.1f} px before, {self.after.median_px:.1f} px after; "
            f"correction = [{numbers}]"
        )


@dataclasses.dataclass(frozen=True)
class _Outlines:
    points_m: np.ndarray  # (points, 3), depth camera
    channel: np.ndarray  # (points,) index into the edge maps: frame * NUM_DIRECTIONS + direction
    blob: np.ndarray  # (points,) which moving thing, of all frames

    def subset(self, keep: np.ndarray) -> _Outlines:
        return _Outlines(self.points_m[keep], self.channel[keep], self.blob[keep])


def misalignment_px(
    colour: UInt8[np.ndarray, "frames height width 3"],
    depth_mm: UInt16[np.ndarray, "depth_frames depth_height depth_width"],
    view: DepthToColour,
) -> Misalignment:
    """Distance between projected depth outlines and colour edges, in pixels of the colour picture.

    For each thing that moved, in each frame, the shift (within `SEARCH_PX`) of its projected outline that meets most
    colour edge of its own direction; things without one clear best shift are left out. RGB pictures and raw depth
    (depth camera's view, millimetres, 0 = missing) of a camera that stands still, a dozen frames or more and best far
    apart in time: the still scene is their median. Ragged depth outlines leave about 1.5 px even where the registration
    is right. Raises `RecordingError` where fewer than `MIN_BLOBS` things can be judged.
    """
    _check(colour, depth_mm)
    return _measure(_outlines(depth_mm, view), _blurred(_colour_edges(colour), BLURS_PX[-1]), view)


def estimate_correction(
    colour: UInt8[np.ndarray, "frames height width 3"],
    depth_mm: UInt16[np.ndarray, "depth_frames depth_height depth_width"],
    view: DepthToColour,
) -> ResidualCorrection:
    """The residual correction of `view` that lays depth outlines onto colour edges; for `view.corrected(...)`.

    Frames as for `misalignment_px`: thirty or more, evenly spread over a recording in which somebody walks. All seven
    numbers are found together, coarse to fine (it comes back from 20 px off), held by `PRIOR_SPREAD`: translation and
    principal point act alike, and so do dTz and the focal factors, unless outlines lie at clearly different depths.
    What is to be trusted is where points of the depths seen are projected, not the single numbers. Deterministic; where
    nothing better is found, no correction. Raises `RecordingError` where outlines are too few or have no clear place.
    """
    _check(colour, depth_mm)
    outlines = _outlines(depth_mm, view)
    if len(outlines.points_m) < MIN_POINTS:
        raise RecordingError(
            f"Only {len(outlines.points_m)} outline points of moving things in {len(colour)} frames; the registration "
            f"needs {MIN_POINTS}. Give frames in which somebody walks through the picture, or correction=null."
        )
    edges = _colour_edges(colour)
    fine = _blurred(edges, BLURS_PX[-1])
    before = _measure(outlines, fine, view)
    thinned = outlines.subset(_every(len(outlines.points_m), MAX_POINTS))
    spread = np.array(PRIOR_SPREAD)
    prior = PRIOR_WEIGHT / len(np.unique(outlines.blob))

    def correction_of(deviation: np.ndarray) -> np.ndarray:
        return np.array(NO_CORRECTION) + deviation * spread

    deviation = np.zeros(7)
    for blur_px in BLURS_PX:
        maps = fine if blur_px == BLURS_PX[-1] else _blurred(edges, blur_px)

        def loss(deviation: np.ndarray, maps: np.ndarray = maps) -> float:
            pixels = _project(thinned.points_m, view.corrected(correction_of(deviation).tolist()))
            return float(-_sample(maps, thinned.channel, pixels).mean() + prior * (deviation**2).sum())

        # The steps of the numerical gradient are of the order of 0.05 px: the maps are piecewise bilinear.
        found = scipy.optimize.minimize(
            loss, deviation, method="L-BFGS-B", bounds=[(-4.0, 4.0)] * 7, options={"eps": 5e-3, "maxiter": 60}
        )
        deviation = found.x
    a, b, c, d, e, f, g = (float(f"{value:.8g}") for value in correction_of(deviation))
    correction = (a, b, c, d, e, f, g)
    after = _measure(outlines, fine, view.corrected(correction))
    if after.median_px > before.median_px:
        correction, after = NO_CORRECTION, before
    return ResidualCorrection(correction, before, after)


def estimate_folder_correction(folder: str | Path, calibration: str | Path) -> ResidualCorrection:
    """`estimate_correction` from `FOLDER_FRAMES` frames, evenly spread, of a folder that `import_jpg_mat` reads.

    Raises `RecordingError` where there are no pictures, or they differ in size.
    """
    pictures = in_order(Path(folder).glob("*.jpg"))
    if not pictures:
        raise RecordingError(f"{folder}: no .jpg file; expected pictures with .mat files of the same names.")
    pictures = [pictures[i] for i in _every(len(pictures), FOLDER_FRAMES)]
    frames = []
    for read, paths in ((read_colour, pictures), (read_mat_depth, [path.with_suffix(".mat") for path in pictures])):
        decoded = [read(path) for path in paths]
        for path, frame in zip(paths, decoded, strict=True):
            if frame.shape != decoded[0].shape:
                raise RecordingError(f"{path}: shape {frame.shape}; expected {decoded[0].shape} as the others.")
        frames.append(np.stack(decoded))
    colour, depth_mm = frames
    height, width = colour.shape[1:3]
    return estimate_correction(colour, depth_mm, load_calibration(calibration, (height, width)))


def _every(count: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _check(colour: np.ndarray, depth_mm: np.ndarray) -> None:
    if len(colour) != len(depth_mm):
        raise RecordingError(f"{len(colour)} colour frames and {len(depth_mm)} depth frames; expected pairs.")
    if len(colour) < 5:
        raise RecordingError(f"Only {len(colour)} frames: what moves cannot be told from what stands. Give a dozen.")


def _outlines(depth_mm: np.ndarray, view: DepthToColour) -> _Outlines:
    """Foreground side of the depth jumps of what moved, in all frames."""
    known = np.where(depth_mm > 0, depth_mm, np.nan).astype(np.float32) * np.float32(1e-3)
    still_m = _median_known(known)
    points, channels, blobs, first_blob = [], [], [], 0
    camera = view.depth_camera
    for frame, depth_m in enumerate(np.nan_to_num(known)):
        # Depth noise of structured light and time of flight grows with the square of the distance, roughly.
        noise_m = 0.06 + 0.008 * depth_m**2
        moved = (depth_m > 0) & (depth_m < still_m - noise_m)
        moved = cv2.morphologyEx(moved.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        beyond = _beyond(depth_m)
        behind_m = beyond.max(axis=0)
        edge = (moved > 0) & (behind_m > depth_m + 2.5 * noise_m)
        _, label, stats, _ = map(np.asarray, cv2.connectedComponentsWithStats(moved, connectivity=8))
        edge &= stats[label, cv2.CC_STAT_AREA] >= 400
        # A gap counts as part of what lies behind it, so that the shadow does not turn the outline's normal.
        closed = cv2.GaussianBlur(np.where(depth_m > 0, depth_m, behind_m), (0, 0), 2.0)
        normal = np.stack([cv2.Sobel(closed, cv2.CV_32F, 1, 0), cv2.Sobel(closed, cv2.CV_32F, 0, 1)], axis=-1)
        row, column = np.nonzero(edge)
        z = depth_m[row, column].astype(np.float64)
        at = np.stack([column, row], axis=-1).astype(np.float64)
        along = normal[row, column][:, ::-1] * np.array([1.0, -1.0])
        along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)

        def lifted(pixels: np.ndarray, z: np.ndarray = z) -> np.ndarray:
            x = (pixels[:, 0] - camera.cx_px) / camera.fx_px
            y = (pixels[:, 1] - camera.cy_px) / camera.fy_px
            return np.stack([x, y, np.ones_like(x)], axis=-1) * z[:, None]

        ends = [_project(lifted(at + sign * along), view) for sign in (-1.0, 1.0)]
        tangent = ends[1] - ends[0]
        angle = np.arctan2(tangent[:, 0], -tangent[:, 1])  # of the normal, in the colour picture
        direction = np.rint(angle / np.pi * NUM_DIRECTIONS).astype(int) % NUM_DIRECTIONS
        points.append(lifted(at))
        channels.append(frame * NUM_DIRECTIONS + direction)
        blobs.append(first_blob + label[row, column])
        first_blob += len(stats)
    return _Outlines(np.concatenate(points), np.concatenate(channels), np.concatenate(blobs))


def _median_known(known: np.ndarray) -> np.ndarray:
    """Median over frames of what is not NaN; 0 where that is nowhere. (nanmedian warns there, and is slow.)"""
    ordered = np.sort(known, axis=0)
    count = np.isfinite(known).sum(axis=0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    return np.where(count > 0, middle, 0).astype(np.float32)


def _beyond(depth_m: np.ndarray) -> np.ndarray:
    """The next measured depth left, right, above and below each pixel, within MAX_GAP_PX; 0 if there is none."""
    out = []
    for turned in range(4):
        turn = np.rot90(depth_m, turned)
        columns = np.arange(turn.shape[1])
        last = np.maximum.accumulate(np.where(turn > 0, columns, -1), axis=1)
        last = np.pad(last, ((0, 0), (1, 0)), constant_values=-1)[:, :-1]
        near = (last >= 0) & (columns - last <= MAX_GAP_PX + 1)
        values = np.take_along_axis(turn, np.maximum(last, 0), axis=1)
        out.append(np.rot90(np.where(near, values, 0), -turned))
    return np.stack(out)


def _colour_edges(colour: np.ndarray) -> np.ndarray:
    """How much of an edge the still scene does not have, 0 to 1, by direction of its normal: (frames * 4, h, w)."""
    still = np.median(colour, axis=0).astype(np.float32)
    own = cv2.dilate(_gradients(still).transpose(1, 2, 0), np.ones((3, 3), np.uint8)).transpose(2, 0, 1)
    out = []
    for picture in colour:
        new = np.maximum(_gradients(picture.astype(np.float32)) - 1.2 * own, 0)
        out.append((new / (new + EDGE_HALF)).astype(np.float16))
    return np.concatenate(out)


def _gradients(picture: np.ndarray) -> np.ndarray:
    """Strongest channel's derivative along NUM_DIRECTIONS normals, grey levels a pixel: (directions, h, w)."""
    smooth = cv2.GaussianBlur(picture, (0, 0), 1.0)
    x, y = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    angles = np.arange(NUM_DIRECTIONS) * np.pi / NUM_DIRECTIONS
    return np.stack([np.abs(np.cos(a) * x + np.sin(a) * y).max(axis=-1) for a in angles]).astype(np.float32)


def _blurred(edges: np.ndarray, blur_px: float) -> np.ndarray:
    return np.stack([cv2.GaussianBlur(e.astype(np.float32), (0, 0), blur_px).astype(np.float16) for e in edges])


def _project(points_m: np.ndarray, view: DepthToColour) -> np.ndarray:
    points = points_m @ view.rotation.T + view.translation_m
    z = np.maximum(points[:, 2], 1e-3)
    camera = view.colour_camera
    return np.stack(
        [camera.fx_px * points[:, 0] / z + camera.cx_px, camera.fy_px * points[:, 1] / z + camera.cy_px], axis=-1
    )


def _sample(maps: np.ndarray, channel: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Bilinear; nothing outside the picture."""
    _, height, width = maps.shape
    x = np.clip(pixels[:, 0], 0, width - 1.001)
    y = np.clip(pixels[:, 1], 0, height - 1.001)
    inside = (x == pixels[:, 0]) & (y == pixels[:, 1])
    column, row = x.astype(np.int64), y.astype(np.int64)
    right, down = x - column, y - row
    flat, at = maps.reshape(-1), (channel * height + row) * width + column
    upper = flat[at] * (1 - right) + flat[at + 1] * right
    lower = flat[at + width] * (1 - right) + flat[at + width + 1] * right
    return np.where(inside, upper * (1 - down) + lower * down, 0)


def _shift_scores(pixels: np.ndarray, channel: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Mean edge strength under the outline moved by every whole shift: (dy, dx) from -SEARCH_PX on."""
    _, height, width = maps.shape
    flat = maps.reshape(-1)
    column, row = np.rint(pixels).astype(np.int64).T
    shifts = np.arange(-SEARCH_PX, SEARCH_PX + 1)
    x = column[:, None] + shifts
    outside = (x < 0) | (x >= width)
    x, scores = np.clip(x, 0, width - 1), np.empty((len(shifts), len(shifts)))
    for i, down in enumerate(shifts):
        y = row + down
        found = flat[((channel * height + np.clip(y, 0, height - 1)) * width)[:, None] + x].astype(np.float32)
        found[outside | ((y < 0) | (y >= height))[:, None]] = 0
        scores[i] = found.mean(axis=0)
    return scores


def _measure(outlines: _Outlines, maps: np.ndarray, view: DepthToColour) -> Misalignment:
    shifts, seen = [], 0
    pixels = _project(outlines.points_m, view)
    order = np.argsort(outlines.blob, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(outlines.blob[order])) + 1):
        if len(members) < 60:
            continue
        members = members[_every(len(members), BLOB_POINTS)]
        seen += 1
        shift = _best_shift(_shift_scores(pixels[members], outlines.channel[members], maps))
        if shift is not None:
            shifts.append(shift)
    if len(shifts) < MIN_BLOBS:
        raise RecordingError(
            f"Only {len(shifts)} of {seen} moving things have a clear place within {SEARCH_PX} px in the colour "
            f"picture; {MIN_BLOBS} are needed. Give frames in which somebody walks through the picture, or "
            "correction=null; a calibration that is farther off has to be made anew."
        )
    found = np.array(shifts)
    lengths = np.linalg.norm(found, axis=1)
    middle = np.median(found, axis=0)
    return Misalignment(
        float(np.median(lengths)),
        float(np.percentile(lengths, 90)),
        (float(middle[0]), float(middle[1])),
        len(shifts),
        seen,
    )


def _best_shift(scores: np.ndarray) -> tuple[float, float] | None:
    """The peak (x, y) to a fraction of a pixel; None where it lies on the border or another is nearly as high."""
    down, right = np.unravel_index(np.argmax(scores), scores.shape)
    size = len(scores)
    if not (0 < down < size - 1 and 0 < right < size - 1):
        return None
    peak, spread = scores[down, right], scores.std()
    y, x = np.mgrid[:size, :size]
    elsewhere = np.hypot(x - right, y - down) > 6
    if peak < scores.mean() + 3 * spread or peak < 1.1 * scores[elsewhere].max():
        return None

    def vertex(low: float, middle: float, high: float) -> float:
        bend = low - 2 * middle + high
        return 0.0 if bend >= 0 else 0.5 * (low - high) / bend

    fine_x = vertex(scores[down, right - 1], peak, scores[down, right + 1])
    fine_y = vertex(scores[down - 1, right], peak, scores[down + 1, right])
    return float(right - SEARCH_PX + fine_x), float(down - SEARCH_PX + fine_y)
