"""TagVision's simulation (Fig. 6): scores of parallel lines, one of which carries the tag."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...baselines.tagvision import PHASE_NOISE_RAD, phase_score, theory_rad
from ...sim.radio.planar import PlanarSettings, planar_trials


@dataclasses.dataclass(frozen=True)
class LineSettings:
    """Where the lines of Fig. 6 and the antenna lie. `circle_m` bends every line into a circle of that radius."""

    name: str = "stated"
    reference: Literal["first", "absolute"] = "first"
    half_length_m: float = 0.3
    antenna_m: tuple[float, float] = (1.018, 0.0)
    circle_m: float | None = None
    num_samples: int = 30
    num_rounds: int = 100
    noise_rad: float = 0.1
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class LineScores:
    """Scores of all lines, and what they say."""

    settings: LineSettings
    line_m: Float[np.ndarray, " lines"]
    true_line: int
    scores: Float[np.ndarray, "rounds lines"]

    def curve(self, rounds: int | None = None) -> Float[np.ndarray, " lines"]:
        """The mean over the first so many rounds (all if None), divided by its maximum as in Fig. 6."""
        mean = self.scores[:rounds].mean(axis=0)
        return mean / mean.max()

    def summary(self) -> dict[str, float]:
        """Figures of the curve of all rounds, and of the rounds one by one."""
        curve, best = self.curve(), np.argmax(self.scores, axis=1)
        others = np.delete(curve, self.true_line)
        return {
            "truth_is_maximum": float(np.argmax(curve) == self.true_line),
            "truth_is_maximum_share_of_rounds": float(np.mean(best == self.true_line)),
            "error_of_a_round_mm": float(np.mean(np.abs(self.line_m[best] - self.line_m[self.true_line])) * 1e3),
            "others_below_0.075": float(np.mean(others < 0.075)),
            "others_least": float(others.min()),
            "others_median": float(np.median(others)),
            "others_90_percent_below": float(np.quantile(others, 0.9)),
            "others_most": float(others.max()),
            "neighbours": float(0.5 * (curve[self.true_line - 1] + curve[self.true_line + 1])),
        }


def line_scores(settings: LineSettings) -> LineScores:
    """Score 101 lines 6 mm apart, the middle one with the tag (Fig. 6), by "absolute" or "first"-sample reference.

    Straight lines and their phases are `sim.planar`'s. With the first sample as reference an unknown constant is added
    to every round's phases, as a real reader does.
    """
    drawn = planar_trials(
        PlanarSettings(
            num_samples=settings.num_samples,
            num_rounds=settings.num_rounds,
            half_length_m=settings.half_length_m,
            antenna_m=settings.antenna_m,
            noise_rad=settings.noise_rad,
        ),
        seed=settings.seed,
    )
    x, y = np.zeros_like(drawn.sample_m), drawn.sample_m
    phase = drawn.phase_rad
    if settings.circle_m is not None:
        angle = np.pi * drawn.sample_m / settings.half_length_m
        x, y = settings.circle_m * np.cos(angle), settings.circle_m * np.sin(angle)
    # (lines, rounds, samples, 3): every line has the same samples.
    across = drawn.line_m[:, None, None] + x[None]
    place = np.stack([across, np.broadcast_to(y, across.shape), np.zeros_like(across)], axis=-1)
    antenna = jnp.asarray((*settings.antenna_m, 0.0), jnp.float32)
    carrier = jnp.full(across.shape, drawn.carrier_hz, jnp.float32)
    theory = theory_rad(jnp.asarray(place, jnp.float32), antenna, carrier)
    if settings.circle_m is not None:
        rng = np.random.default_rng([settings.seed, 1])
        phase = np.asarray(theory[drawn.true_line]) + settings.noise_rad * rng.normal(size=y.shape)
    if settings.reference == "first":
        phase = phase + drawn.phase_offset_rad[:, None]
    residual = jnp.asarray(np.mod(phase, 2 * np.pi), jnp.float32)[None] - theory
    counted = jnp.ones(settings.num_samples, bool)
    sigma = PHASE_NOISE_RAD * 2**0.5
    one = lambda r: phase_score(r, counted, sigma_rad=sigma, reference=settings.reference)  # noqa: E731
    scores = jax.jit(jax.vmap(jax.vmap(one)))(residual)
    return LineScores(settings, drawn.line_m, drawn.true_line, np.asarray(scores, np.float64).T)
