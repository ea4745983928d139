"""Exact optical flow between two casts, forward and backward, with occlusion in both directions."""

from __future__ import annotations

import dataclasses

import numpy as np

from .hits import Hits
from .viewpoint import view_key


@dataclasses.dataclass(frozen=True)
class FlowTruth:
    """Flow in pixels (x right, y down) and occlusion: True where a pixel's point is not visible in the other picture.

    That is where it is behind another surface, turned away, or outside the frame. Pixels without a hit have no flow and
    are not occluded.
    """

    forward_px: np.ndarray  # (height, width, 2) float32, of the first picture's pixels
    backward_px: np.ndarray  # (height, width, 2) float32, of the second picture's pixels
    forward_occluded: np.ndarray  # (height, width) bool
    backward_occluded: np.ndarray  # (height, width) bool


def flow_between(before: Hits, after: Hits) -> FlowTruth:
    """Forward and backward flow between two casts of one world at two poses, from one camera or a camera that moved."""
    if before.geom.shape != after.geom.shape or len(before.geom_position_m) != len(after.geom_position_m):
        raise ValueError(
            f"Casts of {before.geom.shape} pixels, {len(before.geom_position_m)} geoms and {after.geom.shape}, "
            f"{len(after.geom_position_m)} geoms: flow needs two casts of one world at one size."
        )
    forward, forward_occluded = one_way_flow(before, after)
    backward, backward_occluded = one_way_flow(after, before)
    return FlowTruth(forward, backward, forward_occluded, backward_occluded)


def one_way_flow(source: Hits, target: Hits) -> tuple[np.ndarray, np.ndarray]:
    """Flow (height, width, 2) float32 from `source`'s pixels to `target`, and where these are occluded in `target`.

    Each hit point moves with its geom. As geoms are convex, the point is visible if its surface faces the camera and one
    of the four pixels around its new position shows its geom.
    """
    height, width = source.geom.shape
    flow = np.zeros((height, width, 2), np.float32)
    # Most pixels lie on a geom that did not move, seen by a camera that did not move: zero flow.
    hidden = (target.geom != source.geom) & (source.geom >= 0)
    if view_key(source.view) == view_key(target.view):
        still = np.all(source.geom_position_m == target.geom_position_m, axis=1)
        still &= np.all(source.geom_rotation == target.geom_rotation, axis=(1, 2))
        pixels = np.flatnonzero((source.geom >= 0) & ~still[np.maximum(source.geom, 0)])
    else:
        pixels = np.flatnonzero(source.geom >= 0)
    geom = source.geom.reshape(-1)[pixels]
    turn = target.geom_rotation[geom]
    world = np.einsum("nij,nj->ni", turn, source.local_m.reshape(-1, 3)[pixels]) + target.geom_position_m[geom]
    normal = source.normal.reshape(-1, 3)[pixels]
    normal = np.einsum("nij,nj->ni", turn, np.einsum("nji,nj->ni", source.geom_rotation[geom], normal))
    view = target.view
    k = view.intrinsics
    camera = view.to_camera(world)
    ahead = camera[:, 2] > 1e-6
    z = np.where(ahead, camera[:, 2], 1.0)
    x, y = k.fx_px * camera[:, 0] / z + k.cx_px, k.fy_px * camera[:, 1] / z + k.cy_px
    row, column = np.divmod(pixels, width)
    moved = np.where(ahead[:, None], np.stack([x - column, y - row], axis=-1), 0.0)
    flow.reshape(-1, 2)[pixels] = moved
    seen = np.zeros(len(pixels), bool)
    left, top = np.floor(np.clip(x, -2, width + 1)).astype(int), np.floor(np.clip(y, -2, height + 1)).astype(int)
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        u, v = np.clip(left + right, 0, width - 1), np.clip(top + down, 0, height - 1)
        seen |= target.geom[v, u] == geom
    inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    towards = np.einsum("ni,ni->n", world - view.position_m, normal) < 0
    hidden.reshape(-1)[pixels] = ~(seen & inside & ahead & towards)
    return flow, hidden
