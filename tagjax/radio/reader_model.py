"""One model of a reader's phases: thermal noise, what motion and reflections add to it, outliers, pi flips.

Within a dwell (the time that a reader stays on one carrier) a read has the phase m (wave d + offset) + noise, where d is the
tag's distance, wave = 4 pi f / c, and m is 2 where phases count modulo pi, else 1. What is known of the phase at the present
distance is a von Mises distribution: its phasor P has the direction of the phase and the length of its concentration, 0 at
the dwell's first read. A motion by x turns it, and makes it less sure by the variance of the motion's error, which grows
with the way, and with the depth z as a camera's errors do (pixels are larger there, and depth noise is proportional to z^2):

    P' = P exp(j m wave x) / (1 + |P| v) ,    v = (m wave)^2 drift (z / 1 m)^2 |x| .

A read phi of concentration w adds to it, and has the log likelihood ratio g to a phase at random; with outliers of
probability q that is log((1 - q) exp(g) + q):

    P = P' + w exp(j m phi) ,    g = log I0(|P|) - log I0(|P'|) - log I0(w) .

The error of a motion since the last read counts, not that since the dwell began: reads that follow each other agree in phase
even where reflections have changed it along the way. Reflections change with motion: what moves at a speed u has, beside
thermal noise, the variance

    s_0^2 + (s^2 - s_0^2) u^2 / (u^2 + v0^2) ,

from s_0 at rest to s. So what rests, before it is moved, is as probable for a tag that does not move as the background is.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.special import i0e
from jaxtyping import Array, Float

from ..core.constrained import Fraction, Negative, Positive
from ..core.numerics import cos_sin, safe_sqrt
from .noise import FLOOR_RAD, INTERCEPT, SLOPE_PER_DBM, UNKNOWN_RSSI_DBM
from .phase import distance_to_phase


class ReaderModel(eqx.Module):
    """The noise of a reader's phases, learnable; the same for all tags and antennas.

    The defaults of `spread_rad` to `outlier` were chosen on simulated training recordings, where scores change little
    within a factor of 1.5.
    """

    slope_per_dbm: Negative  # d log10(thermal noise / rad) / d RSSI
    intercept: Float[Array, "*shape"]  # log10(thermal noise / rad) at 0 dBm
    floor_rad: Positive  # thermal noise at a high RSSI
    spread_rad: Positive  # s: standard deviation beside thermal noise: reflections, errors of the motion
    still_spread_rad: Positive  # s_0: the same of a tag that stays in place
    moving_m_s: Positive  # v0: change of the range a second, above which a tag moves rather than stays
    drift_m: Positive  # variance of a motion's error, m^2, for each metre of the way, 1 m from the camera
    outlier: Fraction  # probability of a read with any phase
    modulo_pi: bool = eqx.field(static=True)  # phases count modulo pi, so that pi flips do not matter

    def __init__(
        self,
        *,
        slope_per_dbm: float = SLOPE_PER_DBM,
        intercept: float = INTERCEPT,
        floor_rad: float = FLOOR_RAD,
        spread_rad: float = 0.064,
        still_spread_rad: float = 0.03,
        moving_m_s: float = 0.06,
        drift_m: float = 0.00014,
        outlier: float = 0.04,
        modulo_pi: bool = True,
    ) -> None:
        """Raises `ValueError` for a spread, floor, speed or drift that is not positive, a slope that is not negative, or an outlier
        probability of 0 or 1."""
        self.slope_per_dbm = Negative(slope_per_dbm)
        self.intercept = jnp.asarray(intercept, jnp.float32)
        self.floor_rad = Positive(floor_rad)
        self.spread_rad = Positive(spread_rad)
        self.still_spread_rad = Positive(still_spread_rad)
        self.moving_m_s = Positive(moving_m_s)
        self.drift_m = Positive(drift_m)
        self.outlier = Fraction(outlier)
        self.modulo_pi = modulo_pi

    @property
    def multiple(self) -> float:
        """m: 2 where phases count modulo pi, else 1."""
        return 2.0 if self.modulo_pi else 1.0

    def thermal_rad(self, rssi_dbm: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Standard deviation of thermal phase noise; of a read without RSSI (NaN) that at `UNKNOWN_RSSI_DBM`."""
        rssi = jnp.where(jnp.isfinite(rssi_dbm), rssi_dbm, UNKNOWN_RSSI_DBM)
        by_rssi = jnp.exp(jnp.log(10.0) * (self.slope_per_dbm.value * rssi + self.intercept))
        return jnp.sqrt(jnp.square(self.floor_rad.value) + jnp.square(by_rssi))

    def concentration(
        self, rssi_dbm: Float[Array, "*#batch"], speed_m_s: Float[Array, "*#batch"]
    ) -> Float[Array, "*batch"]:
        """w = 1 / (m^2 variance) of reads of a tag whose range changes at `speed_m_s` (of either sign)."""
        square = jnp.square(speed_m_s)
        moving = square / (square + jnp.square(self.moving_m_s.value))
        still = jnp.square(self.still_spread_rad.value)
        spread = still + (jnp.square(self.spread_rad.value) - still) * moving
        return 1.0 / (self.multiple**2 * (jnp.square(self.thermal_rad(rssi_dbm)) + spread))

    def moved(
        self,
        real: Float[Array, "*batch"],
        imaginary: Float[Array, "*batch"],
        moved_m: Float[Array, "*batch"],
        depth_m: Float[Array, "*#batch"],
        carrier_hz: Float[Array, "*#batch"],
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
        """The phasor after the tag has moved by `moved_m` as seen by a camera at `depth_m` from it.

        It is turned by the phase of that motion, and less sure by the motion's error.
        """
        turn_rad = self.multiple * distance_to_phase(moved_m, carrier_hz)
        wave = self.multiple * distance_to_phase(jnp.ones_like(moved_m), carrier_hz)
        error_m2 = self.drift_m.value * jnp.square(depth_m) * safe_sqrt(jnp.square(moved_m))
        variance = jnp.square(wave) * error_m2
        size = safe_sqrt(jnp.square(real) + jnp.square(imaginary))
        kept = 1.0 / (1.0 + size * variance)
        cos, sin = cos_sin(turn_rad)
        return kept * (real * cos - imaginary * sin), kept * (real * sin + imaginary * cos)

    def add_read(
        self,
        real: Float[Array, "*batch"],
        imaginary: Float[Array, "*batch"],
        concentration: Float[Array, "*batch"],
        phase_rad: Float[Array, "*#batch"],
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"], Float[Array, "*batch"]]:
        """A read's log likelihood ratio to a phase at random (nats), and the phasor after it, real and imaginary part.

        The read counts in the phasor by the probability that it is no outlier.
        """
        cos, sin = cos_sin(self.multiple * phase_rad)
        own_real, own_imaginary = concentration * cos, concentration * sin
        before = safe_sqrt(jnp.square(real) + jnp.square(imaginary))
        after = safe_sqrt(jnp.square(real + own_real) + jnp.square(imaginary + own_imaginary))
        # |S'| + w - |S| as a quotient: phasors reach thousands, and their difference in float32 would err by 1e-3 nats. For
        # the same reason |S'| w - S' . w, where they agree, is (S' x w)^2 / (|S'| w + S' . w).
        along = real * own_real + imaginary * own_imaginary
        across, both = real * own_imaginary - imaginary * own_real, before * concentration
        agree = along > 0
        apart = jnp.where(agree, jnp.square(across) / jnp.where(agree, both + along, 1.0), both - along)
        lost = 2.0 * apart / (after + before + concentration)
        ratio = jnp.exp(-lost) * i0e(after) / (i0e(before) * i0e(concentration))
        outlier = self.outlier.value
        inlier = (1.0 - outlier) * ratio
        fraction = inlier / (inlier + outlier)
        return jnp.log(inlier + outlier), real + fraction * own_real, imaginary + fraction * own_imaginary
