"""The candidates of a recording, its tags' true distances, and which of them explains each tag's reads best."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from ...recording import Recording, RecordingError
from ..true_distance import at_times, true_distance_m
from .likelihood import EvidenceSettings, carried_evidence, independent_evidence, read_phasors

TIE_NATS = 1e-6
"""A candidate wins if its evidence exceeds that of every other one by more than this."""


@dataclasses.dataclass(frozen=True)
class Memory:
    """Which evidence a frame has: the reads of the last `seconds` (all so far if None), offsets carried across hops or not."""

    seconds: float | None
    carried: bool

    @property
    def seconds_text(self) -> str:
        return "all reads so far" if self.seconds is None else f"last {self.seconds:g} s"

    @property
    def offsets_text(self) -> str:
        return "carried" if self.carried else "independent"

    @property
    def text(self) -> str:
        """Both, as figures and tables name them."""
        return f"{self.seconds_text}, {self.offsets_text} offsets"


def evidence_of_candidates(
    recording: Recording, epc: str, candidates: Sequence[str], settings: EvidenceSettings, memories: Sequence[Memory]
) -> list[Float[np.ndarray, "candidates frames"]]:
    """The evidence of one tag's reads for each candidate's true distance by every frame, nats, one array a memory.

    All antennas count to which all candidates' distances are known. Reads at which one of these is unknown are left out.
    """
    frame_s = recording.frame_time_s()
    own = recording.reads[(recording.reads.epc == epc) & np.isfinite(recording.reads.carrier_hz)]
    totals = [np.zeros((len(candidates), len(frame_s))) for _ in memories]
    for antenna in np.unique(own.antenna).tolist():
        distances = [true_distance_m(recording, candidate, antenna) for candidate in candidates]
        known = [one for one in distances if one is not None]
        if len(known) < len(candidates):
            continue
        reads = own[own.antenna == antenna]
        time_s = (reads.time_ns - recording.time_ns[0]) * 1e-9
        range_m = np.stack([at_times(frame_s, one, time_s) for one in known])
        used = np.isfinite(range_m).all(axis=0)
        phasors = read_phasors(reads[used], time_s[used], range_m[:, used], settings)
        for total, memory in zip(totals, memories, strict=True):
            if memory.carried:
                total += carried_evidence(phasors, frame_s, settings, memory.seconds)
            else:
                total += independent_evidence(phasors, frame_s, memory.seconds)
    return totals


def winners(evidence: Float[np.ndarray, "candidates frames"]) -> Int[np.ndarray, " frames"]:
    """The candidate with the highest evidence at each frame; -1 where two are equally good."""
    first, second = np.sort(evidence, axis=0)[-1:-3:-1]
    return np.where(first - second > TIE_NATS, np.argmax(evidence, axis=0), -1)


def candidates_of(recording: Recording) -> tuple[str, ...]:
    """The tags that were read and whose distance is known. Raises `RecordingError` for fewer than two: nothing competes."""
    found = tuple(
        epc
        for epc in recording.resolve_epcs(None)
        if any(
            true_distance_m(recording, epc, antenna) is not None for antenna in range(1, len(recording.antennas_m) + 1)
        )
    )
    if len(found) < 2:
        raise RecordingError(
            f"{recording.name}: found {len(found)} tag with reads and a true distance; expected at least 2. The ceiling is the "
            "fraction of frames in which a tag's own distance wins against those of the recording's other tags, so a "
            "recording of one tag has none. Choose a suite with several tags, such as multi_4."
        )
    return found
