"""Times at which tags reply: slotted-ALOHA rounds, antennas in turn, outages of the whole reader."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from ...radio.reader import ROUND_BASE_S, ROUND_JITTER, ROUND_PER_TAG_S

ROUNDS_PER_ANTENNA = 4
"""Rounds before the reader switches antennas. Logs of 4 antennas show 0.03 to 0.24 s on one: 1 to 10 rounds of one tag."""

OUTAGE_S = 0.5
"""Mean length of an outage of the whole reader (assumed: garbage collection, network, a person at the antenna)."""


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Slots in which tags reply, in order of time: every tag in range once per round."""

    time_s: Float[np.ndarray, " slots"]  # true time, strictly increasing
    tag: Int[np.ndarray, " slots"]  # from 0
    antenna: Int[np.ndarray, " slots"]  # from 0
    round: Int[np.ndarray, " slots"]  # from 0


def draw_schedule(
    start_s: float,
    stop_s: float,
    num_tags: int,
    rng: np.random.Generator,
    *,
    num_antennas: int = 1,
    rounds_per_antenna: int = ROUNDS_PER_ANTENNA,
    in_range: tuple[np.ndarray, np.ndarray] | None = None,
) -> Schedule:
    """Slotted-ALOHA rounds: `ROUND_BASE_S`, then one slot of `ROUND_PER_TAG_S` for each tag in random order.

    Overhead and slots jitter by `ROUND_JITTER` (gamma), so the mean round is the measured 17.3 + 4.23 N ms, which
    includes empty and collided slots. The antennas take turns of `rounds_per_antenna` rounds. A tag out of the antenna's
    range takes no slot: `in_range` has times (samples,) and, from each time on, which tags reply (samples, tags,
    antennas); None means all tags at all times.
    """
    if num_tags < 1 or num_antennas < 1:
        raise ValueError(f"{num_tags} tags and {num_antennas} antennas; expected at least one of each.")
    when, present = in_range or (np.array([start_s]), np.ones((1, num_tags, num_antennas), bool))
    fewest = int(present.sum(axis=1).min())
    num_rounds = int((stop_s - start_s) / (ROUND_BASE_S + ROUND_PER_TAG_S * fewest) * 1.1) + 50
    shape = 1.0 / ROUND_JITTER**2
    slots = rng.gamma(shape, ROUND_PER_TAG_S / shape, (num_rounds, num_tags))
    overhead = rng.gamma(shape, ROUND_BASE_S / shape, num_rounds)
    # Start within a round, so that recordings do not begin with the overhead of a round.
    now = start_s - rng.uniform(0, ROUND_BASE_S)
    order = rng.permuted(np.tile(np.arange(num_tags), (num_rounds, 1)), axis=1)
    antenna = np.arange(num_rounds) // rounds_per_antenna % num_antennas
    times, tags = [], []
    for number in range(num_rounds):
        sample = max(int(np.searchsorted(when, now, side="right")) - 1, 0)
        answering = present[sample, order[number], antenna[number]]
        tags.append(order[number][answering])
        times.append(now + overhead[number] + np.cumsum(slots[number][answering]))
        now = float(times[-1][-1]) if len(times[-1]) else now + overhead[number]
        if now >= stop_s:
            break
    number = np.repeat(np.arange(len(tags)), [len(tag) for tag in tags])
    time_s, tag = np.concatenate(times), np.concatenate(tags)
    inside = (time_s >= start_s) & (time_s < stop_s)
    return Schedule(time_s[inside], tag[inside], antenna[number][inside], number[inside])


def in_outage(
    time_s: Float[np.ndarray, " slots"],
    start_s: float,
    stop_s: float,
    per_minute: float,
    rng: np.random.Generator,
) -> Bool[np.ndarray, " slots"]:
    """Which slots fall into an outage of the reader. Outages are a Poisson process with exponential lengths."""
    begins = rng.uniform(start_s, stop_s, rng.poisson(per_minute * (stop_s - start_s) / 60))
    ends = begins + rng.exponential(OUTAGE_S, len(begins))
    return np.any((time_s[:, None] >= begins) & (time_s[:, None] < ends), axis=1)
