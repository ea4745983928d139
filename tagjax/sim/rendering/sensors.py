"""Models of depth sensors: noise, quantisation, missing pixels. Cameras' intrinsics, and the times of frames.

Noise models are those of the cited papers, compared with public implementations; values without a source are marked
as assumed.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from ...recording import Intrinsics
from .hits import Hits


def kinect_v2_intrinsics(width: int = 512) -> Intrinsics:
    """A Kinect v2's depth camera, 512x424, 366 px of focal length (published calibrations: 355 to 366 px)."""
    return _centred(366.0 * width / 512, width, round(width * 424 / 512))


def xtion_intrinsics(width: int = 640) -> Intrinsics:
    """An Xtion's colour camera to which depth is registered: 4:3, 534 px at 640 (535.4 by 539.2 px in the
    TUM RGB-D benchmark's freiburg3 recordings).
    """
    return _centred(534.0 * width / 640, width, round(width * 3 / 4))


def _centred(focal_px: float, width: int, height: int) -> Intrinsics:
    return Intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height)


@dataclasses.dataclass(frozen=True)
class KinectV2:
    """Time of flight (Kinect v2). Far, dark, shiny and grazing surfaces return little light: more noise, then no depth.

    Returned light is modelled as reflectance * cos(incidence) / z^2. Assumed: the threshold, at which a white wall has
    depth up to 8 m and black cloth up to about 2.5 m, and the behaviour at edges. That dark and shiny surfaces, grazing
    angles and edges (flying pixels) cause missing depth is known from measurements (Wasenmueller and Stricker, ACCV
    workshops 2016).
    """

    near_m: float = 0.5
    far_m: float = 8.0  # the manufacturer specifies 4.5 m
    reference_reflectance: float = 0.5  # for which the noise model of the paper is taken to hold
    min_return: float = 0.008  # 1/m^2
    min_facing: float = 0.1  # cosine: no depth from 84 degrees on (assumed)
    shine_loss: float = 0.8  # fraction of the returned light that a mirror loses
    flying_fraction: float = 0.5  # of pixels beside an edge that mix the depth of both sides (assumed)
    edge_loss_fraction: float = 0.25  # of those, removed by the sensor's own filter (assumed)
    dropout: float = 0.001

    def noise_m(self, depth_m: np.ndarray, facing: np.ndarray, reflectance: np.ndarray) -> np.ndarray:
        """Standard deviation: 1.5 - 0.5 z + 0.3 z^2 + 0.1 z^1.5 t^2 / (pi/2 - t)^2 mm at incidence t (Fankhauser et al.,
        ICAR 2015), times the square root of the reference over the surface's reflectance (shot noise).
        """
        z = depth_m.astype(np.float32)
        slant = _slant(facing, 84.0)
        sigma = 1.5 - 0.5 * z + 0.3 * z * z + 0.1 * z * np.sqrt(z) * slant * slant
        return sigma * 1e-3 * np.sqrt(self.reference_reflectance / np.clip(reflectance, 0.02, 1.0))

    def measure(self, hits: Hits, reflectance: np.ndarray, shine: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Depth, uint16 millimetres (height, width), 0 = missing, of a cast; reflectance and shine 0 to 1 a pixel."""
        z = hits.depth_m.astype(np.float32)
        facing = hits.facing().astype(np.float32)
        near, far, edge = _edges(z, facing, hits.view.intrinsics.fx_px)
        normal, chance, mix = _draws(rng, z.shape)
        returned = reflectance * facing * (1 - self.shine_loss * shine) / np.maximum(z * z, 0.01)
        # A mirror that faces the sensor blinds it with its own light.
        blinded = (shine > 0.6) & (facing > 0.985)
        missing = (
            (hits.geom < 0) | blinded | (facing < self.min_facing) | (returned * (1 + 0.15 * normal) < self.min_return)
        )
        flying = edge & (chance < self.flying_fraction)
        missing |= flying & (mix < self.edge_loss_fraction)
        weight = np.clip((mix - self.edge_loss_fraction) / (1 - self.edge_loss_fraction), 0, 1)
        measured = np.where(flying, near + weight * (far - near), z)
        measured = measured + normal * self.noise_m(z, facing, reflectance)
        missing |= (measured < self.near_m) | (measured > self.far_m) | (chance > 1 - self.dropout)
        return np.where(missing, 0, np.rint(measured * 1000)).astype(np.uint16)


@dataclasses.dataclass(frozen=True)
class Xtion:
    """Structured light (Xtion, Kinect v1). Surfaces that the projector, beside the camera, does not reach have no depth.

    Depth is quantised in eighths of a pixel of disparity at 580 px and 75 mm (Khoshelham and Elberink, Sensors 2012:
    2.85 mm at 1 m, growing with z^2).
    """

    near_m: float = 0.5
    far_m: float = 9.0
    baseline_m: float = 0.075
    focal_px: float = 580.0  # of the infra-red camera at 640 px
    fraction: int = 8  # of a pixel of disparity
    min_facing: float = 0.17  # cosine: no depth from 80 degrees on (assumed)
    min_return: float = 0.006  # reflectance * facing / z^2 below which no dots are detected (assumed)
    edge_px: float = 0.8  # lateral noise at 640 px (Nguyen et al., 2012)
    dropout: float = 0.002

    def noise_m(self, depth_m: np.ndarray, facing: np.ndarray) -> np.ndarray:
        """Standard deviation of the reported depth: 1.2 mm + 1.9 mm/m^2 (z - 0.4 m)^2 + 0.1 mm/sqrt(z) t^2 / (pi/2 - t)^2
        at incidence t (Nguyen, Izadi and Lovell, 3DIMPVT 2012; measured to about 3 m, continued beyond).
        """
        z = np.maximum(depth_m.astype(np.float32), 0.1)
        slant = _slant(facing, 84.0)
        return 1e-3 * (1.2 + 1.9 * (z - 0.4) ** 2 + 0.1 / np.sqrt(z) * slant * slant)

    def measure(self, hits: Hits, reflectance: np.ndarray, shine: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Depth, uint16 millimetres (height, width), 0 = missing, of a cast; reflectance and shine 0 to 1 a pixel."""
        exact = hits.depth_m.astype(np.float32)
        facing = hits.facing().astype(np.float32)
        k = hits.view.intrinsics
        _, _, edge = _edges(exact, facing, k.fx_px)
        normal, chance, _ = _draws(rng, exact.shape)
        z = exact.copy()
        row, column = np.nonzero(edge)
        step = rng.standard_normal((2, len(row)), dtype=np.float32) * (self.edge_px * k.width / 640)
        other_row = np.clip(row + np.rint(step[0]).astype(int), 0, k.height - 1)
        other_column = np.clip(column + np.rint(step[1]).astype(int), 0, k.width - 1)
        z[row, column] = exact[other_row, other_column]
        steps = self.fraction * self.focal_px * self.baseline_m
        # The noise model is of reported depth and includes the quantisation noise, q / sqrt(12).
        quantum = z * z / steps
        sigma = np.sqrt(np.maximum(self.noise_m(z, facing) ** 2 - quantum * quantum / 12, 1e-8))
        noisy = np.maximum(z + normal * sigma, 0.1)
        measured = steps / np.maximum(np.rint(steps / noisy), 1)
        dark = reflectance * facing < self.min_return * exact * exact
        mirror = (shine > 0.5) & ((facing > 0.97) | (chance < 0.6 * shine))
        missing = (hits.geom < 0) | (facing < self.min_facing) | mirror | (dark & (chance < 0.85))
        missing |= self.unlit(exact, k.fx_px) | (chance > 1 - self.dropout) | (z <= 0)
        missing |= (measured < self.near_m) | (measured > self.far_m)
        return np.where(missing, 0, np.rint(measured * 1000)).astype(np.uint16)

    def unlit(self, depth_m: np.ndarray, focal_px: float) -> np.ndarray:
        """Pixels in the projector's shadow (height, width): to the left of near surfaces, as the projector is right.

        Surfaces that the projector reaches keep their order along the row; those in the shadow of a nearer surface to
        their right do not.
        """
        column = np.arange(depth_m.shape[1], dtype=np.float32)
        seen = np.where(depth_m > 0, column - focal_px * self.baseline_m / np.maximum(depth_m, 0.1), np.inf)
        first = np.minimum.accumulate(seen[:, ::-1], axis=1)[:, ::-1]
        shadow = np.zeros(depth_m.shape, bool)
        shadow[:, :-1] = seen[:, :-1] > first[:, 1:] + 0.25
        return shadow


SENSORS: dict[str, KinectV2 | Xtion] = {"kinect_v2": KinectV2(), "xtion": Xtion()}
"""The depth sensors by name."""


def frame_times(
    num_frames: int, rate_hz: float, rng: np.random.Generator, *, jitter_s: float = 0.004, drop_probability: float = 0.0
) -> np.ndarray:
    """Times (num_frames,) in seconds from 0, strictly increasing: a constant rate with jitter and dropped frames.

    Jitter is normal and limited to 0.4 frames, so that frames keep their order.
    """
    if num_frames < 1 or rate_hz <= 0:
        raise ValueError(f"{num_frames} frames at {rate_hz} Hz; expected at least 1 frame and a positive rate.")
    if not 0 <= drop_probability < 1 or jitter_s < 0:
        raise ValueError(
            f"drop_probability {drop_probability}, jitter_s {jitter_s}; expected 0 <= drop_probability < 1, jitter_s >= 0."
        )
    # The number of nominal frames between two kept ones is geometrically distributed.
    apart = rng.geometric(1 - drop_probability, num_frames - 1) if drop_probability else np.ones(num_frames - 1, int)
    nominal = np.concatenate([[0], np.cumsum(apart)]) / rate_hz
    limit = 0.4 / rate_hz
    times = nominal + np.clip(rng.normal(0, jitter_s, num_frames), -limit, limit)
    return times - times[0]


def _slant(facing: np.ndarray, max_degrees: float) -> np.ndarray:
    """t / (pi/2 - t) of the angle of incidence t, on which the noise models depend; constant above `max_degrees`."""
    angle = np.arccos(np.clip(facing, np.cos(np.radians(max_degrees)), 1.0)).astype(np.float32)
    return angle / (np.float32(np.pi / 2) - angle)


def _edges(z: np.ndarray, facing: np.ndarray, focal_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest and farthest depth around each pixel (3x3), and whether they differ by more than a slope explains."""
    window = np.ones((3, 3), np.uint8)
    far = cv2.dilate(z, window)
    near = cv2.erode(np.where(z > 0, z, np.float32(1e3)), window)
    slope = 2.8 * z / focal_px / np.maximum(facing, 0.05)
    return near, far, (far - near > 0.04 + 0.02 * z + slope) & (near < 1e3)


def _draws(rng: np.random.Generator, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    normal = rng.standard_normal(shape, dtype=np.float32)
    chance, mix = rng.random((2, *shape), dtype=np.float32)
    return normal, chance, mix
