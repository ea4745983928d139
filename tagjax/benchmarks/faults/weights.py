"""Damaged files of weights: each is refused in one line, or gives the same values as before the damage."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ...core.array_file import ArrayFile
from ...core.json_text import json_checksum, not_float32
from ...tagattention import TagAttention
from ...tagattention.learned import load_parameters, read_learned, save_parameters
from .damaged_bytes import damaged_bytes
from .outcome import Outcome, TimeLimitError, outcome, time_limit, unclear

LIMIT_S = 20.0
_SETTINGS = {"_target_": "tagjax.tagattention.TagAttention", "whole": None}
_FILE = ArrayFile("fault-trial", 1, "arrays of the fault trial", "python -m experiments.fault_trial")
_HOSTILE: tuple[str, ...] = (
    *(
        "1e39",
        "-1e39",
        "1" + "0" * 400,
        "1e400",
        "NaN",
        "Infinity",
        "-Infinity",
        "null",
        "true",
        '"x"',
        "[]",
        "{}",
        "-1",
    ),
    *("1e-60", "[" * 5000 + "]" * 5000, '{"a":' * 500 + "0" + "}" * 500, "9" * 5000, '"\\u0000"', '"\\ud800"'),
)


def trial(number: int, seed: int, folder: Path) -> list[Outcome]:
    """Try damaged files of tracer parameters (JSON) and of arrays (safetensors), half of `number` each."""
    rng = random.Random(seed)
    return [
        outcome("weights, JSON", _json_faults(number - number // 2, rng, folder)),
        outcome("weights, safetensors", _array_faults(number // 2, rng, folder)),
    ]


def _json_faults(number: int, rng: random.Random, folder: Path) -> list[str | None]:
    tracer = TagAttention(whole=None)
    sound, path = folder / "sound.json", folder / "damaged.json"
    save_parameters(sound, tracer, _SETTINGS, {"stride": 2, "flow": "dis"}, {"seed": 3})
    content = sound.read_bytes()

    def values() -> Any:
        learned = read_learned(path)
        return learned.settings, learned.clips, load_parameters(tracer, path, _SETTINGS).physical()

    path.write_bytes(content)
    expected = values()
    found = []
    for _ in range(number):
        hostile = rng.random() < 0.5
        path.write_bytes(_hostile_json(content, rng) if hostile else damaged_bytes(content, rng))
        # A hostile file has its own checksum, so that other values than before are no fault.
        found.append(_fault(values, None if hostile else expected))
    return found


def _hostile_json(content: bytes, rng: random.Random) -> bytes:
    """The file with one value replaced, and the checksum of the new content where it has one."""
    whole = json.loads(content)
    part = whole[rng.choice(["parameters", "settings", "clips", "about"])] if rng.random() < 0.8 else whole
    part[rng.choice(list(part))] = "@"
    whole.pop("sha256", None)
    text = json.dumps(whole).replace('"@"', rng.choice(_HOSTILE))
    if rng.random() < 0.1:
        text = text[:-1] + "," + text[1:]
    try:
        changed = json.loads(text)
        return json.dumps({**changed, "sha256": json_checksum(changed)}).encode()
    except (ValueError, RecursionError, TypeError):
        return text.encode()


def _array_faults(number: int, rng: random.Random, folder: Path) -> list[str | None]:
    tree = {f"layer{n}": np.arange(6.0, dtype=np.float32).reshape(2, 3) + n for n in range(3)}
    path = folder / "damaged.safetensors"
    _FILE.write(path, tree, {"flow": {"_target_": "tagjax.flow.pyramid.PyramidFlow", "widths": [8, 8]}})
    content = path.read_bytes()

    def values() -> Any:
        arrays = _FILE.read(path, tree)
        return _FILE.metadata(path), [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(arrays)]

    expected = values()
    found = []
    for _ in range(number):
        path.write_bytes(damaged_bytes(content, rng))
        found.append(_fault(values, expected))
    return found


def _fault(values: Callable[[], Any], expected: Any) -> str | None:
    try:
        with time_limit(LIMIT_S):
            found = values()
    except (Exception, TimeLimitError) as error:
        return unclear(error, ValueError)
    if expected is not None and found != expected:
        return "silently different"
    wrong = not_float32(found)
    return f"accepted although not finite in float32: {', '.join(wrong[:3])}" if wrong else None
