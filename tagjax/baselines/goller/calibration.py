"""What Goller et al. fit at a site: antennas from a tag grid (III.D), filters, thresholds; and the calibration file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.files import write_atomic
from ...core.json_text import parse_json
from ...core.results import finite_array
from ...recording import Recording
from .antennas import FLOOR_DBM, AntennaModel, fit_antennas
from .location import FloorGrid, LocationModel, make_grid, make_location
from .matching import AssociationModel, make_association
from .room import find_room_frame
from .rssi import grid_statistic
from .settings import GollerSettings


class Calibration(eqx.Module):
    """Antennas and location filter, association, and the two alarm thresholds."""

    location: LocationModel
    association: AssociationModel
    alarm_threshold: Float[Array, ""]  # of `exit_score`
    rssi_threshold_dbm: Float[Array, ""]  # of `rssi_score`

    @property
    def num_antennas(self) -> int:
        """The number of antennas that were calibrated."""
        return self.location.antennas.mean_m.shape[0]


def calibrate(recording: Recording, *, floor_dbm: float = FLOOR_DBM, fit_means: bool = False) -> Calibration:
    """The antennas from a recording of a tag grid (III.D); everything else at its initial value.

    Raises `RecordingError` where the recording holds no true positions of its tag, `ValueError` where they do not
    suffice.
    """
    room = find_room_frame(recording)
    statistic = grid_statistic(recording, room)
    known_m = room.to_room(np.asarray(recording.antennas_m, np.float64))[:, :2]
    antennas = fit_antennas(statistic.position_m, statistic.mean_dbm, known_m, floor_dbm=floor_dbm, fit_means=fit_means)
    return Calibration(make_location(antennas), make_association(), jnp.asarray(0.5), jnp.asarray(-60.0))


def floor_grid(calibration: Calibration, settings: GollerSettings) -> FloorGrid:
    """The part of the floor on which tags are located: around the calibrated antennas."""
    mean_m, margin = np.asarray(calibration.location.antennas.mean_m), np.asarray(settings.margin_m)
    low, high = mean_m.min(axis=0) - margin, mean_m.max(axis=0) + margin
    return make_grid((float(low[0]), float(low[1])), (float(high[0]), float(high[1])), settings.cell_m)


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration as JSON."""
    values = {name: np.asarray(leaf).tolist() for name, leaf in _leaves(calibration).items()}
    write_atomic(path, json.dumps(values, indent=1) + "\n")


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration. Raises `ValueError` for a file that cannot be read or holds other values than a
    calibration.
    """
    try:
        found = parse_json(Path(path).read_bytes())
        skew_m = found[".location.antennas.skew_m"]
        if not isinstance(skew_m, list) or not skew_m:
            raise ValueError(f"skew_m is {skew_m!r:.40}; expected a number for each antenna")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path}: no calibration ({type(error).__name__}: {error}). Calibrate from a tag grid: experiments.goller does."
        ) from error
    num = len(skew_m)
    antennas = AntennaModel(jnp.zeros((num, 2)), jnp.zeros((num, 2)), jnp.zeros(num), jnp.zeros(num), jnp.zeros(()))
    template = Calibration(make_location(antennas), make_association(), jnp.zeros(()), jnp.zeros(()))
    expected = _leaves(template)
    if sorted(expected) != sorted(found):
        raise ValueError(f"{path}: found {', '.join(sorted(found))}; expected {', '.join(sorted(expected))}.")
    leaves = [_float32(found[name], np.shape(leaf), f"{path}: {name}") for name, leaf in expected.items()]
    return jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(template), leaves)


def _float32(value: Any, shape: tuple[int, ...], name: str) -> Array:
    with np.errstate(over="ignore"):
        array = finite_array(value, shape, name).astype(np.float32)
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} is {value!r:.40}; expected values that are finite as float32. Calibrate again.")
    return jnp.asarray(array)


def _leaves(calibration: Calibration) -> dict[str, Any]:
    return {jax.tree_util.keystr(key): leaf for key, leaf in jax.tree_util.tree_leaves_with_path(calibration)}
