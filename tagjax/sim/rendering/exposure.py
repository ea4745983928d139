"""From linear light to the picture of a camera: three levels of illumination, exposure, noise, encoding."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

GAMMA = 2.2
"""Exponent of the picture's encoding."""

_ADC_LEVELS = 4096


@dataclasses.dataclass(frozen=True)
class Illumination:
    """Brightness of the room and the camera's response: electrons = light * radiance * full well.

    Noise is shot noise (variance = electrons) and read noise, both multiplied by the gain. Full well and read noise are
    assumed, of the order of a small CMOS sensor with pixels of 2 to 3 um.
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

        Shot noise is drawn from a normal distribution, which is accurate from ten electrons on. The lens blurs by
        `blur_px` (standard deviation), because one ray per pixel makes edges sharper than those of any camera.
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
"""Lamps on; one lamp far away; curtains drawn and lamps off. The camera's gain compensates only a part of it."""


def auto_exposure(radiance: np.ndarray, *, white: float = 0.8, fraction: float = 0.95) -> float:
    """The exposure at which a fraction of the picture's values lies below `white`; set by the first frame in bright light."""
    return float(white / max(np.quantile(radiance[::4, ::4], fraction), 1e-3))
