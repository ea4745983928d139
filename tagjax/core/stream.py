"""Endless streams of samples from any place on, read by this process or by worker processes."""

from __future__ import annotations

import dataclasses
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import grain
import jax
from absl import flags

_LAST_STEP_S = 60.0
"""A worker that got SIGTERM gives samples for so long."""


@dataclasses.dataclass(frozen=True)
class Stream:
    """An endless dataset with what is needed to read it; iterating gives a `StreamIterator`."""

    dataset: grain.MapDataset  # endless: what comes at each place follows from the place alone
    workers: int = 0  # processes that read ahead; with none a thread of this process does
    ahead: int = 2  # samples read ahead, by each worker if there are some
    share: tuple[int, int] = (0, 1)  # (i, n) takes every n-th sample from the i-th on
    finish: Callable[[Any], Any] | None = None  # done to every sample in this process, after the workers

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise ValueError(f"workers is {self.workers}; expected the number of processes, or 0 for none.")

    def __iter__(self) -> StreamIterator:
        return StreamIterator(self)


class StreamIterator:
    """Samples in order. Its place is the number of samples that all shares together have drawn, and nothing else.

    So a run may go on with another number of workers, or of processes that share the stream.
    """

    def __init__(self, stream: Stream):
        self._stream, self._place, self._samples = stream, 0, None

    def __iter__(self) -> StreamIterator:
        return self

    def __next__(self) -> Any:
        if self._samples is None:
            self._samples = self._open()
        sample = next(self._samples)
        self._place += self._stream.share[1]
        return sample if self._stream.finish is None else self._stream.finish(sample)

    def get_state(self) -> dict[str, int]:
        return {"samples": self._place}

    def set_state(self, state: Any) -> None:
        """Go on at that place. Raises `ValueError` for what is none."""
        place = state.get("samples", state.get("next_index")) if isinstance(state, dict) else None
        if not isinstance(place, int) or place < 0:
            raise ValueError(f"The place in the data is {state!r}; expected {{'samples': <number drawn>}}.")
        self.close()
        self._place = place

    def close(self) -> None:
        """Ends the worker processes."""
        if self._samples is not None:
            self._samples.close()
            self._samples = None

    def _open(self) -> Any:
        stream = self._stream
        first, step = stream.share
        part = stream.dataset[self._place + first :: step]
        samples = part.to_iter_dataset(grain.ReadOptions(num_threads=1, prefetch_buffer_size=stream.ahead))
        if stream.workers:
            # Grain asks flags of Abseil, which only Abseil's own programs parse.
            if not flags.FLAGS.is_parsed():
                flags.FLAGS.mark_as_parsed()
            options = grain.MultiprocessingOptions(num_workers=stream.workers, per_worker_buffer_size=stream.ahead)
            samples = samples.mp_prefetch(options, worker_init_fn=_begin_worker)
        return iter(samples)


def _begin_worker(index: int, count: int) -> None:
    """Workers compute on the host, leave Ctrl-C to the training process, and do not outlive it, however it ends.

    A scheduler sends SIGTERM to all processes: the step in progress still needs its samples.
    """
    del index, count
    jax.config.update("jax_platforms", "cpu")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, frame: threading.Thread(target=leave, daemon=True).start())
    parent = multiprocessing.parent_process()
    assert parent is not None

    def leave() -> None:
        time.sleep(_LAST_STEP_S)
        os._exit(1)

    def follow() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
