"""Outlines of moving objects in depth maps and edges in colour images, which the estimate of the registration
compares."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from .rgbd_folder import DepthToColour

NUM_DIRECTIONS = 4
"""Number of edge directions, 45 degrees apart, so that a vertical outline is not matched to a horizontal edge."""

EDGE_HALF = 20.0
"""Colour gradient of edge strength 0.5, grey levels per pixel; the strength saturates at 1."""

MAX_GAP_PX = 16
"""Maximum width of the shadow without depth beside an outline, which the projector's baseline causes."""


@dataclasses.dataclass(frozen=True)
class Outlines:
    """Outline points of moving objects."""

    points_m: np.ndarray  # (points, 3), depth camera
    channel: np.ndarray  # (points,) index into the edge maps: frame * NUM_DIRECTIONS + direction
    object_index: np.ndarray  # (points,) index of the moving object, over all frames

    def subset(self, keep: np.ndarray) -> Outlines:
        return Outlines(self.points_m[keep], self.channel[keep], self.object_index[keep])


def depth_outlines(depth_mm: np.ndarray, view: DepthToColour) -> Outlines:
    """Points on the foreground side of depth steps of moving objects, in all frames; depth in millimetres, 0 = missing."""
    known = np.where(depth_mm > 0, depth_mm, np.nan).astype(np.float32) * np.float32(1e-3)
    static_m = _median_known(known)
    points, channels, objects, first_object = [], [], [], 0
    camera = view.depth_camera
    for frame, depth_m in enumerate(np.nan_to_num(known)):
        # Depth noise of structured light and time of flight grows with the square of the distance, roughly.
        noise_m = 0.06 + 0.008 * depth_m**2
        moved = (depth_m > 0) & (depth_m < static_m - noise_m)
        moved = cv2.morphologyEx(moved.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        beyond = _beyond(depth_m)
        behind_m = beyond.max(axis=0)
        edge = (moved > 0) & (behind_m > depth_m + 2.5 * noise_m)
        _, label, stats, _ = map(np.asarray, cv2.connectedComponentsWithStats(moved, connectivity=8))
        edge &= stats[label, cv2.CC_STAT_AREA] >= 400
        # A gap takes the depth behind it, so that the shadow does not change the outline's normal.
        filled = cv2.GaussianBlur(np.where(depth_m > 0, depth_m, behind_m), (0, 0), 2.0)
        normal = np.stack([cv2.Sobel(filled, cv2.CV_32F, 1, 0), cv2.Sobel(filled, cv2.CV_32F, 0, 1)], axis=-1)
        row, column = np.nonzero(edge)
        z = depth_m[row, column].astype(np.float64)
        at = np.stack([column, row], axis=-1).astype(np.float64)
        along = normal[row, column][:, ::-1] * np.array([1.0, -1.0])
        along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)

        def lifted(pixels: np.ndarray, z: np.ndarray = z) -> np.ndarray:
            x = (pixels[:, 0] - camera.cx_px) / camera.fx_px
            y = (pixels[:, 1] - camera.cy_px) / camera.fy_px
            return np.stack([x, y, np.ones_like(x)], axis=-1) * z[:, None]

        ends = [project_to_colour(lifted(at + sign * along), view) for sign in (-1.0, 1.0)]
        tangent = ends[1] - ends[0]
        angle = np.arctan2(tangent[:, 0], -tangent[:, 1])  # of the normal, in the colour image
        direction = np.rint(angle / np.pi * NUM_DIRECTIONS).astype(int) % NUM_DIRECTIONS
        points.append(lifted(at))
        channels.append(frame * NUM_DIRECTIONS + direction)
        objects.append(first_object + label[row, column])
        first_object += len(stats)
    return Outlines(np.concatenate(points), np.concatenate(channels), np.concatenate(objects))


def _median_known(known: np.ndarray) -> np.ndarray:
    """Median over frames of values that are not NaN; 0 where all are NaN. (nanmedian is slow, and warns there.)"""
    ordered = np.sort(known, axis=0)
    count = np.isfinite(known).sum(axis=0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    return np.where(count > 0, middle, 0).astype(np.float32)


def _beyond(depth_m: np.ndarray) -> np.ndarray:
    """The next measured depth left, right, above and below each pixel, within MAX_GAP_PX; 0 if there is none."""
    out = []
    for turned in range(4):
        turn = np.rot90(depth_m, turned)
        columns = np.arange(turn.shape[1])
        last = np.maximum.accumulate(np.where(turn > 0, columns, -1), axis=1)
        last = np.pad(last, ((0, 0), (1, 0)), constant_values=-1)[:, :-1]
        near = (last >= 0) & (columns - last <= MAX_GAP_PX + 1)
        values = np.take_along_axis(turn, np.maximum(last, 0), axis=1)
        out.append(np.rot90(np.where(near, values, 0), -turned))
    return np.stack(out)


def colour_edges(colour: np.ndarray) -> np.ndarray:
    """Strength of edges that the static scene does not have, 0 to 1, by direction of the normal: (frames * 4, h, w)."""
    static = np.median(colour, axis=0).astype(np.float32)
    own = cv2.dilate(_gradients(static).transpose(1, 2, 0), np.ones((3, 3), np.uint8)).transpose(2, 0, 1)
    out = []
    for image in colour:
        new = np.maximum(_gradients(image.astype(np.float32)) - 1.2 * own, 0)
        out.append((new / (new + EDGE_HALF)).astype(np.float16))
    return np.concatenate(out)


def _gradients(image: np.ndarray) -> np.ndarray:
    """Derivative of the strongest channel along NUM_DIRECTIONS normals, grey levels per pixel: (directions, h, w)."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    x, y = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    angles = np.arange(NUM_DIRECTIONS) * np.pi / NUM_DIRECTIONS
    return np.stack([np.abs(np.cos(a) * x + np.sin(a) * y).max(axis=-1) for a in angles]).astype(np.float32)


def blurred(edges: np.ndarray, blur_px: float) -> np.ndarray:
    """The edge maps, each blurred by a Gaussian."""
    return np.stack([cv2.GaussianBlur(e.astype(np.float32), (0, 0), blur_px).astype(np.float16) for e in edges])


def project_to_colour(points_m: np.ndarray, view: DepthToColour) -> np.ndarray:
    """Pixels (x, y) in the colour image of points of the depth camera, metres."""
    points = points_m @ view.rotation.T + view.translation_m
    z = np.maximum(points[:, 2], 1e-3)
    camera = view.colour_camera
    return np.stack(
        [camera.fx_px * points[:, 0] / z + camera.cx_px, camera.fy_px * points[:, 1] / z + camera.cy_px], axis=-1
    )
