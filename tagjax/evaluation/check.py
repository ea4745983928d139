"""The check of a recording: what limits it, as text and as a page."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from ..recording.limits import Limits, Thresholds, find_limits
from ..recording.store import open_recording
from ..report.check_page import CHECK_PAGE, write_check_page


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckConfig:
    """The recording, the tags that count (None: all that were read), the limits of each value, and the page's path."""

    recording: str
    epcs: tuple[str, ...] | None = None
    thresholds: Thresholds = dataclasses.field(default_factory=Thresholds)
    out: str | None = None


def check_recording(
    config: CheckConfig, folder: Path, *, on_frame: Callable[[int, int], None] = lambda done, total: None
) -> tuple[Limits, Path]:
    """Measure and judge the recording, and write the page: `out`, or check.html in `folder`. Its path is returned too.

    Raises `RecordingError` for a recording that cannot be opened, and for an EPC that was never read.
    """
    limits = find_limits(open_recording(config.recording), config.thresholds, epcs=config.epcs, on_frame=on_frame)
    return limits, write_check_page(limits, folder / CHECK_PAGE if config.out is None else Path(config.out))
