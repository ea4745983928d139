"""Batches spread over all devices of this process, the state copied to each: data parallelism by sharding."""

from __future__ import annotations

from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

T = TypeVar("T", bound=PyTree)

_AXIS = "data"


def _mesh() -> Mesh:
    return Mesh(np.asarray(jax.local_devices()), (_AXIS,))


def check_batch(batch_size: int) -> None:
    """Raises `ValueError` unless every device gets the same number of samples."""
    count = jax.local_device_count()
    if batch_size % count:
        raise ValueError(f"loop.batch_size is {batch_size}; on {count} devices it must be a multiple of {count}.")


def spread(batch: T) -> T:
    """Arrays with samples first, each device holding its share. What is computed of them is computed there."""
    if jax.local_device_count() == 1:
        return batch
    return jax.device_put(batch, NamedSharding(_mesh(), PartitionSpec(_AXIS)))


def copied(state: T) -> T:
    """The arrays of a state, whole on every device."""
    if jax.local_device_count() == 1:
        return state
    arrays, rest = eqx.partition(state, eqx.is_array)
    return eqx.combine(jax.device_put(arrays, NamedSharding(_mesh(), PartitionSpec())), rest)
