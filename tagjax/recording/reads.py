"""Tag reads as a table: one column per attribute, one row per read."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from ..core.errors import RecordingError, RecordingWarning


def join_reads(parts: Sequence[TagReads]) -> TagReads:
    """The reads of several tables in order of time. Raises `RecordingError` if their phase conventions differ."""
    first = parts[0]
    for part in parts[1:]:
        if (part.phase_period_rad, part.phase_sign) != (first.phase_period_rad, first.phase_sign):
            raise RecordingError(
                "The tables differ in phase period or sign; expected one convention. Convert them first."
            )
    joined = dataclasses.replace(first, **_columns(parts))
    return joined[np.argsort(joined.time_ns, kind="stable")]


def concatenate_reads(parts: Sequence[TagReads]) -> TagReads:
    """Consecutive reads of one reader in their order, with the settings of the last part; no read without any part."""
    return dataclasses.replace(parts[-1], **_columns(parts)) if parts else TagReads.empty()


def _columns(parts: Sequence[TagReads]) -> dict[str, np.ndarray | None]:
    """The columns of all parts in one, by name; None for a column that one of the parts lacks."""
    columns: dict[str, np.ndarray | None] = {}
    for field in dataclasses.fields(TagReads):
        values = [getattr(part, field.name) for part in parts]
        arrays = [isinstance(value, np.ndarray) for value in values]
        if any(arrays):
            columns[field.name] = np.concatenate(values) if all(arrays) else None
    return columns


@dataclasses.dataclass(frozen=True)
class TagReads:
    """Tag reads in order of host time, one array element per read.

    `carrier_hz` is NaN where the carrier is unknown (a channel index without its hop table); `doppler_hz` and
    `rssi_dbm` are NaN where the reader reported none. `phase_rad` is as reported, in [0, phase_period_rad); it grows
    with distance where `phase_sign` is +1 (Impinj), shrinks where it is -1.
    """

    epc: np.ndarray  # (num_reads,) str
    time_ns: np.ndarray  # (num_reads,) int64, host clock
    antenna: np.ndarray  # (num_reads,) int16, counted from 1
    carrier_hz: np.ndarray  # (num_reads,) float64
    phase_rad: np.ndarray  # (num_reads,) float64
    rssi_dbm: np.ndarray  # (num_reads,) float32
    doppler_hz: np.ndarray  # (num_reads,) float32
    reader_time_ns: np.ndarray | None = None  # (num_reads,) int64, reader clock, as reported
    arrival_time_ns: np.ndarray | None = None  # (num_reads,) int64, host clock, as recorded
    channel_index: np.ndarray | None = None  # (num_reads,) int16, counted from 1 into hop_table_hz
    hop_table_hz: tuple[float, ...] = ()
    phase_period_rad: float = 2 * np.pi
    phase_sign: Literal[-1, 1] = 1
    pi_flips: bool | None = None  # None = unknown: estimators decide from the reads

    @property
    def num_reads(self) -> int:
        return len(self.time_ns)

    @property
    def epcs(self) -> list[str]:
        """The EPCs that were read, sorted."""
        return sorted({str(epc) for epc in self.epc})

    def __getitem__(self, index: Any) -> TagReads:
        """The reads that a mask, slice or index array selects."""
        columns = {
            field.name: getattr(self, field.name)[index]
            for field in dataclasses.fields(self)
            if isinstance(getattr(self, field.name), np.ndarray)
        }
        return dataclasses.replace(self, **columns)

    def select(self, epc: str) -> TagReads:
        """The reads of one tag. An EPC that was never read raises `RecordingError`."""
        found = self.epc == epc
        if not found.any():
            known = ", ".join(self.epcs) or "none"
            raise RecordingError(f"EPC {epc!r} was never read. EPCs in this recording: {known}. Choose one of these.")
        return self[found]

    @classmethod
    def empty(cls) -> TagReads:
        """No reads at all."""
        return cls(
            epc=np.empty(0, dtype="<U24"),
            time_ns=np.empty(0, dtype=np.int64),
            antenna=np.empty(0, dtype=np.int16),
            carrier_hz=np.empty(0, dtype=np.float64),
            phase_rad=np.empty(0, dtype=np.float64),
            rssi_dbm=np.empty(0, dtype=np.float32),
            doppler_hz=np.empty(0, dtype=np.float32),
        )

    def check(self) -> None:
        """Raise `RecordingError` for reads that cannot be used; warn of unusual reads that can be used."""
        num_reads = self.num_reads
        for name, kinds in _COLUMN_KINDS.items():
            column = getattr(self, name)
            if column is not None and (column.shape != (num_reads,) or column.dtype.kind not in kinds):
                raise RecordingError(
                    f"Tag reads: column {name} is {column.dtype} of shape {column.shape}; expected {_KINDS[kinds]}, "
                    f"({num_reads},) like time_ns."
                )
        if self.phase_sign not in (-1, 1):
            raise RecordingError(
                f"Tag reads: phase_sign is {self.phase_sign!r}; expected 1 (phase grows with distance) or -1."
            )
        period = self.phase_period_rad
        if isinstance(period, bool) or not isinstance(period, int | float) or not 0.1 <= period <= 2 * np.pi + 1e-6:
            raise RecordingError(
                f"Tag reads: phase_period_rad is {period!r}; expected radians, 2 pi, or pi for a reader with flips."
            )
        if self.pi_flips is not None and not isinstance(self.pi_flips, bool | np.bool_):
            raise RecordingError(f"Tag reads: pi_flips is {self.pi_flips!r}; expected true, false, or null if unknown.")
        if not all(isinstance(carrier, int | float) and 300e6 <= carrier <= 6e9 for carrier in self.hop_table_hz):
            raise RecordingError(f"Tag reads: hop_table_hz is {self.hop_table_hz!r}; expected UHF carriers in Hz.")
        if num_reads == 0:
            warnings.warn("The recording has no tag read: nothing can be traced.", RecordingWarning, stacklevel=3)
            return
        if np.any(np.diff(self.time_ns) < 0):
            first = int(np.argmax(np.diff(self.time_ns) < 0)) + 1
            raise RecordingError(
                f"Tag reads: time goes back at read {first}; expected reads in order of time. "
                "Sort them (the importers do)."
            )
        phase = self.phase_rad
        if not np.all(np.isfinite(phase)):
            bad = int(np.sum(~np.isfinite(phase)))
            raise RecordingError(f"Tag reads: {bad} of {num_reads} values of phase_rad are not finite; drop them.")
        if phase.min() < -1e-6 or phase.max() > period + 1e-6:
            raise RecordingError(
                f"Tag reads: phase_rad spans [{phase.min():.4g}, {phase.max():.4g}]; expected [0, {period:.4g}] rad. "
                "Degrees or raw codes must be converted first."
            )
        known = np.isfinite(self.carrier_hz)
        if not known.all():
            warnings.warn(
                f"The carrier of {int(np.sum(~known))} of {num_reads} reads is unknown (a channel index needs the "
                "reader's hop table): these reads carry no distance.",
                RecordingWarning,
                stacklevel=3,
            )
        carriers = self.carrier_hz[known]
        if carriers.size and (carriers.min() < 300e6 or carriers.max() > 6e9):
            raise RecordingError(
                f"Tag reads: carrier_hz spans [{carriers.min():.4g}, {carriers.max():.4g}]; expected a UHF carrier in Hz, "
                "about 9e8. MHz or kHz must be converted first."
            )
        if carriers.size and carriers.max() - carriers.min() > 120e6:
            raise RecordingError(
                f"Tag reads: carriers from {carriers.min() / 1e6:.1f} to {carriers.max() / 1e6:.1f} MHz are mixed; one "
                "reader's band spans at most about 100 MHz. Import each reader by itself."
            )
        rssi = self.rssi_dbm[np.isfinite(self.rssi_dbm)]
        if rssi.size and (rssi.min() < -120 or rssi.max() > 20):
            raise RecordingError(
                f"Tag reads: rssi_dbm spans [{rssi.min():.4g}, {rssi.max():.4g}]; expected dBm between -120 and 20. "
                "Centi-dBm must be divided by 100 first."
            )
        if np.any(self.antenna < 1):
            raise RecordingError(f"Tag reads: antenna {int(self.antenna.min())} found; antennas are counted from 1.")


_KINDS = {"U": "text", "i": "integers", "f": "floats"}
_COLUMN_KINDS = {
    "epc": "U",
    "time_ns": "i",
    "antenna": "i",
    "carrier_hz": "f",
    "phase_rad": "f",
    "rssi_dbm": "f",
    "doppler_hz": "f",
    "reader_time_ns": "i",
    "arrival_time_ns": "i",
    "channel_index": "i",
}
