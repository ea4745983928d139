"""Association scores of several methods on windows of real tracks, one of which carries a virtual tag.

A virtual tag (`tagjax.recording.virtual_tags`) is put on each person in turn. The tracks that the methods receive have
added noise, so that the carrier's track is not exactly the tag's path.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from ...baselines.tagview.line_fit import fit_pairs
from ...baselines.tagview.sequences import ReadSettings, tag_measurements
from ...baselines.tagvision.phase_score import Snapshots, match_scores
from ...radio.channels import estimate_slope
from ...radio.reader import ReaderSettings
from ...recording import TagReads
from ...recording.virtual_tags import Track, virtual_reads
from ...tagattention.attention import att_corr, att_rbf, attention, coherent_score
from ...tracing.range_windows import phase_reads, radio_windows
from .scenes import NUM_WINDOW, Scene, TracksConfig, antenna_place

METHODS = (
    "TagAttention, coherent",
    "TagAttention, coherent, angle not doubled",
    "TagAttention, Eqs. 4-6",
    "TagVision",
    "Tagview",
)
"""The methods that are scored. Goller et al. need RSSI at several antennas and a calibration, which tracks do not have.

The doubled angle that the tracer uses for readers with pi flips is unaffected by flips, but turns by 8 pi / wavelength a
metre: noise of 2 cm a frame is 1.5 rad, which leaves exp(-1.5^2 / 2) = 0.3 of the carrier's coherence. The angle itself
keeps 0.74 of it, and a fraction p of flips multiplies it by 1 - 2 p.
"""

_ALPHA_M2, _BETA = 5e-4, 0.8  # TagAttention's
_EPC = "virtual"


@dataclasses.dataclass(frozen=True)
class Window:
    """The input of the methods: the candidates' distances at the frames, and the reads of one tag."""

    time_s: Float[np.ndarray, " frames"]
    distance_m: Float[np.ndarray, "people frames"]
    reads: TagReads
    carrier: int  # index of the candidate that carries the tag


