"""Faults of clocks: tables of times with one fault each are converted to the host's clock, within 5 ms, or refused."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ...core.errors import RecordingError
from ...recording.importers.clock import to_host_clock
from .outcome import Outcome, joined, outcome

MAX_ERROR_S = 0.005
"""Largest median error of a converted time."""

_EPOCH_NS = 1_700_000_000 * 10**9


@dataclasses.dataclass(frozen=True)
class ClockTable:
    """Times of a table in order of arrival, with the time on the host's clock at which each read was made."""

    reader_ns: np.ndarray  # (num_rows,) int64
    arrival_ns: np.ndarray  # (num_rows,) int64
    true_ns: np.ndarray  # (num_rows,) int64, with the smallest latency


@dataclasses.dataclass(frozen=True)
class ClockSettings:
    """A simulated table."""

    span_s: float
    rate_hz: float
    min_latency_s: float
    spread_s: float  # mean of the latency above the smallest, exponential; or the period of batches
    batches: bool  # reads are sent together once a period
    drift_ppm: float
    offset_s: float = 0.37


CLOCK_TABLES = {
    "batches": ClockSettings(
        span_s=120.0, rate_hz=100.0, min_latency_s=0.01, spread_s=0.09, batches=True, drift_ppm=30.0
    ),
    "few reads": ClockSettings(
        span_s=600.0, rate_hz=4.0, min_latency_s=0.005, spread_s=0.02, batches=False, drift_ppm=-45.0
    ),
    "few rows": ClockSettings(
        span_s=12.0, rate_hz=40.0, min_latency_s=0.002, spread_s=0.005, batches=False, drift_ppm=20.0
    ),
    "short": ClockSettings(span_s=25.0, rate_hz=60.0, min_latency_s=0.005, spread_s=0.05, batches=True, drift_ppm=50.0),
}


def sound_table(settings: ClockSettings, rng: np.random.Generator) -> ClockTable:
    """A table without a fault."""
    made_s = np.sort(rng.uniform(0, settings.span_s, round(settings.span_s * settings.rate_hz)))
    sent_s = made_s + rng.exponential(settings.spread_s, len(made_s))
    if settings.batches:
        sent_s = np.ceil(made_s / settings.spread_s) * settings.spread_s
    arrival_s = np.maximum.accumulate(sent_s + settings.min_latency_s)
    reader_s = made_s / (1 + settings.drift_ppm * 1e-6) - settings.offset_s
    return ClockTable(
        _EPOCH_NS + np.rint(reader_s * 1e6).astype(np.int64) * 1000,
        _EPOCH_NS + np.rint(arrival_s * 1e3).astype(np.int64) * 10**6,
        _EPOCH_NS + np.rint((made_s + settings.min_latency_s) * 1e9).astype(np.int64),
    )


