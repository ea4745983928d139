"""RSSI as the models use it: means by frame, tag and antenna; and the statistics of a tag grid."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from ...recording import Recording, RecordingError, TagReads
from .room import RoomFrame

_STATIONARY_M = 0.01
_GRID_M = 0.1  # positions closer than this are one point of the grid


@dataclasses.dataclass(frozen=True)
class RssiFrames:
    """Mean RSSI of each tag at each antenna over the period that ends with each frame; 0 where not `received`."""

    rssi_dbm: Float[np.ndarray, "time tag antenna"]
    received: Bool[np.ndarray, "time tag antenna"]


@dataclasses.dataclass(frozen=True)
class RssiReads:
    """Reads with a known RSSI as plain columns, in order of time."""

    tag: Int[np.ndarray, " reads"]  # index into the traced tags
    antenna: Int[np.ndarray, " reads"]  # from 0
    time_ns: Int[np.ndarray, " reads"]
    rssi_dbm: Float[np.ndarray, " reads"]

    def __getitem__(self, index: Bool[np.ndarray, " reads"]) -> RssiReads:
        return RssiReads(self.tag[index], self.antenna[index], self.time_ns[index], self.rssi_dbm[index])

    def append(self, later: RssiReads) -> RssiReads:
        """These reads, then later ones."""
        return RssiReads(
            *(
                np.concatenate([getattr(self, field.name), getattr(later, field.name)])
                for field in dataclasses.fields(self)
            )
        )


def rssi_reads(reads: TagReads, epcs: Sequence[str], time_ns: Int[np.ndarray, " reads"] | None = None) -> RssiReads:
    """The reads of some tags that have an RSSI; `time_ns` replaces the reads' own times."""
    kept = np.isfinite(reads.rssi_dbm) & np.isin(reads.epc, list(epcs))
    number = {epc: tag for tag, epc in enumerate(epcs)}
    return RssiReads(
        np.array([number[str(epc)] for epc in reads.epc[kept]], np.int64),
        reads.antenna[kept].astype(np.int64) - 1,
        (reads.time_ns if time_ns is None else time_ns)[kept],
        reads.rssi_dbm[kept].astype(np.float64),
    )


def mean_rssi(
    reads: RssiReads, time_ns: Int[np.ndarray, " time"], shape: tuple[int, int], period_s: float
) -> RssiFrames:
    """Mean RSSI over the `period_s` up to each frame; `shape` is the number of tags and antennas.

    Raises `ValueError` for a period that is not positive.
    """
    if not period_s > 0:
        raise ValueError(f"period_s is {period_s}; expected a positive observation period.")
    mean, received = np.zeros((len(time_ns), *shape), np.float32), np.zeros((len(time_ns), *shape), bool)
    for tag in range(shape[0]):
        for antenna in range(shape[1]):
            own = reads[(reads.tag == tag) & (reads.antenna == antenna)]
            total = np.concatenate([[0.0], np.cumsum(own.rssi_dbm)])
            stop = np.searchsorted(own.time_ns, time_ns, side="right")
            start = np.searchsorted(own.time_ns, time_ns - round(period_s * 1e9), side="right")
            count = stop - start
            received[:, tag, antenna] = count > 0
            mean[:, tag, antenna] = np.where(count > 0, (total[stop] - total[start]) / np.maximum(count, 1), 0.0)
    return RssiFrames(mean, received)


@dataclasses.dataclass(frozen=True)
class GridStatistic:
    """RSSI of a tag at each point of the calibration grid (III.D); NaN where an antenna did not receive it."""

    position_m: Float[np.ndarray, "points 2"]  # room frame
    mean_dbm: Float[np.ndarray, "points antenna"]
    std_db: Float[np.ndarray, "points antenna"]
    num_reads: Int[np.ndarray, "points antenna"]


def grid_statistic(recording: Recording, room: RoomFrame) -> GridStatistic:
    """Mean and standard deviation of RSSI for every point at which the grid's tag was stationary.

    A point counts where the tag (`truth.tag_position_m`, all tags alike) moves less than 1 cm between two frames; its
    reads are those between such frames. Raises `RecordingError` for a recording without true positions, or whose tag is
    never stationary.
    """
    truth = recording.truth
    if truth is None or not truth.tag_position_m:
        raise RecordingError(
            f"{recording.name}: no true positions of its tag (truth.tag_position_m), which a calibration needs. Record a "
            "tag grid, or simulate shop_grid."
        )
    num_antennas = len(recording.antennas_m)
    points: dict[tuple[int, int], tuple[list[Shaped[np.ndarray, " 2"]], list[list[np.ndarray]]]] = {}
    for epc, path in truth.tag_position_m.items():
        position = room.to_room(np.asarray(path, np.float64))[:, :2]
        reads = recording.reads[(recording.reads.epc == epc) & np.isfinite(recording.reads.rssi_dbm)]
        for frame in np.flatnonzero(np.linalg.norm(np.diff(position, axis=0), axis=1) < _STATIONARY_M):
            between = (reads.time_ns >= recording.time_ns[frame]) & (reads.time_ns < recording.time_ns[frame + 1])
            key = (round(position[frame, 0] / _GRID_M), round(position[frame, 1] / _GRID_M))
            where, samples = points.setdefault(key, ([], [[] for _ in range(num_antennas)]))
            where.append(position[frame])
            for antenna in range(num_antennas):
                samples[antenna].append(reads.rssi_dbm[between & (reads.antenna == antenna + 1)])
    if not points:
        raise RecordingError(
            f"{recording.name}: the tag is never stationary for two frames, expected stops at each point of a grid. "
            "Record a tag grid."
        )
    shape = (len(points), num_antennas)
    mean, std, count = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, int)
    for row, (_, samples) in enumerate(points.values()):
        for antenna, parts in enumerate(samples):
            values = np.concatenate(parts)
            count[row, antenna] = len(values)
            if len(values):
                mean[row, antenna], std[row, antenna] = values.mean(), values.std()
    return GridStatistic(np.array([np.mean(where, axis=0) for where, _ in points.values()]), mean, std, count)
