"""JSON of files that may be damaged or come from elsewhere: whatever is wrong with it is one `ValueError`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

MAX_DEPTH = 32
"""Of the files of this package the deepest has 6 levels."""

_MAX_FLOAT32 = float(np.finfo(np.float32).max)


def parse_json(text: str | bytes) -> Any:
    """The content of a JSON text. Raises `ValueError` for a text that is no JSON, names a key of an object twice, has more
    than `MAX_DEPTH` levels, or holds an integer of thousands of digits.
    """
    try:
        content = json.loads(text, object_pairs_hook=_without_repeats)
    except RecursionError:
        raise ValueError(f"found more than {MAX_DEPTH} levels of lists and objects; expected fewer") from None
    _check_depth(content)
    return content


def not_float32(content: Any, where: str = "") -> list[str]:
    """The dotted paths of the numbers in JSON content that are not finite after conversion to float32."""
    if isinstance(content, Mapping):
        below = [(f"{where}.{key}".lstrip("."), value) for key, value in content.items()]
    elif isinstance(content, list | tuple):
        below = [(f"{where}[{number}]", value) for number, value in enumerate(content)]
    else:
        is_number = isinstance(content, int | float) and not isinstance(content, bool)
        # An integer is compared exactly: 10**400 has no float.
        return [where] if is_number and not -_MAX_FLOAT32 <= content <= _MAX_FLOAT32 else []
    return [path for name, value in below for path in not_float32(value, name)]


def json_checksum(content: Mapping[str, Any]) -> str:
    """SHA-256 of JSON content, which depends neither on the order of keys nor on spaces."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        seen: set[str] = set()
        repeated = next(name for name, _ in pairs if name in seen or seen.add(name))
        raise ValueError(f"found the key {repeated[:80]!r} twice; expected it once")
    return content


def _check_depth(content: Any, depth: int = 0) -> None:
    if depth > MAX_DEPTH:
        raise ValueError(f"found more than {MAX_DEPTH} levels of lists and objects; expected fewer")
    for value in content.values() if isinstance(content, dict) else content if isinstance(content, list) else ():
        _check_depth(value, depth + 1)
