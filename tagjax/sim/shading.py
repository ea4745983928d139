"""Colour pictures of a cast: point lights with shadows on textured surfaces, three levels of light, a camera's noise.

NumPy throughout: what never moves is textured and lit once a viewpoint, so a frame costs what moves. Of the two ways to
motion blur, it is the exact one: the mean of several casts while the shutter is open.
"""

from __future__ import annotations

import dataclasses
from typing import SupportsFloat

import cv2
import numpy as np

from .raycast import Hits, Stage, view_key
from .renderer import Viewpoint
from .textures import Paint
from .world import Light

GAMMA = 2.2
"""Of the picture's encoding."""

_ADC_LEVELS = 4096
_REFERENCE_M = 2.0  # where a light of power 1 lights fully
_LAMP_M = 0.3  # radius of a lamp: nothing nearer gets brighter without end
_MAX_VIEWS = 4


@dataclasses.dataclass(frozen=True)
class Illumination:
    """How bright the room is, and what the camera makes of it: electrons = light * radiance * full well.

    Noise is shot noise (variance = electrons) and read noise, both lifted by the gain. Well and read noise are assumed,
    of the order of a small CMOS sensor's with pixels of 2 to 3 um.
    """

    light: float
    gain: float
    full_well_e: float = 6000.0
    read_noise_e: float = 5.0

    def noise(self, radiance: np.ndarray) -> np.ndarray:
        """Standard deviation of the linear picture (1 = white) at a radiance."""
        electrons = np.maximum(radiance, 0) * np.float32(self.light * self.full_well_e)
        return np.sqrt(electrons + np.float32(self.read_noise_e**2)) * np.float32(self.gain / self.full_well_e)

    def expose(
        self, radiance: np.ndarray, rng: np.random.Generator, *, exposure: float = 1.0, blur_px: float = 0.5
    ) -> np.ndarray:
        """The picture, uint8 RGB, of linear light (height, width, 3): lens, noise, a 12-bit converter, gamma.

        Shot noise is drawn as normal, which it nearly is from ten electrons on. The lens blurs by `blur_px` (standard
        deviation), as one ray a pixel makes edges harder than any camera's.
        """
        light = np.asarray(radiance, np.float32) * np.float32(exposure)
        if blur_px > 0:
            light = cv2.GaussianBlur(light, (3, 3) if blur_px < 0.7 else (0, 0), blur_px)
        noise = self.noise(light)
        noise *= rng.standard_normal(light.shape, dtype=np.float32)
        light *= np.float32(self.light * self.gain)
        light += noise
        light *= np.float32(_ADC_LEVELS - 1)
        np.clip(light, 0, _ADC_LEVELS - 1, out=light)
        light += np.float32(0.5)
        return _ENCODED[light.astype(np.uint16)]


_ENCODED = np.rint(255 * (np.arange(_ADC_LEVELS) / (_ADC_LEVELS - 1)) ** (1 / GAMMA)).astype(np.uint8)

ILLUMINATION = {
    "bright": Illumination(light=1.0, gain=1.0),
    "dim": Illumination(light=0.15, gain=3.0),
    "dark": Illumination(light=0.02, gain=8.0),
}
"""Lamps on; one lamp far away; curtains drawn and lamps off. The camera's gain makes up for part of it only."""


def auto_exposure(radiance: np.ndarray, *, white: float = 0.8, share: float = 0.95) -> float:
    """The exposure that puts a share of a picture's values below `white`; of the first frame, at bright light."""
    return float(white / max(np.quantile(radiance[::4, ::4], share), 1e-3))


@dataclasses.dataclass(frozen=True)
class Surface:
    """What each pixel's surface is like, apart from light."""

    albedo: np.ndarray  # (height, width, 3) float32, linear
    shine: np.ndarray  # (height, width) float32

    @property
    def reflectance(self) -> np.ndarray:
        """Reflectance in the infra-red (height, width), which depth sensors go by: grey to the power 0.6.

        Most dyes are clearer there than to the eye, so dark cloth returns more than it looks (a guess at a rule).
        """
        grey = self.albedo @ np.array([0.3, 0.5, 0.2], np.float32)
        return grey ** np.float32(0.6)


@dataclasses.dataclass(frozen=True)
class _Rest:
    """A viewpoint's surfaces and light where nothing moves: kept, and patched where something does."""

    surface: Surface
    ambient: np.ndarray  # (height, width)
    lights: tuple[tuple[np.ndarray, np.ndarray], ...]  # diffuse and glare, (height, width) each


