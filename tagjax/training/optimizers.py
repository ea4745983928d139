"""The optimisers and learning-rate schedules of Optax that settings can name as `_target_`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import optax

from ..core.build import build

OPTIMIZERS = {
    f"optax.{name}": getattr(optax, name)
    for name in (
        "adabelief",
        "adagrad",
        "adam",
        "adamax",
        "adamw",
        "amsgrad",
        "lamb",
        "lion",
        "nadam",
        "nadamw",
        "novograd",
        "radam",
        "rmsprop",
        "sgd",
        "yogi",
    )
}

SCHEDULES = {
    f"optax.{name}": getattr(optax, name)
    for name in (
        "constant_schedule",
        "cosine_decay_schedule",
        "cosine_onecycle_schedule",
        "exponential_decay",
        "linear_onecycle_schedule",
        "linear_schedule",
        "piecewise_constant_schedule",
        "polynomial_schedule",
        "warmup_constant_schedule",
        "warmup_cosine_decay_schedule",
        "warmup_exponential_decay_schedule",
    )
}


def build_optimizer(settings: Mapping[str, Any], *, where: str = "optimizer") -> optax.GradientTransformation:
    """The optimiser of the settings, whose numbers may be schedules. Raises `ConfigError` for other names and arguments."""
    return build(settings, OPTIMIZERS, where=where, inner=SCHEDULES)
