"""Pairs of neighbouring pictures for flow training: from recordings, videos, image folders, or drawn ones.

Every source is a sequence of RGB pictures, read lazily; Grain draws, crops and varies them in worker threads, and its
iterator resumes exactly.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import cv2
import grain
import numpy as np
import zarr
from jaxtyping import Float, Float32, UInt8
from rich.progress import Progress, track

from ..core.prepared import made_once
from ..core.stream import Stream
from ..core.types import LazyArray
from ..recording import RecordingError
from ..recording.picture_files import in_order, read_colour
from ..recording.store import open_recording

VIDEO_ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".webp")

_LONGEST_SIDE = 640
"""Videos are kept no larger: crops for training are far smaller."""

_DECODING = 2
"""To be raised when the same video gives other frames: older copies are then not read."""

_MANY_FILES, _NAMED_FILES = 200, 5
"""A folder of so many pictures shows a bar while it is checked; so many of its bad ones are named."""


@dataclasses.dataclass(frozen=True)
class VariationSettings:
    """How a pair is cut from two pictures, and how what the network sees differs from what the loss compares.

    The geometry is the same for both pictures of a pair; light and noise differ a little between them.
    """

    height: int = 128
    width: int = 160
    margin_px: int = 0  # at each side of the cut, seen by the loss alone (SMURF's full-image warping)
    scale: tuple[float, float] = (0.7, 1.4)  # log-uniform; a picture too small is enlarged to fit
    turn_deg: float = 10.0
    gaps: tuple[int, ...] = (1, 2, 4)  # frames between the pictures of a pair
    gain: float = 0.25  # of both pictures
    gamma: float = 0.25
    tint: float = 0.1  # of each colour
    unlike: float = 0.05  # gain between the two pictures
    noise: float = 0.02
    grey_probability: float = 0.1  # pairs without colour
    transpose_probability: float = 0.0  # pairs whose rows become columns
    negative_probability: float = 0.0  # pairs with dark and bright exchanged
    recolour_probability: float = 0.0  # pairs whose colours change places

    def __post_init__(self) -> None:
        low, high = self.scale
        if self.margin_px < 0:
            raise ValueError(f"margin_px is {self.margin_px}; expected 0 or more.")
        if not 0 < low <= high:
            raise ValueError(f"scale is {self.scale}; expected two positive numbers, the smaller first.")
        if not self.gaps or min(self.gaps) < 1:
            raise ValueError(f"gaps are {self.gaps}; expected frame distances of at least 1.")
        if min(self.height, self.width) < 32:
            raise ValueError(f"Crops of {self.height} x {self.width} are too small; use at least 32 x 32.")
        for name in ("grey_probability", "transpose_probability", "negative_probability", "recolour_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a share, 0 to 1.")


class ImageFolder:
    """The pictures of a folder in order of their names (frame2 before frame10) as RGB, read when asked for.

    All are read once when the folder is opened: `RecordingError` names those that cannot be, and those of another size
    than most.
    """

    def __init__(self, folder: Path):
        self._files = in_order(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_ENDINGS)
        if len(self._files) < 2:
            raise RecordingError(
                f"{folder} holds {len(self._files)} pictures ({', '.join(IMAGE_ENDINGS)}); a flow needs at least two."
            )
        self.shape = (len(self._files), *_common_shape(folder, self._files))
        self.dtype = np.dtype(np.uint8)

    def __getitem__(self, index: Any) -> np.ndarray:
        """The picture, uint8 (height, width, 3); grey ones become RGB, 16 bits become 8."""
        path = self._files[int(index)]
        picture = np.ascontiguousarray(read_colour(path))
        if picture.shape != self.shape[1:]:
            raise RecordingError(
                f"{path} has {_size(picture.shape)} pixels by now; all had {_size(self.shape[1:])} when the folder was "
                "opened. Leave it as it is during a run."
            )
        return picture


def _common_shape(folder: Path, files: Sequence[Path]) -> tuple[int, ...]:
    """The shape (height, width, 3) of all pictures. Raises `RecordingError` that names those which differ from most."""
    shapes, bad = {}, {}
    with ThreadPoolExecutor() as pool:
        # Decoding leaves Python to others; a large folder takes a while all the same.
        read = pool.map(_shape_or_error, files)
        for path, found in zip(
            files,
            track(read, f"check {folder.name}", len(files), disable=len(files) < _MANY_FILES, transient=True),
            strict=True,
        ):
            (bad if isinstance(found, RecordingError) else shapes)[path] = found
    if not shapes:
        raise RecordingError(f"{folder}: none of {len(files)} pictures can be read. First: {next(iter(bad.values()))}")
    common, _ = Counter(shapes.values()).most_common(1)[0]
    bad |= {path: f"{path}: {_size(shape)} pixels." for path, shape in shapes.items() if shape != common}
    if bad:
        named = [str(bad[path]) for path in files if path in bad]
        listed = " ".join(f"({n}) {told}" for n, told in enumerate(named[:_NAMED_FILES], 1))
        more = f" And {len(named) - _NAMED_FILES} more." if len(named) > _NAMED_FILES else ""
        raise RecordingError(
            f"{folder}: {len(named)} of {len(files)} pictures cannot be used; expected whole ones of {_size(common)} "
            f"pixels, as most are. {listed}{more} Remove or replace them; pictures of another camera go into another folder."
        )
    return common


def _shape_or_error(path: Path) -> tuple[int, ...] | RecordingError:
    try:
        return read_colour(path).shape
    except RecordingError as error:
        return error


def _size(shape: Sequence[int]) -> str:
    return f"{shape[1]} x {shape[0]}"


def open_sequence(path: str, cache: Path) -> LazyArray:
    """Pictures (frame, height, width, 3), uint8, of a recording (.zarr), a video file or a folder of pictures.

    A video is decoded once, into `cache`. Raises `RecordingError` for anything else, and for fewer than two pictures.
    """
    where = Path(path)
    if where.suffix == ".zarr" or path.startswith(("http://", "https://")):
        sequence: LazyArray = open_recording(path).colour
    elif where.is_dir():
        sequence = ImageFolder(where)
    elif where.suffix.lower() in VIDEO_ENDINGS and where.is_file():
        sequence = _decoded(where, cache)
    else:
        found = "a file" if where.is_file() else "nothing"
        raise RecordingError(
            f"{path}: found {found}; expected a recording (.zarr), a folder of pictures ({', '.join(IMAGE_ENDINGS)}) "
            f"or a video ({', '.join(VIDEO_ENDINGS)})."
        )
    if sequence.shape[0] < 2:
        raise RecordingError(f"{path} holds {sequence.shape[0]} picture; a flow needs at least two.")
    return sequence


def _decoded(video: Path, cache: Path) -> LazyArray:
    """The frames of a video, from the cache if it was decoded before."""
    stamp = f"{_DECODING} {video.resolve()} {video.stat().st_size} {video.stat().st_mtime_ns}"
    target = cache / f"{video.stem}-{hashlib.sha256(stamp.encode()).hexdigest()[:12]}.zarr"
    return made_once(target, lambda path: _decode(video, path))


def _decode(video: Path, path: Path) -> None:
    """Write the frames (frame, height, width, 3) of a video. Raises `RecordingError` for fewer than two."""
    capture = cv2.VideoCapture(str(video))
    try:
        ok, picture = capture.read()
        if not ok:
            raise RecordingError(f"{video} cannot be decoded. Is it whole, and does OpenCV know its codec?")
        factor = min(1.0, _LONGEST_SIDE / max(picture.shape[:2]))
        size = (round(picture.shape[1] * factor), round(picture.shape[0] * factor))
        # Streamed videos say nothing, or nonsense: the bar alone believes it.
        stated = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        shape = (0, size[1], size[0], 3)
        kept = zarr.create_array(str(path), shape=shape, dtype="uint8", chunks=(1, *shape[1:]))
        with Progress(transient=True) as bar:
            task = bar.add_task(f"decode {video.name}", total=stated if 0 < stated < math.inf else None)
            while ok:
                small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)[..., ::-1]
                kept.append(np.ascontiguousarray(small)[None])
                bar.advance(task)
                ok, picture = capture.read()
        if kept.shape[0] < 2:
            raise RecordingError(f"{video} holds {kept.shape[0]} picture that can be decoded; a flow needs two.")
    finally:
        capture.release()


class PairSource:
    """Every pair of pictures of a sequence that are one of `gaps` frames apart, as Grain's random access source."""

    def __init__(self, sequence: LazyArray, gaps: Sequence[int]):
        count = sequence.shape[0]
        self._sequence = sequence
        self._pairs = [(t, t + gap) for gap in gaps for t in range(count - gap)]
        if not self._pairs:
            raise RecordingError(f"No two of {count} pictures are {' or '.join(map(str, gaps))} frames apart.")

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index) -> UInt8[np.ndarray, "2 height width 3"]:
        first, second = self._pairs[int(index)]
        return np.stack([np.asarray(self._sequence[first]), np.asarray(self._sequence[second])])


