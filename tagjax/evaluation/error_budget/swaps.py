"""Swaps: functions that put truth in place of one stage's result, before or after a tracer; none is a switch inside of it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

from ...core.camera import working_stride
from ...core.settings import changed
from ...recording import Recording
from ...sim.flow_truth import with_exact_flow
from ...sim.suites import Item
from ...tagattention.tracer_settings import make_tracer, tracer_clips
from ...tracing.clips import Clip, clip_loader
from ...tracing.recordings import TraceSettings, trace_recording
from ...tracing.tracer import AbstractTracer, Trace
from .cut import Uncut, with_best_cuts
from .objects import with_objects
from .reads import TrueReads, with_true_reads

Traces = Iterator[tuple[int, Trace]]


@dataclasses.dataclass(frozen=True)
class Swap:
    """What one swap changes; each function returns its argument with truth in it, and leaves it alone by default."""

    about: str
    recording: Callable[[Item, Recording], Recording] = lambda _, recording: recording
    clips: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # settings of the clips that it needs
    clip: Callable[[Clip, Recording, int], Clip] = lambda clip, _, __: clip  # of the clip, its recording and its stride
    tracer: Callable[[AbstractTracer], AbstractTracer] = lambda tracer: tracer
    traces: Callable[[Traces, Recording, Sequence[str], int], Traces] = lambda traces, *_: traces


def _of_last(function: Callable[[Item, Recording], Recording]) -> Callable[[Item, Recording], Recording]:
    """The function, which computes the result of one recording once while it is asked for this recording only."""
    last: list[tuple[Recording, Recording]] = []

    def remembered(item: Item, recording: Recording) -> Recording:
        if not last or last[0][0] is not recording:
            last[:] = [(recording, function(item, recording))]
        return last[0][1]

    return remembered


def make_swaps(reads: TrueReads) -> dict[str, Swap]:
    """Every swap by name, in the order of the tracer's stages."""
    return {
        "flow": Swap("exact optical flow", recording=_of_last(with_exact_flow), clips={"flow": "truth"}),
        "radio": Swap(
            "true distances, and phases of the direct path",
            recording=lambda _, recording: with_true_reads(recording, reads),
            clips={"estimator": "truth", "antennas": (1,)},
        ),
        "segments": Swap("true objects as segments", clip=with_objects),
        "cut": Swap("best cut of the likelihood", tracer=Uncut, traces=with_best_cuts),
    }


NAMES = tuple(make_swaps(TrueReads()))


def swapped_traces(
    settings: Mapping[str, Any], item: Item, recording: Recording, swaps: Collection[Swap], run: TraceSettings
) -> tuple[Traces, list[str], int]:
    """A tracer's traces of a recording with all of these swaps, the tags traced, and the stride of the masks.

    `settings` are the tracer's, as under conf/tracer. Tags are those that the recording itself has reads of.
    """
    epcs = recording.resolve_epcs(None)
    tracer, clips = _tracer(settings, swaps), tracer_clips(settings)
    for swap in swaps:
        recording = swap.recording(item, recording)
        clips = changed(clips, swap.clips, where="clips")
    load, stride = clip_loader(clips), working_stride(recording.intrinsics.width, clips.stride)

    def swapped_clip(recording: Recording, start: int, stop: int, *, epcs: Sequence[str] | None = None) -> Clip:
        clip = load(recording, start, stop, epcs=epcs)
        return functools.reduce(lambda one, swap: swap.clip(one, recording, stride), swaps, clip)

    traces = trace_recording(tracer, recording, swapped_clip, epcs=epcs, settings=run)
    for swap in swaps:
        traces = swap.traces(traces, recording, epcs, stride)
    return traces, epcs, stride


def _tracer(settings: Mapping[str, Any], swaps: Collection[Swap]) -> AbstractTracer:
    return functools.reduce(lambda tracer, swap: swap.tracer(tracer), swaps, make_tracer(settings))
