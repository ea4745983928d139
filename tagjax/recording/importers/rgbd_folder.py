"""RGB-D folders: NNN.jpg beside NNN.mat with a calibration, and TUM RGB-D. Frames are decoded when indexed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.io

from ...core.camera import Intrinsics
from ...core.errors import RecordingError
from ...core.geometry import register_depth, undistort
from ...core.names import valid_name
from ..computed_frames import ComputedFrames
from ..image_files import natural_sorted, read_colour, read_image, read_labels
from ..reads import TagReads
from ..recording import Recording, Truth
from .read_values import number
from .rows import Rejected, RowError, numbered, read_rows, text_lines


@dataclasses.dataclass(frozen=True)
class DepthToColour:
    """A depth camera beside a colour camera: X_colour = rotation X_depth + translation."""

    depth_camera: Intrinsics
    colour_camera: Intrinsics
    rotation: np.ndarray
    translation_m: np.ndarray

    def corrected(self, correction: Sequence[float]) -> DepthToColour:
        """The same cameras with a residual correction: (dTx, dTy, dTz) metres, factors on fx and fy, shifts of cx and
        cy in pixels.
        """
        dx, dy, dz, scale_x, scale_y, shift_x, shift_y = correction
        camera = self.colour_camera
        return dataclasses.replace(
            self,
            translation_m=self.translation_m + np.array([dx, dy, dz]),
            colour_camera=dataclasses.replace(
                camera,
                fx_px=camera.fx_px * scale_x,
                fy_px=camera.fy_px * scale_y,
                cx_px=camera.cx_px + shift_x,
                cy_px=camera.cy_px + shift_y,
            ),
        )


class FrameFiles(ComputedFrames):
    """Frames stored as files, decoded by `decode(path)`. Raises `RecordingError` for one of another shape than the others'."""

    def __init__(self, files: Sequence[Path], decode: Callable[[Path], np.ndarray], shape: tuple[int, ...], dtype: Any):
        def decoded(number: int) -> np.ndarray:
            frame = decode(files[number])
            if frame.shape != shape:
                raise RecordingError(
                    f"{files[number]}: an image of shape {frame.shape}; expected {shape} like the others."
                )
            return frame

        super().__init__((len(files), *shape), dtype, decoded)


def read_mat_depth(path: Path) -> np.ndarray:
    """`depth_array` of a MATLAB file, uint16 (height, width) millimetres. Anything else raises `RecordingError`."""
    depth = _load_mat(path, "depth_array")
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise RecordingError(
            f"{path}: depth_array is {depth.dtype} of shape {depth.shape}; expected uint16 millimetres of shape (height, "
            "width). Convert it."
        )
    return depth


def _load_mat(path: str | Path, name: str) -> np.ndarray:
    try:
        variables = scipy.io.loadmat(path, variable_names=[name])
    # For a truncated file SciPy raises various errors (zlib.error, TypeError, struct.error, ...).
    except Exception as error:
        raise RecordingError(
            f"{path}: no readable MATLAB file ({type(error).__name__}: {error}). Copy it again; save it with -v7 if it is "
            "of version 7.3."
        ) from error
    if name not in variables:
        raise RecordingError(f"{path}: no variable {name!r}; expected one. Copy the file again, or name another file.")
    return np.asarray(variables[name])


def load_calibration(path: str | Path, shape: tuple[int, int]) -> DepthToColour:
    """Both cameras from Kdepth, Krgb, R, T of a `cam_params` structure; a T in millimetres is converted to metres.

    `shape` is (height, width) of the images. Raises `RecordingError` for a file without these values.
    """
    structure = _load_mat(path, "cam_params")
    try:
        values = structure[0, 0]
        depth, colour, rotation = (np.asarray(values[name], float).reshape(3, 3) for name in ("Kdepth", "Krgb", "R"))
        translation = np.asarray(values["T"], float).reshape(3)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise RecordingError(
            f"{path}: cam_params is incomplete ({error}); expected Kdepth, Krgb and R, 3 x 3, and T, 3 numbers."
        ) from error
    if not all(np.isfinite(value).all() for value in (depth, colour, rotation, translation)):
        raise RecordingError(
            f"{path}: cam_params holds values that are not finite; expected a calibration. Copy it again."
        )
    if np.linalg.norm(translation) > 1.0:
        translation = translation / 1000.0
    height, width = shape

    def camera(k: np.ndarray) -> Intrinsics:
        return Intrinsics(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]), width, height)

    return DepthToColour(camera(depth), camera(colour), rotation, translation)


