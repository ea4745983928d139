"""For a hyper-parameter search: the number of remaining trials, the score of a run, and the report at the end.

Configurations get at the first by the resolver `trials_left`, and at the last by `search_report`.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

_log = logging.getLogger(__name__)


def trials_left(
    num_trials: int, storage: str, study: str, folder: str, launched: str = "", *, _root_: DictConfig | None = None
) -> int:
    """The number of remaining trials of an Optuna study, which a killed search runs when it is started again.

    Only finished trials count; a killed trial stays in the study as running and is not repeated. `folder` is the sweep's
    folder: it is created if no trial is left, because Hydra writes the best trial there. `launched` is the time of the
    launch: because it is resolved here first, the folders of all jobs get the same time. Ends the command if the trials
    would have no score, that is with training recordings but no validation recordings.
    """
    import optuna  # pyright: ignore[reportMissingImports]  # of the sweep extra

    del launched
    if _root_ is not None and _without_score(_root_):
        raise SystemExit(
            "hparams_search: data.recordings is given and data.validation is empty, so no trial would have a score. Give "
            "validation recordings: data.validation=[...]."
        )
    optuna.logging.set_verbosity(logging.WARNING)
    if storage.startswith("sqlite:///"):
        Path(storage.removeprefix("sqlite:///")).parent.mkdir(parents=True, exist_ok=True)
    known = {one.study_name for one in optuna.get_all_study_summaries(storage)}
    if study not in known:
        return num_trials
    trials = optuna.load_study(study_name=study, storage=storage).trials
    left = max(0, num_trials - sum(trial.state is optuna.trial.TrialState.COMPLETE for trial in trials))
    if not left:
        Path(folder).mkdir(parents=True, exist_ok=True)
    return left


class SearchReport(Callback):
    """Hydra's callback that writes what an Optuna search has found into the sweep's folder when it ends."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        del kwargs
        sweeper, folder = config.hydra.sweeper, Path(config.hydra.sweep.dir)
        try:
            from tagjax.evaluation.study import write_study

            written = write_study(sweeper.storage, sweeper.study_name, folder)
        except ImportError as error:
            _log.warning("No report of the search: %s. Install the sweep and viz extras.", error)
            return
        if written:
            _log.info("table and pictures of the search: %s", folder)


OmegaConf.register_new_resolver("trials_left", trials_left, replace=True)
OmegaConf.register_new_resolver("search_report", lambda: f"{__name__}.{SearchReport.__name__}", replace=True)


def _without_score(config: DictConfig) -> bool:
    training, validation = (OmegaConf.select(config, f"data.{name}") for name in ("recordings", "validation"))
    overrides = OmegaConf.select(config, "hydra.overrides.task") or ()
    swept = [*overrides, *(OmegaConf.select(config, "hydra.sweeper.params") or ())]
    return bool(training) and not validation and not any("data.validation" in one for one in swept)


def sweep_score(score: float) -> float | None:
    """The number that a run returns to its sweep: None for NaN, which marks the trial as failed.

    NaN itself would end an Optuna sweep.
    """
    return None if math.isnan(score) else score
