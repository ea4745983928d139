"""TagVision's simulation (INFOCOM 2017, Fig. 6): parallel lines beside an antenna, one of which carries the tag."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from jaxtyping import Float

from ...core.numerics import SPEED_OF_LIGHT_M_S
from ...recording import RecordingError

FORMAT = "tagjax-planar"

_ARRAYS = ("line_m", "sample_m", "phase_rad", "phase_offset_rad")


@dataclasses.dataclass(frozen=True)
class PlanarSettings:
    """Geometry of the figure. `noise_rad` is our choice: the paper gives white Gaussian noise without a level."""

    num_lines: int = 101
    spacing_m: float = 0.006
    num_samples: int = 30
    half_length_m: float = 0.3
    antenna_m: tuple[float, float] = (1.018, 0.0)
    num_rounds: int = 100
    carrier_hz: float = 920.625e6
    noise_rad: float = 0.1

    def __post_init__(self):
        if self.num_lines < 1 or self.num_samples < 2 or self.num_rounds < 1:
            raise ValueError(
                f"{self.num_lines} lines, {self.num_samples} samples, {self.num_rounds} rounds; at least 1, 2 and 1."
            )
        if min(self.spacing_m, self.half_length_m, self.carrier_hz) <= 0 or self.noise_rad < 0:
            raise ValueError("Spacing, half length and carrier must be positive, noise not negative.")


@dataclasses.dataclass(frozen=True)
class PlanarTrials:
    """The measurements of every round. Line k is x = line_m[k]; the tag is on line `true_line`."""

    line_m: Float[np.ndarray, " lines"]
    sample_m: Float[np.ndarray, "rounds samples"]  # y of each sample, the same on every line
    phase_rad: Float[np.ndarray, "rounds samples"]  # in [0, 2 pi), without any offset
    phase_offset_rad: Float[np.ndarray, " rounds"]  # of a real reader: add it, modulo 2 pi, to include it
    true_line: int
    antenna_m: tuple[float, float]
    carrier_hz: float


def planar_trials(settings: PlanarSettings | None = None, *, seed: int) -> PlanarTrials:
    """Draw the samples and phases of every round."""
    settings = settings or PlanarSettings()
    rng = np.random.default_rng(seed)
    line = (np.arange(settings.num_lines) - settings.num_lines // 2) * settings.spacing_m
    true_line = settings.num_lines // 2
    sample = rng.uniform(-settings.half_length_m, settings.half_length_m, (settings.num_rounds, settings.num_samples))
    x, y = settings.antenna_m
    distance = np.hypot(line[true_line] - x, sample - y)
    phase = 4 * np.pi * settings.carrier_hz * distance / SPEED_OF_LIGHT_M_S
    phase = phase + settings.noise_rad * rng.normal(size=phase.shape)
    return PlanarTrials(
        line_m=line,
        sample_m=sample,
        phase_rad=np.mod(phase, 2 * np.pi),
        phase_offset_rad=rng.uniform(0, 2 * np.pi, settings.num_rounds),
        true_line=true_line,
        antenna_m=settings.antenna_m,
        carrier_hz=settings.carrier_hz,
    )


def save_planar(trials: PlanarTrials, path: Path) -> None:
    """Write trials as a Zarr group. The attributes are written last: without them the group is unreadable."""
    root = zarr.open_group(str(path), mode="w", zarr_format=3)
    for name in _ARRAYS:
        values = getattr(trials, name)
        root.create_array(name, shape=values.shape, dtype=values.dtype, chunks=values.shape)[...] = values
    root.attrs.update(
        {
            "format": FORMAT,
            "true_line": trials.true_line,
            "antenna_m": list(trials.antenna_m),
            "carrier_hz": trials.carrier_hz,
        }
    )


def open_planar(path: str | Path) -> PlanarTrials:
    """Read trials. Raises `RecordingError` where arrays or attributes are missing or unreadable."""
    try:
        root = zarr.open_group(str(path), mode="r", zarr_format=3)
        attributes: dict[str, Any] = dict(root.attrs)
        if attributes.get("format") != FORMAT:
            raise RecordingError(
                f"{path}: format {attributes.get('format')!r}; expected {FORMAT!r}. Simulate it again."
            )
        arrays = {name: np.asarray(array[...]) for name, array in root.arrays() if name in _ARRAYS}
        if set(arrays) != set(_ARRAYS):
            raise RecordingError(f"{path}: {', '.join(sorted(set(_ARRAYS) - set(arrays)))} missing. Simulate it again.")
    except RecordingError:
        raise
    except Exception as error:
        raise RecordingError(f"{path}: no readable planar trials ({type(error).__name__}: {error}).") from error
    x, y = attributes["antenna_m"]
    return PlanarTrials(
        **arrays, true_line=int(attributes["true_line"]), antenna_m=(x, y), carrier_hz=float(attributes["carrier_hz"])
    )
