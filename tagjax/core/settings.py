"""Settings from plain nested values: unknown or mistyped keys are refused, and `_target_` names real alternatives."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

TARGET_PREFIXES = ("tagjax.", "optax.")


T = TypeVar("T")


class ConfigError(ValueError):
    """A configuration that cannot be used: which key, what was found, what was expected."""


def from_mapping(schema: type[T], values: Mapping[str, Any], *, where: str = "") -> T:
    """An instance of the dataclass `schema` from plain nested values, lists turned into tuples where a tuple is due.

    Raises `ConfigError` for a key that the schema does not know, one that is missing, a value of another type, or one
    that the schema itself refuses.
    """
    fields = {field.name: field for field in dataclasses.fields(schema)}  # type: ignore[arg-type]
    unknown = sorted(set(map(str, values)) - set(fields))
    if unknown:
        raise ConfigError(
            f"{where or schema.__name__}: unknown key {', '.join(map(repr, unknown))}; known are {', '.join(fields)}."
        )
    hints = typing.get_type_hints(schema)
    given = {name: _convert(hints[name], value, f"{where}.{name}".lstrip(".")) for name, value in values.items()}
    try:
        return schema(**given)
    except TypeError as error:
        raise ConfigError(f"{where or schema.__name__}: {error}.") from error
    except ValueError as error:
        raise ConfigError(f"{where or schema.__name__}: {error}") from error


def changed(settings: T, values: Mapping[str, Any], *, where: str) -> T:
    """The settings with those values that are not None in their places. Errors as of `from_mapping`."""
    given = {name: value for name, value in values.items() if value is not None}
    return from_mapping(type(settings), {**vars(settings), **given}, where=where)


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    wrong = ConfigError(f"{where}: found {value!r}; expected {getattr(hint, '__name__', str(hint))}.")
    if hint is Any:
        return value
    if origin in (types.UnionType, typing.Union):
        if value is None:
            if type(None) in arguments:
                return None
            raise wrong
        return _convert_to_any([a for a in arguments if a is not type(None)], value, where)
    if origin is Literal:
        if value not in arguments:
            raise ConfigError(f"{where}: found {value!r}; expected one of {', '.join(map(repr, arguments))}.")
        return value
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        if not isinstance(value, Mapping | hint):
            raise ConfigError(f"{where}: found {value!r}; expected keys and values.")
        return from_mapping(hint, value, where=where) if isinstance(value, Mapping) else value
    if origin is tuple:
        if isinstance(value, str) or not isinstance(value, Sequence):
            raise ConfigError(f"{where}: found {value!r}; expected a list.")
        each = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else list(arguments)
        if len(each) != len(value):
            raise ConfigError(f"{where}: found {len(value)} elements; expected {len(each)}.")
        return tuple(
            _convert(one, item, f"{where}[{i}]") for i, (one, item) in enumerate(zip(each, value, strict=True))
        )
    if origin is not None and issubclass(origin, Mapping):
        if not isinstance(value, Mapping):
            raise wrong
        return {str(key): _convert(arguments[1], item, f"{where}.{key}") for key, item in value.items()}
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):  # pyright: ignore[reportArgumentType]
        raise wrong
    return value


def _convert_to_any(hints: Sequence[Any], value: Any, where: str) -> Any:
    """The first of the alternatives that takes the value."""
    wrongs = []
    for hint in hints:
        try:
            return _convert(hint, value, where)
        except ConfigError as wrong:
            wrongs.append(wrong)
    if len(wrongs) == 1:
        raise wrongs[0]
    raise ConfigError(f"{where}: found {value!r}; none of these: " + "; ".join(str(wrong) for wrong in wrongs))


def build(settings: Mapping[str, Any], *, where: str = "_target_") -> Any:
    """Call what `_target_` names with the other keys; nested mappings with a `_target_` are built first.

    Raises `ConfigError` for a target outside this package and Optax, one that does not exist, or arguments that it does
    not take.
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
        # What a module has merely imported is not its own: no way round the prefixes.
        owner = getattr(found, "__module__", None) or ""
        if callable(found) and (owner + ".").startswith(TARGET_PREFIXES):
            return found
        break
    raise ConfigError(f"{where}: there is no {target!r} that can be called; check the spelling.")
