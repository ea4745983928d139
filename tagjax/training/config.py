"""The settings of a training run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from ..metrics.recordings import ScoreSettings
from .joint import JointSettings
from .logging import LoggerSettings
from .loop import LoopSettings
from .objective import ObjectiveSettings
from .processes import DistributedSettings
from .sources import DataSettings


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
    objective: ObjectiveSettings = dataclasses.field(default_factory=ObjectiveSettings)
    loop: LoopSettings = dataclasses.field(default_factory=LoopSettings)
    logger: LoggerSettings = dataclasses.field(default_factory=LoggerSettings)
    distributed: DistributedSettings = dataclasses.field(default_factory=DistributedSettings)
    scores: ScoreSettings = dataclasses.field(default_factory=ScoreSettings)
