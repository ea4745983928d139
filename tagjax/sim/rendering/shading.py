"""Linear light of a cast: textured surfaces, point lights with shadows, ambient light, motion blur.

Static surfaces are textured and lit once per viewpoint, so a frame costs only its moving pixels. Motion blur is exact:
the mean of several casts while the shutter is open.
"""

from __future__ import annotations

import dataclasses
from typing import SupportsFloat

import numpy as np

from ..world.bodies import Light
from .hits import Hits
from .raycast import Raycaster
from .textures import Paint
from .viewpoint import Viewpoint, view_key

_REFERENCE_M = 2.0  # distance at which a light of power 1 lights a white wall fully
_LAMP_M = 0.3  # radius of a lamp: bounds the light at small distances
_MAX_VIEWS = 4


@dataclasses.dataclass(frozen=True)
class Surface:
    """Material properties of each pixel's surface."""

    albedo: np.ndarray  # (height, width, 3) float32, linear
    shine: np.ndarray  # (height, width) float32

    @property
    def reflectance(self) -> np.ndarray:
        """Reflectance in the infra-red (height, width), on which depth sensors depend: grey to the power 0.6.

        Assumed: most dyes are brighter in the infra-red, so dark cloth returns more light than it appears to.
        """
        grey = self.albedo @ np.array([0.3, 0.5, 0.2], np.float32)
        return grey ** np.float32(0.6)


@dataclasses.dataclass(frozen=True)
class _StaticPart:
    """Surfaces and light of the static bodies from one viewpoint, kept between frames."""

    surface: Surface
    ambient: np.ndarray  # (height, width)
    lights: tuple[tuple[np.ndarray, np.ndarray], ...]  # diffuse and glare, (height, width) each


