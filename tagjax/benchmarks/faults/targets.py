"""Settings from elsewhere: no function or class is called but those listed for a place of the settings."""

from __future__ import annotations

import importlib
import pkgutil
import random
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import optax

import tagjax

from ...core.build import Slot, find_target
from ...core.settings import ConfigError
from ...flow.networks import NETWORKS
from ...tagattention.tracer_settings import TRACERS
from ...training.optimizers import OPTIMIZERS, SCHEDULES
from .outcome import Outcome, joined, outcome

SLOTS: Mapping[str, Slot] = {
    "tracer": TRACERS,
    "optimizer": OPTIMIZERS,
    "learning rate": SCHEDULES,
    "flow network": NETWORKS,
}


def trial(number: int, seed: int, folder: Path) -> list[Outcome]:
    """`number` of the things that can be called in tagjax and Optax, as `_target_` of each place in turn."""
    rng = random.Random(seed)
    names = sorted({*_callables(tagjax), *_callables(optax), "os.system", "subprocess.run", "builtins.exec", ""})
    found = []
    for draw in range(number):
        (place, slot), name = list(SLOTS.items())[draw % len(SLOTS)], rng.choice(names)
        fault = None if _is_found(name, slot) is (name in slot) else name
        found.append(outcome(f"settings, {place}", [fault]))
    return joined(found)


def _is_found(name: str, slot: Slot) -> bool:
    try:
        return find_target({"_target_": name}, slot, where="settings") is slot[name]
    except ConfigError:
        return False


def _callables(package: Any) -> Iterator[str]:
    """Dotted names of what can be called in the modules of a package, whatever they import included."""
    for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        try:
            module = importlib.import_module(info.name)
        except ImportError:  # an extra that is not installed
            continue
        for name, value in vars(module).items():
            if isinstance(value, Callable):
                yield f"{info.name}.{name}"
