"""The lines of the reads: rate, gaps, phase noise, flips, hopping, speed and RSSI."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...core.names import short_name
from ..recording import Recording
from .line import Line, Verdict, judged, limits_text, worst, worst_verdict
from .tags import TagLimits, dwell_s
from .thresholds import Thresholds


def radio_lines(recording: Recording, tags: list[TagLimits], thresholds: Thresholds) -> list[Line]:
    """The lines of the reads, in the order of the page. Without a tag all are bad or not measured."""
    return [
        _read_rate(tags, thresholds),
        _gaps(tags, thresholds),
        _noise(tags, thresholds),
        _flips(tags, thresholds),
        _hopping(recording, tags, thresholds),
        _speed(tags, thresholds),
        _rssi(tags, thresholds),
    ]


def _of_tags(
    tags: list[TagLimits],
    value: Callable[[TagLimits], float],
    limits: tuple[float, float],
    shown: Callable[[float], str],
) -> tuple[Verdict, str, TagLimits | None]:
    """The worst tag's verdict, the values as text, and that tag."""
    values = np.array([value(tag) for tag in tags])
    known = values[np.isfinite(values)]
    if not known.size:
        return "not measured", "", None
    place = worst(values, limits)
    if len(tags) == 1:
        return judged(values[0], limits), shown(float(values[0])), tags[0]
    good = sum(judged(one, limits) == "good" for one in known)
    text = f"{shown(float(values[place]))} (tag {short_name(tags[place].epc, '…')}, the worst); median {shown(float(np.median(known)))}; {good} of {len(known)} tags good"
    return judged(values[place], limits), text, tags[place]


def _read_rate(tags: list[TagLimits], thresholds: Thresholds) -> Line:
    limits = thresholds.reads_per_s
    verdict, found, _ = _of_tags(tags, lambda tag: tag.reads_per_s, limits, lambda value: f"{value:.1f} reads/s")
    return Line(
        name="read_rate",
        title="Reads per second and tag",
        verdict=verdict if tags else "bad",
        found=found or "no tag was read",
        threshold=limits_text(limits, " reads/s"),
        source="A dwell of an Impinj reader lasts 0.2 s. A phase difference needs two reads of one dwell: 15 reads/s give "
        "three a dwell, 5 reads/s one.",
        change="Report every read (one tag report a read), use session 0 or 1 with dual target, a fast reader mode, one antenna "
        "port, and keep other tags out of the field: n tags take 17 + 4.2 n ms a round.",
    )


def _gaps(tags: list[TagLimits], thresholds: Thresholds) -> Line:
    limits = thresholds.gap_fraction
    verdict, found, tag = _of_tags(tags, lambda tag: tag.gap_fraction, limits, lambda value: f"{value:.0%} of the time")
    longest = f"; its longest gap {tag.longest_gap_s:.2f} s" if tag else ""
    return Line(
        name="gaps",
        title=f"Gaps longer than {thresholds.gap_s:g} s",
        verdict=verdict if tags else "bad",
        found=f"{found}{longest}" if tag else "no tag was read",
        threshold=limits_text(limits, " %", 100.0),
        source="99 of 100 gaps of public R420 logs (1 to 25 tags) are shorter than 0.15 s. A longer one means that the tag was "
        "blocked or out of the field; what it did meanwhile is unknown.",
        change="Keep hands and bodies between tag and antenna away, mount the tag on the side that faces the antenna, and not on "
        "metal or liquid; tilt the antenna to where objects are, or add one.",
    )


def _noise(tags: list[TagLimits], thresholds: Thresholds) -> Line:
    limits = thresholds.noise_rad
    verdict, found, _ = _of_tags(tags, lambda tag: tag.pieces.noise_rad, limits, lambda value: f"{value:.3f} rad")
    return Line(
        name="phase_noise",
        title="Phase noise",
        verdict=verdict,
        found=found or "too few dwells with five reads of a tag",
        threshold=limits_text(limits, " rad"),
        source="Public R420 logs: 0.012 to 0.25 rad, TagVision assumes 0.1. With pi flips phases are doubled: of their "
        "coherence exp(-2 sigma^2) is left, 0.96 at 0.15 rad and 0.73 at 0.4.",
        change="Raise the signal (see RSSI), move metal, screens and moving machines out of the beam, use a mode with more "
        "Miller cycles (these flip phases by pi), and check cable and connectors.",
    )