class StackedPairs:
    """Pairs that already lie side by side, (pair, 2, height, width, 3), as Grain's random access source."""

    def __init__(self, pairs: LazyArray):
        self._pairs = pairs

    def __len__(self) -> int:
        return self._pairs.shape[0]

    def __getitem__(self, index) -> UInt8[np.ndarray, "2 height width 3"]:
        return np.asarray(self._pairs[int(index)])


class TaughtPairs:
    """Pairs that lie side by side, with a teacher's flow from first to second, as Grain's random access source."""

    def __init__(self, pairs: LazyArray, flow_px: LazyArray):
        if tuple(flow_px.shape) != (pairs.shape[0], *pairs.shape[2:4], 2):
            raise ValueError(f"Flow of shape {tuple(flow_px.shape)} for pairs of shape {tuple(pairs.shape)}.")
        self._pairs, self._flow_px = pairs, flow_px

    def __len__(self) -> int:
        return self._pairs.shape[0]

    def __getitem__(self, index) -> dict[str, np.ndarray]:
        number = int(index)
        return {"pair": np.asarray(self._pairs[number]), "flow_px": np.asarray(self._flow_px[number], np.float32)}


def vary(
    pair: UInt8[np.ndarray, "2 _ _ 3"],
    rng: np.random.Generator,
    settings: VariationSettings,
    flow_px: Float32[np.ndarray, "_ _ 2"] | None = None,
) -> dict[str, np.ndarray]:
    """A random cut of a pair: `clean`, for the loss, and `seen`, for the network, with other light and noise.

    `clean` reaches `margin_px` further than `seen` at each side. With the pair's flow, first to second, `flow_px` is what
    that is between the pictures `seen`, NaN where the cut reaches beyond the picture; without, either may come first.
    """
    margin = settings.margin_px
    size = settings.height + 2 * margin, settings.width + 2 * margin
    matrix, scale = _placed(pair.shape[1:3], rng, settings, size)
    order = rng.permutation(2) if flow_px is None else np.arange(2)
    clean = np.stack([_cut(picture, matrix, size, scale) for picture in pair[order]])
    inner = slice(margin, margin + settings.height), slice(margin, margin + settings.width)
    found = {"clean": clean, "seen": _relit(clean[:, *inner].astype(np.float32) / 255, rng, settings)}
    if flow_px is not None:
        found["flow_px"] = _cut_flow(flow_px, matrix, size)[inner]
    return found


