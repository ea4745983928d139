"""A whole run: calibrate, fit, choose thresholds, count, and write tables, metrics and plots into a folder."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ...baselines.goller import (
    Calibration,
    Carried,
    GollerSettings,
    Observations,
    calibrate,
    carried,
    decide,
    find_site,
    fit_association,
    grid_statistic,
    observe,
    save_calibration,
    true_states,
)
from ...recording import Recording
from ...report.report import write_json
from ...sim.suites import SPLITS
from ._figures import antenna_plot, association_plot, handover_plot, roc_plot, scene_picture
from ._handover import Handover, follow
from ._ladder import ladder
from ._tables import (
    SIMPLE,
    TagOutcome,
    at_papers_false_alarms,
    ladder_markdown,
    location_error_m,
    markdown,
    outcomes,
    plain,
    rule_roc,
    table_1,
    table_2,
    thresholds,
)

Example = tuple[str, Observations, Carried]
"""Variant, what was seen, what was true."""


@dataclasses.dataclass(frozen=True)
class GollerConfig:
    """What a run needs: recordings of a tag grid, of the scenarios, of a hand-over; and how much is fitted."""

    grid: str  # a recording
    scenarios: str  # a suite's folder with train/, validation/ and test/
    handover: str | None = None  # a recording, or a suite's folder with test/; shop_handover beside `scenarios` if None
    settings: GollerSettings = dataclasses.field(default_factory=GollerSettings)
    floor_dbm: float = -80.0
    fit_means: bool = False
    fit_steps: int = 120  # 0 keeps the starting values
    learning_rate: float = 0.05
    max_recordings: int | None = None  # of each variant and split; all if None


def scenario_paths(folder: Path, split: str, most: int | None = None) -> list[tuple[str, Path]]:
    """Variant and path of a split's recordings (<suite>-<variant>-<split>-<number>.zarr), in order of number."""
    found = []
    for path in (folder / split).glob("*.zarr"):
        parts = path.stem.split("-")
        if len(parts) != 4 or not parts[3].isdigit():
            raise ValueError(
                f"{path}: expected a name <suite>-<variant>-<split>-<number>.zarr, as experiments.simulate gives."
            )
        if most is None or int(parts[3]) < most:
            found.append((parts[1], int(parts[3]), path))
    return [(variant, path) for variant, _, path in sorted(found)]


def _handover_paths(config: GollerConfig) -> list[str]:
    """Recordings of a hand-over; none where the default folder has none."""
    folder = Path(config.scenarios).parent / "shop_handover" if config.handover is None else Path(config.handover)
    found = sorted(str(path) for path in (folder / "test").glob("*.zarr"))
    if found or config.handover is None or (folder / "test").is_dir():
        return found
    return [config.handover] if _there(config.handover) else []


def _there(recording: str) -> bool:
    return "://" in recording or Path(recording).is_dir()


def _check_paths(config: GollerConfig) -> None:
    """Raises `ValueError` that names all that is missing of the recordings, and the commands that make them."""
    told, home = [], "recordings"
    made = "`python -m experiments.simulate suite={0}` makes {1}/{0}"
    if not _there(config.grid):
        told.append(
            f"grid={config.grid}: no such recording of a tag grid; {made.format('shop_grid', home)}/train/*.zarr."
        )
    folder = Path(config.scenarios)
    if empty := [split for split in SPLITS if not scenario_paths(folder, split, config.max_recordings)]:
        told.append(
            f"scenarios={folder}: no recording in {', '.join(f'{split}/' for split in empty)}; expected some in each of a "
            f"suite's folders; {made.format('shop_exit', home)}."
        )
    if config.handover is not None and not _handover_paths(config):
        told.append(
            f"handover={config.handover}: no recording, and no folder with test/ of some; "
            f"{made.format('shop_handover', home)}."
        )
    if told:
        raise ValueError(" ".join(told))


