"""Suites by name: the files of conf/suite, and their simulated recordings."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from .command import CONF


def suites_named(names: Sequence[str]) -> dict[str, Any]:
    """The settings of suites by name. Raises `ValueError` for a name without a file in conf/suite."""
    known = sorted(path.stem for path in (CONF / "suite").glob("*.yaml"))
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"suites: found {', '.join(unknown)}; expected some of {', '.join(known)}.")
    return {name: OmegaConf.to_container(OmegaConf.load(CONF / "suite" / f"{name}.yaml")) for name in names}


def suite_recordings(
    suite: Mapping[str, Any],
    split: str,
    recordings_dir: str,
    *,
    max_recordings: int | None = None,
    smoke: bool = False,
    progress: bool = True,
) -> list[str]:
    """Paths of a suite's recordings of one split, simulated where they are missing.

    `max_recordings` limits those of each variant. On a terminal a line counts the simulated recordings, if `progress`.
    Raises `ValueError` if the suite has none in this split.
    """
    from tagjax.core.progress import progress_lines
    from tagjax.core.settings import from_mapping
    from tagjax.sim.suites import Suite, make_items

    chosen = from_mapping(Suite, suite, where="suite")
    chosen = chosen.smoke() if smoke else chosen
    folder = Path(recordings_dir)
    with progress_lines(shown=progress) as report:
        items = make_items(
            chosen,
            folder,
            splits=(split,),
            max_per_variant=max_recordings,
            workers=os.cpu_count() or 1,
            on_progress=report,
        )
    if not items:
        raise ValueError(f"suite {chosen.name} has no {split} recording; expected some: set suite.counts.{split}.")
    return [str(item.path(folder)) for item in items]
