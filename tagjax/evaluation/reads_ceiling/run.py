"""The reads' ceiling on suites: tables, a figure and every tag's scores, written to the run folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ...core.files import write_atomic
from ...core.progress import OnProgress, unobserved
from ...core.results import write_csv, write_json
from ...core.settings import ConfigError
from ...metrics.boxes import label_box
from ...metrics.interval import Estimate, estimates
from ...metrics.recordings import RecordingResult, ScoreSettings, score_traces
from ...metrics.tags import CLEAR, Scores
from ...recording import Recording, RecordingError
from ...report.intervals import MarkedRow, marker_plot
from ...sim.suites import Item
from ...tracing.tracer import Trace
from ..suite_items import SuiteSelection
from .candidates import Memory, candidates_of, evidence_of_candidates, winners
from .likelihood import EvidenceSettings
from .table import Row, TagRow, markdown

_XLABEL = "fraction of frames identified (tags: reads of the last second, line of sight; freest first)"

MEASURES = ("identification", f"{CLEAR}identification", "iou")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CeilingConfig(SuiteSelection):
    """The suites, the memories whose ceilings are compared, and the noise of the reads."""

    memories_s: tuple[float | None, ...] = (None, 2.5)  # evidence of the last so many seconds; of all so far if None
    num_antennas: int | None = None  # of the simulated recordings; those of the suite if None
    antennas: tuple[int, ...] | None = None  # only their reads are used, numbered from 1; all if None
    evidence: EvidenceSettings = dataclasses.field(default_factory=EvidenceSettings)
    scores: ScoreSettings = dataclasses.field(default_factory=ScoreSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.memories_s or any(one is not None and not one > 0 for one in self.memories_s):
            raise ConfigError(
                f"memories_s is {list(self.memories_s)}; expected positive times in seconds, or null for all reads so far."
            )
        if self.antennas is not None and (not self.antennas or min(self.antennas) < 1):
            raise ConfigError(f"antennas is {list(self.antennas)}; expected numbers from 1, or null for all antennas.")

    def items(self, name: str, report: OnProgress = unobserved) -> list[Item]:
        """As of every selection, with `num_antennas` in the suite's settings."""
        if self.num_antennas is None:
            return super().items(name, report)
        suite = dict(self.suites[name])
        suite["settings"] = {**suite.get("settings", {}), "num_antennas": self.num_antennas}
        with_them = {**self.suites, name: suite}
        return dataclasses.replace(self, suites=with_them, num_antennas=None).items(name, report)

    @property
    def memories(self) -> tuple[Memory, ...]:
        """Every memory, with independent and with carried offsets."""
        return tuple(Memory(seconds, carried) for seconds in self.memories_s for carried in (False, True))


