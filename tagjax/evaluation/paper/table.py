"""The table of figures: number, suites and recordings, the function that draws it, caption, and what the paper reports."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from ...core.settings import ConfigError
from ...sim.suites import Item
from . import ceiling, curves, phases, stages, strips
from .sources import Sources

Draw = Callable[[Sources, list[Item], Path], str]
"""Draws a figure of recordings to a PNG and writes its numbers beside it as CSV; returns a sentence about what is seen."""


@dataclasses.dataclass(frozen=True)
class Recordings:
    """The recordings of a suite that a figure uses: those of some variants, or the first of each (`one`)."""

    suite: str
    variants: tuple[str, ...] | None = None
    one: bool = False


@dataclasses.dataclass(frozen=True)
class PaperFigure:
    """One figure. `reported` is what the paper's text says of its own."""

    paper: str
    number: int
    recordings: tuple[Recordings, ...]
    draw: Draw
    caption: str
    reported: str

    @property
    def title(self) -> str:
        """The paper and the figure's number there."""
        return f"{self.paper}, Fig. {self.number}"


TAGATTENTION, TAGVIEW, TAGVISION = "TagAttention", "Tagview", "TagVision"

_BOX = (Recordings("single_static", ("box",), one=True),)

_CEILING = tuple(Recordings(f"ceiling_{number}") for number in range(2, 7))