def _relit(
    seen: Float32[np.ndarray, "2 height width 3"], rng: np.random.Generator, settings: VariationSettings
) -> UInt8[np.ndarray, "2 height width 3"]:
    """The pair with other light, colour and noise."""
    seen = seen ** np.float32(np.exp(rng.uniform(-settings.gamma, settings.gamma)))
    unlike = rng.uniform(-settings.unlike, settings.unlike, (2, 1, 1, 1))
    tint = rng.uniform(-settings.tint, settings.tint, (1, 1, 1, 3))
    seen = seen * (1 + rng.uniform(-settings.gain, settings.gain) + unlike + tint).astype(np.float32)
    if rng.uniform() < settings.grey_probability:
        seen = np.repeat(np.mean(seen, axis=-1, keepdims=True), 3, axis=-1)
    if _chance(rng, settings.negative_probability):
        seen = 1 - seen
    if _chance(rng, settings.recolour_probability):
        seen = seen[..., rng.permutation(3)]
    noise = rng.standard_normal(seen.shape, np.float32) * np.float32(settings.noise * rng.uniform() ** 2)
    return np.clip(np.rint(255 * (seen + noise)), 0, 255).astype(np.uint8)


def _placed(
    whole: tuple[int, ...], rng: np.random.Generator, settings: VariationSettings, size: tuple[int, int]
) -> tuple[Float[np.ndarray, "2 3"], float]:
    """Where a cut of (rows, columns) `size` lies: from its pixels (x, y, 1) to the picture's; and its scale."""
    (height, width), (rows, columns) = whole, size
    low, high = settings.scale
    scale = np.exp(rng.uniform(np.log(low), np.log(high)))
    scale = max(scale, rows / height, columns / width)
    turn = np.deg2rad(rng.uniform(-settings.turn_deg, settings.turn_deg))
    # Where the cut's centre lies, such that without a turn all of it is in the picture.
    room = np.array([width - columns / scale, height - rows / scale])
    centre = np.array([(width - 1) / 2, (height - 1) / 2]) + (rng.uniform(size=2) - 0.5) * room
    mirror = rng.choice([-1.0, 1.0], 2)
    cosine, sine = np.cos(turn) / scale, np.sin(turn) / scale
    linear = np.array([[cosine, -sine], [sine, cosine]]) * mirror
    if _chance(rng, settings.transpose_probability):
        linear = linear[:, ::-1]
    corner = centre - linear @ np.array([(columns - 1) / 2, (rows - 1) / 2])
    return np.concatenate([linear, corner[:, None]], axis=1), float(scale)


