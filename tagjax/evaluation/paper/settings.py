"""Settings of `experiments.paper`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from ...baselines.tagview import TagviewSettings
from ...baselines.tagview.experiment.run import Matching
from ...baselines.tagvision import TagVisionSettings
from ...baselines.tagvision.experiment.simulated_calibration import CalibrationSettings
from ...core.settings import ConfigError
from ...metrics.recordings import ScoreSettings
from ...recording.suite_folder import SPLITS

LEARNABLE, PUBLISHED = "tagattention", "published"
"""Names of the two tracers in `PaperConfig.tracers`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaperConfig:
    """Which figures are drawn, and of which recordings.

    `suites` holds the settings of each suite by name, as in the files of conf/suite; `tracers` those of `tagattention`
    and `published`, as under conf/tracer.
    """

    figure: int | str | tuple[int | str, ...]
    suites: Mapping[str, Mapping[str, Any]]
    tracers: Mapping[str, Mapping[str, Any]]
    scores: ScoreSettings = dataclasses.field(default_factory=ScoreSettings)
    tagview: TagviewSettings = dataclasses.field(default_factory=TagviewSettings)
    tagview_matching: Mapping[str, Matching] = dataclasses.field(default_factory=dict)
    tagvision: TagVisionSettings = dataclasses.field(default_factory=TagVisionSettings)
    calibration: CalibrationSettings = dataclasses.field(default_factory=CalibrationSettings)
    recordings_dir: str = "recordings"
    splits: tuple[str, ...] = ("test",)
    max_recordings: int | None = None  # of each variant and split; all if None
    width: int | None = None  # of simulated pictures; the suite's own if None
    smoke: bool = False
    simulate: bool | None = None  # missing recordings; None: for figures that are named, and not for all
    workers: int = 1  # processes that simulate

    def __post_init__(self) -> None:
        unknown = sorted(set(self.splits) - set(SPLITS))
        if unknown or not self.splits:
            found = ", ".join(unknown) or "none"
            raise ConfigError(f"splits: found {found}; expected some of {', '.join(SPLITS)}.")
        if missing := {LEARNABLE, PUBLISHED} - set(self.tracers):
            raise ConfigError(f"tracers: found no {', '.join(sorted(missing))}; expected {LEARNABLE} and {PUBLISHED}.")
        if self.max_recordings is not None and self.max_recordings < 1:
            raise ConfigError(f"max_recordings is {self.max_recordings}; expected at least 1, or null for all.")
        if self.workers < 1:
            raise ConfigError(f"workers is {self.workers}; expected at least 1 process.")

    def figures(self) -> tuple[str, ...]:
        """The names as they are given; `all` is one of them."""
        given = self.figure if isinstance(self.figure, tuple) else (self.figure,)
        return tuple(str(one) for one in given)

    def simulates(self) -> bool:
        """Whether missing recordings are simulated."""
        return "all" not in self.figures() if self.simulate is None else self.simulate
