"""Pinhole geometry on the host: rays, projection, range and depth, registration, undistortion, crop and resize."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import map_coordinates

from .camera import Intrinsics

KINECT_SHAPE = (424, 512)
"""Height and width of the paper's pictures (Kinect v2)."""


def pixel_rays(intrinsics: Intrinsics) -> Float[np.ndarray, "height width 3"]:
    """((x - cx) / fx, (y - cy) / fy, 1) of every pixel: times depth it is the point. Distortion is not undone."""
    x, y = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    rays = np.stack(
        [(x - intrinsics.cx_px) / intrinsics.fx_px, (y - intrinsics.cy_px) / intrinsics.fy_px, np.ones_like(x, float)],
        axis=-1,
    )
    return rays.astype(np.float32)


def backproject(
    depth_m: Float[np.ndarray, "height width"], intrinsics: Intrinsics
) -> Float[np.ndarray, "height width 3"]:
    """Points (camera frame, metres) of a depth map; the origin where depth is missing."""
    return pixel_rays(intrinsics) * depth_m[..., None]


def project(points_m: Float[np.ndarray, "points 3"], intrinsics: Intrinsics) -> Float[np.ndarray, "points 2"]:
    """Pixel positions (x, y) of points; NaN for points that are not in front of the camera."""
    z = points_m[:, 2]
    ahead = np.where(z > 0, z, np.nan)
    return np.stack(
        [
            intrinsics.fx_px * points_m[:, 0] / ahead + intrinsics.cx_px,
            intrinsics.fy_px * points_m[:, 1] / ahead + intrinsics.cy_px,
        ],
        axis=-1,
    )


def range_to_depth(
    range_m: Float[np.ndarray, "*time height width"], intrinsics: Intrinsics
) -> Float[np.ndarray, "*time height width"]:
    """Depth z of a range map (distance to the camera centre)."""
    return (range_m / np.linalg.norm(pixel_rays(intrinsics), axis=-1)).astype(np.float32)


def depth_to_range(
    depth_m: Float[np.ndarray, "*time height width"], intrinsics: Intrinsics
) -> Float[np.ndarray, "*time height width"]:
    """Distance to the camera centre of a depth map (z)."""
    return (depth_m * np.linalg.norm(pixel_rays(intrinsics), axis=-1)).astype(np.float32)


def register_depth(
    depth_m: Float[np.ndarray, "height width"],
    depth_camera: Intrinsics,
    colour_camera: Intrinsics,
    rotation: Float[np.ndarray, "3 3"],
    translation_m: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "colour_height colour_width"]:
    """Depth as the colour camera would see it: X_colour = rotation X_depth + translation, nearest surface kept.

    Single-pixel holes that the change of view opens between measured pixels take the median of their neighbours;
    larger ones stay 0.
    """
    points = backproject(depth_m, depth_camera)[depth_m > 0].astype(np.float64) @ rotation.T + translation_m
    pixels = project(points, colour_camera)
    column, row = np.rint(pixels).T
    inside = (column >= 0) & (column < colour_camera.width) & (row >= 0) & (row < colour_camera.height)
    flat = row[inside].astype(np.int64) * colour_camera.width + column[inside].astype(np.int64)
    nearest = np.full(colour_camera.height * colour_camera.width, np.inf, np.float32)
    np.minimum.at(nearest, flat, points[inside, 2].astype(np.float32))
    out = np.where(np.isfinite(nearest), nearest, 0).reshape(colour_camera.height, colour_camera.width)
    return _fill_pinholes(out)


def _fill_pinholes(depth_m: np.ndarray) -> np.ndarray:
    padded = np.pad(depth_m, 1)
    height, width = depth_m.shape
    near = np.stack([padded[dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3)])
    known = near > 0
    hole = (depth_m == 0) & (known.sum(axis=0) >= 5)
    if not hole.any():
        return depth_m
    values = np.where(known, near, np.nan)[:, hole]
    out = depth_m.copy()
    out[hole] = np.nanmedian(values, axis=0)
    return out


def undistorted_positions(intrinsics: Intrinsics) -> Float[np.ndarray, "height width 2"]:
    """Where each pixel of the ideal pinhole picture lies in the distorted one (Brown-Conrady k1 k2 p1 p2 k3)."""
    k1, k2, p1, p2, k3 = (*intrinsics.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    rays = pixel_rays(intrinsics).astype(np.float64)
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([xd * intrinsics.fx_px + intrinsics.cx_px, yd * intrinsics.fy_px + intrinsics.cy_px], axis=-1)


def _bilinear(
    colour: UInt8[np.ndarray, "height width 3"], where: Sequence[np.ndarray], *, mode: str
) -> UInt8[np.ndarray, "h w 3"]:
    """The picture at (row, column) positions; beyond its edge black ("constant") or the edge ("nearest")."""
    # For integers SciPy cuts the fraction off, which darkens the picture by half a level.
    bands = [map_coordinates(colour[..., c], where, np.float32, order=1, mode=mode) for c in range(3)]
    return np.clip(np.rint(np.stack(bands, axis=-1)), 0, 255).astype(np.uint8)


def undistort(
    colour: UInt8[np.ndarray, "height width 3"], depth_m: Float[np.ndarray, "height width"], intrinsics: Intrinsics
) -> tuple[UInt8[np.ndarray, "height width 3"], Float[np.ndarray, "height width"], Intrinsics]:
    """Colour (bilinear) and depth (nearest: depth must not be mixed) without lens distortion."""
    positions = undistorted_positions(intrinsics)
    where = [positions[..., 1], positions[..., 0]]
    picture = _bilinear(colour, where, mode="constant")
    depth = map_coordinates(depth_m, where, order=0, cval=0)
    return picture, depth, dataclasses.replace(intrinsics, distortion=())


def crop_resize(
    colour: UInt8[np.ndarray, "height width 3"],
    depth_m: Float[np.ndarray, "height width"],
    intrinsics: Intrinsics,
    shape: tuple[int, int] = KINECT_SHAPE,
) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "h w"], Intrinsics]:
    """Central crop to the aspect of `shape`, then resize (colour bilinear, depth nearest); pixel centres at integers."""
    height, width = shape
    scale = min(intrinsics.width / width, intrinsics.height / height)
    left = (intrinsics.width - scale * width) / 2
    top = (intrinsics.height - scale * height) / 2
    x = left + scale * (np.arange(width) + 0.5) - 0.5
    y = top + scale * (np.arange(height) + 0.5) - 0.5
    where = np.meshgrid(y, x, indexing="ij")
    picture = _bilinear(colour, where, mode="nearest")
    depth = map_coordinates(depth_m, where, order=0, mode="nearest")
    scaled = dataclasses.replace(
        intrinsics,
        fx_px=intrinsics.fx_px / scale,
        fy_px=intrinsics.fy_px / scale,
        cx_px=(intrinsics.cx_px + 0.5 - left) / scale - 0.5,
        cy_px=(intrinsics.cy_px + 0.5 - top) / scale - 0.5,
        width=width,
        height=height,
    )
    return picture, depth, scaled
