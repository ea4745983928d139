"""tagjax: vision-RFID tracing in JAX."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .recording import ClockAudit, Intrinsics, Recording, RecordingError, RecordingWarning, TagReads, Truth

__all__ = ["ClockAudit", "Intrinsics", "Recording", "RecordingError", "RecordingWarning", "TagReads", "Truth"]


def __getattr__(name: str) -> Any:
    """The public names are imported when they are used: a command sets its signal handlers before anything large."""
    if name in __all__:
        return getattr(importlib.import_module(".recording", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
