"""The trial of faults: every kind in parts, with the results as JSON after each part, and as Markdown."""

from __future__ import annotations

import dataclasses
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.progress import OnProgress, unobserved
from ...core.results import markdown_table, write_json
from .kinds import KINDS
from .outcome import Outcome, joined

FORMAT, VERSION = "tagjax-fault-trial", 1
_MAX_PART = 500
"""Number of faults in a part of a kind, after which progress is shown and results are written."""


@dataclasses.dataclass(frozen=True)
class FaultTrialSettings:
    """Which faults are tried, and how many of each kind."""

    kinds: tuple[str, ...] = ("clocks", "names", "targets", "tables", "weights")
    number: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        unknown = [name for name in self.kinds if name not in KINDS]
        if unknown or len(set(self.kinds)) < len(self.kinds):
            raise ValueError(f"kinds is {list(self.kinds)}; expected different ones of {', '.join(KINDS)}.")
        if self.number < 1 or self.seed < 0:
            raise ValueError(f"number is {self.number}, seed {self.seed}; expected at least 1 and 0.")


def run_trial(
    settings: FaultTrialSettings,
    path: Path,
    *,
    about: Mapping[str, Any] | None = None,
    on_progress: OnProgress = unobserved,
) -> dict[str, Any]:
    """Try the kinds of faults, write the results to `path` after each part, and return them.

    Kinds that the file holds already, from an earlier trial, remain if they are not tried again. `about` is stored with
    each kind: revision, date. The same settings give the same results. After an interruption the file holds every part
    that was finished.
    """
    results = read_results(path)
    for name in settings.kinds:
        begun, outcomes, done = time.monotonic(), [], 0
        while done < settings.number:
            on_progress(name, done, settings.number)
            part = min(_MAX_PART, settings.number - done)
            outcomes = joined([*outcomes, *_part(name, part, settings.seed, done // _MAX_PART)])
            done += part
            results["kinds"][name] = {
                "number": settings.number,
                "done": done,
                "seed": settings.seed,
                "seconds": round(time.monotonic() - begun, 1),
                "outcomes": [dataclasses.asdict(one) for one in outcomes],
                **(about or {}),
            }
            write_json(path, results)
        on_progress(name, done, settings.number)
    return results


def _part(name: str, number: int, seed: int, part: int) -> list[Outcome]:
    own_seed = int(np.random.SeedSequence([seed, part]).generate_state(1)[0])
    with tempfile.TemporaryDirectory(prefix="fault_trial_") as folder:
        return KINDS[name](number, own_seed, Path(folder))


def read_results(path: Path) -> dict[str, Any]:
    """The results in a file of `run_trial`; none if it does not exist. Raises `ValueError` for another file."""
    if not path.exists():
        return {"format": FORMAT, "version": VERSION, "kinds": {}}
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not JSON ({error}). Remove it, and try the faults again.") from error
    if not isinstance(results, dict) or (results.get("format"), results.get("version")) != (FORMAT, VERSION):
        raise ValueError(f"{path}: found no {FORMAT} of version {VERSION}. Remove it, and try the faults again.")
    return results


def num_failed(results: Mapping[str, Any]) -> int:
    """The number of faults that failed."""
    return sum(one["failed"] for kind in results["kinds"].values() for one in kind["outcomes"])


def rendered(results: Mapping[str, Any]) -> str:
    """The results as a Markdown table, a row for each kind and its sum, and the first failures by their variety."""
    if not results["kinds"]:
        return "*The trial has not been run yet: `python -m experiments.fault_trial`.*"
    rows = [
        (f"`{name}`", *_counts(kind["outcomes"]), f"`number={kind['number']} seed={kind['seed']}`{_made_at(kind)}")
        for name, kind in results["kinds"].items()
    ]
    outcomes = [one for kind in results["kinds"].values() for one in kind["outcomes"]]
    rows.append(("all", *_counts(outcomes), ""))
    failures = [f"- {one['kind']}: {example}" for one in outcomes for example in one["examples"]]
    parts = [
        markdown_table(("kind", "varieties", "tried", "failed", "made with"), rows),
        *(["The first failures:\n\n" + "\n".join(failures)] if failures else []),
    ]
    return "\n\n".join(parts)


def _counts(outcomes: Sequence[Mapping[str, Any]]) -> tuple[str, str, str]:
    """The numbers of varieties, of faults that were tried, and of those that failed."""
    tried, failed = (sum(one[name] for one in outcomes) for name in ("tried", "failed"))
    return str(len(outcomes)), f"{tried:,}", f"{failed:,}"


def _made_at(kind: Mapping[str, Any]) -> str:
    stopped = "" if kind["done"] == kind["number"] else f", stopped after {kind['done']}"
    commit = kind.get("commit")
    at = f", revision `{commit[:10]}`" if commit else ""
    return f"{stopped}{at}{', ' + kind['date_utc'][:10] if 'date_utc' in kind else ''}"