def _reader(change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Callable:
    return lambda table, rng: dataclasses.replace(table, reader_ns=change(table.reader_ns.copy(), rng))


def _from(fraction: float, seconds: float) -> Callable:
    def change(reader: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        reader[int(fraction * len(reader)) :] += round(seconds * 1e9)
        return reader

    return _reader(change)


def _restart(reader: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    start = int(rng.uniform(0.3, 0.7) * len(reader))
    reader[start:] -= reader[start] - 10**9
    return reader


def _rows(number: int, factor: float) -> Callable:
    def change(reader: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        wrong = rng.choice(len(reader), min(number, len(reader) // 10), replace=False)
        reader[wrong] = (reader[wrong] * factor).astype(np.int64)
        return reader

    return _reader(change)


def _run(number: int, seconds: float) -> Callable:
    def change(reader: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        start = int(rng.integers(40, len(reader) - 40))
        reader[start : start + number] += round(seconds * 1e9)
        return reader

    return _reader(change)


def _scattered(seconds: float) -> Callable:
    def change(reader: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        reader[rng.choice(len(reader), len(reader) // 25, replace=False)] += round(seconds * 1e9)
        return reader

    return _reader(change)


def _stop(reader: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    start = len(reader) // 2
    reader[start:] = reader[start]
    return reader


def _first_arrival(table: ClockTable, rng: np.random.Generator) -> ClockTable:
    arrival = table.arrival_ns.copy()
    arrival[[0, -1]] = 10**6
    return dataclasses.replace(table, arrival_ns=arrival)


def _host_set(table: ClockTable, rng: np.random.Generator) -> ClockTable:
    start, step = len(table.arrival_ns) // 3, 2 * 10**9
    late = np.arange(len(table.arrival_ns)) >= start
    return dataclasses.replace(table, arrival_ns=table.arrival_ns + late * step, true_ns=table.true_ns + late * step)


def _outage(table: ClockTable, rng: np.random.Generator) -> ClockTable:
    arrival = table.arrival_ns.copy()
    start = arrival[len(arrival) // 3]
    held = (arrival >= start) & (arrival < start + 3 * 10**9)
    arrival[held] = start + 3 * 10**9
    return dataclasses.replace(table, arrival_ns=arrival)


def _sorted_otherwise(table: ClockTable, rng: np.random.Generator) -> ClockTable:
    order = np.argsort(rng.integers(0, 4, len(table.reader_ns)), kind="stable")
    return ClockTable(table.reader_ns[order], table.arrival_ns[order], table.true_ns[order])


def _few(table: ClockTable, rng: np.random.Generator) -> ClockTable:
    return ClockTable(table.reader_ns[:16], table.arrival_ns[:16], table.true_ns[:16])


FAULTS: dict[str, tuple[Callable[[ClockTable, np.random.Generator], ClockTable], bool]] = {
    "none": (lambda table, rng: table, False),
    "reader's clock set forward by an hour": (_from(0.4, 3600.0), False),
    "reader's clock set back by an hour": (_from(0.6, -3600.0), False),
    "reader's clock set back by 0.3 s": (_from(0.5, -0.3), False),
    "reader's clock set forward by 0.3 s": (_from(0.5, 0.3), False),
    "reader restarts in 1970": (_reader(_restart), False),
    "counter of 32 bits wraps": (_from(0.7, -(2**32) * 1e-6), False),
    "one time is five-fold": (_rows(1, 5.0), False),
    "eight times are 0": (_rows(8, 0.0), False),
    "ten times in a row are an hour late": (_run(10, 3600.0), False),
    "ten times in a row are an hour early": (_run(10, -3600.0), False),
    "ten times in a row are half a second late": (_run(10, 0.5), False),
    "one in 25 times is 0.3 s late": (_scattered(0.3), False),
    "one in 25 times is 0.9 s early": (_scattered(-0.9), False),
    "sixteen rows": (_few, False),
    "host's clock set forward by 2 s": (_host_set, False),
    "arrivals held up for 3 s": (_outage, False),
    "first and last time of arrival are in 1970": (_first_arrival, False),
    "rows sorted by tag": (_sorted_otherwise, False),
    "reader's clock stands still": (_reader(lambda reader, rng: np.full_like(reader, reader[0])), True),
    "reader's clock stops half-way": (_reader(_stop), True),
    "reader's clock runs backwards": (_reader(lambda reader, rng: 2 * reader[0] - reader), True),
    "milliseconds taken for microseconds": (_reader(lambda reader, rng: reader // 1000), True),
    "reader's clock 2 % fast": (_reader(lambda reader, rng: reader[0] + (reader - reader[0]) * 51 // 50), True),
    "reader's clock 2,000 ppm fast": (_reader(lambda reader, rng: reader[0] + (reader - reader[0]) * 501 // 500), True),
    "reader's clock at half speed": (_reader(lambda reader, rng: reader[0] + (reader - reader[0]) // 2), True),
    "whole seconds of arrival": (
        lambda table, rng: dataclasses.replace(table, arrival_ns=table.arrival_ns // 10**9 * 10**9),
        True,
    ),
    "whole seconds": (_reader(lambda reader, rng: reader // 10**9 * 10**9), True),
}
"""Each fault, and whether it has to be refused. The others are corrected, or refused where too little is left."""


def median_error_s(table: ClockTable) -> float:
    """Median error of the converted times in seconds. Raises `RecordingError` if the times are refused."""
    found = to_host_clock(table.reader_ns, table.arrival_ns)
    return float(np.median(np.abs(found.time_ns - table.true_ns)[found.usable])) * 1e-9


def trial(number: int, seed: int, folder: Path) -> list[Outcome]:
    """`number` tables, every fault of every table in turn; a failure is a larger error, or a fault that was not refused."""
    cases = list(itertools.product(CLOCK_TABLES, FAULTS))
    found = []
    for draw in range(number):
        table, fault = cases[draw % len(cases)]
        found.append(outcome(f"clocks, {fault}", [fault_of(table, fault, np.random.default_rng([seed, draw]))]))
    return joined(found)


def fault_of(table: str, fault: str, rng: np.random.Generator) -> str | None:
    """None if the times of a table with this fault are converted or refused as they must be; else what happens instead."""
    change, refused = FAULTS[fault]
    faulty = change(sound_table(CLOCK_TABLES[table], rng), rng)
    try:
        error_s = median_error_s(faulty)
    except RecordingError as error:
        return f"{table}: refused: {error}" if fault == "none" else None
    if refused:
        return f"{table}: not refused, median error {1e3 * error_s:.1f} ms"
    return None if error_s <= MAX_ERROR_S else f"{table}: median error {1e3 * error_s:.1f} ms"