def run_ceiling(
    config: CeilingConfig, folder: Path, *, on_progress: OnProgress = unobserved
) -> tuple[list[Row], list[TagRow]]:
    """The ceiling of every suite, memory and tag; writes table.md, table.csv, result.json and ceiling.png.

    Raises `RecordingError` for a recording of one tag.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows, tags, done = list[Row](), list[TagRow](), 0
    items = config.all_items(on_progress)
    total = sum(map(len, items.values()))
    for suite in config.suites:
        scores: list[list[Scores]] = [[] for _ in config.memories]
        for item in items[suite]:
            on_progress("measure", done, total, item.name)
            recording = _with_antennas(config.open(item), config.antennas)
            results = ceilings(recording, config.evidence, config.memories, config.scores)
            for kept, result in zip(scores, results, strict=True):
                kept.append(result.scores())
            tags += _tag_rows(suite, config.memories, results)
            done += 1
        for memory, kept in zip(config.memories, scores, strict=True):
            means = estimates([one.means for one in kept])
            undefined = Estimate(None, None, None, 0.0, 0, 0)
            rows.append(Row(suite, memory, {name: means.get(name, undefined) for name in MEASURES}))
        _write(folder, rows, tags)
    on_progress("measure", done, total)
    return rows, tags


def _with_antennas(recording: Recording, antennas: Sequence[int] | None) -> Recording:
    """The recording with the reads of these antennas. Raises `RecordingError` for one that read no tag."""
    if antennas is None:
        return recording
    reads = recording.reads
    if unread := sorted(set(antennas) - set(reads.antenna.tolist())):
        raise RecordingError(
            f"{recording.name}: found no read of antenna {', '.join(map(str, unread))}; expected antennas among "
            f"{', '.join(map(str, np.unique(reads.antenna).tolist()))}."
        )
    return recording.with_reads(reads[np.isin(reads.antenna, antennas)])


def ceilings(
    recording: Recording, settings: EvidenceSettings, memories: Sequence[Memory], scores: ScoreSettings
) -> list[RecordingResult]:
    """A recording's scores with each memory, where the mask of a tag is its winning candidate's true mask.

    Candidates, and the tags scored, are those of `candidates_of`. Raises `RecordingError` without labels in the truth.
    """
    truth = recording.truth
    if truth is None or truth.labels is None:
        raise RecordingError(
            f"{recording.name}: found no labels in the truth; the ceiling needs a simulated recording."
        )
    epcs = candidates_of(recording)
    labels = np.array([truth.tag_to_label.get(epc, 0) for epc in epcs])
    evidence = [evidence_of_candidates(recording, epc, epcs, settings, memories) for epc in epcs]
    quiet = dataclasses.replace(scores, num_pictures=0)
    results = []
    for number in range(len(memories)):
        best = np.stack([winners(one[number]) for one in evidence])
        chosen = np.where(best >= 0, labels[best], 0)
        results.append(score_traces(winner_traces(recording, chosen), recording, epcs, settings=quiet))
    return results


def winner_traces(recording: Recording, label: Int[np.ndarray, "tag frames"]) -> Iterator[tuple[int, Trace]]:
    """Traces whose mask of each tag is the true mask of an object by its label; empty and no detection for label 0."""
    truth = recording.truth
    assert truth is not None
    assert truth.labels is not None
    num_tags = len(label)
    for number in range(recording.num_frames):
        picture = np.asarray(truth.labels[number])
        mask = (picture[None] == label[:, number, None, None]) & (label[:, number] > 0)[:, None, None]
        box = np.stack([label_box(one.astype(np.int64), 1) for one in mask])
        detected = mask.any(axis=(1, 2))
        yield (
            number,
            Trace(
                mask=jnp.asarray(mask, jnp.float32),
                box_px=jnp.asarray(box, jnp.float32),
                centre_px=jnp.asarray(0.5 * (box[:, :2] + box[:, 2:]), jnp.float32),
                centre_m=jnp.full((num_tags, 3), jnp.nan),
                step_m=jnp.zeros((num_tags, 1)),
                confidence=jnp.asarray(detected, jnp.float32),
                detected=jnp.asarray(detected),
            ),
        )


def _tag_rows(suite: str, memories: Sequence[Memory], results: Sequence[RecordingResult]) -> list[TagRow]:
    """One row for each tag with a frame that counts."""
    rows = []
    each = [result.tag_scores() for result in results]
    for epc, scores in each[0].items():
        numbers = scores.result()
        if not numbers["num_frames"]:
            continue
        identified = tuple(one[epc].result()["identification"] for one in each)
        kept = {name: numbers[name] for name in ("reads_1s", "rssi_dbm", "line_of_sight", "clearly_read")}
        rows.append(TagRow(suite, results[0].recording.name, epc, numbers["num_frames"], identified, **kept))
    return rows


def _write(folder: Path, rows: Sequence[Row], tags: Sequence[TagRow]) -> None:
    memories = list(dict.fromkeys(row.memory for row in rows))
    write_atomic(folder / "table.md", markdown(rows, tags) + "\n")
    header = ["suite", "memory_s", "carried", "measure", *(field.name for field in dataclasses.fields(Estimate))]
    write_csv(
        folder / "table.csv",
        header,
        (
            [row.suite, row.memory.seconds, row.memory.carried, name, *dataclasses.astuple(estimate)]
            for row in rows
            for name, estimate in row.estimates.items()
        ),
    )
    write_json(
        folder / "result.json",
        {"rows": [dataclasses.asdict(row) for row in rows], "tags": [dataclasses.asdict(tag) for tag in tags]},
    )
    marker_plot(folder / "ceiling.png", _marked(rows, tags, memories), xlabel=_XLABEL)


def _marked(rows: Sequence[Row], tags: Sequence[TagRow], memories: Sequence[Memory]) -> list[MarkedRow]:
    """The rows of the figure: of each suite all tags, the clearly read frames, and each tag, the best read first."""
    marked = []
    for suite in dict.fromkeys(row.suite for row in rows):
        own = {row.memory: row.estimates for row in rows if row.suite == suite}
        for name, text in (("identification", "all tags"), (f"{CLEAR}identification", "clearly read")):
            marked.append(MarkedRow(f"{suite}: {text}", {one.text: own[one][name] for one in memories}, heading=True))
        for tag in sorted((tag for tag in tags if tag.suite == suite), key=lambda tag: -(tag.line_of_sight or 0.0)):
            values: Mapping[str, Any] = dict(zip((one.text for one in memories), tag.identified, strict=True))
            marked.append(MarkedRow(tag.text, values))
    return marked
