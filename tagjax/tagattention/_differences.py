"""Differences between two sets of settings by dotted name, as text for errors."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping
from typing import Any, TypeGuard

_MISSING = object()
_TOLERANCE = 1e-5
"""By which floats may differ, as a fraction: float32 keeps a value through its logarithm and back."""


def flat(settings: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Nested settings by dotted name."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        found |= flat(value, f"{where}{name}.") if isinstance(value, Mapping) else {f"{where}{name}": value}
    return found


def same(one: Any, other: Any) -> bool:
    """Whether two values of settings are equal; floats but for rounding in float32, lists as tuples."""
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if _is_number(one) and _is_number(other):
        return math.isclose(one, other, rel_tol=_TOLERANCE)
    return type(one) is type(other) and one == other


def differences(found: Mapping[str, Any], expected: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """The names whose values differ, in order, with both values as text."""
    values = {name: (found.get(name, _MISSING), expected.get(name, _MISSING)) for name in {**found, **expected}}
    return {
        name: (shown(own, other), shown(other, own)) for name, (own, other) in values.items() if not same(own, other)
    }


def shown(value: Any, other: Any = None) -> str:
    """A value in an error; `other` is what it is compared with: a part that is not off has no value under its own name."""
    if value is _MISSING:
        return "not null" if other is None else "nothing"
    if value is None:
        return "null"
    return repr(float(f"{value:.6g}")) if isinstance(value, float) else reprlib.repr(value)


def _is_number(value: Any) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