def _flips(tags: list[TagLimits], thresholds: Thresholds) -> Line:
    limits = thresholds.flip_probability
    verdict, found, _ = _of_tags(
        tags, lambda tag: tag.pieces.flip_probability, limits, lambda value: f"{value:.1%} of the reads"
    )
    return Line(
        name="pi_flips",
        title="Pi flips",
        verdict=verdict,
        found=found or "too few steps within dwells",
        threshold=limits_text(limits, " %", 100.0),
        source="Public R420 logs: 0 % in mode 0 (FM0), 6 to 12 % in Miller modes. With flips phases count modulo pi: half of the "
        "speed is unambiguous.",
        change="Choose a reader mode with FM0 (Impinj mode 0, Max Throughput) where the signal allows it. tagjax handles flips; "
        "keep motion slower than the line below asks for.",
    )


def _hopping(recording: Recording, tags: list[TagLimits], thresholds: Thresholds) -> Line:
    reads = recording.reads
    known = np.isfinite(reads.carrier_hz)
    unknown = float(np.mean(~known)) if reads.num_reads else 0.0
    num_carriers = len(np.unique(reads.carrier_hz[known]))
    limits = thresholds.reads_per_dwell
    verdict, found, _ = _of_tags(
        tags, lambda tag: tag.reads_per_dwell, limits, lambda value: f"{value:.1f} reads a dwell"
    )
    if num_carriers == 1:
        verdict, found = "good", "one channel, no hopping"
    elif num_carriers:
        found = f"{num_carriers} channels, dwells of {dwell_s(recording):.2f} s; {found or 'dwells not measured'}"
    verdict = worst_verdict([verdict, judged(unknown, thresholds.unknown_carriers)]) if tags else "not measured"
    return Line(
        name="hopping",
        title="Hopping and dwell",
        verdict=verdict,
        found=f"{found}{'; ' if found else ''}carrier of {unknown:.0%} of the reads unknown",
        threshold=f"{limits_text(limits, ' reads of a tag a dwell')}; unknown carriers "
        f"{limits_text(thresholds.unknown_carriers, ' %', 100.0)}",
        source="Phase offsets differ from channel to channel, so differences within a dwell are what tracing lives on: two "
        "reads give one, three a check of it. A read of an unknown carrier gives no distance.",
        change="Record the reader's own hop table (FCC readers hop in an order of their own). Raise the read rate, or choose "
        "longer dwells or fewer channels where the region allows it (ETSI: up to 4 s).",
    )


def _speed(tags: list[TagLimits], thresholds: Thresholds) -> Line:
    limits = thresholds.ambiguity
    verdict, found, tag = _of_tags(tags, lambda tag: tag.ambiguity, limits, lambda value: f"{value:.2f} of the limit")
    if tag is not None:
        found += f"; its speed {tag.speed_m_s:.2f} m/s, phases unambiguous up to {tag.fastest_m_s:.2f} m/s"
    elif tags:
        found = f"speed not measured; phases unambiguous up to {min(one.fastest_m_s for one in tags):.2f} m/s"
    modulo = "lambda/8 (pi flips)" if any(one.flips for one in tags) else "lambda/4"
    return Line(
        name="speed",
        title="Motion against read rate",
        verdict=verdict,
        found=found or "no tag was read",
        threshold=f"way between two reads over {modulo}: {limits_text(limits, '')}",
        source="A phase repeats every lambda/2 (16 cm). A step between two reads is ambiguous beyond lambda/4, with pi flips "
        "beyond lambda/8 (TagAttention, III.B); at half of that noise rarely matters.",
        change="Move more slowly, or raise the read rate: fewer tags in the field, a faster reader mode, one antenna port.",
    )


def _rssi(tags: list[TagLimits], thresholds: Thresholds) -> Line:
    limits = thresholds.rssi_dbm
    verdict, found, _ = _of_tags(tags, lambda tag: tag.rssi_dbm, limits, lambda value: f"{value:.1f} dBm")
    return Line(
        name="rssi",
        title="RSSI, median",
        verdict=verdict,
        found=found or "the reader reports none",
        threshold=limits_text(limits, " dBm"),
        source="log10(phase noise / rad) = -0.0374 RSSI - 3.56 on public R420 logs: 0.074 rad at -65 dBm, 0.136 at -72. Nothing "
        "weaker than -77.5 dBm is there.",
        change="Raise the transmit power to what is allowed, point the antenna at the tags, turn a tag whose dipole points at the "
        "antenna, use a larger tag, shorten the cable.",
    )
