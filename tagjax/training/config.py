"""The settings of a training run."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from ..core.settings import ConfigError
from ..metrics.recordings import ScoreSettings
from .hindsight import HindsightSettings
from .joint import JointSettings
from .logging import LoggerSettings
from .loop import LoopSettings
from .objective import ObjectiveSettings
from .processes import DistributedSettings
from .sources import DataSettings

RUNS_OWN = ("learned", "untrained", "initial")
"""Names of a run's or an evaluation's own tracers."""


def check_baselines(baselines: Iterable[str]) -> None:
    """Raises `ConfigError` for a baseline with the name of a run's own tracer, whose place it would take."""
    if taken := sorted({*baselines}.intersection(RUNS_OWN)):
        raise ConfigError(
            f"baselines: found {', '.join(taken)}; expected other names than {', '.join(RUNS_OWN)}, which are those of the run's "
            "own tracers. For example tracer@baselines.peer=tagattention."
        )


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """All settings of a training run."""

    tracer: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    weights: str | None = None  # initial learned parameters: `default`, a name, or a file (tagjax.tagattention.learned)
    baselines: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)  # evaluated beside the tracer
    seed: int = 0
    clip_norm: float = 1.0
    resume: bool = True  # from the run folder's newest checkpoint, if there is one
    retune: bool = False  # a resumed run may have another clip_norm and other numbers of its optimiser
    joint: JointSettings | None = None  # None: the flow is `data.clips.flow`, computed once
    data: DataSettings = dataclasses.field(default_factory=DataSettings)
    hindsight: HindsightSettings | None = (
        None  # what is learned: one of these two, and hindsight where neither is given
    )
    objective: ObjectiveSettings | None = None
    loop: LoopSettings = dataclasses.field(default_factory=LoopSettings)
    logger: LoggerSettings = dataclasses.field(default_factory=LoggerSettings)
    distributed: DistributedSettings = dataclasses.field(default_factory=DistributedSettings)
    scores: ScoreSettings = dataclasses.field(default_factory=ScoreSettings)

    def __post_init__(self) -> None:
        check_baselines(self.baselines)
        if self.hindsight is not None and self.objective is not None:
            raise ConfigError(
                "found both hindsight and objective; expected one: objective=hindsight or, say, coherent."
            )
        if self.joint is not None and isinstance(self.learned, HindsightSettings) and self.learned.learn != "reads":
            raise ConfigError(
                f"joint is on, and hindsight.learn={self.learned.learn} does not reach the flow; expected "
                "hindsight.learn=reads, or experiment=clips."
            )
        if (
            self.data.control is not None
            and isinstance(self.learned, HindsightSettings)
            and self.learned.needs_controls
        ):
            raise ConfigError(
                f"data.control is {self.data.control} and hindsight.controls is {self.learned.controls}; expected one of them: "
                "reads that are exchanged twice may belong to what is seen. Set hindsight.controls=0."
            )

    @property
    def learned(self) -> HindsightSettings | ObjectiveSettings:
        """What is learned."""
        return self.hindsight or self.objective or HindsightSettings()
