"""Suites: named sets of simulated recordings with train, validation and test splits, made in several processes."""

from __future__ import annotations

import dataclasses
import itertools
import json
import multiprocessing
import multiprocessing.process
import shutil
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any, Literal

import numpy as np
from filelock import FileLock

from ..core.files import atomic_path, make_folder, write_atomic, writing
from ..core.json_text import parse_json
from ..core.progress import OnProgress, unobserved
from ..core.settings import ConfigError
from ..core.worker_process import end_with_parent, signals_blocked, unblock_sigterm
from ..recording import RecordingError
from ..recording.store import save_recording
from ..recording.suite_folder import SPLITS
from .radio.inventory import InventorySettings
from .radio.planar import PlanarSettings, planar_trials, save_planar
from .record import CaptureSettings, simulate_recording
from .stories import STORIES, build_scenario
from .stories.scenario import Scenario

PLANAR = "planar_101"
"""The only story without pictures."""

MANIFEST = "suite.json"

_VERSION = 2
_DRAWS = 6


@dataclasses.dataclass(frozen=True)
class Variant:
    """One condition of a suite: its name, and the settings that differ from the suite's."""

    name: str
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    capture: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    reader: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    story: str | None = None  # the suite's if None


@dataclasses.dataclass(frozen=True)
class Counts:
    """Number of recordings of each variant in each split."""

    train: int = 2
    validation: int = 1
    test: int = 2


@dataclasses.dataclass(frozen=True)
class Suite:
    """A named set of recordings. These settings determine every recording."""

    name: str
    about: str
    paper: str
    story: str
    seed: int
    duration_s: float = 5.0
    smoke_s: float = 2.4  # duration of the recordings in small
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    capture: CaptureSettings = dataclasses.field(default_factory=CaptureSettings)
    reader: Mapping[str, Any] = dataclasses.field(
        default_factory=dict
    )  # settings that differ from the story's `InventorySettings`
    variants: tuple[Variant, ...] = (Variant("all"),)
    counts: Counts = dataclasses.field(default_factory=Counts)

    def __post_init__(self):
        for story in (self.story, *(variant.story for variant in self.variants if variant.story is not None)):
            if story not in (PLANAR, *STORIES):
                raise ValueError(f"{self.name}: story is {story!r}; expected one of {', '.join([*STORIES, PLANAR])}.")
        if not (self.duration_s > 0 and self.smoke_s > 0):
            raise ValueError(
                f"{self.name}: duration_s is {self.duration_s}, smoke_s {self.smoke_s}; expected positive durations."
            )
        known = {field.name for field in dataclasses.fields(InventorySettings)}
        for reader in (self.reader, *(variant.reader for variant in self.variants)):
            if unknown := sorted(set(reader) - known):
                raise ValueError(
                    f"{self.name}: unknown reader setting {', '.join(unknown)}; expected settings among "
                    f"{', '.join(sorted(known))}."
                )
        if min(dataclasses.astuple(self.counts)) < 0 or not self.variants:
            raise ValueError(
                f"{self.name}: {self.counts} and {len(self.variants)} variants; expected counts of at least 0 and at least "
                "1 variant."
            )
        names = [variant.name for variant in self.variants]
        if len(set(names)) != len(names):
            raise ValueError(f"{self.name}: variants are named {', '.join(names)}; expected different names.")

    def as_dict(self) -> dict[str, Any]:
        """The settings as plain values. A second camera is left out where there is none: such a suite's stay what they were."""
        values = dataclasses.asdict(self)
        if self.capture.stereo_baseline_m is None:
            del values["capture"]["stereo_baseline_m"]
        return values

    def smoke(self) -> Suite:
        """The suite in small, for tests: pictures 64 pixels wide, `smoke_s` long, one test recording per variant."""
        capture = dataclasses.replace(self.capture, width=64, frame_rate_hz=min(self.capture.frame_rate_hz, 5.0))
        return dataclasses.replace(
            self, duration_s=min(self.duration_s, self.smoke_s), capture=capture, counts=Counts(0, 0, 1)
        )

    def preview(self, num_frames: int = 6) -> Suite:
        """A few frames of the first test recording of every variant (or training recording), for a contact sheet.

        The worlds are those of the suite itself.
        """
        rate_hz = (num_frames - 0.9) / self.duration_s
        width = min(self.capture.width or 384, 384)
        capture = dataclasses.replace(self.capture, width=width, frame_rate_hz=rate_hz, drop_probability=0.0)
        return dataclasses.replace(
            self, capture=capture, counts=Counts(0, 0, 1) if self.counts.test else Counts(1, 0, 0)
        )

    def items(self) -> list[Item]:
        """All recordings of the suite."""
        found = []
        for split, (index, variant) in itertools.product(range(len(SPLITS)), enumerate(self.variants)):
            for number in range(dataclasses.astuple(self.counts)[split]):
                source = np.random.SeedSequence([self.seed, split, index, number])
                seed = int(source.generate_state(1)[0])
                found.append(Item(self, variant, SPLITS[split], number, seed))
        return found