def import_jpg_mat(
    folder: str | Path,
    calibration: str | Path,
    *,
    fps: float,
    correction: Sequence[float] | None = None,
    masks: str | Path | None = None,
    name: str | None = None,
) -> Recording:
    """A folder of NNN.jpg with NNN.mat beside (depth camera's view, millimetres), registered to colour.

    The folder has no times: frames get times at `fps`. `correction` is a residual correction of the calibration
    (see `DepthToColour.corrected`), as `registration.estimate_correction` returns it. `masks` is a folder of label
    images, one per frame. The recording has no tag reads. Raises `RecordingError` if images or their .mat files are
    missing or differ in size.
    """
    folder = Path(folder)
    images = natural_sorted(folder.glob("*.jpg"))
    if not images:
        raise RecordingError(f"{folder}: no .jpg file; expected images with .mat files of the same names.")
    depths = [image.with_suffix(".mat") for image in images]
    absent = [depth.name for depth in depths if not depth.is_file()]
    if absent:
        raise RecordingError(
            f"{folder}: {len(absent)} of {len(images)} images have no depth file (no {', '.join(absent[:3])}"
            f"{', ...' if len(absent) > 3 else ''}). Copy the missing files or remove those images."
        )
    if not np.isfinite(fps) or fps <= 0:
        raise RecordingError(f"fps is {fps}; expected a positive frame rate.")
    first = read_colour(images[0])
    view = load_calibration(calibration, first.shape[:2])
    if correction is not None:
        view = view.corrected(correction)

    def registered(path: Path) -> np.ndarray:
        depth = read_mat_depth(path)
        if depth.shape != first.shape[:2]:
            raise RecordingError(
                f"{path}: depth of shape {depth.shape}; expected {first.shape[:2]} like the images, which the calibration is for."
            )
        metres = depth.astype(np.float32) * np.float32(1e-3)
        out = register_depth(metres, view.depth_camera, view.colour_camera, view.rotation, view.translation_m)
        return np.rint(out * 1000).astype(np.uint16)

    truth = None
    if masks is not None:
        labels = natural_sorted(Path(masks).glob("*.png"))
        if len(labels) != len(images):
            raise RecordingError(f"{masks}: {len(labels)} masks for {len(images)} images; expected one per image.")
        truth = Truth(labels=FrameFiles(labels, read_labels, first.shape[:2], np.uint8))
    return Recording(
        colour=FrameFiles(images, read_colour, first.shape, np.uint8),
        depth=FrameFiles(depths, registered, first.shape[:2], np.uint16),
        time_ns=np.rint(np.arange(len(images)) / fps * 1e9).astype(np.int64),
        intrinsics=view.colour_camera,
        reads=TagReads.empty(),
        truth=truth,
        name=valid_name(name or folder.name),
        source=f"jpg + mat folder {folder.name}, {fps:g} frames/s assumed",
    )


TUM_INTRINSICS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": (535.4, 539.2, 320.1, 247.6, ()),
}
"""fx, fy, cx, cy, distortion of the TUM RGB-D benchmark's colour cameras."""

TUM_SHAPE = (480, 640)

TUM_UNITS_PER_M = 5000.0

_MAX_TIME_S = 9e9  # of int64 nanoseconds


