"""Which of several real tracks carries a tag: each method's association score, by the length of the window it sees.

A virtual tag (`sim.virtual_tag`) is put on each person in turn. What the methods are given of a track is the track with
noise of its own, so that the carrier's is not the tag's path to the letter. Where a real tag's speeds lie beside the tracks
(`real_tags`), those are asked as well.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from ..baselines.tagview.line_fit import fit_pairs
from ..baselines.tagview.sequences import ReadSettings, tag_measurements
from ..baselines.tagvision.phase_score import Snapshots, match_scores
from ..core.results import write_json
from ..radio.channels import estimate_slope
from ..radio.reader import ReaderSettings
from ..recording import RecordingError, TagReads
from ..recording.importers.tagged_walks import load_tagged, load_uwb, read_kinect, read_xovis
from ..recording.virtual_tags import Track, virtual_reads
from ..tagattention.attention import att_corr, att_rbf, attention, coherent_score
from ..tracing.range_windows import phase_reads, radio_windows
from .real_tags import SCORES, associate, speed_scores, speed_windows
from .tracks_figures import accuracy_plot, speeds_plot

METHODS = (
    "TagAttention, coherent",
    "TagAttention, coherent, angle not doubled",
    "TagAttention, Eqs. 4-6",
    "TagVision",
    "Tagview",
)
"""Whose scores are asked. Goller et al. need RSSI at several antennas and a calibration, which tracks do not have.

The doubled angle that the tracer takes of readers with pi flips leaves flips alone, yet turns by 8 pi / wavelength a metre:
noise of 2 cm a frame is 1.5 rad of it, which keeps exp(-1.5^2 / 2) = 0.3 of the right track's coherence. Not doubled, the
angle keeps 0.74 of it, and a share p of flips takes 1 - 2 p.
"""

_NUM_WINDOW, _ALPHA_M2, _BETA = 5, 5e-4, 0.8  # TagAttention's
_EPC = "virtual"


@dataclasses.dataclass(frozen=True)
class TracksConfig:
    """What a run needs, beside the folder of tracks."""

    folder: str  # holds kinect-rfid/ or xovis-uwb/, or both
    windows_s: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
    frame_rate_hz: float = 15.0  # tracks are brought to it
    noise_m: float = 0.02  # standard deviation of a track's noise, by frame and axis
    min_move_m: float = 0.16  # half a wavelength: windows in which the tag's distance changes by less are left out
    max_windows: int = 40  # of each length and scene
    xovis_unit_m: float = 0.02
    region: str = "fcc"
    flip_probability: float = 0.08
    seed: int = 0

    def __post_init__(self):
        if not self.windows_s or min(self.windows_s) * self.frame_rate_hz < _NUM_WINDOW:
            raise ValueError(
                f"windows_s is {self.windows_s} at {self.frame_rate_hz} frames/s; at least {_NUM_WINDOW} frames are needed."
            )
        if self.noise_m < 0 or self.max_windows < 1 or not self.xovis_unit_m > 0:
            raise ValueError(
                f"noise_m {self.noise_m}, max_windows {self.max_windows}, xovis_unit_m {self.xovis_unit_m}; expected not negative, at least "
                "1, and positive."
            )


@dataclasses.dataclass(frozen=True)
class Scene:
    """People's tracks on one clock, as if all of them were there at a time; NaN where one is not."""

    name: str
    time_s: Float[np.ndarray, " time"]
    position_m: Float[np.ndarray, "people time 2"]  # on the floor


def _scene(name: str, tracks: Sequence[tuple[np.ndarray, np.ndarray]], rate_hz: float) -> Scene:
    """Each track from its own first sample on, at even times."""
    longest = max(times[-1] - times[0] for times, _ in tracks)
    clock = np.arange(0.0, longest + 1e-9, 1.0 / rate_hz)
    out = np.full((len(tracks), len(clock), 2), np.nan)
    for row, (times, place) in enumerate(tracks):
        own, first = np.unique(times - times[0], return_index=True)
        inside = clock <= own[-1]
        for axis in range(2):
            out[row, inside, axis] = np.interp(clock[inside], own, place[first, axis])
    return Scene(name, clock, out)