@dataclasses.dataclass(frozen=True)
class Item:
    """One recording of a suite."""

    suite: Suite
    variant: Variant
    split: str
    number: int
    seed: int

    @property
    def name(self) -> str:
        return f"{self.suite.name}-{self.variant.name}-{self.split}-{self.number}"

    def path(self, folder: Path) -> Path:
        """Path of the recording within the output folder."""
        return folder / self.suite.name / self.split / f"{self.name}.zarr"


@dataclasses.dataclass(frozen=True)
class Made:
    """A simulated recording: its name, length, and the time that the simulation took."""

    name: str
    num_frames: int
    elapsed_s: float


def item_scenario(item: Item) -> Scenario:
    """The scenario of a recording: the first of several draws that satisfies all constraints of the story.

    Raises `ValueError` with the reason of the last draw if none does.
    """
    suite, variant = item.suite, item.variant
    settings, reader = {**suite.settings, **variant.settings}, {**suite.reader, **variant.reader}
    for draw in range(_DRAWS):
        try:
            rng = np.random.default_rng([item.seed, draw])
            scenario = build_scenario(variant.story or suite.story, rng, suite.duration_s, settings)
            scenario.world.check()
            scenario = dataclasses.replace(scenario, inventory=dataclasses.replace(scenario.inventory, **reader))
        except ValueError as error:
            if draw == _DRAWS - 1:
                raise ValueError(
                    f"{item.name} (seed {item.seed}): all {_DRAWS} draws failed; the last one: {error}"
                ) from error
        else:
            return scenario
    raise AssertionError("a draw returns or raises")


def make_item(item: Item, folder: Path) -> Made:
    """Simulate one recording and write it. It appears complete or not at all."""
    start = time.perf_counter()
    path = item.path(folder)
    if item.suite.story == PLANAR:
        settings = {**item.suite.settings, **item.variant.settings}
        with atomic_path(path) as partial:
            save_planar(planar_trials(PlanarSettings(**settings), seed=item.seed), partial)
        return Made(item.name, 0, time.perf_counter() - start)
    capture = dataclasses.replace(item.suite.capture, **item.variant.capture)
    recording = simulate_recording(item_scenario(item), capture, seed=item.seed, name=item.name)
    save_recording(recording, path)
    return Made(item.name, recording.num_frames, time.perf_counter() - start)


def prepare(suite: Suite, folder: Path) -> list[Item]:
    """Check the suite's folder and return the recordings that are missing. Leftovers of an interrupted run are removed.

    The folder may hold the suite with other counts. Raises `RecordingError`, and changes nothing, where it holds something
    else or the suite with other settings. The caller holds the suite's lock.
    """
    home = folder / suite.name
    manifest = json.loads(json.dumps({"version": _VERSION, **suite.as_dict()}))
    if home.exists() and not all(path.name.startswith(".") for path in home.iterdir()):
        try:
            found = parse_json((home / MANIFEST).read_bytes())
            if not isinstance(found, dict):
                raise ValueError(f"found {type(found).__name__}; expected an object")
        except (OSError, ValueError) as error:
            raise RecordingError(
                f"{home} has no readable {MANIFEST}; expected a folder made for this suite, or none. Choose another "
                "folder, or remove this one."
            ) from error
        differs = {key for key in {*found, *manifest} if found.get(key) != manifest.get(key)}
        # A recording is determined by its variant, split and number: other counts or texts leave the recordings valid.
        if settings := differs - {"counts", "about", "paper"}:
            raise RecordingError(
                f"{home} holds this suite with other settings ({', '.join(sorted(settings))}). Choose another folder, or "
                "remove this one."
            )
    else:
        differs = {"counts"}  # a new folder, or one whose suite.json could not be written
    if differs:
        write_atomic(home / MANIFEST, json.dumps(manifest, indent=1) + "\n")
    _remove_partial(home)
    return [item for item in suite.items() if not item.path(folder).exists()]


