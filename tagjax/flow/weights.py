"""Weights of flow networks: safetensors files with the network's settings and the training recipe as metadata.

Nothing in a file is executed. The only class that its settings can name is a flow network of this package.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax

from ..core.array_file import ArrayFile, named_arrays
from .network import AbstractFlowNetwork
from .networks import NETWORKS

PACKAGED = Path(__file__).parent / "weights"
"""The folder of the weights that come with the package: <name>.safetensors."""

SUFFIX = ".safetensors"

_FILE = ArrayFile("tagjax-flow-weights", 2, "weights of a flow network", "python -m experiments.train_flow")
_MAX_SIZE, _MAX_LENGTH = 1024, 32  # of a number and of a list in the settings of a network

Network = TypeVar("Network", bound=AbstractFlowNetwork)


def packaged_weights() -> tuple[str, ...]:
    """Names of the weights that come with the package."""
    return tuple(sorted(path.stem for path in PACKAGED.glob(f"*{SUFFIX}")))


def find_weights(source: str | Path) -> Path:
    """The file of the packaged weights of that name, or the file at that path. Raises `ValueError` where there is none."""
    packaged = PACKAGED / f"{source}{SUFFIX}"
    if str(source) in packaged_weights():
        return packaged
    if str(source).endswith(SUFFIX) and Path(source).is_file():
        return Path(source)
    available = ", ".join(packaged_weights()) or "none"
    raise ValueError(
        f"No weights at {str(source)!r}; expected the path of a {SUFFIX} file, or the name of packaged weights "
        f"({available}). `python -m experiments.train_flow` makes such files."
    )


def save_weights(
    path: str | Path, network: AbstractFlowNetwork, metadata: Mapping[str, Any], *, half: bool = False
) -> None:
    """Write a network's arrays by name, with `metadata` as JSON; as float16 instead of float32 if `half`.

    `metadata["flow"]` are the settings that build the network: `_target_` and arguments, as under conf/flow. The other
    entries are free: recipe, seed, data, scores. The same content gives the same bytes. Raises `ValueError` for
    settings that build another network, and for values that are not finite.
    """
    settings = metadata.get("flow")
    if not isinstance(settings, Mapping):
        raise ValueError(f"metadata holds {sorted(metadata)}; expected `flow`, the settings that build the network.")
    described = _abstract_network(settings, str(path))
    if jax.tree.structure(described) != jax.tree.structure(network) or _shapes(described) != _shapes(network):
        raise ValueError(f"{path}: the settings {dict(settings)} build another network than the one to be saved.")
    _FILE.write(path, network, metadata, half=half)


def load_weights(network: Network, source: str | Path = "default") -> Network:
    """The network with the weights of a file, of packaged weights by name, or (`default`) of those packaged for it.

    Raises `ValueError` for a file that is missing, damaged or of another kind, and for one whose arrays do not fit.
    """
    if str(source) == "default":
        source = _packaged_for(network)
    return _FILE.read(find_weights(source), network)


def load_network(source: str | Path, **changes: Any) -> AbstractFlowNetwork:
    """The network that the metadata of a weights file describe, with its weights; errors as of `load_weights`.

    `changes` replace settings of the file; they must not change the shape of any weight.
    """
    path = find_weights(source)
    return _FILE.read(path, _abstract_network({**weights_metadata(path)["flow"], **changes}, str(path)))


def weights_metadata(source: str | Path) -> dict[str, Any]:
    """The metadata of a weights file: `flow` (settings of the network), recipe, seed, data, scores."""
    path = find_weights(source)
    metadata = _FILE.metadata(path)
    if not isinstance(metadata.get("flow"), dict):
        raise ValueError(f"{path}: the metadata have no settings of a network (`flow`). Train again.")
    return metadata


def _packaged_for(network: AbstractFlowNetwork) -> Path:
    """The packaged weights of this class and these shapes, or else the first of this class."""
    class_name = f"{type(network).__module__}.{type(network).__name__}"
    of_class = [name for name in packaged_weights() if weights_metadata(name)["flow"].get("_target_") == class_name]
    for name in of_class:
        if _shapes(_abstract_network(weights_metadata(name)["flow"], name)) == _shapes(network):
            return PACKAGED / f"{name}{SUFFIX}"
    if of_class:
        return PACKAGED / f"{of_class[0]}{SUFFIX}"
    available = ", ".join(packaged_weights()) or "none"
    raise ValueError(
        f"No weights are packaged for {class_name} (packaged are: {available}). Train it, or give a file of weights."
    )


def _shapes(network: Any) -> dict[str, tuple[int, ...]]:
    return {name: tuple(leaf.shape) for name, leaf in named_arrays(network).items()}


def _abstract_network(settings: Mapping[str, Any], where: str) -> AbstractFlowNetwork:
    """The network that settings build, with shapes in place of arrays, so that no memory of its size is allocated."""
    target = settings.get("_target_")
    network = NETWORKS.get(target) if isinstance(target, str) else None
    if network is None:
        raise ValueError(
            f"{where}: the settings name {target!r}; expected a network of tagjax.flow ({', '.join(NETWORKS)})."
        )
    arguments = {str(key): value for key, value in settings.items() if key != "_target_"}
    if too_large := [name for name, value in arguments.items() if name != "seed" and not _is_small(value)]:
        raise ValueError(
            f"{where}: {target} with {', '.join(too_large)} too large; expected at most {_MAX_SIZE}, and lists of at most "
            f"{_MAX_LENGTH} values. Copy the file again, or train again."
        )
    try:
        return eqx.filter_eval_shape(lambda: network(**arguments))
    except (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError) as error:
        raise ValueError(
            f"{where}: {target} does not take the settings {reprlib.repr(arguments)} ({type(error).__name__}: "
            f"{str(error).partition(chr(10))[0]}). Copy the file again, or train again."
        ) from error


def _is_small(value: Any) -> bool:
    """Whether the numbers and lists in a setting are of sizes that a network has, so that it can be built in seconds."""
    if isinstance(value, list | tuple):
        return len(value) <= _MAX_LENGTH and all(map(_is_small, value))
    return not isinstance(value, int | float) or abs(value) <= _MAX_SIZE
