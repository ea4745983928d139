"""Processes that train one model together, on one machine or on many, by JAX's own runtime.

Every process runs the same program on its part of each batch. Collective functions must be called by all processes.
Only process 0 writes files.
"""

from __future__ import annotations

import dataclasses
import json
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import PyTree

T = TypeVar("T", bound=PyTree)


@dataclasses.dataclass(frozen=True)
class DistributedSettings:
    """How the processes find each other. By default there is one process."""

    automatic: bool = False  # ask the scheduler, as JAX does: Slurm, Open MPI, Kubernetes
    coordinator: str | None = None  # host:port at which process 0 listens
    num_processes: int = 1
    process_id: int = 0  # counted from 0
    timeout_s: int = 300  # to wait for the others at the start

    def __post_init__(self) -> None:
        if self.timeout_s < 1 or self.num_processes < 1:
            raise ValueError(
                f"distributed: timeout_s is {self.timeout_s}, num_processes {self.num_processes}; expected at least 1."
            )
        if not 0 <= self.process_id < self.num_processes:
            raise ValueError(
                f"distributed.process_id is {self.process_id}; expected 0 to {self.num_processes - 1} "
                f"(num_processes is {self.num_processes})."
            )
        if self.num_processes > 1 and self.coordinator is None and not self.automatic:
            raise ValueError(
                f"distributed.num_processes is {self.num_processes} without a coordinator; give "
                "distributed.coordinator=<host of process 0>:<port>, or distributed.automatic=true under a scheduler."
            )


@contextmanager
def distributed_runtime(settings: DistributedSettings) -> Iterator[None]:
    """JAX's distributed runtime, in which all processes act as one machine with many devices.

    To be entered before anything is computed. The runtime is shut down when all processes have left the context. After
    an error in one process JAX's runtime ends the others; the run resumes from its newest checkpoint when all are
    started again. Raises `ValueError` where `automatic` is set and there is no scheduler.
    """
    if not settings.automatic and settings.num_processes == 1:
        yield
        return
    handler = signal.getsignal(signal.SIGTERM) or signal.SIG_DFL
    if settings.automatic:
        try:
            jax.distributed.initialize(initialization_timeout=settings.timeout_s)
        except ValueError as error:
            raise ValueError(
                f"distributed.automatic is true, but JAX finds no scheduler that has started this process ({error}) "
                "Expected Slurm, Open MPI or Kubernetes: start it by srun or mpirun, or give distributed.coordinator, "
                "num_processes and process_id."
            ) from error
    else:
        jax.distributed.initialize(
            settings.coordinator,
            settings.num_processes,
            settings.process_id,
            initialization_timeout=settings.timeout_s,
        )
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)  # JAX's own handler only sets a flag, and the process would not end
    yield
    jax.distributed.shutdown()


def is_first() -> bool:
    """Whether this is process 0, which writes files."""
    return jax.process_index() == 0


def local_batch_size(batch_size: int | None) -> int:
    """The number of a batch's samples for each process. Raises `ValueError` unless the batch divides evenly."""
    count = jax.process_count()
    if batch_size is None:
        raise ValueError("loop.batch_size is null; expected the number of samples in a step.")
    if batch_size % count:
        raise ValueError(f"loop.batch_size is {batch_size}; over {count} processes it must be a multiple of {count}.")
    return batch_size // count


def mean_over_processes(tree: T) -> T:
    """The mean over processes of arrays with different values in each; bit-identical in all processes."""
    if jax.process_count() == 1:
        return tree
    arrays, static = eqx.partition(tree, eqx.is_array)
    # Gathered and summed in the same order by all, so that the processes cannot diverge.
    gathered = multihost_utils.process_allgather(jax.tree.map(np.asarray, arrays))
    mean = jax.tree.map(lambda leaf: jax.numpy.asarray(np.mean(leaf, axis=0, dtype=leaf.dtype)), gathered)
    return eqx.combine(mean, static)


def max_over_processes(number: int) -> int:
    """The greatest of the processes' numbers."""
    if jax.process_count() == 1:
        return number
    return int(np.max(multihost_utils.process_allgather(np.asarray(number, np.int32))))


def broadcast_arrays(tree: T) -> T:
    """The arrays of process 0; shapes and dtypes must be the same in all processes."""
    if jax.process_count() == 1:
        return tree
    arrays, static = eqx.partition(tree, eqx.is_array)
    received = multihost_utils.broadcast_one_to_all(jax.tree.map(np.asarray, arrays))
    return eqx.combine(jax.tree.map(jax.numpy.asarray, received), static)


def broadcast_json(content: Any) -> Any:
    """The plain JSON content of process 0."""
    if jax.process_count() == 1:
        return content
    text = np.frombuffer(json.dumps(content).encode(), np.uint8)
    length = int(multihost_utils.broadcast_one_to_all(np.asarray(text.size, np.int32)))
    padded = np.zeros(length, np.uint8)
    if is_first():
        padded[:] = text
    return json.loads(np.asarray(multihost_utils.broadcast_one_to_all(padded)).tobytes())