class Shader:
    """Shades the casts of one raycaster."""

    def __init__(self, raycaster: Raycaster):
        self.raycaster = raycaster
        self._paint = Paint(raycaster.geom_shape)
        self._shine = np.array([material.shine for material in raycaster.materials], np.float32)
        self._static_parts: dict[tuple, _StaticPart] = {}

    def surface(self, hits: Hits) -> Surface:
        """Albedo and shine of every pixel of a cast; black and matt where nothing was hit."""
        static = self._static_part(hits.view).surface
        pixels = np.flatnonzero(hits.moving)
        albedo, shine = static.albedo.copy(), static.shine.copy()
        albedo.reshape(-1, 3)[pixels], shine.reshape(-1)[pixels] = self._surface(hits, pixels)
        return Surface(albedo, shine)

    def radiance(self, hits: Hits, surface: Surface | None = None, *, shadows: bool = True) -> np.ndarray:
        """Linear light (height, width, 3) float32 of a cast of the world's present pose: 1 = white, fully lit.

        Lambert's law and a Blinn-Phong highlight for each point light, whose light falls with squared distance; ambient
        light, a little stronger from above.
        """
        surface = self.surface(hits) if surface is None else surface
        static = self._static_part(hits.view)
        pixels = np.flatnonzero(hits.moving)
        light_sum = static.ambient.copy()
        light_sum.reshape(-1)[pixels] = self._ambient(hits, pixels)
        glare_sum = np.zeros_like(light_sum)
        for light, (diffuse, glare) in zip(self.raycaster.world.lights, static.lights, strict=True):
            diffuse, glare = diffuse.copy(), glare.copy()
            diffuse.reshape(-1)[pixels], glare.reshape(-1)[pixels] = self._light(hits, pixels, light)
            if shadows:
                lit = self.raycaster.lit(hits, light.position_m)
                diffuse *= lit
                glare *= lit
            light_sum += diffuse
            glare_sum += glare
        return surface.albedo * light_sum[..., None] + glare_sum[..., None]

    def blurred(
        self,
        view: Viewpoint,
        step: SupportsFloat,
        shutter_steps: float,
        *,
        num_casts: int = 5,
        shadows: bool = True,
    ) -> np.ndarray:
        """Linear light of a frame whose shutter is open for `shutter_steps`, centred on a step: the mean of casts.

        Leaves the world posed at `step`. Costs as much as `num_casts` pictures.
        """
        total = np.zeros((view.intrinsics.height, view.intrinsics.width, 3), np.float32)
        for part in (np.arange(num_casts) + 0.5) / num_casts - 0.5:
            self.raycaster.pose(float(step) + part * shutter_steps)
            total += self.radiance(self.raycaster.cast(view), shadows=shadows)
        self.raycaster.pose(step)
        return total / np.float32(num_casts)

    def _static_part(self, view: Viewpoint) -> _StaticPart:
        key = view_key(view)
        if key not in self._static_parts:
            while len(self._static_parts) >= _MAX_VIEWS:
                self._static_parts.pop(next(iter(self._static_parts)))
            hits = self.raycaster.background(view)
            shape = hits.geom.shape
            every = np.arange(hits.geom.size)
            albedo, shine = self._surface(hits, every)
            lights = [self._light(hits, every, light) for light in self.raycaster.world.lights]
            self._static_parts[key] = _StaticPart(
                Surface(albedo.reshape(*shape, 3), shine.reshape(shape)),
                self._ambient(hits, every).reshape(shape),
                tuple((diffuse.reshape(shape), glare.reshape(shape)) for diffuse, glare in lights),
            )
        return self._static_parts[key]

    def _surface(self, hits: Hits, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        geom = hits.geom.reshape(-1)[pixels]
        hit = geom >= 0
        albedo, shine = np.zeros((len(pixels), 3), np.float32), np.zeros(len(pixels), np.float32)
        pixels, geom = pixels[hit], geom[hit]
        normal = hits.normal.reshape(-1, 3)[pixels]
        ray = hits.world_m.reshape(-1, 3)[pixels] - hits.view.position_m
        facing = np.abs(np.einsum("ni,ni->n", ray, normal)) / np.linalg.norm(ray, axis=1)
        # A pixel's size on the surface; on a slanted surface, between the sizes in its two directions.
        footprint = hits.depth_m.reshape(-1)[pixels] / hits.view.intrinsics.fx_px / np.sqrt(np.maximum(facing, 0.05))
        turned = np.einsum("nji,nj->ni", hits.geom_rotation[geom], normal)
        albedo[hit] = self._paint.albedo(geom, hits.local_m.reshape(-1, 3)[pixels], turned, footprint)
        shine[hit] = self._shine[geom]
        return albedo, shine

    def _ambient(self, hits: Hits, pixels: np.ndarray) -> np.ndarray:
        up = hits.normal.reshape(-1, 3)[pixels, 2]
        return (self.raycaster.world.ambient * (0.85 + 0.15 * up)).astype(np.float32)

    def _light(self, hits: Hits, pixels: np.ndarray, light: Light) -> tuple[np.ndarray, np.ndarray]:
        """Diffuse light and specular highlight of pixels (flat indices), without shadows."""
        normal = hits.normal.reshape(-1, 3)[pixels].astype(np.float32)
        point = hits.world_m.reshape(-1, 3)[pixels]
        to_light = (np.asarray(light.position_m) - point).astype(np.float32)
        to_eye = (hits.view.position_m - point).astype(np.float32)
        square = np.einsum("ni,ni->n", to_light, to_light)
        to_light /= np.sqrt(square)[:, None]
        to_eye /= np.maximum(np.sqrt(np.einsum("ni,ni->n", to_eye, to_eye)), 1e-9)[:, None]
        cosine = np.maximum(np.einsum("ni,ni->n", to_light, normal), 0)
        fall = np.float32(light.power * (_REFERENCE_M**2 + _LAMP_M**2)) / (square + np.float32(_LAMP_M**2))
        diffuse = np.where(hits.geom.reshape(-1)[pixels] >= 0, fall * cosine, 0).astype(np.float32)
        shine = self._shine[np.maximum(hits.geom.reshape(-1)[pixels], 0)]
        glare = np.zeros_like(diffuse)
        some = np.flatnonzero((shine > 0) & (diffuse > 0))
        half = to_light[some] + to_eye[some]
        half /= np.linalg.norm(half, axis=1)[:, None]
        facing = np.clip(np.einsum("ni,ni->n", half, normal[some]), 0, 1)
        glare[some] = shine[some] * facing ** (8 + 120 * shine[some]) * fall[some] * np.float32(0.6)
        return diffuse, glare
