"""What sweeps need of a command: how many of a study's trials are left, and what a job tells its sweep."""

from __future__ import annotations

import logging
import math
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from .errors import sweeping
from .run_folder import checkpoint_steps


def trials_left(
    wanted: int, storage: str, study: str, folder: str, launched: str = "", *, _root_: DictConfig | None = None
) -> int:
    """How many trials an Optuna study still lacks: a sweep that was killed does these when it is started again.

    Only trials that were finished count; one that was killed stays among them as running, and is tried no more.
    `folder` is the sweep's, in which Hydra writes the best trial also where none is left to do. `launched`
    is the time: Hydra keeps what it was told here for the folders of all jobs. Ends the command if the trials would have
    no score: recordings are named, but none that is held out.
    """
    import optuna  # pyright: ignore[reportMissingImports]  # of the sweep extra

    del launched
    if _root_ is not None and _without_score(_root_):
        raise SystemExit(
            "search: data.recordings is given and data.validation is empty: no trial would have a score. Name held-out "
            "recordings: data.validation=[...]."
        )
    optuna.logging.set_verbosity(logging.WARNING)
    if storage.startswith("sqlite:///"):
        Path(storage.removeprefix("sqlite:///")).parent.mkdir(parents=True, exist_ok=True)
    known = {one.study_name for one in optuna.get_all_study_summaries(storage)}
    if study not in known:
        return wanted
    trials = optuna.load_study(study_name=study, storage=storage).trials
    left = max(0, wanted - sum(trial.state is optuna.trial.TrialState.COMPLETE for trial in trials))
    if not left:
        Path(folder).mkdir(parents=True, exist_ok=True)
    return left


def _without_score(config: DictConfig) -> bool:
    named, held_out = (OmegaConf.select(config, f"data.{name}") for name in ("recordings", "validation"))
    overrides = OmegaConf.select(config, "hydra.overrides.task") or ()
    swept = [*overrides, *(OmegaConf.select(config, "hydra.sweeper.params") or ())]
    return bool(named) and not held_out and not any("data.validation" in one for one in swept)


def told(score: float, folder: Path, num_steps: int) -> float | None:
    """What a training run tells its sweep: None for NaN, by which a trial fails; NaN itself ends an Optuna sweep.

    Raises `KeyboardInterrupt` in a sweep if the run was stopped before its last step, which is no failure: the jobs after
    it must not start. The run's checkpoint is then written.
    """
    steps = checkpoint_steps(folder)
    if math.isnan(score) and sweeping() and steps and max(steps) < num_steps:
        raise KeyboardInterrupt
    return None if math.isnan(score) else score
