"""Learned tracer parameters as plain numbers: one JSON file with the tracer's settings, the clip settings and the recipe.

Nothing in a file is executed: it names numbers, which take the place of parameters that the tracer has already, and the
clip settings of the training, with which the tracer is evaluated unless others are given. Parameters and static settings
have their dotted names (`body.rigid.noise_m`). A checksum shows damage.
"""

from __future__ import annotations

import dataclasses
import json
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import equinox as eqx

from ..core.build import build
from ..core.constrained import static_settings
from ..core.files import write_atomic
from ..core.json_text import json_checksum, not_float32, parse_json
from ._differences import differences, flat, same, shown

PACKAGED = Path(__file__).parent / "weights"
"""Where the parameters that come with the package lie, as <name>.json."""

_FORMAT = "tagjax-tracer-parameters"
_VERSION = 4
_MAX_BYTES = 1_000_000
_CHECKSUM = "sha256"

CLIP_NAMES = ("stride", "window", "flow", "estimator", "antennas")
"""Clip settings that change a tracer's results; `max_reads` and `length` are sizes of buffers."""


@runtime_checkable
class LearnableTracer(Protocol):
    """A tracer (a Module) whose parameters have names, and values in physical units."""

    def physical(self) -> dict[str, float]: ...

    def with_physical(self, values: Mapping[str, float]) -> Any: ...


TracerT = TypeVar("TracerT", bound=LearnableTracer)


def packaged_parameters() -> tuple[str, ...]:
    """Names of the parameters that come with the package."""
    return tuple(sorted(path.stem for path in PACKAGED.glob("*.json")))


@dataclasses.dataclass(frozen=True)
class Learned:
    """A file of learned parameters."""

    path: Path
    settings: Mapping[str, Any]  # of the tracer, with the values that learning began from
    static: Mapping[str, Any]  # settings that are not learned, by dotted name
    clips: Mapping[str, Any]  # clip settings of the training: stride, window, flow, estimator, antennas
    parameters: Mapping[str, float]  # in physical units, by dotted name
    default: bool  # whether `default` may mean this file
    about: Any  # for people: how it was learned

    def unmoved(self, began: Mapping[str, Any]) -> set[str]:
        """Parameters that still have the value that learning began from."""
        return {name for name, value in self.parameters.items() if name in began and same(value, began[name])}