FIGURES: dict[str, PaperFigure] = {
    "2": PaperFigure(
        TAGATTENTION, 2, (Recordings("hopping_fixed", ("box",), one=True),), phases.phase_unwrapping,
        "The phase of one tag, read on one channel with the reader's jumps of pi, and the change of distance that it gives: unwrapped by the "
        "paper's thresholds, smoothed by its acceleration rule read by read and over slots of 0.1 s, and true.",
        "Thresholds of 0.5 pi and 1.5 pi detect jumps; accelerations above 9.8 m/s² are taken for wrong unwrapping.",
    ),
    "3": PaperFigure(
        TAGATTENTION, 3, (Recordings("multi_2", one=True),), phases.synchronisation,
        "Times of frames and of two tags' reads, and one tag's distance fitted at the frames.",
        "Reads come at uneven times; distances are interpolated by a polynomial at the times of the frames.",
    ),
    "4": PaperFigure(
        TAGATTENTION, 4, _BOX, stages.chosen_pixels,
        "(A) pixels chosen on the object (solid in C) and elsewhere, (B) the motion map (orange: away from the antenna, blue: nearer, grey: "
        "unknown), (C) the motion of these pixels against the tag's over five frames, (D) the attention (Eq. 6). Black: the true outline.",
        "The two pixels of the target follow the tag's motion, the others do not.",
    ),
    "5": PaperFigure(
        TAGATTENTION, 5, _BOX, stages.propagation,
        "Attention of a frame, the likelihood carried from the frame before along the flow, and the likelihood that results (Eq. 7); "
        "0 dark to 1 bright.",
        "A drawing of the principle, without numbers.",
    ),
    "6": PaperFigure(
        TAGATTENTION, 6, _BOX, stages.distribution,
        "The distribution of the normalised likelihood over the pixels of one frame. Circles: corners, where the slope changes most; "
        "dotted: the cut that is used here, in the flat part after the background.",
        "Corners are marked on the CDF; the last one cuts the mask.",
    ),
    "7": PaperFigure(
        TAGATTENTION, 7, _BOX, stages.refinement,
        "The mask cut from the likelihood, and refined by K-means clusters of position. Black: the true outline.",
        "An example picture, without numbers.",
    ),
    "10": PaperFigure(
        TAGATTENTION, 10, (Recordings("single_static"),), curves.all_and_each,
        "One object in a meeting room, five objects: box IoU (0 without a detection) and centre error (over detections). Right: by object, "
        "without bands.",
        "IoU close to 0 in the first frames, rising until about frame 40 and then high; the centre error falls likewise.",
    ),
    "11": PaperFigure(
        TAGATTENTION, 11, _BOX, stages.attention_maps,
        "Attention of the top-down module at eight frames, yellow (little) to red (1). Black: the true outline.",
        "In several frames the attention is not on the target alone, in most frames it is continuous and stable there.",
    ),
    "12": PaperFigure(
        TAGATTENTION, 12, (Recordings("single_static"), Recordings("single_dynamic")), curves.by_suite,
        "One object in the meeting room, and in a crowded office in which another person walks.",
        "Both scenarios are equivalent.",
    ),
    "13": PaperFigure(
        TAGATTENTION,
        13,
        (Recordings("single_static", ("box",), one=True), Recordings("single_dynamic", ("box",), one=True)),
        strips.examples,
        "Masks and boxes of both tracers at five times after the first motion (white and dashed: the true box), and the published tracer around "
        "its sharpest fall.",
        "Most errors are the hand and wrist that move with the object. At one frame the IoU falls suddenly because the flow leaks attention "
        "to the body, and a few frames later the object is recaptured.",
    ),
    "14": PaperFigure(
        TAGATTENTION, 14, (Recordings("multi_2"),), curves.one_panel,
        "Two objects, one in each hand.",
        "As with a single object; it takes less than 35 frames to find each object, which is then kept.",
    ),
    "15": PaperFigure(
        TAGATTENTION,
        15,
        (Recordings("multi_2"), Recordings("multi_4")),
        strips.several,
        "Two objects, and four objects of which two bottles look alike (white and dashed: the true boxes).",
        "At the 5th frame nothing is detected; later each object has its mask and ID, also the two bottles that look alike.",
    ),
    "16": PaperFigure(
        TAGATTENTION, 16, (Recordings("speed"),), curves.by_variant,
        "A person with a badge walks towards the sensor and away at four speeds; gaps: the picture's edge cuts the person off.",
        "At every speed the person is found and kept after around 25 frames, sooner at high speed.",
    ),
    "17": PaperFigure(
        TAGATTENTION, 17, (Recordings("velocity_threshold"),), curves.by_threshold,
        "An object that is stationary, then waved at a peak speed of 0.5 m/s (slow) or 2.5 m/s (fast): the published tracer at three "
        "velocity thresholds, and the learnable one, which has no threshold.",
        "Slow target: a smaller threshold reacts sooner, 0.5 m/s finds nothing, and 0.01 m/s is less accurate than 0.1 m/s. Fast target: "
        "all find it with a short latency.",
    ),
    "19": PaperFigure(
        TAGATTENTION, 19, (Recordings("illumination"),), curves.by_variant,
        "The same kind of scene in bright, dim and dark light.",
        "Robust where the target can be seen, and much worse where it can hardly be seen.",
    ),
    "20": PaperFigure(
        TAGATTENTION,
        20,
        (Recordings("occlusion"),),
        strips.blocked,
        "A notebook passes between the camera and the object (white and dashed: the true box of what is in view).",
        "Partly covered: the visible part and the body; fully covered: nothing; captured again about one second after the notebook is gone.",
    ),
    "21": PaperFigure(
        TAGATTENTION,
        21,
        (Recordings("co_moving"),),
        strips.alike,
        "Two objects in one grip that move as one, read by one antenna, and by two in turn (white and dashed: the true boxes).",
        "Both objects are highlighted and recognised as one whole target.",
    ),
    "tagview_7": PaperFigure(
        TAGVIEW, 7, (Recordings("ceiling_3", one=True),), ceiling.tracks,
        "Three toy trains on a table: true centres (black +) and those of the traces (green o), every third frame.",
        "Mean error 4.82 px, 5.36 mm, with a standard deviation of 3.42 px, in pictures of 1080 rows.",
    ),
    "tagview_8": PaperFigure(
        TAGVIEW, 8, _CEILING, ceiling.pairs,
        "R² and slope (the linear coefficient, over its true value 4πh/λ) of the fit of each trace to each tag, for correct and for incorrect pairs.",
        "Correct pairs have larger R² and denser coefficients; the Hungarian algorithm alone identifies 0.91 on average.",
    ),
    "tagview_9": PaperFigure(
        TAGVIEW, 9, _CEILING, ceiling.systems,
        "Traces (of TagVision: tags) that are identified by Tagview, by TagVision with a calibrated camera, and by TagVision with a camera that was "
        "moved by 0.4 m and turned by 20 degrees since its calibration; black: 95 % interval by recording. TagVision has the settings that were "
        "chosen for balls on a table (`planar_tracks`).",
        "Tagview and calibrated TagVision 0.98; without calibration TagVision is below 0.30.",
    ),
    "tagview_10": PaperFigure(
        TAGVIEW, 10, _CEILING, ceiling.by_number,
        "Identified traces by the number of tags, of Tagview and of the Hungarian algorithm alone.",
        "From 0.99 with two tags to about 0.96 with six.",
    ),
    "tagview_11": PaperFigure(
        TAGVIEW, 11, (Recordings("tag_models"),), ceiling.by_model,
        "Identified traces by the tags' model. The models differ in the strength of the reply only, by values that are assumed: the square one "
        "8 dB below the strongest.",
        "All four models above 0.97; Square, the smallest (22.5 mm a side), slightly lower.",
    ),
    "tagvision_5": PaperFigure(
        TAGVISION, 5, (), phases.constant_offset,
        "A tag on a straight track past the antenna at 7 cm/s: measured phase and the one of the true path, as received and relative to "
        "the first. Simulated from the geometry of the text, without a suite.",
        "The two differ by a constant of some 3.2 rad, which the first phase as reference removes.",
    ),
}  # fmt: skip
"""By the name that `figure=` takes: the number in TagAttention, or `<paper>_<number>`."""


def suites() -> tuple[str, ...]:
    """Names of all suites of the table."""
    return tuple(dict.fromkeys(own.suite for figure in FIGURES.values() for own in figure.recordings))


def chosen(names: Sequence[str]) -> list[str]:
    """The figures of these names, each once; `all` is every one. Raises `ConfigError` for an unknown name."""
    if unknown := [name for name in names if name not in FIGURES and name != "all"]:
        raise ConfigError(f"figure: found {', '.join(unknown)}; expected all or some of {', '.join(FIGURES)}.")
    return list(FIGURES) if "all" in names else list(dict.fromkeys(names))
