"""Objects from settings that name a class by `_target_`. Each place of the settings has a list of the classes it takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from .settings import ConfigError

Slot = Mapping[str, Callable[..., Any]]
"""What `_target_` may name in one place of the settings: the class or function of each name. Nothing else is called."""


def build(settings: Mapping[str, Any], slot: Slot, *, where: str = "_target_", inner: Slot | None = None) -> Any:
    """Call what `_target_` names with the other keys as arguments.

    `_target_` is looked up in `slot`, and that of a nested mapping, which is built first, in `inner`; no module is
    imported by name. All names are checked before anything is called. Raises `ConfigError` for a name that is not in the
    slot, or arguments that its class does not take.
    """
    called = find_target(settings, slot, where=where)
    parts = {str(key): value for key, value in settings.items() if key != "_target_"}
    nested = {key: value for key, value in parts.items() if isinstance(value, Mapping) and "_target_" in value}
    for key, value in nested.items():
        find_target(value, inner or {}, where=f"{where}.{key}")
    for key, value in nested.items():
        parts[key] = build(value, inner or {}, where=f"{where}.{key}")
    try:
        return called(**parts)
    except TypeError as error:
        text = " ".join(str(error).split())
        raise ConfigError(f"{where}: {settings['_target_']} does not take these settings: {text}.") from error
    except (ArithmeticError, AttributeError, LookupError, ValueError) as error:
        raise ConfigError(f"{where}: {' '.join(str(error).split())}") from error


def find_target(settings: Mapping[str, Any], slot: Slot, *, where: str) -> Callable[..., Any]:
    """The class of the slot that `_target_` names. Raises `ConfigError` for any other name."""
    target = settings.get("_target_")
    if not isinstance(target, str) or target not in slot:
        expected = f"one of {', '.join(slot)}" if slot else "plain values without `_target_`"
        raise ConfigError(f"{where}: found _target_ {target!r}; expected {expected}.")
    return slot[target]
