"""One model of a reader's phases: thermal noise, what motion and reflections add to it, outliers, pi flips.

Within a dwell (the time that a reader stays on one carrier) a read r has the phase m (wave d_r) + offset + noise, where d_r
is the distance moved since the dwell's first read, wave = 4 pi f / c, and m is 2 where phases count modulo pi, else 1. With
von Mises noise of concentration w_r and a flat prior of the offset, n reads depend on one number, their phasor:

    S = sum_r w_r exp(j m (phi_r - wave d_r)) ,    p(phi_1 .. phi_n) = I0(|S|) / prod_r 2 pi I0(w_r) .

A read that makes S of S' has the log likelihood ratio g = log I0(|S|) - log I0(|S'|) - log I0(w) to a phase at random. With
outliers of probability q it is log((1 - q) exp(g) + q).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.special import i0e
from jaxtyping import Array, Bool, Float

from ..core.constrained import Fraction, Positive
from ..core.numerics import cos_sin, safe_sqrt
from .noise import FLOOR_RAD, INTERCEPT, SLOPE_PER_DBM, UNKNOWN_RSSI_DBM
from .phase import distance_to_phase


class ReaderModel(eqx.Module):
    """The noise of a reader's phases, learnable; the same for all tags and antennas.

    The defaults of `spread_rad` to `outlier` were chosen on simulated training recordings, where scores change little
    within a factor of 1.5.
    """

    slope_per_dbm: Float[Array, "*shape"]  # d log10(thermal noise / rad) / d RSSI
    intercept: Float[Array, "*shape"]  # log10(thermal noise / rad) at 0 dBm
    floor_rad: Positive  # thermal noise at a high RSSI
    spread_rad: Positive  # standard deviation beside thermal noise: reflections, errors of the motion
    still_spread_rad: Positive  # the same of a tag that stays in place
    slack: Positive  # standard deviation as a fraction of the phase moved since the dwell began
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
        slack: float = 0.2,
        outlier: float = 0.04,
        modulo_pi: bool = True,
    ) -> None:
        """Raises `ValueError` for a spread, floor or slack that is not positive, or an outlier probability of 0 or 1."""
        self.slope_per_dbm = jnp.asarray(slope_per_dbm, jnp.float32)
        self.intercept = jnp.asarray(intercept, jnp.float32)
        self.floor_rad = Positive(floor_rad)
        self.spread_rad = Positive(spread_rad)
        self.still_spread_rad = Positive(still_spread_rad)
        self.slack = Positive(slack)
        self.outlier = Fraction(outlier)
        self.modulo_pi = modulo_pi

    @property
    def multiple(self) -> float:
        """m: 2 where phases count modulo pi, else 1."""
        return 2.0 if self.modulo_pi else 1.0

    def thermal_rad(self, rssi_dbm: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Standard deviation of thermal phase noise; of a read without RSSI (NaN) that at `UNKNOWN_RSSI_DBM`."""
        rssi = jnp.where(jnp.isfinite(rssi_dbm), rssi_dbm, UNKNOWN_RSSI_DBM)
        by_rssi = jnp.exp(jnp.log(10.0) * (self.slope_per_dbm * rssi + self.intercept))
        return jnp.sqrt(jnp.square(self.floor_rad.value) + jnp.square(by_rssi))

    def concentration(
        self,
        rssi_dbm: Float[Array, "*#batch"],
        carrier_hz: Float[Array, "*#batch"],
        moved_m: Float[Array, "*batch"],
        still: Bool[Array, "*#batch"],
    ) -> Float[Array, "*batch"]:
        """w = 1 / (m^2 variance) of reads whose tag would have moved so far since the dwell's first read.

        The variance is thermal^2 + spread^2 + (slack wave moved)^2; where `still`, `still_spread_rad` is the spread.
        """
        spread = jnp.where(still, self.still_spread_rad.value, self.spread_rad.value)
        slack_rad = self.slack.value * distance_to_phase(moved_m, carrier_hz)
        variance = jnp.square(self.thermal_rad(rssi_dbm)) + jnp.square(spread) + jnp.square(slack_rad)
        return 1.0 / (self.multiple**2 * variance)

    def add_read(
        self,
        real: Float[Array, "*batch"],
        imaginary: Float[Array, "*batch"],
        concentration: Float[Array, "*batch"],
        residual_rad: Float[Array, "*batch"],
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"], Float[Array, "*batch"]]:
        """A read's log likelihood ratio to a phase at random (nats), and the phasor after it, real and imaginary part.

        `residual_rad` is phi - wave d. The read counts in the phasor by the probability that it is no outlier.
        """
        cos, sin = cos_sin(self.multiple * residual_rad)
        own_real, own_imaginary = concentration * cos, concentration * sin
        before = safe_sqrt(jnp.square(real) + jnp.square(imaginary))
        after = safe_sqrt(jnp.square(real + own_real) + jnp.square(imaginary + own_imaginary))
        # |S'| + w - |S| as a quotient: phasors reach thousands, and their difference in float32 would err by 1e-3 nats.
        along = real * own_real + imaginary * own_imaginary
        lost = 2.0 * (before * concentration - along) / (after + before + concentration)
        ratio = jnp.exp(-lost) * i0e(after) / (i0e(before) * i0e(concentration))
        outlier = self.outlier.value
        inlier = (1.0 - outlier) * ratio
        fraction = inlier / (inlier + outlier)
        return jnp.log(inlier + outlier), real + fraction * own_real, imaginary + fraction * own_imaginary