def load_kinect(folder: Path, rate_hz: float) -> Scene:
    """All skeleton tracks of a folder (id, time, x cm, z cm), recorded one or two at a time, put side by side.

    Raises `RecordingError` for other lines and for fewer than two tracks.
    """
    tracks = []
    for path in sorted(folder.glob("[0-9]*.txt")):
        each = [np.array(own) for own in read_kinect(path).values() if len(own) > 1]
        tracks += [(own[:, 0], own[:, 1:]) for own in each]
    if len(tracks) < 2:
        raise RecordingError(f"{folder}: {len(tracks)} tracks; association needs two or more.")
    return _scene("kinect-rfid", tracks, rate_hz)


def load_xovis(path: Path, rate_hz: float, unit_m: float) -> Scene:
    """All tracks of a table ;time;id;x;y;... (ms; x and y in units of `unit_m`), put side by side.

    Raises `RecordingError` for missing columns and for fewer than two tracks.
    """
    each = [np.array(own) for own in read_xovis(path, unit_m).values() if len(own) > 1]
    tracks = [(own[:, 0], own[:, 1:]) for own in each]
    if len(tracks) < 2:
        raise RecordingError(f"{path}: {len(tracks)} tracks; association needs two or more.")
    return _scene("xovis-uwb", tracks, rate_hz)


def load_scenes(config: TracksConfig) -> list[Scene]:
    """What there is in the folder. Raises `RecordingError` where there is nothing."""
    folder, found = Path(config.folder), []
    if (folder / "kinect-rfid").is_dir():
        found.append(load_kinect(folder / "kinect-rfid", config.frame_rate_hz))
    table = folder / "xovis-uwb" / "raw_xovis.csv"
    if table.is_file():
        found.append(load_xovis(table, config.frame_rate_hz, config.xovis_unit_m))
    if not found:
        raise RecordingError(f"{folder}: neither kinect-rfid/ nor xovis-uwb/raw_xovis.csv; name the folder of tracks.")
    return found


def antenna_place(scene: Scene) -> Float[np.ndarray, " 3"]:
    """Where the antenna stands: a metre before the people's floor, off its middle, as high as the tags."""
    low, high = np.nanmin(scene.position_m, axis=(0, 1)), np.nanmax(scene.position_m, axis=(0, 1))
    return np.array([low[0] - 1.0, 0.7 * low[1] + 0.3 * high[1], 0.0])


@dataclasses.dataclass(frozen=True)
class Window:
    """What the methods are given: the candidates' distances at the frames, and the reads of one tag."""

    time_s: Float[np.ndarray, " frames"]
    distance_m: Float[np.ndarray, "people frames"]
    reads: TagReads
    carrier: int  # whose tag it is


def windows(scene: Scene, length_s: float, config: TracksConfig) -> list[Window]:
    """Windows of a length, at most `config.max_windows` spread over tags and times, each with two people or more."""
    rng = np.random.default_rng([config.seed, len(scene.name)])
    antenna, found = antenna_place(scene), []
    three = lambda place: np.concatenate([place, np.zeros((*place.shape[:-1], 1))], axis=-1)  # noqa: E731
    num = round(length_s * config.frame_rate_hz)
    settings = ReaderSettings(region=config.region, flip_probability=config.flip_probability)
    true_m = np.linalg.norm(three(scene.position_m) - antenna, axis=-1)
    noisy = scene.position_m + config.noise_m * rng.normal(size=scene.position_m.shape)
    seen_m = np.linalg.norm(three(noisy) - antenna, axis=-1)
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
            own = dataclasses.replace(reads[inside], time_ns=reads.time_ns[inside] - round(first * 1e9))
            carrier = int(np.sum(here[:person]))
            found.append(Window(scene.time_s[span] - first, seen_m[here][:, span], own, carrier))
    chosen = np.linspace(0, len(found) - 1, min(len(found), config.max_windows)).round().astype(int) if found else []
    return [found[i] for i in chosen]


