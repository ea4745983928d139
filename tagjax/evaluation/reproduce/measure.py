"""Measure the scores of a table: simulate missing recordings, trace each one, and store its scores immediately."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...baselines import AbstractHostTracer, host_trace
from ...baselines.blobs import BlobSettings, BlobTracer
from ...core.camera import working_stride
from ...core.progress import OnProgress, unobserved
from ...core.results import to_json_values
from ...core.settings import ConfigError, changed, from_mapping
from ...metrics.recordings import RecordingResult, ScoreSettings, evaluate_recording, score_traces
from ...recording.store import open_recording
from ...sim.suites import Item, Suite, make_suite
from ...tagattention.tracer_settings import learned_tracer, make_tracer, settled, tracer_clips
from ...tracing.clips import ClipSettings, clip_loader
from ...tracing.tracer import AbstractTracer
from ...training.evaluate import parameters
from .finished import hash_of, store, stored
from .recipe import SCORES, Job, Recipe
from .scores import RecordingScores

HOST_TRACERS: Mapping[str, Callable[[Mapping[str, Any]], AbstractHostTracer]] = {
    "blobs": lambda settings: BlobTracer(from_mapping(BlobSettings, settings, where="blobs")),
}
"""Tracers that run on the host, with settings in conf/system, by name."""


@dataclasses.dataclass(frozen=True)
class Inputs:
    """The settings of suites and tracers by name, to which a recipe refers, and the folders."""

    suites: Mapping[str, Mapping[str, Any]]
    tracers: Mapping[str, Mapping[str, Any]]
    recordings: Path  # folder of the suites' recordings; missing ones are simulated
    finished: Path  # folder of the scores of traced recordings, by the hash of what determines them
    code: Mapping[str, str]  # ids of the files that determine the scores
    workers: int = 1  # processes that simulate
    revision: str | None = None  # Git's commit of that code


def measure(
    recipe: Recipe,
    inputs: Inputs,
    *,
    before: Mapping[str, Sequence[RecordingScores]] | None = None,
    confirm: int | None = None,
    on_progress: OnProgress = unobserved,
) -> dict[Job, list[RecordingScores]]:
    """The scores of every job of a recipe, one element per recording.

    Recordings that were traced before, by the same code with the same settings, are not traced again; an interruption
    loses only the recording in progress. With `confirm`, the first so many recordings of each job are traced; where they
    score as in `before` (by the job's name), the scores of the others are taken from there, if only the code has changed since
    and no setting or parameter; only what is traced is simulated. Raises `ConfigError` for a
    suite or tracer that is not in `inputs`, for a split without recordings, and for `confirm` below 1.
    """
    if confirm is not None and confirm < 1:
        raise ConfigError(f"confirm is {confirm}; expected 1 or more recordings, or null to trace every one.")
    jobs = recipe.jobs()
    tracings = {job: _tracing(recipe, inputs, job) for job in jobs}  # wrong settings raise before the work starts
    items = {draw: _items(inputs, *draw) for draw in dict.fromkeys(map(_recordings_key, jobs))}
    for draw in items.values():
        _simulate(draw[:confirm], inputs, on_progress)
    total = sum(len(items[_recordings_key(job)]) for job in jobs)
    numbers = itertools.count()
    scores: dict[Job, list[RecordingScores]] = {job: [] for job in jobs}
    earlier = {job: {one.name: one for one in (before or {}).get(job.name, ())} for job in jobs}
    for draw in items:
        for position, item in enumerate(items[draw]):
            for job in (job for job in jobs if _recordings_key(job) == draw):
                on_progress("trace", next(numbers), total, f"{item.name}: {job.system}")
                known = earlier[job].get(item.name)
                if (
                    known is None
                    or confirm is None
                    or position < confirm
                    or known.settings != tracings[job].settings_hash(item)
                ):
                    if confirm is not None and position >= confirm:  # the others are there
                        _simulate([item], inputs, on_progress)
                    found = tracings[job].scores(item, inputs)
                    if known is None or not found.same_as(known, SCORES):
                        earlier[job] = {}  # the code scores otherwise than before: nothing of this job is taken over
                else:
                    found = known
                scores[job].append(found)
    on_progress("trace", total, total)
    return scores


@dataclasses.dataclass(frozen=True)
class Tracing:
    """A tracer with all settings that determine its scores on a recording. A host tracer uses no `clips`."""

    tracer: AbstractTracer | AbstractHostTracer
    settings: Mapping[str, Any]
    clips: ClipSettings
    scores_settings: ScoreSettings
    frames: tuple[int, int] | None

    def scores(self, item: Item, inputs: Inputs) -> RecordingScores:
        """The scores of a recording, which is traced unless they are stored already."""
        follows_from = self.determinants(item, inputs.code)
        kept = stored(inputs.finished, follows_from, RecordingScores.from_json)
        if kept is None:
            kept = RecordingScores.of(self.trace(item.path(inputs.recordings)), inputs.revision)
            store(inputs.finished, follows_from, dataclasses.asdict(kept))
        return dataclasses.replace(kept, settings=self.settings_hash(item))

    def settings_hash(self, item: Item) -> str:
        """A hash of all that determines the scores but the code."""
        return hash_of(self.determinants(item, {}))

    def trace(self, path: Path) -> RecordingResult:
        """Trace and score the recording at `path`."""
        recording = open_recording(path)
        if isinstance(self.tracer, AbstractHostTracer):
            epcs = recording.resolve_epcs(None)
            traces = host_trace(self.tracer, recording, epcs=epcs, frames=self.frames)
            return score_traces(traces, recording, epcs, settings=self.scores_settings, frames=self.frames)
        return evaluate_recording(
            self.tracer,
            recording,
            clip_loader(self.clips),
            stride=self.clips.stride,
            epcs=self.clips.epcs,
            settings=self.scores_settings,
            frames=self.frames,
        )

    def determinants(self, item: Item, code: Mapping[str, str]) -> dict[str, Any]:
        """All that determines the scores, as plain JSON.

        Settings (.yaml) and learned parameters (.json) enter by their values, all other files by their content.
        """
        suite = item.suite.as_dict()
        for name in ("about", "paper", "counts", "variants"):  # about other recordings, or descriptions
            del suite[name]
        width = item.suite.capture.intrinsics().width
        clips = dataclasses.replace(self.clips, stride=working_stride(width, self.clips.stride))
        on_host = isinstance(self.tracer, AbstractHostTracer)
        learned = {} if isinstance(self.tracer, AbstractHostTracer) else parameters(self.tracer)
        everything = {
            "recording": {"suite": suite, "variant": dataclasses.asdict(item.variant), "seed": item.seed},
            "name": item.name,
            "tracer": {"settings": settled(self.settings, width), "parameters": learned},
            "clips": {} if on_host else dataclasses.asdict(clips),
            "scores": dataclasses.asdict(self.scores_settings),
            "frames": self.frames,
            "code": {
                path: content
                for path, content in code.items()
                if not path.endswith((".yaml", ".json")) and (on_host or not path.startswith("tagjax/baselines/"))
            },
        }
        return json.loads(json.dumps(to_json_values(everything)))


def _tracing(recipe: Recipe, inputs: Inputs, job: Job) -> Tracing:
    system, protocol = recipe.systems[job.system], recipe.protocols[job.protocol]
    settings = _settings_by_name("tracer", system.tracer, inputs.tracers)
    scores = changed(ScoreSettings(num_pictures=0), {**protocol.scores, **system.scores}, where="scores")
    if system.tracer in HOST_TRACERS:
        if system.weights is not None or system.clips:
            raise ConfigError(f"system {job.system}: found weights or clips; {system.tracer} has neither.")
        return Tracing(HOST_TRACERS[system.tracer](settings), settings, ClipSettings(), scores, protocol.frames)
    if system.weights is None:
        tracer, clips = make_tracer(settings), tracer_clips(settings)
    else:
        tracer, clips = learned_tracer(system.weights, settings)
    clips = changed(clips, system.clips, where="clips")
    return Tracing(tracer, settings, clips, scores, protocol.frames)


def _recordings_key(job: Job) -> tuple[str, str, tuple[int, ...] | None]:
    """Suite, split and seeds of a job's recordings."""
    return job.suite, job.split, job.seeds


def _items(inputs: Inputs, name: str, split: str, seeds: Sequence[int] | None) -> list[Item]:
    """The recordings of a suite's split with each of the seeds."""
    own = from_mapping(Suite, _settings_by_name("suite", name, inputs.suites), where=f"suite {name}")
    suites = [own]
    if seeds is not None:
        suites = [dataclasses.replace(own, name=f"{own.name}-seed{seed}", seed=seed) for seed in seeds]
    recordings = [item for suite in suites for item in suite.items() if item.split == split]
    if not recordings:
        raise ConfigError(f"suite {name}: found no {split} recording; choose another split, or raise its counts.")
    return recordings


def _simulate(items: Sequence[Item], inputs: Inputs, report: OnProgress) -> None:
    """Simulate those of the items that are missing."""
    for suite, ones in itertools.groupby(items, key=lambda item: item.suite):
        names = {one.name for one in ones}
        make_suite(
            suite,
            inputs.recordings,
            workers=inputs.workers,
            on_progress=report,
            wanted=lambda one, names=names: one.name in names,
        )


def _settings_by_name(kind: str, name: str, known: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any]:
    if name not in known:
        raise ConfigError(f"found {kind} {name!r}; expected one of {', '.join(known) or 'none'}.")
    return known[name]
