"""What the rays of a camera hit: the result of a ray cast, one entry a pixel."""

from __future__ import annotations

import dataclasses

import numpy as np

from .viewpoint import Viewpoint


@dataclasses.dataclass(frozen=True)
class Hits:
    """The first surface on every pixel's ray, and the pose of every geom at that time, which exact flow needs."""

    view: Viewpoint
    geom: np.ndarray  # (height, width) int32, -1 = nothing
    depth_m: np.ndarray  # (height, width) z, 0 = nothing
    normal: np.ndarray  # (height, width, 3) outwards, world
    local_m: np.ndarray  # (height, width, 3) hit point in the geom's frame
    world_m: np.ndarray  # (height, width, 3)
    moving: np.ndarray  # (height, width) bool: on a body that ever moves
    geom_position_m: np.ndarray  # (num_geoms, 3)
    geom_rotation: np.ndarray  # (num_geoms, 3, 3) geom frame to world

    def facing(self) -> np.ndarray:
        """Cosine of the angle between surface normal and line of sight, (height, width), 0 where nothing is hit."""
        ray = self.world_m - self.view.position_m
        away = np.sqrt(np.einsum("hwi,hwi->hw", ray, ray))
        cosine = np.abs(np.einsum("hwi,hwi->hw", ray, self.normal)) / np.maximum(away, 1e-9)
        return np.where(self.geom >= 0, np.minimum(cosine, 1.0), 0.0)
