"""Residual misregistration of depth and colour, measured and corrected from the recording itself.

Outlines are compared: at the border of a near object the depth map has a step and the colour image an edge. Only
outlines of moving objects are used, with colour edges that the static scene does not have: texture of furniture is an
edge in colour only and would attract the outlines. The camera must be static.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import scipy.optimize
from jaxtyping import UInt8, UInt16

from ...core.errors import RecordingError
from ..image_files import natural_sorted, read_colour
from .outlines import Outlines, blurred, colour_edges, depth_outlines, project_to_colour
from .rgbd_folder import DepthToColour, load_calibration, read_mat_depth

NO_CORRECTION = (0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0)
"""The correction that changes nothing, in the order of `DepthToColour.corrected`."""

PRIOR_SPREAD = (0.01, 0.01, 0.01, 0.01, 0.01, 12.0, 12.0)
"""Expected error of a calibration: metres (3), focal factors (2), pixels (2). It separates parameters that the data
cannot: a shift of the principal point and one of the translation differ only by depth."""

PRIOR_WEIGHT = 0.04
"""Loss of mean edge strength (0 to 1) that equals a deviation of one spread, with one moving object; with more objects
the data have more weight. Held-out errors differ by at most 0.3 px from a quarter to four times of it."""

SEARCH_PX = 24
"""Largest misalignment of the search, in each direction."""

BLURS_PX = (6.0, 3.0, 1.5)
"""Blur of the colour edges, coarse to fine; the first gives a gradient over large distances."""

MIN_POINTS = 400
"""Minimum number of outline points for an estimate."""

MIN_OBJECTS = 5
"""Minimum number of moving objects with an unambiguous shift for a measurement."""

MAX_POINTS = 20_000
"""Maximum number of outline points of the estimate; evenly thinned if there are more."""

OBJECT_POINTS = 300
"""Maximum number of outline points of one object, for the measurement of its shift."""

FOLDER_FRAMES = 40
"""Number of frames of a folder that are read: about 15 s on two slow cores, and a peak of 0.9 GB."""


@dataclasses.dataclass(frozen=True)
class Misalignment:
    """Distance of projected depth outlines from colour edges, over moving objects with one unambiguous shift."""

    median_px: float  # of the lengths of the shifts
    p90_px: float
    mean_shift_px: tuple[float, float]  # medians in x and y; to be added to the projected outline
    num_unambiguous: int  # moving objects that were used
    num_objects: int  # moving objects with enough outline points


@dataclasses.dataclass(frozen=True)
class ResidualCorrection:
    """The estimated correction, in the order of `DepthToColour.corrected`, with the misalignment before and after."""

    correction: tuple[float, float, float, float, float, float, float]
    before: Misalignment
    after: Misalignment

    def line(self) -> str:
        """A summary in one line."""
        numbers = ", ".join(f"{value:.6g}" for value in self.correction)
        return (
            f"Residual registration: {self.before.median_px:.1f} px before, {self.after.median_px:.1f} px after; "
            f"correction = [{numbers}]"
        )


def misalignment_px(
    colour: UInt8[np.ndarray, "frames height width 3"],
    depth_mm: UInt16[np.ndarray, "depth_frames depth_height depth_width"],
    view: DepthToColour,
) -> Misalignment:
    """Distance between projected depth outlines and colour edges, in pixels of the colour image.

    For each moving object in each frame: the shift (within `SEARCH_PX`) of its projected outline with the highest mean
    strength of colour edges of the same direction; objects with an ambiguous shift are left out. RGB images and raw
    depth (depth camera's view, millimetres, 0 = missing) of a static camera, a dozen frames or more, preferably far
    apart in time: the static scene is their median. Noisy depth outlines give about 1.5 px even if the registration is
    correct. Raises `RecordingError` with fewer than `MIN_OBJECTS` unambiguous objects.
    """
    _check(colour, depth_mm)
    return _measure(depth_outlines(depth_mm, view), blurred(colour_edges(colour), BLURS_PX[-1]), view)


def estimate_correction(
    colour: UInt8[np.ndarray, "frames height width 3"],
    depth_mm: UInt16[np.ndarray, "depth_frames depth_height depth_width"],
    view: DepthToColour,
) -> ResidualCorrection:
    """The residual correction of `view` that aligns depth outlines with colour edges, for `view.corrected(...)`.

    Frames as for `misalignment_px`: thirty or more, evenly spread over a recording in which a person walks. All seven
    parameters are estimated jointly, coarse to fine (from errors of up to 20 px), with the prior `PRIOR_SPREAD`:
    translation and principal point have similar effects, as have dTz and the focal factors, unless outlines are at
    clearly different depths. The projection of points at the observed depths is reliable, not the single parameters.
    Deterministic; without an improvement, no correction. Raises `RecordingError` if outlines are too few or ambiguous.
    """
    _check(colour, depth_mm)
    outlines = depth_outlines(depth_mm, view)
    if len(outlines.points_m) < MIN_POINTS:
        raise RecordingError(
            f"Only {len(outlines.points_m)} outline points of moving objects in {len(colour)} frames; the registration "
            f"needs {MIN_POINTS}. Give frames in which a person walks through the image, or correction=null."
        )
    edges = colour_edges(colour)
    fine = blurred(edges, BLURS_PX[-1])
    before = _measure(outlines, fine, view)
    thinned = outlines.subset(_evenly_spaced(len(outlines.points_m), MAX_POINTS))
    spread = np.array(PRIOR_SPREAD)
    prior = PRIOR_WEIGHT / len(np.unique(outlines.object_index))

    def correction_of(deviation: np.ndarray) -> np.ndarray:
        return np.array(NO_CORRECTION) + deviation * spread

    deviation = np.zeros(7)
    for blur_px in BLURS_PX:
        maps = fine if blur_px == BLURS_PX[-1] else blurred(edges, blur_px)

        def loss(deviation: np.ndarray, maps: np.ndarray = maps) -> float:
            pixels = project_to_colour(thinned.points_m, view.corrected(correction_of(deviation).tolist()))
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

    Raises `RecordingError` if there are no images, or they differ in size.
    """
    images = natural_sorted(Path(folder).glob("*.jpg"))
    if not images:
        raise RecordingError(f"{folder}: no .jpg file; expected images with .mat files of the same names.")
    images = [images[i] for i in _evenly_spaced(len(images), FOLDER_FRAMES)]
    frames = []
    for read, paths in ((read_colour, images), (read_mat_depth, [path.with_suffix(".mat") for path in images])):
        decoded = [read(path) for path in paths]
        for path, frame in zip(paths, decoded, strict=True):
            if frame.shape != decoded[0].shape:
                raise RecordingError(f"{path}: shape {frame.shape}; expected {decoded[0].shape} like the others.")
        frames.append(np.stack(decoded))
    colour, depth_mm = frames
    height, width = colour.shape[1:3]
    return estimate_correction(colour, depth_mm, load_calibration(calibration, (height, width)))


def _evenly_spaced(count: int, maximum: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, maximum)).round().astype(int))