def save_parameters(
    path: str | Path,
    tracer: LearnableTracer,
    settings: Mapping[str, Any],
    clips: Mapping[str, Any],
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write a tracer's parameters in physical units.

    `settings` are those that the tracer was built with, as under conf/tracer. `clips` are the clip settings of its training
    that change its results (`CLIP_NAMES`); a flow in a file beside `path` is named relative to it. `about` is for people:
    recipe, seed, data, scores. Raises `ValueError` for values that are not finite in float32.
    """
    path = Path(path)
    chosen = {name: clips[name] for name in CLIP_NAMES if name in clips}
    if isinstance(flow := chosen.get("flow"), str) and Path(flow).parent == path.parent:
        chosen["flow"] = Path(flow).name
    content = {
        "format": _FORMAT,
        "version": _VERSION,
        "settings": without_clips(settings),
        "static": _static(tracer),
        "clips": chosen,
        "parameters": tracer.physical(),
        "about": dict(about or {}),
    }
    _write(path, content)


def renew_checksum(path: str | Path) -> None:
    """Write the checksum of a file of learned parameters again, after it was edited on purpose.

    Raises `ValueError` for a file of another kind, and for values that are not finite in float32.
    """
    path = Path(path)
    _write(path, _content(path))


def _write(path: Path, content: Mapping[str, Any]) -> None:
    content = {name: value for name, value in content.items() if name != _CHECKSUM}
    if wrong := not_float32(content):
        raise ValueError(
            f"{path}: {', '.join(wrong[:5])}: not finite in float32; expected finite numbers. Train again."
        )
    # The checksum is that of the text, in which tuples are lists.
    checksum = json_checksum(json.loads(json.dumps(content)))
    write_atomic(path, json.dumps({**content, _CHECKSUM: checksum}, indent=1, allow_nan=False) + "\n")


def read_learned(source: str | Path, settings: Mapping[str, Any] | None = None) -> Learned:
    """A file of `save_parameters`, packaged parameters by name, or `default`.

    `default` means the packaged parameters that were learned from these tracer `settings`; without settings, those that are
    the package's default. Raises `ValueError` where there are none, and for a file that is damaged or of another kind.
    """
    return _default_for(settings) if str(source) == "default" else _read(_find(source))


def load_parameters(tracer: TracerT, source: str | Path, settings: Mapping[str, Any]) -> TracerT:
    """The tracer with learned parameters in place of its own; `source` and errors as of `read_learned`.

    `settings` are those that the tracer was built with. Raises `ValueError` also for parameters of another tracer, for
    other static settings than the file's (floats may differ by 1e-5 of their value), and for other initial values than the
    learning began from. A parameter that learning left unchanged may have any value.
    """
    found = read_learned(source, settings)
    _check_target(found, settings)
    wanted = _built(tracer, settings)
    _check_static(found.path, _static(wanted), found.static)
    began = _began(tracer, found)
    learned, unmoved = dict(found.parameters), found.unmoved(began)
    for name, asked in wanted.physical().items():
        if name not in began or same(asked, began[name]):
            continue
        if name not in unmoved:
            raise ValueError(
                f"{found.path}: found tracer.{name}={shown(asked)}; expected {shown(began[name])}, from which these "
                f"parameters were learned: the learned value would replace yours. Leave out {name}, or weights=."
            )
        learned[name] = asked
    try:
        return tracer.with_physical(learned)
    except ValueError as error:
        raise ValueError(f"{found.path}: {error} Use the tracer that these parameters were learned with.") from error


def _check_target(found: Learned, settings: Mapping[str, Any]) -> None:
    learned, asked = found.settings.get("_target_"), settings.get("_target_")
    if learned != asked:
        raise ValueError(
            f"{found.path}: found parameters of the tracer {str(learned)[:100]}; expected those of {asked}. Choose the "
            "tracer that they were learned with (tracer=), or other weights (weights=)."
        )


def _check_static(path: Path, asked: Mapping[str, Any], learned: Mapping[str, Any]) -> None:
    if apart := differences(asked, learned):
        some = list(apart.items())[:3]
        found, expected = (", ".join(f"tracer.{name}={both[side]}" for name, both in some) for side in (0, 1))
        more = f" ({len(apart) - 3} further settings differ)" if len(apart) > 3 else ""
        raise ValueError(
            f"{path}: found {found}; expected {expected}, with which these parameters were learned{more}. Set the expected "
            "values, or leave out weights= and train again."
        )


def _built(tracer: TracerT, settings: Mapping[str, Any]) -> TracerT:
    """A tracer of the same class from other settings. Raises `ConfigError` for settings that it does not take."""
    return build(without_clips(settings), {str(settings.get("_target_")): type(tracer)}, where="tracer")


def _began(tracer: LearnableTracer, found: Learned) -> dict[str, float]:
    """The values that learning began from, by the names of parameters."""
    try:
        return _built(tracer, found.settings).physical()
    except ValueError as error:
        raise ValueError(
            f"{found.path}: found settings that the tracer does not take ({str(error)[:300]}); expected those of its training. "
            "Copy the file again, or train again."
        ) from error


def _static(tracer: LearnableTracer) -> dict[str, Any]:
    assert isinstance(tracer, eqx.Module)
    return static_settings(tracer)


def without_clips(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that a tracer is built with: those of its configuration but for `clips`."""
    return {name: value for name, value in settings.items() if name != "clips"}


def _find(source: str | Path) -> Path:
    if str(source) in packaged_parameters():
        return PACKAGED / f"{source}.json"
    if str(source).endswith(".json") and Path(source).is_file():
        return Path(source)
    there = ", ".join(packaged_parameters()) or "none"
    raise ValueError(
        f"No learned parameters at {str(source)!r}; expected the path of a .json file (a run folder's weights.json), "
        f"`default`, or the name of packaged ones ({there})."
    )


def _default_for(settings: Mapping[str, Any] | None) -> Learned:
    found = [one for name in packaged_parameters() if (one := _read(PACKAGED / f"{name}.json")).default]
    for one in found:
        if settings is None:
            return one
        began, asked = flat(one.settings), flat(without_clips(settings))
        if differences(asked, began).keys() <= one.unmoved(began):
            return one
    there = ", ".join(packaged_parameters()) or "none"
    raise ValueError(
        f"weights=default: no packaged parameters were learned from these settings of {(settings or {}).get('_target_')} "
        f"(packaged are: {there}). Leave the settings at their defaults, or give a name or a file."
    )


def _read(path: Path) -> Learned:
    content = _content(path)
    needed = ["settings", "static", "clips", "parameters"]
    if lacking := [name for name in needed if not isinstance(content.get(name), dict)]:
        raise ValueError(f"{path}: found no {', '.join(lacking)}; expected {', '.join(needed)}. Copy the file again.")
    wrong = [name for name, value in content["parameters"].items() if not _is_number(value)]
    if wrong:
        raise ValueError(f"{path}: {', '.join(wrong)}: not a number; expected one. Train again.")
    checked = {name: value for name, value in content.items() if name != _CHECKSUM}
    if wrong := not_float32(checked):
        raise ValueError(
            f"{path}: {', '.join(wrong[:5])}: not finite in float32; expected finite numbers. Train again."
        )
    default = content.get("default", True)
    if not isinstance(default, bool):
        raise ValueError(f"{path}: found default={default!r}; expected true or false. Copy the file again.")
    if content.get(_CHECKSUM) != json_checksum(checked):
        raise ValueError(
            f"{path}: the content does not have the checksum of the file: it is damaged or was edited. Copy it again; after an "
            "edit on purpose call tagjax.tagattention.learned.renew_checksum."
        )
    clips = dict(content["clips"])
    if isinstance(flow := clips.get("flow"), str) and _is_file(path.parent / flow):
        clips["flow"] = str(path.parent / flow)
    parameters = {name: float(value) for name, value in content["parameters"].items()}
    return Learned(path, content["settings"], content["static"], clips, parameters, default, content.get("about"))


def _content(path: Path) -> dict[str, Any]:
    """The JSON of a file of learned parameters of this version. Raises `ValueError` for any other file."""
    try:
        if (size := path.stat().st_size) > _MAX_BYTES:
            raise ValueError(f"found {size} bytes; expected at most {_MAX_BYTES}")
        content = parse_json(path.read_bytes().decode("utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{path}: no learned parameters ({type(error).__name__}: {error}); expected JSON of `python -m experiments.train`. "
            "Copy the file again."
        ) from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise ValueError(f"{path}: found JSON, but no learned parameters; expected the format {_FORMAT}.")
    if content.get("version") != _VERSION:
        raise ValueError(
            f"{path}: version {reprlib.repr(content.get('version'))}; this release reads {_VERSION}. Train again."
        )
    return content


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is too long
        return False
