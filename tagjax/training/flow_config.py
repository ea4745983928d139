"""The settings of a run that trains a flow network."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

from ..core.settings import ConfigError
from ..flow.losses import FlowLossSettings
from .flow_sources import FlowDataSettings
from .logging import LoggerSettings
from .loop import LoopSettings
from .processes import DistributedSettings


@dataclasses.dataclass(frozen=True)
class TrainFlowConfig:
    """All settings of a training run of a flow network."""

    flow: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    weights: str | None = None  # initial weights: `default` or a file; random if None
    seed: int = 0
    clip_norm: float = 1.0
    average_over: int = 500  # steps over which the weights are averaged; the average is what is saved
    matmul_precision: Literal["bfloat16", "tensorfloat32", "float32"] | None = (
        None  # of matrix products; None is JAX's default
    )
    resume: bool = True
    retune: bool = False
    data: FlowDataSettings = dataclasses.field(default_factory=FlowDataSettings)
    loss: FlowLossSettings = dataclasses.field(default_factory=FlowLossSettings)
    loop: LoopSettings = dataclasses.field(default_factory=LoopSettings)
    logger: LoggerSettings = dataclasses.field(default_factory=LoggerSettings)
    distributed: DistributedSettings = dataclasses.field(default_factory=DistributedSettings)

    def __post_init__(self) -> None:
        if self.average_over < 1:
            raise ConfigError(f"average_over is {self.average_over}; expected at least 1 step.")
