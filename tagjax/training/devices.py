"""Data parallelism by sharding: batches are sharded over the devices, and states are replicated on each.

`shard` and `replicate` use the devices of all processes, for one program that all of them run; `shard_locally` and
`replicate_locally` use the devices of this process.
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


def local_mesh() -> Mesh:
    """A one-dimensional mesh of this process's devices."""
    return Mesh(np.asarray(jax.local_devices()), (AXIS,))


def _global_mesh() -> Mesh:
    return Mesh(np.asarray(jax.devices()), (AXIS,))


def check_batch(batch_size: int | None) -> int:
    """The number of samples. Raises `ValueError` unless every device of every process gets the same number of them."""
    count = jax.device_count()
    if batch_size is None:
        raise ValueError("loop.batch_size is null; expected the number of samples in a step.")
    if batch_size % count:
        raise ValueError(f"loop.batch_size is {batch_size}; on {count} devices it must be a multiple of {count}.")
    return batch_size


def shard(batch: T) -> T:
    """Arrays with a leading sample axis, sharded over all devices; what follows from a sample is computed on its device.

    Each process passes its own samples.
    """
    if jax.device_count() == 1:
        return batch
    sharding = NamedSharding(_global_mesh(), PartitionSpec(AXIS))
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(sharding, np.asarray(leaf)), batch)


def replicate(state: T) -> T:
    """The arrays of a state, replicated on every device; they must be the same in all processes."""
    if jax.device_count() == 1:
        return state
    sharding = NamedSharding(_global_mesh(), PartitionSpec())
    arrays, static = eqx.partition(state, eqx.is_array)

    def copy(leaf: jax.Array) -> jax.Array:
        if isinstance(leaf, jax.Array) and leaf.sharding == sharding:
            return leaf
        return jax.make_array_from_process_local_data(sharding, np.asarray(leaf))

    return eqx.combine(jax.tree.map(copy, arrays), static)


def unreplicate(state: T) -> T:
    """The inverse of `replicate`: the arrays on this process's first device, for computations of this process alone."""
    if jax.device_count() == 1:
        return state
    arrays, static = eqx.partition(state, eqx.is_array)
    return eqx.combine(jax.device_put(jax.tree.map(np.asarray, arrays), jax.local_devices()[0]), static)


def shard_locally(batch: T) -> T:
    """Like `shard`, over this process's devices only."""
    return jax.device_put(batch, NamedSharding(local_mesh(), PartitionSpec(AXIS)))


def replicate_locally(state: T) -> T:
    """Like `replicate`, on this process's devices only."""
    arrays, static = eqx.partition(state, eqx.is_array)
    return eqx.combine(jax.device_put(arrays, NamedSharding(local_mesh(), PartitionSpec())), static)