def _remove_partial(home: Path) -> None:
    """Remove unfinished recordings. The caller holds the suite's lock, so that nobody is writing them."""
    for partial in home.glob("*/.*.partial"):
        shutil.rmtree(partial, ignore_errors=True)


def make_suite(
    suite: Suite,
    folder: Path,
    *,
    workers: int = 1,
    on_progress: OnProgress = unobserved,
    wanted: Callable[[Item], bool] = lambda item: True,
) -> list[Made]:
    """Simulate the missing recordings of a suite that are `wanted`. Finished recordings are kept if a later one fails.

    Each recording is determined by its seed alone, so the number of workers changes nothing in it. Several processes may
    call this at once: one simulates, the others wait and find the recordings there. `on_progress` counts the recordings
    that are there; it is not called where none is missing.
    """
    make_folder(folder)
    with writing(folder / suite.name), FileLock(folder / f".{suite.name}.lock"):
        missing = [item for item in prepare(suite, folder) if wanted(item)]
        try:
            return _make_items(missing, folder, workers, _counting(suite, missing, wanted, on_progress))
        except BaseException:  # a worker that was ended while it wrote may leave a part
            _remove_partial(folder / suite.name)
            raise


def _counting(
    suite: Suite, missing: Sequence[Item], wanted: Callable[[Item], bool], report: OnProgress
) -> Callable[[Made], None]:
    """Reports the number of recordings that are there: now, if some are missing, and after each call."""
    total = sum(map(wanted, suite.items()))
    numbers, stage = itertools.count(total - len(missing)), f"simulate {suite.name}"
    if missing:
        report(stage, next(numbers), total)
    return lambda made: report(stage, next(numbers), total, made.name)


def _make_items(items: Sequence[Item], folder: Path, workers: int, on_done: Callable[[Made], None]) -> list[Made]:
    made: list[Made] = []

    def finished(one: Made) -> None:
        made.append(one)
        on_done(one)

    if workers <= 1 or len(items) <= 1:
        for item in items:
            finished(make_item(item, folder))
        return made
    # Spawned, not forked: JAX's threads do not survive a fork.
    context, others = multiprocessing.get_context("spawn"), set(multiprocessing.active_children())
    with ProcessPoolExecutor(min(workers, len(items)), mp_context=context, initializer=_begin_worker) as pool:
        try:
            with signals_blocked():
                waiting = {pool.submit(make_item, item, folder) for item in items}
            while waiting:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in done:
                    finished(future.result())
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            if isinstance(error, KeyboardInterrupt):  # after another error, the recordings in progress are finished
                _end(set(multiprocessing.active_children()) - others)
            raise
    return made


def _end(workers: Collection[multiprocessing.process.BaseProcess]) -> None:
    """End workers and wait for it: none may still write when the unfinished recordings are removed."""
    for worker in workers:
        worker.kill()
    for worker in workers:
        worker.join()


def _begin_worker() -> None:
    """SIGTERM ends a worker at once and without a traceback: what it has written, the process that started it removes."""
    end_with_parent()
    unblock_sigterm()


def make_items(
    suite: Suite,
    folder: Path,
    *,
    splits: Sequence[str],
    max_per_variant: int | None = None,
    workers: int = 1,
    on_progress: OnProgress = unobserved,
) -> list[Item]:
    """The items of some splits, at most `max_per_variant` of each variant and split; missing ones are simulated."""

    def wanted(item: Item) -> bool:
        return item.split in splits and (max_per_variant is None or item.number < max_per_variant)

    make_suite(suite, folder, workers=workers, on_progress=on_progress, wanted=wanted)
    return [item for item in suite.items() if wanted(item)]


@dataclasses.dataclass(frozen=True)
class SimulateConfig:
    """The suite that is simulated (settings of `tagjax.sim.suites.Suite`), and the folder for its recordings."""

    suite: Mapping[str, Any]
    recordings_dir: str = "recordings"
    smoke: bool = False
    workers: int | None = None  # processes; as many as there are cores if None
    progress: bool = True
    sheet: str | None = None  # a folder for a contact sheet; no recordings are then made
    budget: Literal["train", "validation", "test"] | None = None  # a split; its link budgets are then printed instead

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ConfigError(f"workers is {self.workers}; expected at least 1 process.")
