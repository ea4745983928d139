"""Pinhole geometry on the host: rays, projection, range to depth, depth registration, undistortion."""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy  # `scipy.ndimage` is imported at its first use: it takes a quarter of a second
from jaxtyping import Float, UInt8

from .camera import Intrinsics


def pixel_rays(intrinsics: Intrinsics) -> Float[np.ndarray, "height width 3"]:
    """((x - cx) / fx, (y - cy) / fy, 1) of every pixel: depth times ray is the 3D point. Lens distortion is ignored."""
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


def register_depth(
    depth_m: Float[np.ndarray, "height width"],
    depth_camera: Intrinsics,
    colour_camera: Intrinsics,
    rotation: Float[np.ndarray, "3 3"],
    translation_m: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "colour_height colour_width"]:
    """Depth in the view of the colour camera: X_colour = rotation X_depth + translation; the nearest surface wins.

    Single-pixel holes that the change of view opens between measured pixels take the median of their neighbours;
    larger holes stay 0.
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
    known = np.pad((depth_m > 0).view(np.uint8), 1)
    along = known[:-2] + known[1:-1] + known[2:]
    count = along[:, :-2] + along[:, 1:-1] + along[:, 2:]
    row, column = np.nonzero((depth_m == 0) & (count >= 5))
    if not len(row):
        return depth_m
    padded = np.pad(depth_m, 1)
    near = np.stack([padded[row + dy, column + dx] for dy in range(3) for dx in range(3)])
    out = depth_m.copy()
    out[row, column] = np.nanmedian(np.where(near > 0, near, np.nan), axis=0)
    return out


def undistorted_positions(intrinsics: Intrinsics) -> Float[np.ndarray, "height width 2"]:
    """Position (x, y) in the distorted image of each pixel of the pinhole image, pixels.

    OpenCV's model: Brown-Conrady k1 k2 p1 p2 k3, the rational model's k4 k5 k6, the thin prism's s1 s2 s3 s4. Raises
    `ValueError` for a tilted sensor (coefficients 13 and 14 that are not 0).
    """
    given = intrinsics.distortion
    if any(given[12:]):
        raise ValueError(
            f"distortion has the coefficients {given[12:]} of a tilted sensor; expected at most the 12 of the rational and thin "
            "prism models. Calibrate without CALIB_TILTED_MODEL."
        )
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (*given, *(0.0,) * 12)[:12]
    rays = pixel_rays(intrinsics).astype(np.float64)
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
    return np.stack([xd * intrinsics.fx_px + intrinsics.cx_px, yd * intrinsics.fy_px + intrinsics.cy_px], axis=-1)


def undistort(
    colour: UInt8[np.ndarray, "height width 3"], depth_m: Float[np.ndarray, "height width"], intrinsics: Intrinsics
) -> tuple[UInt8[np.ndarray, "height width 3"], Float[np.ndarray, "height width"], Intrinsics]:
    """Colour (bilinear) and depth (nearest neighbour: depth must not be averaged) without lens distortion; black and 0
    outside.
    """
    positions = undistorted_positions(intrinsics)
    where = [positions[..., 1], positions[..., 0]]
    # With integer output SciPy truncates, which darkens the image by half a level.
    channels = [
        scipy.ndimage.map_coordinates(colour[..., c], where, np.float32, order=1, mode="constant") for c in range(3)
    ]
    image = np.clip(np.rint(np.stack(channels, axis=-1)), 0, 255).astype(np.uint8)
    depth = scipy.ndimage.map_coordinates(depth_m, where, order=0, cval=0)
    return image, depth, dataclasses.replace(intrinsics, distortion=())
