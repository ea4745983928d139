"""Weights of flow networks as plain arrays: one .npz file with the settings and the recipe that made them, as text.

Nothing in a file is executed: arrays are read as numbers, and the only class that its settings can name is a flow
network of this package.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax

from ..core.arrays_file import ArraysFile, named_arrays
from .network import AbstractFlowNetwork

PACKAGED = Path(__file__).parent / "weights"
"""Where the weights that come with the package lie, as <name>.npz."""

_FILE = ArraysFile("tagjax-flow-weights", 1, "weights of a flow network", "python -m experiments.train_flow")
_TARGET = re.compile(r"tagjax\.flow\.([a-z][a-z0-9_]*)\.([A-Z]\w*)")

Network = TypeVar("Network", bound=AbstractFlowNetwork)


def packaged_weights() -> tuple[str, ...]:
    """Names of the weights that come with the package."""
    return tuple(sorted(path.stem for path in PACKAGED.glob("*.npz")))


def find_weights(source: str | Path) -> Path:
    """The file of packaged weights of that name, or at that path. Raises `ValueError` where there is none."""
    packaged = PACKAGED / f"{source}.npz"
    if str(source) in packaged_weights():
        return packaged
    if str(source).endswith(".npz") and Path(source).is_file():
        return Path(source)
    there = ", ".join(packaged_weights()) or "none"
    raise ValueError(
        f"No weights at {str(source)!r}; expected the path of an .npz file, or the name of packaged weights ({there}). "
        "`python -m experiments.train_flow` makes some."
    )


def save_weights(
    path: str | Path, network: AbstractFlowNetwork, about: Mapping[str, Any], *, half: bool = False
) -> None:
    """Write a network's arrays, named by their place in it, with `about` as JSON; in half precision if `half`.

    `about["flow"]` are the settings that build the network: `_target_` and arguments, as under conf/flow. The rest is
    the writer's: recipe, seed, data, scores. The same content gives the same bytes. Raises `ValueError` for settings
    that build another network.
    """
    settings = about.get("flow")
    if not isinstance(settings, Mapping):
        raise ValueError(f"about holds {sorted(about)}; expected `flow`, the settings that build the network.")
    told = _outline(settings, str(path))
    if jax.tree.structure(told) != jax.tree.structure(network) or _shapes(told) != _shapes(network):
        raise ValueError(f"{path}: the settings {dict(settings)} build another network than the one to be saved.")
    _FILE.write(path, network, about, half=half)


def load_weights(network: Network, source: str | Path = "default") -> Network:
    """The network with the weights of a file, of packaged weights by name, or (`default`) of those packaged for it.

    Raises `ValueError` for a file that is missing, damaged or foreign, and for one whose arrays do not fit.
    """
    if str(source) == "default":
        source = _packaged_for(network)
    return _FILE.fill(network, find_weights(source))


def load_network(source: str | Path, **changes: Any) -> AbstractFlowNetwork:
    """The network that a file of weights describes, with these weights; errors as of `load_weights`.

    `changes` take the place of settings of the file that no weight depends on.
    """
    path = find_weights(source)
    return _FILE.fill(_outline({**weights_about(path)["flow"], **changes}, str(path)), path)


def weights_about(source: str | Path) -> dict[str, Any]:
    """What a file of weights says of itself: `flow` (settings), recipe, seed, data, scores."""
    path = find_weights(source)
    about = _FILE.about(path)
    if not isinstance(about.get("flow"), dict):
        raise ValueError(f"{path}: does not say which network it is of (`flow`).")
    return about


def _packaged_for(network: AbstractFlowNetwork) -> Path:
    """The packaged weights of this class and these shapes; of this class at least."""
    own = f"{type(network).__module__}.{type(network).__name__}"
    of_class = [name for name in packaged_weights() if weights_about(name)["flow"].get("_target_") == own]
    for name in of_class:
        if _shapes(_outline(weights_about(name)["flow"], name)) == _shapes(network):
            return PACKAGED / f"{name}.npz"
    if of_class:
        return PACKAGED / f"{of_class[0]}.npz"
    there = ", ".join(packaged_weights()) or "none"
    raise ValueError(f"No weights are packaged for {own} (there are: {there}). Train it, or give a file of weights.")


def _shapes(network: Any) -> dict[str, tuple[int, ...]]:
    return {name: tuple(leaf.shape) for name, leaf in named_arrays(network).items()}


def _outline(settings: Mapping[str, Any], where: str) -> AbstractFlowNetwork:
    """The network that settings build, with shapes in place of arrays: nothing of its size is allocated."""
    target = settings.get("_target_")
    named = _TARGET.fullmatch(target) if isinstance(target, str) else None
    network = None
    if named is not None and (Path(__file__).parent / f"{named[1]}.py").is_file():
        network = getattr(importlib.import_module(f"tagjax.flow.{named[1]}"), named[2], None)
    if not inspect.isclass(network) or not issubclass(network, AbstractFlowNetwork) or inspect.isabstract(network):
        raise ValueError(f"{where}: the settings name {target!r}; expected a network of tagjax.flow.")
    arguments = {str(key): value for key, value in settings.items() if key != "_target_"}
    try:
        return eqx.filter_eval_shape(lambda: network(**arguments))
    except (TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{where}: {target} does not take the settings {arguments}: {error}") from error
