"""The optimisers and learning-rate schedules of Optax that settings can name as `_target_`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PyTree

from ..core.build import Slot, build, find_target
from ..core.settings import ConfigError

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
        "rprop",
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


_MAX_NUMBER = float(jnp.finfo(jnp.float32).max)


def build_optimizer(settings: Mapping[str, Any], *, where: str = "optimizer") -> optax.GradientTransformation:
    """The optimiser of the settings, whose numbers may be schedules. Raises `ConfigError` for other names and arguments.

    Optax finds many wrong arguments only in its first step, so one step is tried with a single parameter.
    """
    optimizer = build(_checked(settings, OPTIMIZERS, where), OPTIMIZERS, where=where, inner=SCHEDULES)
    one = jnp.ones((), jnp.float32)
    try:
        with jax.numpy_dtype_promotion("standard"):  # Optax takes powers with the step's integer number
            step, _ = optimizer.update(one, optimizer.init(one), one)
        step = float(step)  # type: ignore[arg-type]  # a tree of one array
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ConfigError(f"{where}: the first step fails: {' '.join(str(error).split())[:300]}") from error
    if not math.isfinite(step):
        raise ConfigError(f"{where}: the first step is {step}; expected a finite one. Check the settings' numbers.")
    return optimizer


def _checked(settings: Mapping[str, Any], slot: Slot, where: str) -> dict[str, Any]:
    """The settings of an optimiser or schedule, whose arguments are checked to be numbers, booleans, null or schedules.

    A piecewise schedule's mapping from steps to scales gets integers as keys, which are texts in some files.
    """
    find_target(settings, slot, where=where)
    checked: dict[str, Any] = {}
    for name, value in settings.items():
        place = f"{where}.{name}"
        if name == "_target_":
            checked[name] = value
        elif isinstance(value, Mapping) and "_target_" in value:
            checked[name] = _checked(value, SCHEDULES, place)
        elif isinstance(value, Mapping) and name == "boundaries_and_scales":
            checked[name] = {_step(key, place): _number(scale, f"{place}.{key}") for key, scale in value.items()}
        else:
            is_switch = name != "learning_rate" and (value is None or isinstance(value, bool))
            checked[name] = value if is_switch else _number(value, place)
    return checked


def _number(value: Any, where: str) -> int | float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _MAX_NUMBER:
        raise ConfigError(f"{where}: found {str(value)[:60]!r} ({type(value).__name__}); expected a finite number.")
    return value


def _step(key: Any, where: str) -> int:
    text = str(key)
    if isinstance(key, bool) or not (text.isascii() and text.isdigit() and len(text) <= 9):
        raise ConfigError(f"{where}: found the step {text[:60]!r}; expected the number of a step, 0 to 999999999.")
    return int(text)


def guarded_update(
    optimizer: optax.GradientTransformation, gradient: PyTree, loss: Float[Array, ""], state: PyTree, learnable: PyTree
) -> tuple[PyTree, PyTree, Bool[Array, ""], dict[str, Float[Array, ""]]]:
    """The arrays `learnable` and the optimiser's state after an update, whether there was one, and what to log of it: a loss
    or a gradient that is not finite changes nothing.
    """
    norm = optax.tree.norm(gradient)
    usable = jnp.isfinite(norm) & jnp.isfinite(loss)
    safe = jax.tree.map(lambda g: jnp.where(usable, g, jnp.zeros_like(g)), gradient)
    with jax.numpy_dtype_promotion("standard"):  # Optax takes powers of its integer step count
        updates, after = optimizer.update(safe, state, learnable)
    moved = optax.apply_updates(learnable, updates)
    new, old = (moved, after), (learnable, state)
    (learnable, state) = jax.tree.map(lambda new, old: jnp.where(usable, new, old), new, old)
    return learnable, state, usable, {"gradient_norm": norm, "skipped": 1.0 - usable.astype(jnp.float32)}