def windows(scene: Scene, length_s: float, config: TracksConfig) -> list[Window]:
    """Windows of a length with two people or more, at most `config.max_windows`, evenly spaced over tags and times."""
    rng = np.random.default_rng([config.seed, len(scene.name)])
    antenna, candidates = antenna_place(scene), []
    three = lambda place: np.concatenate([place, np.zeros((*place.shape[:-1], 1))], axis=-1)  # noqa: E731
    num = round(length_s * config.frame_rate_hz)
    settings = ReaderSettings(region=config.region, flip_probability=config.flip_probability)
    true_m = np.linalg.norm(three(scene.position_m) - antenna, axis=-1)
    noisy = scene.position_m + config.noise_m * rng.normal(size=scene.position_m.shape)
    noisy_m = np.linalg.norm(three(noisy) - antenna, axis=-1)
    for person, place in enumerate(scene.position_m):
        reads = virtual_reads(
            Track(scene.time_s, three(place)), _EPC, settings, seed=config.seed + person, antenna_m=antenna
        )
        for start in range(0, len(scene.time_s) - num, max(num // 2, 1)):
            span = slice(start, start + num)
            here = np.all(np.isfinite(true_m[:, span]), axis=1)
            if not here[person] or here.sum() < 2 or np.ptp(true_m[person, span]) < config.min_move_m:
                continue
            first, last = scene.time_s[start], scene.time_s[start + num - 1]
            inside = (reads.time_ns >= first * 1e9) & (reads.time_ns <= last * 1e9)
            tag_reads = dataclasses.replace(reads[inside], time_ns=reads.time_ns[inside] - round(first * 1e9))
            carrier = int(np.sum(here[:person]))
            candidates.append(Window(scene.time_s[span] - first, noisy_m[here][:, span], tag_reads, carrier))
    chosen = np.linspace(0, len(candidates) - 1, min(len(candidates), config.max_windows))
    return [candidates[i] for i in chosen.round().astype(int)] if candidates else []


def association_scores(window: Window, *, seed: int = 0) -> dict[str, Float[np.ndarray, " people"]]:
    """Every method's score of every candidate; all 0 with fewer than four reads."""
    people = len(window.distance_m)
    if window.reads.num_reads < 4:
        return {name: np.zeros(people) for name in METHODS}
    frames, distance = jnp.asarray(window.time_s, jnp.float32), jnp.asarray(window.distance_m, jnp.float32)
    flips = bool(window.reads.pi_flips)
    reads = phase_reads(window.reads, _EPC, 0)
    coherent, plain = (coherent_score(distance[None], reads, frames, doubled_angle=one)[0] for one in (flips, False))
    radio = radio_windows(reads, frames, NUM_WINDOW)
    windowed = _windowed_attention(distance, radio.relative_m, radio.std_m)
    stamp = window.reads.time_ns * 1e-9
    carrier = window.reads.carrier_hz
    channel = np.unique(carrier, return_inverse=True)[1].reshape(-1)
    slope = estimate_slope(window.reads.phase_rad, stamp, channel, carrier).slope_rad_hz
    snapshots = Snapshots(
        jnp.asarray(window.reads.phase_rad, jnp.float32),
        jnp.asarray(carrier, jnp.float32),
        jnp.asarray(np.stack([np.interp(stamp, window.time_s, one) for one in window.distance_m]), jnp.float32),
        jnp.ones((people, len(stamp)), bool),
    )
    vision = match_scores(
        snapshots,
        key=jax.random.key(seed),
        num_rounds=30,
        angle_multiple=2 if flips else 1,
        hop_slope_rad_hz=jnp.asarray(slope, jnp.float32),
    )
    measured = tag_measurements([_EPC], window.reads, stamp, window.time_s, ReadSettings()).sequences
    # Tagview's factor is the distance in units of the antenna's height; R^2 does not depend on the unit.
    fit = fit_pairs(distance, jnp.ones(distance.shape, bool), measured.phase_rad, measured.phase_known, measured.piece)
    line = jnp.where(fit.slope[:, 0] > 0, fit.r_squared[:, 0], 0.0)
    return dict(
        zip(METHODS, (np.asarray(x, np.float64) for x in (coherent, plain, windowed, vision, line)), strict=True)
    )


@jax.jit
def _windowed_attention(
    distance_m: Float[Array, "people frames"],
    relative_m: Float[Array, "frames window"],
    std_m: Float[Array, "frames window"],
) -> Float[Array, " people"]:
    """Att_RF (Eqs. 4-6) averaged over the sliding windows of k frames with a radio estimate."""
    num = distance_m.shape[1]
    index = jnp.arange(NUM_WINDOW - 1, num)[:, None] - jnp.arange(NUM_WINDOW - 1, -1, -1)[None, :]
    rho = distance_m[:, index] - distance_m[:, index[:, :1]]
    rd = relative_m[NUM_WINDOW - 1 :]
    known = jnp.all(jnp.isfinite(std_m[NUM_WINDOW - 1 :]), axis=1)
    valid = jnp.broadcast_to(known[None, :, None], rho.shape)
    rd = jnp.broadcast_to(rd[None], rho.shape)
    rbf = att_rbf(rho, rd, valid, jnp.full(rho.shape[:2], _ALPHA_M2, rho.dtype))
    score = attention(rbf, att_corr(rho, rd, valid), jnp.asarray(_BETA, rho.dtype))
    weight = known.astype(rho.dtype)[None]
    return jnp.sum(weight * score, axis=1) / jnp.maximum(jnp.sum(weight), 1.0)


def accuracy(score: Shaped[np.ndarray, " people"], carrier: int) -> float:
    """1 where the carrier has the highest score, 1/n where n candidates have it: equal scores give chance level."""
    best = np.asarray(score) >= np.max(score)
    return float(best[carrier]) / float(best.sum())
