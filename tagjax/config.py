"""Typed schemas of every configuration, and the helpers that turn plain dictionaries into them.

YAML under conf/ is the home of a run's tunables: a schema names what may be set and of which type, and an unknown or
mistyped key is refused. Its own defaults are those of the YAML, but for the training of flow networks. Real alternatives are named by `_target_` and built by `build`, which reaches no further
than this package and Optax.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

from .data.clips import Antennas, Estimator, check_clip
from .evaluation.evaluate import ScoreSettings
from .flow.losses import FlowLossSettings
from .training.flow_sources import FlowDataSettings
from .training.logging import LoggerSettings
from .training.loop import LoopSettings
from .training.loss import ObjectiveSettings
from .training.processes import DistributedSettings

TARGET_PREFIXES = ("tagjax.", "optax.")

T = TypeVar("T")


class ConfigError(ValueError):
    """A configuration that cannot be used: which key, what was found, what was expected."""


@dataclasses.dataclass(frozen=True)
class ClipSettings:
    """How recordings become clips."""

    stride: int = 4  # every n-th pixel in both directions
    window: int = 5  # frames in a motion vector (k)
    max_reads: int = 64  # reads of one tag in a window
    flow: str = "dis"
    estimator: Estimator = "robust"  # of the tags' distances
    antennas: Antennas = None  # that distances are to: `all`, numbers from 1, or the one with the most reads if None
    length: int = 24  # frames of a training clip
    epcs: tuple[str, ...] | None = None  # all that were read
    least_motion: float = 0.1  # training clips in which no tag is heard to move by so much are not drawn; 0 draws all
    most_tags: int | None = None  # of a training clip: the one that moves most, others by chance; all if None
    workers: int = 0  # processes that load training clips; with none a thread does

    def __post_init__(self) -> None:
        check_clip(stride=self.stride, window=self.window, max_reads=self.max_reads)
        if self.length < self.window:
            raise ConfigError(f"length is {self.length}; expected at least the window's {self.window} frames.")
        if not 0 <= self.least_motion < 1:
            raise ConfigError(f"least_motion is {self.least_motion}; expected a share of coherence, 0 to less than 1.")
        if self.most_tags is not None and self.most_tags < 1:
            raise ConfigError(f"most_tags is {self.most_tags}; expected at least 1 tag, or null for all.")

    def arguments(self) -> dict[str, Any]:
        """What `load_clip` and `clip_dataset` both take, by name."""
        names = ("stride", "flow", "window", "max_reads", "estimator", "antennas")
        return {name: getattr(self, name) for name in names}


@dataclasses.dataclass(frozen=True)
class VirtualTagSettings:
    """Virtual tags for recordings whose tracks are known: each label in turn, by itself, at the full read rate."""

    tracks: str | None = None  # CSV: frame,person,x_m,y_m,z_m,range_m,visible
    labels: str | None = None  # folder of label masks NNNNNNNN.png
    seeds: tuple[int, ...] = (0,)
    reader: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # fields of the reader's settings

    def __post_init__(self) -> None:
        if not self.seeds:
            raise ConfigError("seeds is empty; expected at least one: a reader and its noise are drawn for each.")
        if self.tracks is None and (self.labels, self.seeds, dict(self.reader)) != (None, (0,), {}):
            raise ConfigError(
                "tracks is null, so there is no virtual tag; give tracks (a CSV file), or nothing of the rest."
            )


@dataclasses.dataclass(frozen=True)
class DataSettings:
    """Training and validation recordings: those named, or the train and validation split of a simulated suite."""

    recordings: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    clips: ClipSettings = dataclasses.field(default_factory=ClipSettings)
    suite: Mapping[str, Any] | None = None  # settings of a suite (tagjax.sim.suites.Suite), used without `recordings`
    suites_folder: str = "recordings/benchmark"  # where suites lie; missing recordings are simulated into it
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)


@dataclasses.dataclass(frozen=True)
class JointSettings:
    """A flow network that learns with the tracer."""

    flow: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    init: str | None = "default"  # weights to begin with: `default` or a file; random ones if None
    clip_norm: float = 1.0
    weight: float = 1.0  # of the network's own loss beside the tracer's objective
    loss: FlowLossSettings = dataclasses.field(default_factory=lambda: FlowLossSettings(occlusion_after=0))

    def __post_init__(self) -> None:
        if self.weight < 0:
            raise ConfigError(f"weight is {self.weight}; expected 0 or more.")
        if self.loss.self_supervision > 0:
            raise ConfigError("loss.self_supervision is of experiments.train_flow only; expected 0.")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Everything of a training run."""

    tracer: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    weights: str | None = None  # learned parameters to begin with: `default`, a name, or a file (tagjax.learned)
    baselines: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)  # evaluated beside it
    baseline_estimators: Mapping[str, str] = dataclasses.field(default_factory=dict)  # where not the clips' own
    seed: int = 0
    clip_norm: float = 1.0
    resume: bool = True  # go on from the run folder's newest checkpoint, if it holds one
    retune: bool = False  # then with another clip_norm or optimiser than it was begun with
    joint: JointSettings | None = None  # without it flow is `data.clips.flow`, computed once
    data: DataSettings = dataclasses.field(default_factory=DataSettings)
    objective: ObjectiveSettings = dataclasses.field(default_factory=ObjectiveSettings)
    loop: LoopSettings = dataclasses.field(default_factory=LoopSettings)
    logger: LoggerSettings = dataclasses.field(default_factory=LoggerSettings)
    distributed: DistributedSettings = dataclasses.field(default_factory=DistributedSettings)
    scores: ScoreSettings = dataclasses.field(default_factory=ScoreSettings)