def association_scores(window: Window, *, seed: int = 0) -> dict[str, Float[np.ndarray, " people"]]:
    """Every method's score of every candidate; all 0 where a method has nothing to go by."""
    people = len(window.distance_m)
    if window.reads.num_reads < 4:
        return {name: np.zeros(people) for name in METHODS}
    frames, distance = jnp.asarray(window.time_s, jnp.float32), jnp.asarray(window.distance_m, jnp.float32)
    flips = bool(window.reads.pi_flips)
    reads = phase_reads(window.reads, _EPC, 0)
    coherent, plain = (coherent_score(distance[None], reads, frames, doubled_angle=one)[0] for one in (flips, False))
    radio = radio_windows(reads, frames, _NUM_WINDOW)
    attended = _attended(distance, radio.relative_m, radio.std_m)
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
    said = tag_measurements([_EPC], window.reads, stamp, window.time_s, ReadSettings()).sequences
    # Tagview's factor is the distance in units of the antenna's height; R^2 does not ask for the unit.
    fit = fit_pairs(distance, jnp.ones(distance.shape, bool), said.phase_rad, said.phase_known, said.piece)
    line = jnp.where(fit.slope[:, 0] > 0, fit.r_squared[:, 0], 0.0)
    return dict(
        zip(METHODS, (np.asarray(x, np.float64) for x in (coherent, plain, attended, vision, line)), strict=True)
    )


@jax.jit
def _attended(
    distance_m: Float[Array, "people frames"],
    relative_m: Float[Array, "frames window"],
    std_m: Float[Array, "frames window"],
) -> Float[Array, " people"]:
    """Att_RF (Eqs. 4-6) of every sliding window of k frames that the radio knows, averaged."""
    num = distance_m.shape[1]
    index = jnp.arange(_NUM_WINDOW - 1, num)[:, None] - jnp.arange(_NUM_WINDOW - 1, -1, -1)[None, :]
    rho = distance_m[:, index] - distance_m[:, index[:, :1]]
    rd = relative_m[_NUM_WINDOW - 1 :]
    known = jnp.all(jnp.isfinite(std_m[_NUM_WINDOW - 1 :]), axis=1)
    valid = jnp.broadcast_to(known[None, :, None], rho.shape)
    rd = jnp.broadcast_to(rd[None], rho.shape)
    rbf = att_rbf(rho, rd, valid, jnp.full(rho.shape[:2], _ALPHA_M2, rho.dtype))
    score = attention(rbf, att_corr(rho, rd, valid), jnp.asarray(_BETA, rho.dtype))
    share = known.astype(rho.dtype)[None]
    return jnp.sum(share * score, axis=1) / jnp.maximum(jnp.sum(share), 1.0)


def right(score: Shaped[np.ndarray, " people"], carrier: int) -> float:
    """1 where the carrier has the highest score, a share of it where several have; so that nothing scores chance."""
    best = np.asarray(score) >= np.max(score)
    return float(best[carrier]) / float(best.sum())


def run_tracks(config: TracksConfig, folder: Path, *, on_done: Callable[[str], None] = print) -> dict[str, Any]:
    """Accuracy of every method by scene and window length; writes `metrics.json`, `tables.md` and `accuracy.png`.

    Where there are real tags, what is said of them is in both, too, and `real_tags.png` shows it.
    """
    rows = []
    for scene in load_scenes(config):
        for length_s in config.windows_s:
            seen = windows(scene, length_s, config)
            scored = (association_scores(window, seed=number) for number, window in enumerate(seen))
            marked = zip((len(one.distance_m) for one in seen), (one.carrier for one in seen), scored, strict=True)
            rows += _accuracy(scene.name, length_s, METHODS, marked)
            on_done(f"{scene.name}, {length_s:g} s")
    accuracy_plot(folder / "accuracy.png", rows, METHODS)
    real = run_real_tags(config, folder, on_done)
    write_json(folder / "metrics.json", {"virtual_tags": rows, **real})
    text = "Virtual tags on real tracks: share of windows in which the carrier scores highest.\n\n" + markdown(
        rows, METHODS
    )
    (folder / "tables.md").write_text(text + real_tags_markdown(real))
    return {"rows": rows, **real}


