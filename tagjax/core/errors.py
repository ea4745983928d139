"""Errors and warnings about recordings."""

from __future__ import annotations


class RecordingError(ValueError):
    """A recording that cannot be used: what was found, what was expected, what to do."""


class RecordingWarning(UserWarning):
    """A recording that can be used although something about it is unusual."""
