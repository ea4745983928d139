"""Objects from settings that name a class by `_target_`. Each place of the settings has a list of the classes it takes."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx

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
    try:
        parts = with_modules(called, parts, where=where)
    except (TypeError, ValueError) as error:
        raise ConfigError(str(error)) from error
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


def with_modules(called: Callable[..., Any], settings: Mapping[str, Any], *, where: str) -> dict[str, Any]:
    """The settings in which each mapping that stands for a Module has become one, at any depth.

    The annotations of `called` say which arguments are Modules; such a mapping holds that Module's own arguments. Lists become
    tuples. Raises `ConfigError` with the dotted path for arguments that a Module does not take, or refuses.
    """
    if not _is_module(called):
        return dict(settings)
    hints = typing.get_type_hints(called.__init__)
    parts = {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}
    for name, value in parts.items():
        classes = [one for one in (hints.get(name), *typing.get_args(hints.get(name))) if _is_module(one)]
        if classes and isinstance(value, Mapping):
            path, module = f"{where}.{name}", classes[0]
            assert module is not None
            known = inspect.signature(module).parameters
            if unknown := sorted(set(value) - set(known)):
                raise ConfigError(f"{path}: unknown key {', '.join(unknown)}; known keys are {', '.join(known)}.")
            try:
                parts[name] = module(**with_modules(module, value, where=path))
            except (TypeError, ValueError) as error:
                text = " ".join(str(error).split())
                raise ConfigError(text if text.startswith(where) else f"{path}: {text}") from error
    return parts


def _is_module(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, eqx.Module)


def find_target(settings: Mapping[str, Any], slot: Slot, *, where: str) -> Callable[..., Any]:
    """The class of the slot that `_target_` names. Raises `ConfigError` for any other name."""
    target = settings.get("_target_")
    if not isinstance(target, str) or target not in slot:
        expected = f"one of {', '.join(slot)}" if slot else "plain values without `_target_`"
        raise ConfigError(f"{where}: found _target_ {target!r}; expected {expected}.")
    return slot[target]