def run_real_tags(config: TracksConfig, folder: Path, on_done: Callable[[str], None]) -> dict[str, Any]:
    """Who carries the real tags of the folder, by whole recordings and by windows; nothing where there are none."""
    home, rows, whole = Path(config.folder), [], []
    scenes = {
        "kinect-rfid": load_tagged(home / "kinect-rfid", config.frame_rate_hz),
        "xovis-uwb": load_uwb(home / "xovis-uwb", config.frame_rate_hz, config.xovis_unit_m),
    }
    for name, tagged in scenes.items():
        if not tagged:
            continue
        on_done(f"{name}, real tags")
        found = associate(tagged)
        whole += found
        for length_s in config.windows_s:
            seen = [window for one in found for window in speed_windows(one, length_s, config.min_move_m)]
            scored = ((len(one.distance_m), one.carrier, speed_scores(one)) for one in seen)
            rows += _accuracy(name, length_s, SCORES, scored)
    if not whole:
        return {}
    speeds_plot(folder / "real_tags.png", whole)
    return {"real_tags": rows, "real_tags_whole": [one.plain() for one in whole]}


def _accuracy(
    scene: str,
    length_s: float,
    methods: Sequence[str],
    scored: Iterable[tuple[int, int, Mapping[str, Shaped[np.ndarray, " people"]]]],
) -> list[dict[str, Any]]:
    """The row of a table, of every window's number of candidates, carrier and scores; none without a window."""
    counts, marks = [], {name: [] for name in methods}
    for num_candidates, carrier, scores in scored:
        counts.append(num_candidates)
        for name in methods:
            marks[name].append(right(scores[name], carrier))
    if not counts:
        return []
    return [
        {
            "scene": scene,
            "window_s": length_s,
            "num_windows": len(counts),
            "candidates": float(np.mean(counts)),
            "chance": float(np.mean(1.0 / np.array(counts))),
            "accuracy": {name: float(np.mean(values)) for name, values in marks.items()},
        }
    ]


def markdown(rows: Sequence[dict[str, Any]], methods: Sequence[str]) -> str:
    """One row for each scene and window length."""
    lines = [
        "| scene | window (s) | windows | candidates | chance | " + " | ".join(methods) + " |",
        "|" + "---|" * (5 + len(methods)),
    ]
    for row in rows:
        cells = [
            row["scene"],
            f"{row['window_s']:g}",
            row["num_windows"],
            f"{row['candidates']:.1f}",
            f"{row['chance']:.2f}",
        ]
        cells += [f"{row['accuracy'][name]:.2f}" for name in methods]
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def real_tags_markdown(real: Mapping[str, Any]) -> str:
    """Of each recording how well its tag's speeds suit each track, and the accuracy by windows."""
    if not real:
        return ""
    lines = [
        "",
        "Real tags: correlation of the speeds that were measured with each track's towards the antenna, over the whole",
        "recording, at the clock offset that suits the track best. The antenna (of a UWB tag, the place that its distances are",
        "to) stands where the other recordings put it.",
        "",
        "| recording | antenna by the others (m) | by its own track | track | correlation | clock offset (s) | measured / track's speed |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in real["real_tags_whole"]:
        places = [", ".join(f"{value:.2f}" for value in one[name]) for name in ("antenna_m", "own_antenna_m")]
        for number, each in enumerate(one["candidates"]):
            first = [one["recording"], *places] if number == 0 else ["", "", ""]
            where = f"...{each['track'][-4:]}" + ("" if each["own"] else ", of another recording")
            where += " (carries it)" if each["carrier"] else ""
            cells = [*first, where, f"{each['correlation']:.2f}", f"{each['lag_s']:.1f}", f"{each['slope']:.2f}"]
            lines.append("| " + " | ".join(cells) + " |")
    lines += [
        "",
        "Share of windows in which the carrier scores highest, the clocks apart as its whole track says. Speeds are known, not",
        "phases, and not to scale: coherence, TagVision and Eq. 4 cannot be asked, and Goller et al. need RSSI at several antennas.",
        "",
        "",
    ]
    return "\n".join(lines) + markdown(real["real_tags"], SCORES)
