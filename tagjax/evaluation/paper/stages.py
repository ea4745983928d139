"""Figures of one frame's stages in the published tracer: TagAttention's Figs. 4 to 7, and 11."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ...core.camera import working_stride
from ...core.results import write_csv
from ...core.settings import ConfigError
from ...metrics.locking import first_motion
from ...report.paper import maps
from ...report.paper.style import around
from ...report.stages import change_colours
from ...sim.suites import Item
from ...tagattention.published.tracer import PublishedStages, TagAttentionPublished
from ...tracing.clips import clip_loader
from ...tracing.recordings import TraceSettings, run_tracer
from ...tracing.tracer import Camera, Frame
from .settings import PUBLISHED
from .sources import Sources

SETTLED, LAST = 40, 90
"""Stages are shown so many frames after the first motion: the paper's tracer has its object by then."""

_ROWS, _APART = 4, 4  # rows of Fig. 5, and the frames between them
_NUM_MAPS = 8  # of Fig. 11
_FAST_M_S = 0.25


@eqx.filter_jit
def _step(tracer: TagAttentionPublished, camera: Camera, state: Any, frame: Frame) -> tuple[Any, PublishedStages]:
    return tracer.stages(camera, state, frame)


@dataclasses.dataclass(frozen=True)
class Stages:
    """The stages of one tag at one frame, as `PublishedStages` has them."""

    moves: bool
    motion_m: Float[np.ndarray, "height width window"]
    complete: Bool[np.ndarray, "height width"]
    attention: Float[np.ndarray, "height width"]
    carried: Float[np.ndarray, "height width"]  # exp(l - max l)
    probability: Float[np.ndarray, "height width"]
    cut: Bool[np.ndarray, "height width"]
    mask: Bool[np.ndarray, "height width"]
    cluster: Int[np.ndarray, "height width"]


@dataclasses.dataclass(frozen=True)
class FrameNumbers:
    """One frame in numbers: means on the object and elsewhere, over pixels with known motion, and both masks' IoU."""

    frame: int
    since_motion: int
    moves: int
    attention_on: float
    attention_off: float
    carried_on: float
    carried_off: float
    likelihood_on: float
    likelihood_off: float
    iou_before: float
    iou_after: float

    def texts(self, *names: str) -> list[str]:
        """Some of the numbers for a table."""
        return [f"{getattr(self, name):.4g}" for name in names]


