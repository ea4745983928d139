"""Checks of what a recording says of itself: names, sizes, positions, ground truth and the time of its reads."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import RecordingError, RecordingWarning
from ..core.names import name_fault

if TYPE_CHECKING:
    from .recording import Recording, Truth

MAX_ANTENNA_M = 100.0
"""Largest distance of an antenna from the camera: far beyond the range of a passive tag."""

MAX_OUTSIDE = 0.5
"""A recording is refused if a larger fraction of its reads lies outside of the video's time."""

FIRST_DATE_NS = 86_400 * 10**9
"""Times before the second day of 1970 are no dates: they count from the first frame."""

_WARN_OUTSIDE = 0.05
_MARGIN_NS = 500_000_000  # a reader starts and ends a little before or after the camera
_MAX_LABEL = 254  # 255 is ignored


def check_names(recording: Recording) -> None:
    """Raise `RecordingError` for a recording's name or an EPC that cannot be one."""
    if (fault := name_fault(recording.name)) is not None:
        raise RecordingError(f"The recording's name: {fault}. Rename it.")
    epcs: Iterable[Any] = recording.reads.epcs
    if recording.truth is not None:
        truth = recording.truth
        tables = (
            truth.tag_to_label,
            truth.tag_range_m,
            truth.tag_position_m,
            truth.line_of_sight,
            truth.carrier_box_px,
        )
        epcs = [*epcs, *(epc for table in tables for epc in table)]
    for epc in epcs:
        if (fault := name_fault(epc)) is not None:
            raise RecordingError(f"{recording.name}: an EPC: {fault}. Correct it in the source and import again.")


def check_geometry(recording: Recording) -> None:
    """Raise `RecordingError` for an unknown kind of depth and for antennas that are no positions in metres."""
    name = recording.name
    if recording.depth_kind not in ("depth", "range"):
        raise RecordingError(f"{name}: depth_kind is {recording.depth_kind!r}; expected 'depth' (along z) or 'range'.")
    antennas = np.asarray(recording.antennas_m)
    if antennas.ndim != 2 or antennas.shape[1] != 3 or antennas.dtype.kind not in "fiu" or not len(antennas):
        raise RecordingError(
            f"{name}: antennas_m is {antennas.dtype} of shape {antennas.shape}; expected (antennas, 3) metres, one row at least."
        )
    if not np.all(np.isfinite(antennas)):
        raise RecordingError(f"{name}: antennas_m holds values that are not finite; expected finite metres.")
    farthest_m = float(np.linalg.norm(antennas.astype(float), axis=1).max())
    if farthest_m > MAX_ANTENNA_M:
        raise RecordingError(
            f"{name}: an antenna is {farthest_m:.4g} m from the camera; expected at most {MAX_ANTENNA_M:g}. Millimetres or "
            "centimetres must be converted to metres."
        )


def check_second(recording: Recording, min_m: float, max_m: float) -> None:
    """Raise `RecordingError` for a second camera with other pictures than the first, or no plausible baseline."""
    second, name = recording.second, recording.name
    if second is None:
        return
    if second.colour.shape != recording.colour.shape or second.colour.dtype != np.uint8:
        raise RecordingError(
            f"{name}: the second camera's colour is {second.colour.dtype} of shape {second.colour.shape}; expected uint8 of shape "
            f"{recording.colour.shape}, as the first camera's."
        )
    baseline = second.baseline_m
    if isinstance(baseline, bool) or not isinstance(baseline, int | float) or not min_m <= baseline <= max_m:
        raise RecordingError(
            f"{name}: the second camera's baseline_m is {baseline!r}; expected {min_m:g} to {max_m:g} m to the right of the first. "
            "Millimetres must be converted; where it is on the left, exchange the two cameras."
        )


def check_time_of_reads(recording: Recording) -> None:
    """Raise `RecordingError` if most reads lie outside of the video's time; warn if some do."""
    reads, time_ns = recording.reads, recording.time_ns
    outside = float(np.mean((reads.time_ns < time_ns[0] - _MARGIN_NS) | (reads.time_ns > time_ns[-1] + _MARGIN_NS)))
    if outside <= _WARN_OUTSIDE:
        return
    first_s, last_s = ((int(stamp) - int(time_ns[0])) * 1e-9 for stamp in (reads.time_ns.min(), reads.time_ns.max()))
    length_s = (int(time_ns[-1]) - int(time_ns[0])) * 1e-9
    found = (
        f"{recording.name}: {outside:.0%} of the reads fall outside of the video's time (reads from {first_s:+.1f} to "
        f"{last_s:+.1f} s after the first frame, the video lasts {length_s:.1f} s)"
    )
    if outside > MAX_OUTSIDE:
        if int(time_ns[0]) < FIRST_DATE_NS <= reads.time_ns.min():
            raise RecordingError(
                f"{found}. The video's times count from 0, those of the reads do not: import with start=<time of the first frame, "
                "2025-06-01T12:00:00.250Z or seconds since 1970>."
            )
        raise RecordingError(
            f"{found}. Reader and camera clocks differ: import with clock=arrival, or with clock=<seconds to add to the "
            "reader's clock>. If the reader ran longer than the camera, cut the table to the video's time."
        )
    warnings.warn(f"{found}; they are not used.", RecordingWarning, stacklevel=4)


def check_truth(truth: Truth, name: str, num_frames: int, shape: tuple[int, int]) -> None:
    """Raise `RecordingError` for ground truth of another size, dtype or length than the recording's."""

    def expect(what: str, array: Any, sizes: tuple[int | None, ...], kinds: str) -> None:
        found = tuple(array.shape)
        fits = len(found) == len(sizes) and all(want in (None, size) for want, size in zip(sizes, found, strict=True))
        if not fits or np.dtype(array.dtype).kind not in kinds:
            wanted = " x ".join("any" if size is None else str(size) for size in sizes)
            raise RecordingError(
                f"{name}: truth.{what} is {array.dtype} of shape {found}; expected {_KINDS[kinds]} of shape {wanted}."
            )

    frames = (num_frames, *shape)
    for field, sizes, kinds in (
        ("labels", frames, "u"),
        ("flow_px", (*frames, 2), "f"),
        ("backward_flow_px", (*frames, 2), "f"),
        ("occluded", frames, "b"),
        ("backward_occluded", frames, "b"),
        ("boxes_px", (num_frames, None, 4), "f"),
    ):
        if (array := getattr(truth, field)) is not None:
            expect(field, array, sizes, kinds)
    for field, sizes, kinds in (
        ("tag_range_m", (num_frames,), "f"),
        ("tag_position_m", (num_frames, 3), "f"),
        ("line_of_sight", (num_frames,), "f"),
        ("carrier_box_px", (num_frames, 4), "f"),
        ("visible", (num_frames,), "b"),
    ):
        for key, array in getattr(truth, field).items():
            expect(f"{field}[{key!r}]", np.asarray(array), sizes, kinds)
    for epc, label in truth.tag_to_label.items():
        if isinstance(label, bool) or not isinstance(label, int | np.integer) or not 1 <= label <= _MAX_LABEL:
            raise RecordingError(f"{name}: truth gives tag {epc} the label {label!r}; expected 1 to {_MAX_LABEL}.")


_KINDS = {"u": "unsigned integers", "f": "floats", "b": "booleans"}
