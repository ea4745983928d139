"""Checkpoints: everything that a run needs to resume exactly where it stopped, written atomically by Orbax.

A checkpoint holds the arrays of the training state (never code or pickles), the state of the data iterator and a
description of the arrays, which is compared before anything is restored. The description has a checksum. With several processes
only process 0 reads and writes the folder, so no shared file system is needed.
"""

from __future__ import annotations

import json
import reprlib
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
import orbax.checkpoint as ocp
from jaxtyping import PyTree

from ..core.files import WriteError, make_folder, remove, writing
from ..core.json_text import json_checksum
from .processes import broadcast_arrays, broadcast_json, is_first
from .state import HasStep

StateT = TypeVar("StateT", bound=HasStep)

FORMAT = "tagjax training checkpoint 2"

_UNFINISHED = ".orbax-checkpoint-tmp"
"""How Orbax ends the name of a checkpoint's folder until it is finished."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be used: what was found, what was expected, what to do."""


def describe_arrays(tree: PyTree) -> dict[str, str]:
    """Path, dtype and shape of every array leaf."""
    leaves = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, eqx.is_array))[0]
    return {jax.tree_util.keystr(path): f"{leaf.dtype}{list(leaf.shape)}" for path, leaf in leaves}


class Checkpoints:
    """The checkpoints of one run, in one folder; the newest three are kept."""

    def __init__(self, folder: Path | str, *, create: bool = True):
        """Raises `CheckpointError` if the folder is missing and is not to be created."""
        self.folder = Path(folder).absolute()
        self._manager: ocp.CheckpointManager | None = None
        if not is_first():
            return
        if not create and not self.folder.is_dir():
            raise CheckpointError(
                f"No checkpoints at {self.folder}: no such folder. Give a run folder written by experiments.train."
            )
        make_folder(self.folder)
        if create:  # a run that only reads may look at the folder of one that is writing a checkpoint
            self._remove_unfinished()
        options = ocp.CheckpointManagerOptions(
            max_to_keep=3,
            create=False,
            enable_async_checkpointing=False,
            multiprocessing_options=ocp.options.MultiprocessingOptions(active_processes={0})
            if jax.process_count() > 1
            else ocp.options.MultiprocessingOptions(),
        )
        self._manager = ocp.CheckpointManager(self.folder, options=options)

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        if self._manager is not None:
            self._manager.close()

    def steps(self) -> list[int]:
        """Steps at which a finished checkpoint exists, ascending. All processes must call this."""
        return broadcast_json([] if self._manager is None else sorted(self._manager.all_steps()))

    def save(self, state: HasStep, data_state: Any) -> None:
        """Write a checkpoint of the state at its step; `data_state` is plain JSON (the iterator's own state).

        Raises `WriteError` where the file system refuses to write; what was written of the checkpoint is removed.
        """
        if self._manager is None:
            return
        step = int(state.step)
        if step in self._manager.all_steps():
            return
        # A flat dictionary keyed by number: Orbax needs no knowledge of the classes, and nothing is pickled.
        arrays = [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(state, eqx.is_array))]
        about = {"format": FORMAT, "step": step, "arrays": describe_arrays(state), "data": _jsonable(data_state)}
        about["sha256"] = json_checksum(about)
        try:
            with writing(self.folder / str(step)):
                self._manager.save(
                    step,
                    args=ocp.args.Composite(
                        arrays=ocp.args.StandardSave({f"{n:04d}": leaf for n, leaf in enumerate(arrays)}),
                        about=ocp.args.JsonSave(about),
                    ),
                )
                self._manager.wait_until_finished()
        except WriteError:
            self._remove_unfinished()
            raise

    def _remove_unfinished(self) -> None:
        """Remove the parts of checkpoints that were not finished: of a killed process, or on a full disk."""
        for unfinished in self.folder.glob(f"*{_UNFINISHED}"):
            remove(unfinished)

    def restore(self, like: StateT, step: int | None = None) -> tuple[StateT, Any]:
        """The state at `step` (the newest if None) and the data iterator's state.

        `like` is a fresh state of the same configuration: it gives the structure, the checkpoint the arrays. Raises
        `CheckpointError` for a folder without a checkpoint, and for a checkpoint that is damaged or belongs to another
        program or model. All processes must call this.
        """
        state, data_state = (like, None) if self._manager is None else self._read(self._manager, like, step)
        return broadcast_arrays(state), broadcast_json(data_state)

    def _read(self, manager: ocp.CheckpointManager, like: StateT, step: int | None) -> tuple[StateT, Any]:
        steps = sorted(manager.all_steps())
        if not steps:
            inside = ", ".join(sorted(path.name for path in self.folder.iterdir())[:6]) or "nothing"
            raise CheckpointError(
                f"No finished checkpoint at {self.folder} (it holds {inside}). Give a run folder written by "
                "experiments.train that has done at least one step."
            )
        step = steps[-1] if step is None else step
        if step not in steps:
            raise CheckpointError(f"No checkpoint of step {step} at {self.folder}; there are {steps}.")
        about = self._about(manager, step)
        _compare(about["arrays"], describe_arrays(like), self.folder / str(step))
        arrays, static = eqx.partition(like, eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        wanted = {
            f"{n:04d}": jax.ShapeDtypeStruct(
                leaf.shape, leaf.dtype, sharding=jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
            )
            for n, leaf in enumerate(leaves)
        }
        try:
            restored = manager.restore(step, args=ocp.args.Composite(arrays=ocp.args.StandardRestore(wanted)))["arrays"]
        except Exception as error:  # Orbax and TensorStore raise many kinds for damaged files
            raise CheckpointError(
                f"The checkpoint {self.folder / str(step)} is damaged: its arrays cannot be read "
                f"({type(error).__name__}). Delete that folder to go on from an older one; there are {steps}."
            ) from error
        state = eqx.combine(jax.tree.unflatten(structure, [restored[f"{n:04d}"] for n in range(len(leaves))]), static)
        return state, about["data"]

    def _about(self, manager: ocp.CheckpointManager, step: int) -> dict[str, Any]:
        path = self.folder / str(step)
        try:
            about = manager.restore(step, args=ocp.args.Composite(about=ocp.args.JsonRestore()))["about"]
        except Exception as error:
            inside = ", ".join(sorted(item.name for item in path.iterdir())[:6]) or "nothing"
            raise CheckpointError(
                f"{path} is no checkpoint of tagjax, or a damaged one: it holds {inside}; expected a readable "
                f"description in 'about' ({type(error).__name__})."
            ) from error
        if not isinstance(about, dict) or about.get("format") != FORMAT:
            found = about.get("format") if isinstance(about, dict) else type(about).__name__
            raise CheckpointError(
                f"{path} has format {reprlib.repr(found)}; expected {FORMAT!r}. Another program or version wrote it."
            )
        _check_about(about, path, step)
        return about


def _check_about(about: dict[str, Any], path: Path, step: int) -> None:
    """Raise `CheckpointError` unless a description has the checksum, the step and the entries that it was written with."""
    try:
        checksum = json_checksum({name: value for name, value in about.items() if name != "sha256"})
    except (RecursionError, ValueError):
        checksum = None
    arrays = about.get("arrays")
    described = isinstance(arrays, dict) and all(isinstance(text, str) for text in arrays.values())
    if checksum is None or about.get("sha256") != checksum:
        fault = "does not have its checksum"
    elif about.get("step") != step or isinstance(about["step"], bool | float):
        fault = f"is of step {reprlib.repr(about.get('step'))}; expected {step}"
    elif not described or "data" not in about:
        fault = "lacks arrays (names and shapes) or data (the position in the data)"
    else:
        return
    raise CheckpointError(
        f"{path} is damaged: its description {fault}. Delete that folder to go on from an older checkpoint."
    )


def _compare(found: dict[str, str], expected: dict[str, str], path: Path) -> None:
    differences = [
        f"{name}: found {found.get(name, 'nothing')}, expected {expected.get(name, 'nothing')}"
        for name in sorted({*found, *expected})
        if found.get(name) != expected.get(name)
    ]
    if differences:
        listed = "; ".join(differences[:5]) + (f"; and {len(differences) - 5} more" if len(differences) > 5 else "")
        raise CheckpointError(
            f"The checkpoint {path} belongs to another model or optimiser. {listed}. Use the configuration of its run."
        )


def _jsonable(data_state: Any) -> Any:
    try:
        json.dumps(data_state)
    except TypeError as error:
        raise CheckpointError(f"The data iterator's state is no plain JSON ({error}); it cannot be kept.") from error
    return data_state