class Scene:
    """One recording with the published tracer's stages of its first labelled tag, up to frame 90 after the first motion.

    Raises `ConfigError` where the tracer is another one.
    """

    def __init__(self, sources: Sources, item: Item):
        system = sources.system(PUBLISHED)
        self.recording, self.clips, tracer = sources.recording(item), system.clip_settings(), sources.tracer(system)
        if not isinstance(tracer, TagAttentionPublished):
            raise ConfigError(f"tracers.published is {type(tracer).__name__}; expected TagAttentionPublished.")
        truth = self.recording.truth
        assert truth is not None, "suites have truth"
        assert truth.labels is not None, "suites have labels"
        self.cut = float(tracer.cut)
        self.epc = next(epc for epc in self.recording.reads.epcs if epc in truth.tag_to_label)
        self.stride = working_stride(self.recording.intrinsics.width, self.clips.stride)
        self.begin = first_motion(truth, self.epc, self.recording.frame_time_s()) or 0
        self._labels, self._label = truth.labels, truth.tag_to_label[self.epc]
        self._range_m = np.asarray(truth.tag_range_m[self.epc], np.float64)
        self.last = min(self.begin + LAST, self.recording.num_frames - 1)
        self.spread = np.linspace(min(self.begin + 8, self.last), self.last, _NUM_MAPS).astype(int).tolist()
        self.numbers: list[FrameNumbers] = []
        self.stages: dict[int, Stages] = {}
        sources.report(f"{item.name}, stages of the published tracer")
        frames, load = (0, self.last + 1), clip_loader(self.clips)
        for number, (out,) in run_tracer(_step, tracer, self.recording, load, [self.epc], TraceSettings(), frames):
            if number >= self.begin:
                self._keep(number, out)

    def _keep(self, frame: int, out: PublishedStages) -> None:
        carried, cut, mask = np.asarray(out.carried[0]), np.asarray(out.cut[0], bool), np.asarray(out.mask[0]) > 0.5
        kept = Stages(
            moves=bool(out.moves[0]),
            motion_m=np.asarray(out.motion_m),
            complete=np.asarray(out.complete, bool),
            attention=np.asarray(out.attention[0]),
            carried=np.exp(carried - carried.max()),
            probability=np.asarray(out.probability[0]),
            cut=cut,
            mask=mask,
            cluster=np.asarray(out.cluster),
        )
        true_mask = self.true_mask(frame)
        parts = (true_mask & kept.complete, ~true_mask & kept.complete)
        maps_of = (kept.attention, kept.carried, kept.probability)
        means = [float(one[part].mean()) if part.any() else float("nan") for one in maps_of for part in parts]
        overlaps = [_iou(one, true_mask) for one in (cut, mask)]
        self.numbers.append(FrameNumbers(frame, frame - self.begin, int(kept.moves), *means, *overlaps))
        if frame >= self.begin + SETTLED or frame in self.spread or frame == self.last:
            self.stages[frame] = kept

    def typical(self) -> int:
        """Of the frames from `SETTLED` on, but the last few, the one with the median IoU of the refined mask.

        Only frames at which the true range changes by 0.25 m/s or more over the window are considered, if there are some.
        """
        since = [
            one for one in self.numbers if one.frame in self.stages and one.frame <= self.last - _APART * (_ROWS - 1)
        ]
        rows = since or self.numbers[-1:]
        speed = {one.frame: self._speed_m_s(one.frame) for one in rows}
        fast = [one for one in rows if speed[one.frame] >= _FAST_M_S and one.since_motion >= SETTLED] or rows
        ordered = sorted(fast, key=lambda one: (np.nan_to_num(one.iou_after), one.frame))
        return ordered[len(ordered) // 2].frame

    def _speed_m_s(self, frame: int) -> float:
        time_s = self.recording.frame_time_s()
        first = max(frame - 4, 0)
        return abs(self._range_m[frame] - self._range_m[first]) / max(time_s[frame] - time_s[first], 1e-9)

    def true_mask(self, frame: int) -> np.ndarray:
        """The object's pixels of the working resolution."""
        return np.asarray(self._labels[frame])[:: self.stride, :: self.stride] == self._label

    def colour(self, frame: int) -> np.ndarray:
        """The picture at the working resolution."""
        return np.asarray(self.recording.colour[frame])[:: self.stride, :: self.stride]

    def crop(self, frames: list[int], *, margin: float = 1.2) -> tuple[int, int, int, int]:
        """A part of the picture around the object at some frames."""
        shape = self.true_mask(frames[0]).shape
        return around(np.stack([_box(self.true_mask(frame)) for frame in frames]), *shape, margin=margin)

    def map_frame(self, frame: int) -> maps.MapFrame:
        """The pictures of a kept frame."""
        one, title = self.stages[frame], f"frame {frame - self.begin}"
        return maps.MapFrame(
            title, self.colour(frame), self.true_mask(frame), one.attention, one.carried, one.probability
        )

    def where(self, frame: int) -> str:
        """The recording and the frame in words."""
        return f"{self.recording.name}, frame {frame} ({frame - self.begin} after the first motion)"


def _scene(sources: Sources, items: list[Item]) -> Scene:
    """The scene of the first recording, computed once for all figures."""
    return sources.once(("scene", items[0].name), lambda: Scene(sources, items[0]))


def chosen_pixels(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 4: the motion of chosen pixels against the tag's over one window, the motion map, and the attention."""
    scene = _scene(sources, items)
    frame = scene.typical()
    stages, true_mask = scene.stages[frame], scene.true_mask(frame)
    clip = clip_loader(scene.clips)(scene.recording, frame, frame + 1, epcs=[scene.epc])
    tag_m = np.asarray(clip.frames.radio.relative_m, np.float64)[0, 0, 0]
    tag_m = tag_m - tag_m[0]
    time_s = scene.recording.frame_time_s()[np.maximum(np.arange(frame - len(tag_m) + 1, frame + 1), 0)]
    crop = scene.crop([frame], margin=2.5)
    anchors = _anchors(stages, true_mask, crop)
    change_mm = np.where(stages.complete, 1e3 * stages.motion_m[..., -1], np.nan)
    largest_mm = max(20.0, 1.5e3 * float(np.abs(tag_m).max()))
    maps.attention_figure(
        path, scene.map_frame(frame), change_colours(change_mm, largest_mm), largest_mm, anchors, time_s, tag_m, crop
    )
    columns = {"tag_m": tag_m}
    columns |= {f"pixel{n}_{'object' if a.on_object else 'other'}_m": a.motion_m for n, a in enumerate(anchors, 1)}
    rows = zip(time_s - time_s[0], *columns.values(), strict=True)
    write_csv(path.with_suffix(".csv"), ("time_s", *columns), ([f"{float(v):.6g}" for v in row] for row in rows))
    (numbers,) = (one for one in scene.numbers if one.frame == frame)
    return (
        f"{scene.where(frame)}. Mean attention {numbers.attention_on:.2f} on the object, {numbers.attention_off:.2f} "
        "elsewhere."
    )


def propagation(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 5: attention, the likelihood carried along the flow, and the likelihood after both, at several frames."""
    scene = _scene(sources, items)
    first = scene.typical()
    wanted = [min(first + _APART * number, scene.last) for number in range(_ROWS)]
    maps.propagation_figure(path, [scene.map_frame(frame) for frame in wanted], scene.crop(wanted, margin=1.6))
    names = ("attention_on", "attention_off", "carried_on", "carried_off", "likelihood_on", "likelihood_off")
    _write_numbers(scene, path, names)
    late = [one for one in scene.numbers if one.since_motion >= SETTLED and one.moves]
    means = {name: _mean_known([getattr(one, name) for one in late]) for name in names}
    return (
        f"{scene.where(wanted[0])}, and every {_APART}th after it. Mean of the moving frames from the {SETTLED}th on: attention "
        f"{means['attention_on']:.2f} on the object and {means['attention_off']:.2f} elsewhere, likelihood "
        f"{means['likelihood_on']:.2f} and {means['likelihood_off']:.4f}."
    )


def _mean_known(values: list[float]) -> float:
    """The mean of the values that are known; NaN where none is."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def distribution(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 6: the CDF of the normalised likelihood at one frame, its corners, and the cut."""
    scene = _scene(sources, items)
    frame = scene.typical()
    values, on_object = scene.stages[frame].probability.ravel(), scene.true_mask(frame).ravel()
    corners = maps.cdf_corners(values)
    maps.distribution_figure(path, values, on_object, scene.cut, corners)
    at = np.linspace(0.0, 1.0, 101)
    columns = (at, *(maps.below(part, at) for part in (values, values[on_object], values[~on_object])))
    rows = ([f"{float(v):.6g}" for v in row] for row in zip(*columns, strict=True))
    write_csv(path.with_suffix(".csv"), ("level", "all", "object", "elsewhere"), rows)
    kept = [100 * _mean_known(list(1.0 * (values[on_object] >= level))) for level in (scene.cut, corners[-1])]
    return (
        f"{scene.where(frame)}. {kept[0]:.0f} % of the object's pixels are above the cut; {kept[1]:.0f} % would be above the last "
        f"corner, p = {corners[-1]:.2f}."
    )


def refinement(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 7: the mask before and after the refinement by clusters of position, and both masks' IoU over the recording."""
    scene = _scene(sources, items)
    frame = scene.typical()
    stages, true_mask = scene.stages[frame], scene.true_mask(frame)
    texts = (f"IoU {_iou(stages.cut, true_mask):.2f}", f"IoU {_iou(stages.mask, true_mask):.2f}")
    crop = scene.crop([frame])
    maps.refinement_figure(path, scene.colour(frame), stages.cluster, stages.cut, stages.mask, true_mask, texts, crop)
    _write_numbers(scene, path, ("iou_before", "iou_after"))
    late = [one for one in scene.numbers if one.since_motion >= SETTLED]
    before, after = (_mean_known([getattr(one, name) for one in late]) for name in ("iou_before", "iou_after"))
    return (
        f"{scene.where(frame)}. Mask IoU, mean from frame {SETTLED} to {LAST} after the first motion: {before:.2f} before, "
        f"{after:.2f} after."
    )


def attention_maps(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 11: the attention at eight frames of a recording."""
    scene = _scene(sources, items)
    shown = []
    for frame in scene.spread:
        one = scene.stages[frame]
        title = f"frame {frame - scene.begin}{'' if one.moves else ' (below $v_0$)'}"
        shown.append((title, scene.colour(frame), one.attention, scene.true_mask(frame)))
    maps.heat_figure(path, shown, scene.crop(scene.spread, margin=1.0))
    _write_numbers(scene, path, ("attention_on", "attention_off"))
    moving = [one for one in scene.numbers if one.moves]
    higher = float(np.mean([one.attention_on > one.attention_off for one in moving])) if moving else float("nan")
    return (
        f"{scene.recording.name}, frames since the first motion. In {100 * higher:.0f} % of the frames in which the tag is as "
        "fast as v0 the mean attention on the object exceeds that elsewhere."
    )


def _write_numbers(scene: Scene, path: Path, names: tuple[str, ...]) -> None:
    rows = ([one.frame, one.since_motion, one.moves, *one.texts(*names)] for one in scene.numbers)
    write_csv(path.with_suffix(".csv"), ("frame", "since_motion", "moves", *names), rows)


def _anchors(stages: Stages, true_mask: np.ndarray, crop: tuple[int, int, int, int]) -> list[maps.Anchor]:
    """Two pixels inside of the object and four others in the crop, none at an edge, far from each other.

    Of the four the first two move themselves, if there are such pixels.
    """
    x0, y0, x1, y1 = crop
    inside = np.zeros_like(true_mask)
    inside[y0 + 4 : y1 - 4, x0 + 4 : x1 - 4] = True
    kernel = np.ones((5, 5), np.uint8)
    last = np.ascontiguousarray(stages.motion_m[..., -1])
    even = cv2.dilate(last, kernel) - cv2.erode(last, kernel) < 0.04
    known = cv2.erode(stages.complete.astype(np.uint8), kernel[:3, :3]).astype(bool) & even & inside
    core = cv2.erode(true_mask.astype(np.uint8), kernel).astype(bool)
    away = ~cv2.dilate(true_mask.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    moving = cv2.blur(np.abs(last), (5, 5)) > 0.012
    chosen: list[tuple[int, int]] = []
    for part, total in ((core if (core & known).any() else true_mask, 2), (away & moving, 4), (away, 6)):
        places = np.argwhere(part & known)
        for _ in range(min(total - len(chosen), len(places))):
            chosen.append(_farthest(places, chosen))
    return [
        maps.Anchor((column, row), bool(true_mask[row, column]), np.asarray(stages.motion_m[row, column], np.float64))
        for row, column in chosen
    ]


def _farthest(places: np.ndarray, others: list[tuple[int, int]]) -> tuple[int, int]:
    """The place farthest from the others; of none the one nearest to the middle of all."""
    if not others:
        distance = -np.linalg.norm(places - np.median(places, axis=0), axis=1)
    else:
        distance = np.min(np.linalg.norm(places[:, None] - np.array(others)[None], axis=-1), axis=1)
    row, column = places[int(np.argmax(distance))].tolist()
    return row, column


def _iou(mask: np.ndarray, true_mask: np.ndarray) -> float:
    union = np.sum(mask | true_mask)
    return float(np.sum(mask & true_mask) / union) if union else float("nan")


def _box(mask: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(mask)
    return np.array([columns.min(), rows.min(), columns.max(), rows.max()], float) if len(rows) else np.full(4, np.nan)
