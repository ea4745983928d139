"""Checks of parameters by name."""

from __future__ import annotations

import reprlib

import numpy as np

_MIN_FLOAT32, _MAX_FLOAT32 = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)


def check_positive(**values: float) -> None:
    """Raise `ValueError` with the name of a value that is not positive, or is 0 or infinite in float32."""
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name} is {value}; expected a positive value (it is stored as its logarithm).")
        if not _MIN_FLOAT32 <= value <= _MAX_FLOAT32:
            raise ValueError(
                f"{name} is {reprlib.repr(value)}; expected {_MIN_FLOAT32:g} to {_MAX_FLOAT32:g}, as float32 has."
            )


def check_fractions(**values: float) -> None:
    """Raise `ValueError` with the name of a value that is not a fraction from 0 to 1."""
    for name, value in values.items():
        if not 0 <= value <= 1:
            raise ValueError(f"{name} is {value}; expected a fraction from 0 to 1.")


def check_positive_integers(**values: int) -> None:
    """Raise `ValueError` with the name of a value that is not an integer of at least 1."""
    for name, value in values.items():
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"{name} is {value!r}; expected an integer of at least 1.")