class Shader:
    """Shades the casts of one stage."""

    def __init__(self, stage: Stage):
        self.stage = stage
        self._paint = Paint(stage.geom_shape)
        self._shine = np.array([material.shine for material in stage.materials], np.float32)
        self._rest: dict[tuple, _Rest] = {}

    def surface(self, hits: Hits) -> Surface:
        """Albedo and shine of every pixel of a cast; black and matt where nothing was hit."""
        rest = self._at_rest(hits.view).surface
        pixels = np.flatnonzero(hits.moving)
        albedo, shine = rest.albedo.copy(), rest.shine.copy()
        albedo.reshape(-1, 3)[pixels], shine.reshape(-1)[pixels] = self._surface(hits, pixels)
        return Surface(albedo, shine)

    def radiance(self, hits: Hits, surface: Surface | None = None, *, shadows: bool = True) -> np.ndarray:
        """Linear light (height, width, 3) float32 of a cast of the stage's present pose: 1 = white, fully lit.

        Lambert's law and a Blinn-Phong highlight for each point light, whose light falls with squared distance; ambient
        light, a little stronger from above.
        """
        surface = self.surface(hits) if surface is None else surface
        rest = self._at_rest(hits.view)
        pixels = np.flatnonzero(hits.moving)
        light_sum = rest.ambient.copy()
        light_sum.reshape(-1)[pixels] = self._ambient(hits, pixels)
        glare_sum = np.zeros_like(light_sum)
        for light, (diffuse, glare) in zip(self.stage.world.lights, rest.lights, strict=True):
            diffuse, glare = diffuse.copy(), glare.copy()
            diffuse.reshape(-1)[pixels], glare.reshape(-1)[pixels] = self._light(hits, pixels, light)
            if shadows:
                lit = self.stage.lit(hits, light.position_m)
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

        Leaves the stage posed at `step`. Costs `num_casts` pictures.
        """
        total = np.zeros((view.intrinsics.height, view.intrinsics.width, 3), np.float32)
        for part in (np.arange(num_casts) + 0.5) / num_casts - 0.5:
            self.stage.pose(float(step) + part * shutter_steps)
            total += self.radiance(self.stage.cast(view), shadows=shadows)
        self.stage.pose(step)
        return total / np.float32(num_casts)

    def _at_rest(self, view: Viewpoint) -> _Rest:
        key = view_key(view)
        if key not in self._rest:
            while len(self._rest) >= _MAX_VIEWS:
                self._rest.pop(next(iter(self._rest)))
            hits = self.stage.background(view)
            shape = hits.geom.shape
            every = np.arange(hits.geom.size)
            albedo, shine = self._surface(hits, every)
            lights = [self._light(hits, every, light) for light in self.stage.world.lights]
            self._rest[key] = _Rest(
                Surface(albedo.reshape(*shape, 3), shine.reshape(shape)),
                self._ambient(hits, every).reshape(shape),
                tuple((diffuse.reshape(shape), glare.reshape(shape)) for diffuse, glare in lights),
            )
        return self._rest[key]

    def _surface(self, hits: Hits, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        geom = hits.geom.reshape(-1)[pixels]
        hit = geom >= 0
        albedo, shine = np.zeros((len(pixels), 3), np.float32), np.zeros(len(pixels), np.float32)
        pixels, geom = pixels[hit], geom[hit]
        normal = hits.normal.reshape(-1, 3)[pixels]
        ray = hits.world_m.reshape(-1, 3)[pixels] - hits.view.position_m
        facing = np.abs(np.einsum("ni,ni->n", ray, normal)) / np.linalg.norm(ray, axis=1)
        # A pixel's size on the surface; on a slant, between those of its two directions.
        footprint = hits.depth_m.reshape(-1)[pixels] / hits.view.intrinsics.fx_px / np.sqrt(np.maximum(facing, 0.05))
        turned = np.einsum("nji,nj->ni", hits.geom_rotation[geom], normal)
        albedo[hit] = self._paint.albedo(geom, hits.local_m.reshape(-1, 3)[pixels], turned, footprint)
        shine[hit] = self._shine[geom]
        return albedo, shine

    def _ambient(self, hits: Hits, pixels: np.ndarray) -> np.ndarray:
        up = hits.normal.reshape(-1, 3)[pixels, 2]
        return (self.stage.world.ambient * (0.85 + 0.15 * up)).astype(np.float32)

    def _light(self, hits: Hits, pixels: np.ndarray, light: Light) -> tuple[np.ndarray, np.ndarray]:
        """Diffuse light on, and glare from, pixels (flat indices), without shadows."""
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
