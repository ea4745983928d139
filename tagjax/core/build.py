"""Objects from settings that name their class or function by `_target_`, which reach no further than tagjax and Optax."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Mapping
from typing import Any

from .settings import ConfigError

TARGET_PREFIXES = ("tagjax.", "optax.")


def build(settings: Mapping[str, Any], *, where: str = "_target_") -> Any:
    """Call what `_target_` names with the other keys as arguments; nested mappings with a `_target_` are built first.

    Raises `ConfigError` for a target outside of tagjax and Optax, one that does not exist, or arguments that it does not
    take.
    """
    target = settings.get("_target_")
    if not isinstance(target, str) or not target.startswith(TARGET_PREFIXES):
        raise ConfigError(
            f"{where}: found {target!r}; expected a name that starts with {' or '.join(TARGET_PREFIXES)}."
        )
    arguments = {
        str(key): build(value, where=f"{where}.{key}") if isinstance(value, Mapping) and "_target_" in value else value
        for key, value in settings.items()
        if key != "_target_"
    }
    called = _resolve(target, where)
    try:
        return called(**arguments)
    except TypeError as error:
        raise ConfigError(f"{where}: {target} does not take these settings: {error}.") from error
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from error


def _resolve(target: str, where: str) -> Any:
    parts = target.split(".")
    for cut in range(len(parts) - 1, 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        if any(part.startswith("_") for part in parts[cut:]):
            break
        try:
            found = functools.reduce(getattr, parts[cut:], module)
        except AttributeError:
            break
        # A module's imports are not its own: they must not be a way around the prefixes.
        owner = getattr(found, "__module__", None) or ""
        if callable(found) and (owner + ".").startswith(TARGET_PREFIXES):
            return found
        break
    raise ConfigError(f"{where}: found {target!r}, which is nothing that can be called; check the spelling.")
