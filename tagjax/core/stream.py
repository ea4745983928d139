"""Endless streams of samples that start at any position, read by this process or by worker processes."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import reprlib
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import grain
import jax
from absl import flags

from .worker_process import end_with_parent, signals_blocked, unblock_sigterm

_GRACE_PERIOD_S = 60.0
"""A worker that got SIGTERM goes on serving samples for so long."""

_MAX_POSITION = 1 << 62


@dataclasses.dataclass(frozen=True)
class Stream:
    """An endless dataset and how it is read; `iter` returns a `StreamIterator`. Raises `ValueError` for negative
    workers.
    """

    dataset: grain.MapDataset  # endless: a sample depends on its position alone
    workers: int = 0  # processes that prefetch; with 0 a thread of this process does
    prefetch: int = 2  # samples read ahead, by each worker if there are any
    shard: tuple[int, int] = (0, 1)  # (i, n): every n-th sample, from the i-th on
    transform: Callable[[Any], Any] | None = None  # applied to every sample in this process, after the workers

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise ValueError(f"workers is {self.workers}; expected the number of processes, or 0 for none.")

    def __iter__(self) -> StreamIterator:
        return StreamIterator(self)


class StreamIterator:
    """Samples in order. The only state is the position: the number of samples that all shards together have drawn.

    So a run may resume with another number of workers or shards.
    """

    def __init__(self, stream: Stream):
        self._stream, self._position, self._samples = stream, 0, None

    def __iter__(self) -> StreamIterator:
        return self

    def __next__(self) -> Any:
        if self._samples is None:
            # The first sample starts the workers.
            with signals_blocked() if self._stream.workers else contextlib.nullcontext():
                self._samples = self._open()
                sample = next(self._samples)
        else:
            sample = next(self._samples)
        self._position += self._stream.shard[1]
        return sample if self._stream.transform is None else self._stream.transform(sample)

    def get_state(self) -> dict[str, int]:
        """The position, for `set_state`."""
        return {"samples": self._position}

    def set_state(self, state: Any) -> None:
        """Continue at the position of `get_state`. Raises `ValueError` for anything else."""
        position = state.get("samples", state.get("next_index")) if isinstance(state, dict) else None
        if not isinstance(position, int) or isinstance(position, bool) or not 0 <= position < _MAX_POSITION:
            raise ValueError(
                f"The position in the data is {reprlib.repr(state)}; expected {{'samples': <number drawn>}}."
            )
        self.close()
        self._position = position

    def close(self) -> None:
        """End the worker processes."""
        if self._samples is not None:
            self._samples.close()
            self._samples = None

    def _open(self) -> Any:
        stream = self._stream
        first, step = stream.shard
        part = stream.dataset[self._position + first :: step]
        samples = part.to_iter_dataset(grain.ReadOptions(num_threads=1, prefetch_buffer_size=stream.prefetch))
        if stream.workers:
            # Grain reads Abseil's flags, which only Abseil's own programs parse.
            if not flags.FLAGS.is_parsed():
                flags.FLAGS.mark_as_parsed()
            options = grain.MultiprocessingOptions(num_workers=stream.workers, per_worker_buffer_size=stream.prefetch)
            samples = samples.mp_prefetch(options, worker_init_fn=_begin_worker)
        return iter(samples)


def _begin_worker(index: int, count: int) -> None:
    """Set up a worker: it computes on the CPU, ignores Ctrl-C, and ends when the training process ends.

    A scheduler sends SIGTERM to all processes: the training step in progress still needs its samples.
    """
    del index, count
    jax.config.update("jax_platforms", "cpu")
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def exit_later() -> None:
        time.sleep(_GRACE_PERIOD_S)
        os._exit(1)

    signal.signal(signal.SIGTERM, lambda number, frame: threading.Thread(target=exit_later, daemon=True).start())
    unblock_sigterm()
    end_with_parent()
