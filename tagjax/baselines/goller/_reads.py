"""From tag reads to what the model sees: mean RSSI by frame, tag and antenna; and the statistic of a tag grid."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from ...recording import Recording, RecordingError, TagReads
from ._site import Site

_STILL_M = 0.01


@dataclasses.dataclass(frozen=True)
class RssiFrames:
    """Mean RSSI of each tag on each antenna over the period that ends with each frame; 0 where `heard` is not."""

    rssi_dbm: Float[np.ndarray, "time tag antenna"]
    heard: Bool[np.ndarray, "time tag antenna"]


def rssi_frames(
    reads: TagReads,
    epcs: Sequence[str],
    time_ns: Int[np.ndarray, " time"],
    num_antennas: int,
    *,
    period_s: float = 0.5,
) -> RssiFrames:
    """What was heard in the `period_s` up to each frame. Reads without RSSI do not count; `ValueError` for no period."""
    told = reads[np.isfinite(reads.rssi_dbm) & np.isin(reads.epc, list(epcs))]
    number = {epc: tag for tag, epc in enumerate(epcs)}
    tag = np.array([number[str(epc)] for epc in told.epc], int)
    return mean_rssi(
        tag, told.antenna.astype(int) - 1, told.time_ns, told.rssi_dbm, time_ns, (len(epcs), num_antennas), period_s
    )


def mean_rssi(
    tag: Int[np.ndarray, " reads"],
    antenna: Int[np.ndarray, " reads"],
    read_ns: Int[np.ndarray, " reads"],
    rssi_dbm: Shaped[np.ndarray, " reads"],
    time_ns: Int[np.ndarray, " time"],
    shape: tuple[int, int],
    period_s: float,
) -> RssiFrames:
    """`rssi_frames` of plain columns in order of time; tags and antennas count from 0, `shape` is how many there are."""
    if not period_s > 0:
        raise ValueError(f"period_s is {period_s}; expected a positive observation period.")
    mean, heard = np.zeros((len(time_ns), *shape), np.float32), np.zeros((len(time_ns), *shape), bool)
    for row in range(shape[0]):
        for port in range(shape[1]):
            mine = (tag == row) & (antenna == port)
            stamps, total = read_ns[mine], np.concatenate([[0.0], np.cumsum(rssi_dbm[mine], dtype=np.float64)])
            stop = np.searchsorted(stamps, time_ns, side="right")
            start = np.searchsorted(stamps, time_ns - round(period_s * 1e9), side="right")
            count = stop - start
            heard[:, row, port] = count > 0
            mean[:, row, port] = np.where(count > 0, (total[stop] - total[start]) / np.maximum(count, 1), 0.0)
    return RssiFrames(mean, heard)


@dataclasses.dataclass(frozen=True)
class GridStatistic:
    """What a tag at each place of the calibration grid was read like (III.D); NaN where an antenna did not hear it."""

    position_m: Float[np.ndarray, "points 2"]  # room frame
    mean_dbm: Float[np.ndarray, "points antenna"]
    std_db: Float[np.ndarray, "points antenna"]
    num_reads: Int[np.ndarray, "points antenna"]


def grid_statistic(recording: Recording, site: Site) -> GridStatistic:
    """Mean and deviation of RSSI for every place at which the grid's tag rested, from a recording that knows its places.

    A place counts where the tag (`truth.tag_position_m`, all tags alike) is within 1 cm at two frames in a row; reads
    between such frames are its reads. Raises `RecordingError` for a recording without places or without a rest.
    """
    truth = recording.truth
    if truth is None or not truth.tag_position_m:
        raise RecordingError(
            f"{recording.name}: no calibration from it: it does not know where its tag was (truth.tag_position_m). Record "
            "a tag grid, or simulate shop_grid."
        )
    num_antennas = len(recording.antennas_m)
    places: dict[tuple[int, int], tuple[list[np.ndarray], list[list[np.ndarray]]]] = {}
    for epc, path in truth.tag_position_m.items():
        room = site.to_room(np.asarray(path, np.float64))[:, :2]
        reads = recording.reads[(recording.reads.epc == epc) & np.isfinite(recording.reads.rssi_dbm)]
        for frame in np.flatnonzero(np.linalg.norm(np.diff(room, axis=0), axis=1) < _STILL_M):
            between = (reads.time_ns >= recording.time_ns[frame]) & (reads.time_ns < recording.time_ns[frame + 1])
            key = (round(room[frame, 0] / 0.1), round(room[frame, 1] / 0.1))
            where, samples = places.setdefault(key, ([], [[] for _ in range(num_antennas)]))
            where.append(room[frame])
            for antenna in range(num_antennas):
                samples[antenna].append(reads.rssi_dbm[between & (reads.antenna == antenna + 1)])
    if not places:
        raise RecordingError(f"{recording.name}: the tag never rests for two frames; a grid recording needs rests.")
    shape = (len(places), num_antennas)
    mean, std, count = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, int)
    for row, (_, samples) in enumerate(places.values()):
        for antenna, parts in enumerate(samples):
            values = np.concatenate(parts)
            count[row, antenna] = len(values)
            if len(values):
                mean[row, antenna], std[row, antenna] = values.mean(), values.std()
    position = np.array([np.mean(where, axis=0) for where, _ in places.values()])
    return GridStatistic(position, mean, std, count)