def _check(colour: np.ndarray, depth_mm: np.ndarray) -> None:
    if len(colour) != len(depth_mm):
        raise RecordingError(f"{len(colour)} colour frames and {len(depth_mm)} depth frames; expected pairs.")
    if len(colour) < 5:
        raise RecordingError(
            f"Only {len(colour)} frames: moving objects cannot be separated from the static scene. Give a dozen."
        )


def _sample(maps: np.ndarray, channel: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Bilinear samples; 0 outside the image."""
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
    """Mean edge strength along the outline, moved by every integer shift (dy, dx) from -SEARCH_PX to SEARCH_PX."""
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


def _measure(outlines: Outlines, maps: np.ndarray, view: DepthToColour) -> Misalignment:
    shifts, num_objects = [], 0
    pixels = project_to_colour(outlines.points_m, view)
    order = np.argsort(outlines.object_index, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(outlines.object_index[order])) + 1):
        if len(members) < 60:
            continue
        members = members[_evenly_spaced(len(members), OBJECT_POINTS)]
        num_objects += 1
        shift = _best_shift(_shift_scores(pixels[members], outlines.channel[members], maps))
        if shift is not None:
            shifts.append(shift)
    if len(shifts) < MIN_OBJECTS:
        raise RecordingError(
            f"Only {len(shifts)} of {num_objects} moving objects have an unambiguous shift within {SEARCH_PX} px in the "
            f"colour image; expected at least {MIN_OBJECTS}. Give frames in which a person walks through the image, or "
            "correction=null; a calibration with larger errors has to be repeated."
        )
    found = np.array(shifts)
    lengths = np.linalg.norm(found, axis=1)
    middle = np.median(found, axis=0)
    return Misalignment(
        float(np.median(lengths)),
        float(np.percentile(lengths, 90)),
        (float(middle[0]), float(middle[1])),
        len(shifts),
        num_objects,
    )


def _best_shift(scores: np.ndarray) -> tuple[float, float] | None:
    """The peak (x, y) with subpixel accuracy; None if it is on the border or another is nearly as high."""
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