def _chance(rng: np.random.Generator, share: float) -> bool:
    """Draws nothing where the share is 0: recipes without one go on seeing the pairs that they saw."""
    return share > 0 and rng.uniform() < share


_BACKWARDS = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


def _cut(picture: np.ndarray, matrix: np.ndarray, size: tuple[int, int], scale: float) -> np.ndarray:
    """The cut of (rows, columns) `size`; what lies beyond the picture mirrors it."""
    # Shrinking skips pixels: blur first.
    sigma = 0.5 * (1 / scale - 1)
    smooth = cv2.GaussianBlur(picture, (0, 0), sigma) if sigma > 0.1 else np.ascontiguousarray(picture)
    return cv2.warpAffine(smooth, matrix, size[::-1], flags=_BACKWARDS, borderMode=cv2.BORDER_REFLECT_101)


def _cut_flow(
    flow_px: Float32[np.ndarray, "_ _ 2"], matrix: Float[np.ndarray, "2 3"], size: tuple[int, int]
) -> Float32[np.ndarray, "rows columns 2"]:
    """The same cut of a flow field, in the cut's pixels; NaN beyond the picture."""
    nowhere = (np.nan, np.nan)
    cut = cv2.warpAffine(
        np.ascontiguousarray(flow_px),
        matrix,
        size[::-1],
        flags=_BACKWARDS,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=nowhere,
    )
    return (cut @ np.linalg.inv(matrix[:, :2]).T).astype(np.float32)


class _Vary(grain.transforms.RandomMap):
    def __init__(self, settings: VariationSettings):
        self._settings = settings

    def random_map(self, element: Any, rng: np.random.Generator) -> Any:
        if isinstance(element, dict):
            return vary(element["pair"], rng, self._settings, element["flow_px"])
        return vary(element, rng, self._settings)


def pair_dataset(
    sources: Sequence[PairSource | StackedPairs | TaughtPairs],
    shares: Sequence[float],
    settings: VariationSettings,
    *,
    seed: int,
    workers: int = 0,
    share: tuple[int, int] = (0, 1),
) -> Stream:
    """An endless, shuffled stream of varied pairs (`vary`), from each source by its share; its iterator resumes exactly.

    `workers` processes read them; `share` (i, n) is every n-th pair of the stream from the i-th on.
    """
    if len(sources) != len(shares) or not sources or min(shares) <= 0:
        raise ValueError(f"{len(sources)} sources with shares {list(shares)}; expected a positive share for each.")
    datasets = [
        grain.MapDataset.source(cast(Any, source)).seed(seed + number).shuffle().repeat().random_map(_Vary(settings))
        for number, source in enumerate(sources)
    ]
    mixed = grain.MapDataset.mix(datasets, weights=list(shares)) if len(datasets) > 1 else datasets[0]
    return Stream(mixed, workers=workers, ahead=16, share=share)
