"""Batches spread over devices, what learns copied to each: data parallelism by sharding.

`spread` and `copied` reach over the devices of all processes, for one program that all of them run; `spread_here` and
`copied_here` over this process's own.
"""

from __future__ import annotations

from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

T = TypeVar("T", bound=PyTree)

AXIS = "data"


def mesh_here() -> Mesh:
    """This process's devices in a row."""
    return Mesh(np.asarray(jax.local_devices()), (AXIS,))


def _mesh() -> Mesh:
    return Mesh(np.asarray(jax.devices()), (AXIS,))


def check_batch(batch_size: int) -> None:
    """Raises `ValueError` unless every device of every process gets the same number of samples."""
    count = jax.device_count()
    if batch_size % count:
        raise ValueError(f"loop.batch_size is {batch_size}; on {count} devices it must be a multiple of {count}.")


def spread(batch: T) -> T:
    """Arrays with samples first, each device holding its share. What is computed of them is computed there.

    Each process gives its own samples.
    """
    if jax.device_count() == 1:
        return batch
    sharding = NamedSharding(_mesh(), PartitionSpec(AXIS))
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(sharding, np.asarray(leaf)), batch)


def copied(state: T) -> T:
    """The arrays of a state, whole on every device; they must be the same in all processes."""
    if jax.device_count() == 1:
        return state
    sharding = NamedSharding(_mesh(), PartitionSpec())
    arrays, rest = eqx.partition(state, eqx.is_array)

    def copy(leaf: jax.Array) -> jax.Array:
        if isinstance(leaf, jax.Array) and leaf.sharding == sharding:
            return leaf
        return jax.make_array_from_process_local_data(sharding, np.asarray(leaf))

    return eqx.combine(jax.tree.map(copy, arrays), rest)


def local(state: T) -> T:
    """`copied` undone: the arrays on this process's first device, for what it computes by itself."""
    if jax.device_count() == 1:
        return state
    arrays, rest = eqx.partition(state, eqx.is_array)
    return eqx.combine(jax.device_put(jax.tree.map(np.asarray, arrays), jax.local_devices()[0]), rest)


def spread_here(batch: T) -> T:
    """`spread` over this process's devices only."""
    return jax.device_put(batch, NamedSharding(mesh_here(), PartitionSpec(AXIS)))


def copied_here(state: T) -> T:
    """`copied` to this process's devices only."""
    arrays, rest = eqx.partition(state, eqx.is_array)
    return eqx.combine(jax.device_put(arrays, NamedSharding(mesh_here(), PartitionSpec())), rest)