@dataclasses.dataclass(frozen=True)
class TrainFlowConfig:
    """Everything of a run that trains a flow network."""

    flow: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    weights: str | None = None  # to begin with: `default` or a file; random ones if None
    seed: int = 0
    clip_norm: float = 1.0
    average_over: int = 500  # steps that the kept weights are a running average of
    matmul_precision: Literal["bfloat16", "tensorfloat32", "float32"] | None = (
        None  # of products; None is JAX's default
    )
    resume: bool = True
    retune: bool = False
    data: FlowDataSettings = dataclasses.field(default_factory=FlowDataSettings)
    loss: FlowLossSettings = dataclasses.field(default_factory=FlowLossSettings)
    loop: LoopSettings = dataclasses.field(default_factory=LoopSettings)
    logger: LoggerSettings = dataclasses.field(default_factory=LoggerSettings)
    distributed: DistributedSettings = dataclasses.field(default_factory=DistributedSettings)

    def __post_init__(self) -> None:
        if self.average_over < 1:
            raise ConfigError(f"average_over is {self.average_over}; expected at least 1 step.")


@dataclasses.dataclass(frozen=True)
class EvaluateConfig:
    """Everything of an evaluation. What is None is taken from the run."""

    run: str | None = None  # a run folder of experiments.train; without it `tracer` is evaluated untrained
    checkpoint: int | None = None  # step; the newest if None
    tracer: Mapping[str, Any] | None = None
    weights: str | None = None  # learned parameters of `tracer`: `default`, a name, or a file (tagjax.learned)
    recordings: tuple[str, ...] = ()
    epcs: tuple[str, ...] | None = None
    stride: int | None = None
    frames: tuple[int, int] | None = None
    clips: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # in place of the run's, or of `ClipSettings`
    baselines: Mapping[str, Mapping[str, Any]] | None = None
    baseline_estimators: Mapping[str, str] | None = None
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)
    scores: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # in place of the run's, or of `ScoreSettings`
    progress: bool = True

    def __post_init__(self) -> None:
        if self.stride is not None:
            check_clip(stride=self.stride)
        changed(ClipSettings(), self.clips, where="clips")
        changed(ScoreSettings(), self.scores, where="scores")
        for name, other in (("tracer", self.tracer), ("weights", self.weights)):
            if self.run is not None and other is not None:
                raise ConfigError(f"run={self.run} has a tracer and parameters of its own: leave out {name}=, or run=.")
        if self.run is None and self.checkpoint is not None:
            raise ConfigError(
                f"checkpoint={self.checkpoint} is one of a run's: give run=<folder of experiments.train>."
            )


@dataclasses.dataclass(frozen=True)
class SimulateConfig:
    """Which suite is simulated, and where to; `benchmark` is a suite's settings (`tagjax.sim.suites.Suite`)."""

    benchmark: Mapping[str, Any]
    out: str = "recordings/benchmark"
    smoke: bool = False
    workers: int | None = None
    progress: bool = True

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ConfigError(f"workers is {self.workers}; at least 1 process is needed.")


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