def run_goller(
    config: GollerConfig,
    open_recording: Callable[[str], Recording],
    folder: Path,
    *,
    on_done: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Everything of the paper's evaluation on simulated recordings; returns what `metrics.json` holds.

    Widths and rates are fitted on the train split, thresholds chosen on train and validation, rates counted on test.
    Raises `ValueError`, before anything is observed, where the grid, a split or a hand-over that is asked for is missing.
    """
    _check_paths(config)
    settings = config.settings
    grid = open_recording(config.grid)
    calibration = calibrate(grid, floor_dbm=config.floor_dbm, fit_means=config.fit_means)
    antenna_plot(folder / "antennas.png", grid_statistic(grid, find_site(grid)), calibration.location.antennas)
    start, num_frames = time.perf_counter(), 0
    splits: dict[str, list[Example]] = {}
    for split in SPLITS:
        splits[split] = []
        for variant, path in scenario_paths(Path(config.scenarios), split, config.max_recordings):
            recording = open_recording(str(path))
            splits[split].append((variant, observe(recording, settings), carried(recording)))
            num_frames += recording.num_frames
            on_done(recording.name)
    seen_ms = 1e3 * (time.perf_counter() - start) / num_frames
    losses = np.zeros(0)
    if config.fit_steps:
        pairs = [(seen, truth) for _, seen, truth in splits["train"]]
        calibration, losses = fit_association(
            calibration, pairs, settings, num_steps=config.fit_steps, learning_rate=config.learning_rate
        )
    known = _outcomes(calibration, splits["train"] + splits["validation"], settings)
    fused, rfid = thresholds(known)
    calibration = eqx.tree_at(
        lambda c: (c.alarm_threshold, c.rssi_threshold_dbm),
        calibration,
        (jnp.asarray(fused, jnp.float32), jnp.asarray(rfid, jnp.float32)),
    )
    save_calibration(calibration, folder / "calibration.json")
    start = time.perf_counter()
    found = _outcomes(calibration, splits["test"], settings)
    decided_ms = 1e3 * (time.perf_counter() - start) / max(sum(len(s.time_s) for _, s, _ in splits["test"]), 1)
    first, second = table_1(found, fused, rfid), table_2(found, fused)
    rungs = ladder(calibration, splits["train"] + splits["validation"], splits["test"], settings)
    at_papers = at_papers_false_alarms(found)
    (folder / "tables.md").write_text(markdown(first, second, at_papers) + "\n" + ladder_markdown(rungs))
    _curves(folder, found, first)
    passed = _handovers(folder, config, calibration, open_recording)
    errors = location_error_m(calibration, [(seen, truth) for _, seen, truth in splits["test"]], settings)
    metrics = {
        "table_1": {name: plain(row) for name, row in first.items()},
        "table_1_at_papers_false_alarms": {
            name: {"detected": point[0], "false_alarm": point[1]} for name, point in at_papers.items()
        },
        "table_2": {name: plain(row) for name, row in second.items()},
        "ladder": {rung: {name: plain(row) for name, row in rows.items()} for rung, rows in rungs.items()},
        "handover": passed,
        "thresholds": {"fused": fused, "rfid_dbm": rfid},
        "fitted": _fitted(calibration),
        "fit_loss": [float(losses[0]), float(losses[-1])] if len(losses) else None,
        "location_error_m": {"median": float(np.median(errors)), "p90": float(np.quantile(errors, 0.9))},
        "num_recordings": {split: len(examples) for split, examples in splits.items()},
        "never_read": sum(not one.read for one in found),
        "milliseconds_a_frame": {"both sensors, reading included": seen_ms, "location and association": decided_ms},
    }
    write_json(folder / "metrics.json", metrics)
    write_json(folder / "outcomes.json", [dataclasses.asdict(one) for one in found])
    return metrics


def _outcomes(calibration: Calibration, examples: list[Example], settings: GollerSettings) -> list[TagOutcome]:
    return [one for variant, seen, truth in examples for one in outcomes(calibration, variant, seen, truth, settings)]


def _fitted(calibration: Calibration) -> dict[str, Any]:
    parts = {"location": calibration.location, "association": calibration.association}
    return {
        f"{part}.{field.name.removeprefix('log_')}": np.exp(np.asarray(getattr(model, field.name))).tolist()
        for part, model in parts.items()
        for field in dataclasses.fields(model)
        if field.name.startswith("log_")
    }


def _curves(folder: Path, found: list[TagOutcome], first: dict[str, Any]) -> None:
    """Table I as a curve, where its scenario was recorded."""
    simple = [one for one in found if one.variant == SIMPLE]
    if not {"leaves", "still"} <= {one.kind for one in simple}:
        return
    curves = {
        "RFID only": rule_roc(simple, "rfid", stays=False),
        "RFID + CV": rule_roc(simple, "fused", stays=False),
    }
    rows = {"RFID only": first["rfid"], "RFID + CV": first["fused"]}
    roc_plot(folder / "roc.png", curves, {name: (row.detected, row.false_alarm) for name, row in rows.items()})


def _handovers(
    folder: Path, config: GollerConfig, calibration: Calibration, open_recording: Callable[[str], Recording]
) -> dict[str, Any] | None:
    """Fig. 7 for every tag of the first recording, and what all recordings have in common; None without any."""
    paths = _handover_paths(config)
    if not paths:
        return None
    followed: list[Handover] = []
    for number, path in enumerate(paths):
        recording = open_recording(path)
        seen, truth = observe(recording, config.settings), carried(recording)
        decision, states = decide(calibration, seen, config.settings), true_states(seen, truth)
        for row, epc in enumerate(seen.epcs):
            probability, place = np.asarray(decision.probability[row]), truth.position_m[truth.epcs.index(epc)]
            one = follow(seen.time_s, place, probability, seen.blobs)
            followed += [] if one is None else [one]
            if number == 0:
                association_plot(
                    folder / ("handover.png" if row == 0 else f"handover_{row + 1}.png"),
                    seen.time_s,
                    probability,
                    seen.blobs.identity,
                    states[row],
                    np.asarray(decision.location.position_m[row, :, 0]),
                    place[:, 0],
                    title=f"{recording.name}, tag {epc[-4:]}",
                )
        if number == 0:
            scores, threshold = np.asarray(decision.exit_score), float(calibration.alarm_threshold)
            _scene(folder / "handover_scene.png", recording, seen, np.asarray(decision.probability), scores, threshold)
    if not followed:
        return {"num_recordings": len(paths), "num_followed": 0}
    handover_plot(folder / "handover_mean.png", followed)
    delays = {"taker": [one.delay_s for one in followed], "rest": [one.rest_delay_s for one in followed]}
    return {
        "num_recordings": len(paths),
        "num_followed": len(followed),
        "giver_peak_before": [float(one.probability[one.time_s <= one.taken_s, 1].max()) for one in followed],
        "taker_peak_before": [float(one.probability[one.time_s <= one.taken_s, 2].max()) for one in followed],
        "taker_peak_after": [float(one.probability[one.time_s > one.taken_s, 2].max()) for one in followed],
        "background_at_end": [float(one.probability[-1, 0]) for one in followed],
        **{f"{name}_delay_s": [d if np.isfinite(d) else None for d in values] for name, values in delays.items()},
    }


def _scene(path, recording, seen, probability, score, threshold) -> None:
    """Five moments with the blobs' boxes and their tags."""
    frames = np.linspace(0.08, 0.92, 5) * (recording.num_frames - 1)
    frames = frames.astype(int)
    best = np.argmax(probability, axis=2)
    labels, red = [], []
    for frame in frames:
        texts, flags = [], []
        for slot, name in enumerate(seen.blobs.identity[frame]):
            mine = [tag for tag in range(len(seen.epcs)) if best[tag, frame] == slot + 1]
            texts.append(f"{name}: " + " ".join(f"T{tag + 1}" for tag in mine))
            flags.append(any(score[tag, frame] >= threshold for tag in mine))
        labels.append(texts)
        red.append(flags)
    pictures = np.stack([np.asarray(recording.colour[int(frame)]) for frame in frames])
    scene_picture(path, pictures, seen.blobs.box_px[frames], labels, red)
