"""What a run folder holds for its page, read from its files."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.run_record import read_run_record
from ..report import overlay_folder
from ..stages import STAGES
from ..video import VIDEO
from .states import TagFrames


@dataclasses.dataclass(frozen=True)
class Contents:
    """A run's report. `tags` has by tracer and recording the tags in their order; `report` is the folder of frames.csv."""

    run: Path
    report: Path
    summary: Mapping[str, Any]
    tags: Mapping[str, Mapping[str, Sequence[TagFrames]]]
    motion: Mapping[
        str, Mapping[str, Sequence[tuple[float, float, float, int]]]
    ]  # tracer, score: mean, low, high, tags
    record: Mapping[str, Any]
    configuration: str
    training: Sequence[Mapping[str, Any]]  # lines of metrics.jsonl
    parameters: Mapping[str, Mapping[str, float]]

    @property
    def tracers(self) -> list[str]:
        """Names of the tracers; the first is the one that the run is about."""
        return list(self.summary)

    def recordings(self) -> list[str]:
        """Names of the recordings, the one with the lowest box IoU of the first tracer first; those without truth last."""
        scores = self.summary[self.tracers[0]]["recordings"]

        def iou(name: str) -> float:
            value = scores.get(name, {}).get("all", {}).get("iou")
            return 2.0 if value is None else float(value)

        return sorted(self.tags[self.tracers[0]], key=iou)

    def video(self, recording: str, tracer: str) -> Path | None:
        """The overlay video of a recording and a tracer; None where there is none."""
        path = overlay_folder(self.report, recording, tracer) / VIDEO
        return path if path.is_file() else None

    def stages(self, recording: str, tracer: str) -> tuple[int, list[tuple[Path, str, str]]] | None:
        """The frame of the stage pictures, and each one's file, title and text; None where there are none."""
        folder = overlay_folder(self.report, recording, tracer)
        if not (folder / STAGES).is_file():
            return None
        content = _json(folder / STAGES)
        try:
            listed = [(folder / Path(one["file"]).name, one["title"], one["text"]) for one in content["stages"]]
            frame = int(content["frame"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{folder / STAGES}: expected a frame and stages with file, title and text.") from error
        return frame, [one for one in listed if one[0].is_file()]


def read_contents(run: Path) -> Contents:
    """Read a run folder of `experiments.train` or `experiments.evaluate`.

    Raises `ValueError` for a folder that holds no report, and for a file that is not as the commands write it.
    """
    report = next((one for one in (run, run / "report") if (one / "frames.csv").is_file()), None)
    if report is None or not (report / "metrics.json").is_file():
        raise ValueError(
            f"run={run}: found no metrics.json and frames.csv, there or in report/; expected the run folder of "
            "experiments.evaluate, or of experiments.train with validation recordings that has come to its end."
        )
    summary = _json(report / "metrics.json")
    if not summary or not all(
        isinstance(one, dict) and {"all", "recordings"} <= one.keys() for one in summary.values()
    ):
        raise ValueError(
            f"{report / 'metrics.json'}: expected the scores of each tracer: all, and recordings. Evaluate again."
        )
    tags = _frames(report / "frames.csv")
    if not set(summary) <= set(tags):
        raise ValueError(
            f"{report / 'frames.csv'}: found tracers {', '.join(tags) or 'none'}; expected {', '.join(summary)}."
        )
    configuration, log = run / "config.yaml", run / "metrics.jsonl"
    parameters = run / "parameters.json"
    return Contents(
        run=run,
        report=report,
        summary=summary,
        tags=tags,
        motion=_motion(report / "motion_curves.csv"),
        record=read_run_record(run),
        configuration=configuration.read_text(encoding="utf-8", errors="replace") if configuration.is_file() else "",
        training=_lines(log) if log.is_file() else [],
        parameters=_json(parameters) if parameters.is_file() else {},
    )


def _json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path}: found {error}; expected JSON as the commands write it. Evaluate again.") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: found {type(content).__name__}; expected a JSON object. Evaluate again.")
    return content


def _lines(path: Path) -> list[dict[str, Any]]:
    """The complete lines of a log; a run that was killed may have left half a line."""
    found = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            content = json.loads(line)
        except ValueError:
            continue
        if isinstance(content, dict) and isinstance(content.get("step"), int | float):
            found.append(content)
    return found


_NUMBERS = ("frame", "time_s", "detected", "identified", "valid", "iou", "cle_px", "confidence", "label")


def _frames(path: Path) -> dict[str, dict[str, list[TagFrames]]]:
    rows: dict[tuple[str, str, str], list[dict[str, str]]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        missing = {"tracer", "recording", "epc", "status", *_NUMBERS} - set(reader.fieldnames or ())
        if missing:
            raise ValueError(f"{path}: found no column {', '.join(sorted(missing))}; evaluate again to write them.")
        for row in reader:
            rows.setdefault((row["tracer"], row["recording"], row["epc"]), []).append(row)
    found: dict[str, dict[str, list[TagFrames]]] = {}
    for (tracer, recording, epc), own in rows.items():
        try:
            numbers = {name: np.array([float(row[name]) for row in own]) for name in _NUMBERS}
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: {tracer}, {recording}, {epc}: {error}. Evaluate again.") from error
        detected = numbers["detected"] > 0
        one = TagFrames(
            epc=epc,
            label=int(numbers["label"][0]),
            frame=numbers["frame"].astype(np.int64),
            time_s=numbers["time_s"],
            detected=detected,
            status=tuple(row["status"] for row in own),
            identified=numbers["identified"].astype(np.int64),
            valid=numbers["valid"] > 0,
            iou=np.where(detected, np.nan_to_num(numbers["iou"]), 0.0),
            cle_px=np.where(detected, numbers["cle_px"], np.nan),
            confidence=numbers["confidence"],
        )
        found.setdefault(tracer, {}).setdefault(recording, []).append(one)
    return found


def _motion(path: Path) -> dict[str, dict[str, list[tuple[float, float, float, int]]]]:
    found: dict[str, dict[str, list[tuple[float, float, float, int]]]] = {}
    if not path.is_file():
        return found
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            try:
                values = (float(row["mean"]), float(row["low"]), float(row["high"]), int(row["num_tags"]))
                found.setdefault(row["tracer"], {}).setdefault(row["score"], []).append(values)
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(
                    f"{path}: {error!r}; expected columns as evaluate writes them. Evaluate again."
                ) from error
    return found
