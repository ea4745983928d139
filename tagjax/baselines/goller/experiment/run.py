"""Goller et al.'s experiments: calibrate, train, choose thresholds, count; writes tables, metrics and plots to a
folder.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ....core.files import write_atomic
from ....core.names import plain_label
from ....core.progress import OnProgress, unobserved
from ....core.results import write_json
from ....recording import Recording
from ....recording.suite_folder import SPLITS, SuiteRecording, find_recordings
from ..calibration import Calibration, calibrate, save_calibration
from ..offline import Estimates, Observations, estimate, observe
from ..room import find_room_frame
from ..rssi import grid_statistic
from ..settings import GollerSettings
from ..training import fit_association
from ..truth import true_states, true_tags
from .ablation import sensor_ablation
from .handover import Handover, find_handover, summarise_handovers
from .paper import paper_rates
from .rates import (
    Example,
    Rates,
    Rule,
    TagOutcome,
    location_error_m,
    outcomes,
    rates_at_paper_false_alarms,
    rule_roc,
    scenario_rates,
    simple_rates,
    simple_scenario,
    thresholds,
)
from .tables import ablation_table, rate_tables

_NUM_SCENE_PICTURES = 5


@dataclasses.dataclass(frozen=True)
class GollerExperiment:
    """Recordings of a tag grid, of the scenarios and of hand-overs; and how much is trained."""

    grid: str  # a recording
    scenarios: str  # a suite's folder with train/, validation/ and test/
    handover: str | None = None  # a recording, or a suite's folder with test/; shop_handover beside `scenarios` if None
    settings: GollerSettings = dataclasses.field(default_factory=GollerSettings)
    floor_dbm: float = -80.0
    fit_means: bool = False
    fit_steps: int = 120  # 0 keeps the initial values
    learning_rate: float = 0.05
    max_recordings: int | None = None  # of a variant in each split; all if None

    def scenario_recordings(self, split: str) -> list[SuiteRecording]:
        """The recordings of a split of the scenarios."""
        return find_recordings(self.scenarios, split, self.max_recordings)

    def handover_recordings(self) -> list[str]:
        """The recordings of hand-overs; none where the default folder has none."""
        folder = Path(self.scenarios).parent / "shop_handover" if self.handover is None else Path(self.handover)
        found = sorted(str(path) for path in (folder / "test").glob("*.zarr"))
        if found or self.handover is None or (folder / "test").is_dir():
            return found
        return [self.handover] if _exists(self.handover) else []

    def check_recordings(self) -> None:
        """Raises `ValueError` that names every missing recording, and the commands that make them."""
        missing = []
        command = "`python -m experiments.simulate suite={0}` makes recordings/{0}"
        if not _exists(self.grid):
            missing.append(
                f"grid={self.grid}: no such recording of a tag grid; {command.format('shop_grid')}/train/*.zarr."
            )
        if empty := [split for split in SPLITS if not self.scenario_recordings(split)]:
            missing.append(
                f"scenarios={self.scenarios}: no recording in {', '.join(f'{split}/' for split in empty)}; expected some "
                f"in each split of a suite's folder; {command.format('shop_exit')}."
            )
        if self.handover is not None and not self.handover_recordings():
            missing.append(
                f"handover={self.handover}: no recording, and no folder with test/ of some; "
                f"{command.format('shop_handover')}."
            )
        if missing:
            raise ValueError(" ".join(missing))


def _exists(recording: str) -> bool:
    return "://" in recording or Path(recording).is_dir()


def run_goller(
    config: GollerExperiment,
    folder: Path,
    *,
    open_recording: Callable[[str], Recording],
    on_progress: OnProgress = unobserved,
) -> dict[str, Any]:
    """The paper's evaluation on simulated recordings; returns the content of `metrics.json`.

    Filters are trained on the train split, thresholds chosen on train and validation, rates counted on test. Raises
    `ValueError`, before any recording is opened, where the grid, a split or a configured hand-over is missing.
    """
    from .. import figures

    config.check_recordings()
    folder.mkdir(parents=True, exist_ok=True)
    grid = open_recording(config.grid)
    calibration = calibrate(grid, floor_dbm=config.floor_dbm, fit_means=config.fit_means)
    statistic = grid_statistic(grid, find_room_frame(grid))
    figures.antenna_plot(folder / "antennas.png", statistic, calibration.location.antennas)
    splits, observe_ms = _observe_splits(config, open_recording, on_progress)
    known, test = splits["train"] + splits["validation"], splits["test"]
    losses = np.zeros(0)
    if config.fit_steps:
        on_progress("fit", 0, 1, f"{config.fit_steps} steps")
        pairs = [(example.observed, example.truth) for example in splits["train"]]
        calibration, losses = fit_association(
            calibration, pairs, config.settings, num_steps=config.fit_steps, learning_rate=config.learning_rate
        )
        on_progress("fit", 1, 1)
    on_progress("score", 0, 3, "thresholds")
    fused, rfid = thresholds(outcomes(calibration, known, config.settings))
    calibration = eqx.tree_at(
        lambda c: (c.alarm_threshold, c.rssi_threshold_dbm),
        calibration,
        (jnp.asarray(fused, jnp.float32), jnp.asarray(rfid, jnp.float32)),
    )
    save_calibration(calibration, folder / "calibration.json")
    on_progress("score", 1, 3, "outcomes")
    start = time.perf_counter()
    found = outcomes(calibration, test, config.settings)
    estimate_ms = 1e3 * (time.perf_counter() - start) / max(sum(len(one.observed.time_s) for one in test), 1)
    simple, scenarios = simple_rates(found, fused, rfid), scenario_rates(found, fused)
    on_progress("score", 2, 3, "ablation")
    conditions = sensor_ablation(calibration, known, test, config.settings)
    at_paper = rates_at_paper_false_alarms(found)
    write_atomic(folder / "tables.md", rate_tables(simple, scenarios, at_paper) + "\n" + ablation_table(conditions))
    _roc_plot(folder, found, simple)
    errors = location_error_m(calibration, test, config.settings)
    on_progress("score", 3, 3)
    metrics = {
        "paper": paper_rates(),
        "table_1": {name: row.to_json() for name, row in simple.items()},
        "table_1_at_papers_false_alarms": {
            name: {"detected": point[0], "false_alarm": point[1]} for name, point in at_paper.items()
        },
        "table_2": {name: row.to_json() for name, row in scenarios.items()},
        "ablation": {name: {key: row.to_json() for key, row in rows.items()} for name, rows in conditions.items()},
        "handover": _handovers(folder, config, calibration, open_recording, on_progress),
        "thresholds": {"fused": fused, "rfid_dbm": rfid},
        "fitted": _fitted(calibration),
        "fit_loss": [float(losses[0]), float(losses[-1])] if len(losses) else None,
        "location_error_m": {"median": float(np.median(errors)), "p90": float(np.quantile(errors, 0.9))},
        "num_recordings": {split: len(examples) for split, examples in splits.items()},
        "never_read": sum(not one.read for one in found),
        "milliseconds_per_frame": {"reading and both sensors": observe_ms, "location and association": estimate_ms},
    }
    write_json(folder / "metrics.json", metrics)
    write_json(folder / "outcomes.json", [dataclasses.asdict(one) for one in found])
    return metrics


def _observe_splits(
    config: GollerExperiment, open_recording: Callable[[str], Recording], on_progress: OnProgress
) -> tuple[dict[str, list[Example]], float]:
    """The examples of each split, and the time a frame took, ms."""
    start, num_frames = time.perf_counter(), 0
    splits: dict[str, list[Example]] = {split: [] for split in SPLITS}
    work = [(split, one) for split in SPLITS for one in config.scenario_recordings(split)]
    for number, (split, one) in enumerate(work):
        on_progress("observe", number, len(work), one.path.stem)
        recording = open_recording(str(one.path))
        observed = observe(recording, config.settings)
        splits[split].append(Example(one.variant, observed, true_tags(recording)))
        num_frames += recording.num_frames
    on_progress("observe", len(work), len(work))
    return splits, 1e3 * (time.perf_counter() - start) / num_frames


def _fitted(calibration: Calibration) -> dict[str, Any]:
    """The trained parameters, out of the logarithm."""
    parts = {"location": calibration.location, "association": calibration.association}
    return {
        f"{part}.{field.name.removeprefix('log_')}": np.exp(np.asarray(getattr(model, field.name))).tolist()
        for part, model in parts.items()
        for field in dataclasses.fields(model)
        if field.name.startswith("log_")
    }


def _roc_plot(folder: Path, found: Sequence[TagOutcome], simple: dict[str, Rates]) -> None:
    """Table I as a curve, where its scenario was recorded."""
    from .. import figures

    if outcomes_of_simple := simple_scenario(found):
        labels: dict[str, Rule] = {"RFID only": "rfid", "RFID + CV": "fused"}
        curves = {label: rule_roc(outcomes_of_simple, rule, stays=False) for label, rule in labels.items()}
        chosen = {label: (simple[rule].detected, simple[rule].false_alarm) for label, rule in labels.items()}
        figures.roc_plot(folder / "roc.png", curves, chosen)


def _handovers(
    folder: Path,
    config: GollerExperiment,
    calibration: Calibration,
    open_recording: Callable[[str], Recording],
    on_progress: OnProgress,
) -> dict[str, Any] | None:
    """Fig. 7 for every tag of the first recording, and the summary of all recordings; None without any."""
    from .. import figures

    paths = config.handover_recordings()
    if not paths:
        return None
    found: list[Handover] = []
    for number, path in enumerate(paths):
        on_progress("hand-overs", number, len(paths))
        recording = open_recording(path)
        observed, truth = observe(recording, config.settings), true_tags(recording)
        estimates, states = estimate(calibration, observed, config.settings), true_states(observed, truth)
        for row, epc in enumerate(observed.epcs):
            probability, true_m = np.asarray(estimates.probability[row]), truth.position_m[truth.epcs.index(epc)]
            one = find_handover(observed.time_s, true_m, probability, observed.blobs)
            found += [] if one is None else [one]
            if number == 0:
                figures.association_plot(
                    folder / ("handover.png" if row == 0 else f"handover_{row + 1}.png"),
                    observed.time_s,
                    probability,
                    observed.blobs.identity,
                    states[row],
                    np.asarray(estimates.location.position_m[row, :, 0]),
                    true_m[:, 0],
                    title=plain_label(f"{recording.name}, tag {epc[-4:]}"),
                )
        if number == 0:
            threshold = float(calibration.alarm_threshold)
            _scene_picture(folder / "handover_scene.png", recording, observed, estimates, threshold)
    on_progress("hand-overs", len(paths), len(paths))
    if found:
        figures.handover_plot(folder / "handover_mean.png", found)
    return summarise_handovers(found, len(paths))


def _scene_picture(
    path: Path, recording: Recording, observed: Observations, estimates: Estimates, threshold: float
) -> None:
    """Pictures of a recording with the blobs' boxes and their tags; alarmed tags in red."""
    from .. import figures

    frames = (np.linspace(0.08, 0.92, _NUM_SCENE_PICTURES) * (recording.num_frames - 1)).astype(int)
    best, score = np.argmax(np.asarray(estimates.probability), axis=2), np.asarray(estimates.exit_score)
    labels, alarmed = [], []
    for frame in frames:
        texts, flags = [], []
        for slot, identity in enumerate(observed.blobs.identity[frame]):
            carried = [tag for tag in range(len(observed.epcs)) if best[tag, frame] == slot + 1]
            texts.append(f"{identity}: " + " ".join(f"T{tag + 1}" for tag in carried))
            flags.append(any(score[tag, frame] >= threshold for tag in carried))
        labels.append(texts)
        alarmed.append(flags)
    pictures = np.stack([np.asarray(recording.colour[int(frame)]) for frame in frames])
    figures.scene_picture(path, pictures, observed.blobs.box_px[frames], labels, alarmed)
