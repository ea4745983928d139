"""Small sound tables of every format that the importers read, made in code."""

from __future__ import annotations

import base64
import dataclasses
import datetime
import json
import math
import random
from collections.abc import Callable, Sequence

HOP_TABLE_HZ = tuple(920.625e6 + 0.25e6 * number for number in range(16))
_START_US = 1_700_000_000_000_000  # microseconds since 1970
_EPCS = ("E2801191A503006543210ABC", "300833B2DDD9014000000000", "ABCD")


@dataclasses.dataclass(frozen=True)
class SoundRead:
    """One read, in units in which every format can write it without rounding."""

    epc: str
    time_us: int
    antenna: int
    channel: int  # counted from 1 into HOP_TABLE_HZ
    code: int  # phase in 1/4096 of a turn
    rssi_dbm: int
    doppler_hz: int

    @property
    def phase_rad(self) -> float:
        return self.code * 2 * math.pi / 4096

    @property
    def carrier_mhz(self) -> str:
        return f"{HOP_TABLE_HZ[self.channel - 1] / 1e6:.3f}"

    @property
    def iso(self) -> str:
        moment = datetime.datetime.fromtimestamp(self.time_us // 10**6, datetime.UTC)
        return f"{moment:%Y-%m-%dT%H:%M:%S}.{self.time_us % 10**6:06d}0Z"

    @property
    def seconds(self) -> str:
        return f"{self.time_us // 10**6}.{self.time_us % 10**6:06d}"


def _r700(r: SoundRead) -> str:
    tag = {
        "epc": base64.urlsafe_b64encode(bytes.fromhex(r.epc)).decode().rstrip("="),
        "antennaPort": r.antenna,
        "peakRssiCdbm": 100 * r.rssi_dbm,
        "frequency": round(HOP_TABLE_HZ[r.channel - 1] / 1e3),
        "lastSeenTime": r.iso,
        "phaseAngle": r.code * 360 / 4096,
    }
    return json.dumps({"timestamp": tag["lastSeenTime"], "eventType": "tagInventory", "tagInventoryEvent": tag})


WRITERS: dict[str, tuple[str, Callable[[SoundRead], str]]] = {
    "sllurp": (
        "timestamp,reader,antenna,rssi,epc,phase_angle,channel_index,doppler_frequency",
        lambda r: f"{r.seconds},h,{r.antenna},{r.rssi_dbm},b'{r.epc.lower()}',{r.code},{r.channel},{16 * r.doppler_hz}",
    ),
    "octane": (
        '"EPC","Timestamp","ChannelInMhz","PeakRssiInDbm","PhaseAngleInRadians"',
        lambda r: f'"{r.epc[:4]} {r.epc[4:]}","{r.time_us}","{r.carrier_mhz}","{r.rssi_dbm}","{r.phase_rad!r}"',
    ),
    "octane_gesture": (
        "EPC,DopplerShift(Hz),Time,Antenna,TxPower,Frequency(MHz),RSS(dbm),PhaseAngle(Radian),PhaseAngle(Degree)",
        lambda r: f"{r.epc},{r.doppler_hz},{r.time_us},{r.antenna},30,{r.carrier_mhz},{r.rssi_dbm},{r.phase_rad!r},0",
    ),
    "tagbeat": (
        "EPC,AntnenaId,ChannelIndex,Doppler,PeekRssi,PreciseRssi,Phase,FirstReadTime,LastReadTime,ReadCount,Timestamp",
        lambda r: (
            f"{r.epc},{r.antenna},{r.channel},{16 * r.doppler_hz},{r.rssi_dbm},{100 * r.rssi_dbm},{r.code},{r.time_us},"
            f"{r.time_us},1,{r.time_us // 1000}"
        ),
    ),
    "itemtest": (
        "// Antennas connected = 1\n// Timestamp, EPC, TID, Antenna, RSSI, Frequency, Hostname, PhaseAngle, DopplerFrequency",
        lambda r: f"{r.iso}, {r.epc}, , {r.antenna}, {r.rssi_dbm}, {r.carrier_mhz}, h, {r.phase_rad!r}, {r.doppler_hz}",
    ),
    "itemtest_plain": (
        "timestamp,epc,antenna,rssi,frequency,hostname,phaseAngle,dopplerFrequency,power",
        lambda r: f"{r.iso},{r.epc},{r.antenna},{r.rssi_dbm},{r.carrier_mhz},h,{r.phase_rad!r},{r.doppler_hz},30",
    ),
    "antenna_rail": (
        "epc,antennaIndex,frequency,phase,RSSI,dopplerShift,position",
        lambda r: f"{r.epc},{r.antenna},{HOP_TABLE_HZ[r.channel - 1]!r},{r.phase_rad!r},{r.rssi_dbm},{r.doppler_hz},0",
    ),
    "r700": ("", _r700),
    "sllurp_log": (
        "timestamp,reader,antenna,rssi,epc",
        lambda r: f"{r.seconds},h,{r.antenna},{r.rssi_dbm},{r.epc}",
    ),
}
"""The header (empty for none) and the function that writes a row, for each format in `FORMATS`."""

TIME_COLUMNS = {"timestamp", "time", "firstreadtime"}
"""Columns that hold times, in lower case."""


def sound_lines(name: str, reads: Sequence[SoundRead]) -> list[str]:
    """The lines of a table of reads."""
    header, write = WRITERS[name]
    return [*(header.split("\n") if header else []), *map(write, reads)]


def sound_reads(number: int, rng: random.Random) -> list[SoundRead]:
    """Reads in order of time, with phases that differ."""
    time_us, reads = _START_US, []
    for code in rng.sample(range(4096), number):
        time_us += 1000 * rng.randint(1, 200)
        reads.append(
            SoundRead(
                epc=rng.choice(_EPCS),
                time_us=time_us,
                antenna=rng.randint(1, 4),
                channel=rng.randint(1, len(HOP_TABLE_HZ)),
                code=code,
                rssi_dbm=rng.randint(-80, -30),
                doppler_hz=rng.randint(-40, 40),
            )
        )
    return reads


def sound_tracks(number: int, rng: random.Random) -> dict[str, list[str]]:
    """Tables of `number` positions of two people in every format of tracks, and of a tag's speeds."""
    walks = [
        (frame, person, 3 + 0.05 * frame + rng.gauss(0, 0.01), 2 + person + rng.gauss(0, 0.01))
        for frame in range(1, number // 2 + 1)
        for person in (1, 2)
    ]

    def stamp(frame: int) -> str:
        return f"2020-05-01 12:00:{frame // 30 % 60:02d}:{frame % 30 * 33:03d}"

    return {
        "tracks.csv": [
            "frame,person,x_m,y_m,z_m,range_m",
            *(f"{frame},{person},{x:.4f},0.3,{y:.4f},1" for frame, person, x, y in walks),
        ],
        "kinect": [f"7{person}, {stamp(frame)}, {100 * x}, {100 * y}" for frame, person, x, y in walks],
        "kinect speeds": [f"0000 001E,0.1,nan,{x - 3},{stamp(frame)}" for frame, _, x, _ in walks],
        "xovis": [
            ";time;id;x;y;height;cam",
            *(
                f"0;{1557995040213 + 100 * frame};{person};{x / 0.02:.0f};{y / 0.02:.0f};1;c"
                for frame, person, x, y in walks
            ),
        ],
        "tum": ["# timestamp filename", *(f"{frame / 30:.4f} image.png" for frame in range(number))],
    }
