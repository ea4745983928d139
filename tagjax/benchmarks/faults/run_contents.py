"""The contents of run folders and of folders of recordings as digests, so that two of them can be compared."""

from __future__ import annotations

import hashlib
import json
import warnings
from pathlib import Path

import numpy as np
import orbax.checkpoint as ocp
import safetensors.numpy

_VARYING = ("elapsed_s_in_this_call", "steps_in_this_call", "machine")
"""Keys of metrics.json that differ between runs with the same result."""

DAMAGED = "damaged"
"""Stands for the digest of a checkpoint that cannot be read."""


def recording_contents(folder: Path) -> dict[str, str]:
    """Every visible file of recordings, suites and their pictures, by its path in the folder."""
    return {str(path.relative_to(folder)): _digest(path.read_bytes()) for path in _visible_files(folder)}


def run_contents(folder: Path) -> dict[str, str]:
    """The files, checkpoints and logged steps of a run; of files with times and places only what does not depend on them."""
    found: dict[str, str] = {}
    for path in _visible_files(folder):
        name = str(path.relative_to(folder))
        if path.suffix == ".log" or name.startswith("checkpoints/"):
            continue
        if path.suffix == ".safetensors":
            arrays = safetensors.numpy.load_file(path)
            found[name] = _digest(b"".join(key.encode() + arrays[key].tobytes() for key in sorted(arrays)))
        elif path.name == "metrics.json":
            values = {key: value for key, value in json.loads(path.read_text()).items() if key not in _VARYING}
            found[name] = _digest(json.dumps(values, sort_keys=True).encode())
        elif path.name == "metrics.jsonl":  # grows by lines; a last one without its end is dropped when the run resumes
            lines = path.read_text().splitlines(keepends=True)
            found |= {f"{name}, line {number}": line for number, line in enumerate(lines) if line.endswith("\n")}
        elif name in ("run.json", "report.html"):  # both hold times, and the run's command
            found[name] = "there"
        elif path.name == "config.yaml":
            found[name] = path.read_text().replace(str(folder), "<folder>")
        else:
            found[name] = _digest(path.read_bytes())
    return found | _checkpoints(folder / "checkpoints")


def _checkpoints(folder: Path) -> dict[str, str]:
    """Every checkpoint: its arrays, and what is written beside them."""
    if not folder.is_dir():
        return {}
    found = {}
    options = ocp.CheckpointManagerOptions(create=False)
    with warnings.catch_warnings(), ocp.CheckpointManager(folder, options=options) as manager:
        warnings.simplefilter("ignore")  # Orbax guesses how arrays are placed on devices
        for step in manager.all_steps():
            arguments = ocp.args.Composite(arrays=ocp.args.StandardRestore(), about=ocp.args.JsonRestore())
            try:
                parts = manager.restore(step, args=arguments)
            except Exception:  # of many kinds
                found[f"checkpoint {step}"] = DAMAGED
                continue
            arrays = {name: np.asarray(leaf) for name, leaf in parts["arrays"].items()}
            content = b"".join(name.encode() + arrays[name].tobytes() for name in sorted(arrays))
            found[f"checkpoint {step}"] = _digest(content + json.dumps(parts["about"], sort_keys=True).encode())
    return found


def _visible_files(folder: Path) -> list[Path]:
    return [
        path
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
