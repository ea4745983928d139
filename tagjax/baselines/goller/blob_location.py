"""Where a blob stands on the floor, from its box and the camera alone or from depth (Goller et al., III.B)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Shaped

from ...core.geometry import pixel_rays
from ...recording import Intrinsics
from ..boxes import box_centre_px
from .detection import BlobSettings
from .room import RoomFrame

_BORDER_PX = 2


class BlobLocator:
    """Positions of blobs in the room frame, by `BlobSettings.position`.

    "centre", for a camera that looks down, as the paper's: the ray of the box's centre meets the plane at half the
    height of a person. "foot", for a camera that looks along the room: the ray of the lowest pixels meets the floor;
    where the picture cuts the feet off, the ray of the highest pixels meets the plane at the person's height. "depth":
    the median of the depth camera's points, which the paper does not have.
    """

    def __init__(self, settings: BlobSettings, room: RoomFrame, intrinsics: Intrinsics):
        self._settings, self._room, self._intrinsics = settings, room, intrinsics
        self._rays = pixel_rays(intrinsics)

    def position(
        self,
        box_px: Shaped[np.ndarray, " 4"],
        mask: Bool[np.ndarray, "height width"],
        depth_m: Float[np.ndarray, "height width"],
        height_m: float | None = None,
    ) -> Float[np.ndarray, " 2"] | None:
        """Where a blob of a height (`person_height_m` if None) stands on the floor; None where that is unknown."""
        if self._settings.position == "depth":
            points = (self._rays * depth_m[..., None])[mask & (depth_m > 0)]
            return np.median(self._room.to_room(points.astype(np.float64))[:, :2], axis=0) if len(points) else None
        tall = self._settings.person_height_m if height_m is None else height_m
        centre = box_centre_px(box_px)
        if self._settings.position == "centre":
            row, plane = centre[1], 0.5 * tall
        elif self.cuts_feet(box_px):
            row, plane = box_px[1], tall
        else:
            row, plane = box_px[3], 0.0
        pixel = np.array([[centre[0], float(row)]])
        found = self._room.pixels_on_plane(pixel, self._intrinsics, plane)[0]
        return found if np.all(np.isfinite(found)) else None

    def cuts_feet(self, box_px: Shaped[np.ndarray, " 4"]) -> bool:
        """Whether the picture's lower edge cuts a box off."""
        return bool(box_px[3] >= self._intrinsics.height - _BORDER_PX - 1)

    def shows_whole(self, box_px: Shaped[np.ndarray, " 4"]) -> bool:
        """Whether head and feet are both in the picture."""
        return bool(box_px[1] > _BORDER_PX) and not self.cuts_feet(box_px)

    def height_m(self, box_px: Shaped[np.ndarray, " 4"], position_m: Float[np.ndarray, " 2"]) -> float:
        """Height of the ray of a box's upper edge over a position on the floor; `person_height_m` if that is
        undefined.
        """
        pixel = np.array([[box_centre_px(box_px)[0], float(box_px[1])]])
        ground, above = (self._room.pixels_on_plane(pixel, self._intrinsics, height)[0] for height in (0.0, 1.0))
        if not np.isfinite([ground, above]).all():
            return self._settings.person_height_m
        return float(np.linalg.norm(ground - position_m) / max(float(np.linalg.norm(ground - above)), 1e-6))

    def visible_area_m2(self, area_px: int, position_m: Float[np.ndarray, " 2"]) -> float:
        """Area in square metres, seen by the camera, of a blob that stands at a position."""
        camera = -self._room.axes @ self._room.origin_m
        middle = np.append(position_m, 0.5 * self._settings.person_height_m)
        distance = float(np.linalg.norm(middle - camera))
        return area_px * distance**2 / (self._intrinsics.fx_px * self._intrinsics.fy_px)