def import_tum(folder: str | Path, *, camera: str | None = None, max_gap_s: float = 0.02) -> Recording:
    """A TUM RGB-D folder (rgb.txt, depth.txt; depth PNG in 1/5000 m, registered): each image with the depth nearest in
    time.

    The camera follows from the folder's name if not given; lens distortion is removed frame by frame. Images without
    depth within `max_gap_s` are left out; the recording's `source` states how many. Rows of a list that are not valid are
    left out, with a `RecordingWarning`. Raises `RecordingError` for missing lists, lists of which most rows are not valid,
    and an unknown camera.
    """
    folder = Path(folder)
    listings = {kind: _tum_listing(folder / f"{kind}.txt") for kind in ("rgb", "depth")}
    chosen = camera or next((name for name in TUM_INTRINSICS if name in folder.name), None)
    if chosen not in TUM_INTRINSICS:
        raise RecordingError(f"{folder}: unknown TUM camera {chosen!r}; give one of {', '.join(TUM_INTRINSICS)}.")
    depth_s = np.array([stamp for stamp, _ in listings["depth"]])
    order = np.argsort(depth_s)
    pairs, dropped = [], 0
    for stamp, image in sorted(listings["rgb"]):
        place = np.searchsorted(depth_s[order], stamp)
        near = order[np.clip([place - 1, place], 0, len(order) - 1)]
        best = near[np.argmin(np.abs(depth_s[near] - stamp))]
        if abs(depth_s[best] - stamp) <= max_gap_s:
            pairs.append((stamp, image, listings["depth"][best][1]))
        else:
            dropped += 1
    if not pairs:
        raise RecordingError(
            f"{folder}: no image has a depth map within {max_gap_s} s; expected both lists on the same clock."
        )
    shape = read_colour(pairs[0][1]).shape
    if shape[:2] != TUM_SHAPE:
        raise RecordingError(
            f"{pairs[0][1]}: an image of {shape[:2]}; expected {TUM_SHAPE}, which TUM's intrinsics are for."
        )
    fx, fy, cx, cy, distortion = TUM_INTRINSICS[chosen]
    lens = Intrinsics(fx, fy, cx, cy, shape[1], shape[0], distortion)

    def colour(path: Path) -> np.ndarray:
        image = read_colour(path)
        if not distortion or image.shape != shape:  # FrameFiles refuses another shape, with the file's name
            return image
        return undistort(image, np.zeros(shape[:2], np.float32), lens)[0]

    def depth_mm(path: Path) -> np.ndarray:
        raw = read_image(path, cv2.IMREAD_UNCHANGED)
        if raw.dtype != np.uint16 or raw.ndim != 2:
            raise RecordingError(
                f"{path}: {raw.dtype} of shape {raw.shape}; expected a 16-bit grey depth image. Convert it."
            )
        depth = np.rint(raw * (1000.0 / TUM_UNITS_PER_M)).astype(np.float32)
        if distortion and depth.shape == shape[:2]:
            depth = undistort(np.zeros(shape, np.uint8), depth, lens)[1]
        return depth.astype(np.uint16)

    removed = f"; lens distortion of {chosen} removed" if distortion else ""
    return Recording(
        colour=FrameFiles([p for _, p, _ in pairs], colour, shape, np.uint8),
        depth=FrameFiles([d for _, _, d in pairs], depth_mm, shape[:2], np.uint16),
        time_ns=np.array([round(stamp * 1e9) for stamp, _, _ in pairs], np.int64),
        intrinsics=dataclasses.replace(lens, distortion=()),
        reads=TagReads.empty(),
        name=valid_name(folder.name),
        source=f"TUM RGB-D {folder.name}; {dropped} of {len(listings['rgb'])} images without depth left out{removed}",
    )


def _tum_listing(path: Path) -> list[tuple[float, Path]]:
    """The times and files that a list of a TUM folder names, without the rows that are not valid."""
    if not path.is_file():
        raise RecordingError(f"{path}: missing; a TUM RGB-D folder lists its images there.")
    stamps: set[float] = set()

    def parse(text: str) -> tuple[float, Path]:
        stamp, *names = text.split()
        stamp_s = number({"time": stamp}, "time")
        if not 0 <= stamp_s <= _MAX_TIME_S:
            raise RowError(f"time is outside 0 to {_MAX_TIME_S:g} s")
        if stamp_s in stamps:
            raise RowError("this time is there already")
        name = Path(*names[:1])
        if name.is_absolute() or ".." in name.parts:
            raise RowError("the file is outside of the folder")
        if not _is_file(path.parent / name):
            raise RowError("the file is missing")
        stamps.add(stamp_s)
        return stamp_s, path.parent / name

    lines = [one for one in numbered(text_lines(path)) if not one[1].lstrip().startswith("#")]
    rejected = Rejected()
    rows = [row for _, row in read_rows(lines, parse, rejected)]
    rejected.check(path, len(lines), "a time in seconds and the name of an image, separated by a space")
    return rows


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is too long
        return False
