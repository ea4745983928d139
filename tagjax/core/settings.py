"""Checked settings: frozen dataclasses made from the plain dictionaries of a YAML file, validated by pydantic.

A schema is a frozen dataclass. `from_mapping` refuses unknown keys and values of another type at any depth, without
conversion between types (the text "1" is no number), and reports the first fault as one line: the dotted path, what was
found, what was expected.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

T = TypeVar("T")

_STRICT = ConfigDict(extra="forbid")
_WORDS = {
    bool: "true or false",
    int: "int (a whole number)",
    float: "float (a number)",
    str: "str (a text)",
    type(None): "null",
}


class ConfigError(ValueError):
    """Settings that cannot be used: the dotted path, what was found, what was expected."""


def from_mapping(schema: type[T], values: Mapping[str, Any], *, where: str = "") -> T:
    """An instance of the dataclass `schema` from plain nested values; lists become tuples where the schema has tuples.

    `where` is the dotted path of `values` in the configuration, for error messages. Raises `ConfigError` for an unknown
    or missing key, a value of another type, or a value that the schema's own `__post_init__` refuses.
    """
    # JSON in strict mode: a list is a tuple and a whole number is a float, and nothing else is converted.
    text = json.dumps(dict(values), default=_plain)
    try:
        return _adapter(schema).validate_json(text, strict=True)
    except ValidationError as error:
        raise ConfigError(_message(error, schema, json.loads(text), where)) from error


def changed(settings: T, values: Mapping[str, Any], *, where: str) -> T:
    """A copy of `settings` in which those of `values` that are not None replace the old ones. Errors as `from_mapping`."""
    given = {name: value for name, value in values.items() if value is not None}
    return from_mapping(type(settings), {**vars(settings), **given}, where=where)


@functools.cache
def _adapter(schema: type) -> Any:  # a TypeAdapter, which the runtime type checker does not know
    _forbid_unknown_keys(schema)
    return TypeAdapter(schema)


def _forbid_unknown_keys(hint: Any) -> None:
    """Set pydantic's option on every dataclass that a value of this type may hold: by itself it ignores unknown keys."""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type) and "__pydantic_config__" not in vars(hint):
        hint.__pydantic_config__ = _STRICT  # type: ignore[attr-defined]
        for each in typing.get_type_hints(hint).values():
            _forbid_unknown_keys(each)
    for each in typing.get_args(hint):
        _forbid_unknown_keys(each)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return dict(value)
    raise ConfigError(f"found {value!r} of type {type(value).__name__}; expected plain values, lists and mappings.")


def _message(error: ValidationError, schema: type, values: Any, where: str) -> str:
    """The first fault as one line."""
    faults = error.errors(include_url=False)
    fault = faults[0]
    path, hint, found = _follow(fault["loc"], schema, values)
    place = _dotted(where, path)
    if fault["type"] == "unexpected_keyword_argument":
        parent = path[:-1]
        unknown = [str(one["loc"][-1]) for one in faults if one["type"] == fault["type"] and one["loc"][:-1] == parent]
        return _unknown_keys(unknown, _follow(parent, schema, values)[1], _dotted(where, parent) or schema.__name__)
    if fault["type"] in ("value_error", "assertion_error"):
        return f"{place or schema.__name__}: {fault.get('ctx', {}).get('error', fault['msg'])}"
    if fault["type"] in ("missing", "missing_argument") and not isinstance(path[-1], int):
        return f"{_dotted(where, path[:-1]) or schema.__name__}: no key {path[-1]!r}; expected one: {_expected(hint)}."
    if fault["type"] in ("missing", "too_long"):  # a tuple of fixed length
        whole = path[:-1] if fault["type"] == "missing" else path
        _, hint, found = _follow(whole, schema, values)
        return f"{_dotted(where, whole)}: found {len(found)} elements; expected {len(_tuple_hints(hint))}."
    return f"{place or schema.__name__}: found {found!r}; expected {_expected(hint)}."


def _unknown_keys(unknown: Sequence[str], schema: Any, place: str) -> str:
    known = [field.name for field in dataclasses.fields(_without_none(schema))]
    close = difflib.get_close_matches(unknown[0], known, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else "."
    return f"{place}: unknown key {', '.join(map(repr, unknown))}; known keys are {', '.join(known)}{hint}"


def _follow(location: Sequence[int | str], hint: Any, values: Any) -> tuple[tuple[int | str, ...], Any, Any]:
    """The path of a fault, the type at its end, and the value found there.

    The path ends at a union of several types: what pydantic adds below names the alternative that it tried.
    """
    path: list[int | str] = []
    for step in location:
        inner = _without_none(hint)
        if _is_union(inner):
            break
        path.append(step)
        if dataclasses.is_dataclass(inner):
            hint = typing.get_type_hints(inner).get(str(step), Any)
        elif typing.get_origin(inner) is tuple:
            arguments = _tuple_hints(inner)
            hint = arguments[0] if arguments[-1] is Ellipsis else arguments[min(int(step), len(arguments) - 1)]
        elif typing.get_args(inner):
            hint = typing.get_args(inner)[-1]
        inside = isinstance(values, Mapping) and step in values
        inside |= isinstance(values, list) and isinstance(step, int) and step < len(values)
        values = values[step] if inside else None
    return tuple(path), hint, values


def _dotted(where: str, path: Sequence[int | str]) -> str:
    return "".join([where, *(f"[{one}]" if isinstance(one, int) else f".{one}" for one in path)]).lstrip(".")


def _is_union(hint: Any) -> bool:
    return typing.get_origin(hint) in (types.UnionType, typing.Union)


def _without_none(hint: Any) -> Any:
    """The type without None, if only one alternative then remains."""
    if _is_union(hint):
        others = [one for one in typing.get_args(hint) if one is not type(None)]
        return others[0] if len(others) == 1 else hint
    return hint


def _tuple_hints(hint: Any) -> tuple[Any, ...]:
    return typing.get_args(_without_none(hint))


def _expected(hint: Any) -> str:
    """A type in words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if _is_union(hint):
        return " or ".join(_expected(one) for one in arguments)
    if origin is Literal:
        return f"one of {', '.join(map(repr, arguments))}" if len(arguments) > 1 else repr(arguments[0])
    if origin is tuple:
        return f"a list of {_expected(arguments[0])}"
    if dataclasses.is_dataclass(hint) or (isinstance(origin, type) and issubclass(origin, Mapping)):
        return "keys and values"
    return _WORDS.get(hint, str(getattr(hint, "__name__", hint)))
