"""Plots: antennas (Figs. 9, 10), hand-over (Fig. 7), ROC (Table I), blobs with their tags (Fig. 12). Needs
matplotlib.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8
from matplotlib.axes import Axes

from ...recording.image_files import write_image
from ...report.figure import blank, save_figure
from .alarm import Roc
from .antennas import AntennaModel, response_db
from .experiment.handover import Handover, mean_curve
from .experiment.paper import PAPER_TABLE_1
from .rssi import GridStatistic

_COLOURS = ("0.45", "tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown")


def antenna_plot(path: Path, statistic: GridStatistic, model: AntennaModel) -> None:
    """Measured RSSI at the points of the grid, and the fitted Gaussian of each antenna (Figs. 9 and 10)."""
    num, floor_dbm = model.mean_m.shape[0], float(model.floor_dbm)
    figure = blank(3.2 * num + 1, 4.6)
    received = np.isfinite(statistic.mean_dbm)
    measured = np.where(received, statistic.mean_dbm, floor_dbm)
    low, high = statistic.position_m.min(axis=0) - 0.3, statistic.position_m.max(axis=0) + 0.3
    axes_x, axes_y = np.linspace(low[0], high[0], 80), np.linspace(low[1], high[1], 50)
    x, y = np.meshgrid(axes_x, axes_y)
    points = jnp.asarray(np.stack([x.ravel(), y.ravel()], axis=-1), jnp.float32)
    modelled = np.asarray(jax.vmap(lambda point: response_db(model, point))(points)) + floor_dbm
    grid = np.atleast_2d(figure.subplots(2, num, sharex=True, sharey="row", squeeze=False, height_ratios=[1.0, 1.5]))
    levels = np.arange(floor_dbm, max(float(measured.max()), float(modelled.max())) + 2.0, 2.0)
    shown = {"cmap": "viridis", "vmin": levels[0], "vmax": levels[-1]}
    shades: Any = None
    for antenna in range(num):
        upper, lower, is_received = grid[0, antenna], grid[1, antenna], received[:, antenna]
        shades = upper.contourf(x, y, modelled[:, antenna].reshape(x.shape), levels, **shown)
        points_m = statistic.position_m
        upper.scatter(*points_m[is_received].T, c=measured[is_received, antenna], edgecolors="w", s=45, **shown)
        upper.plot(*points_m[~is_received].T, "x", color="0.8", markersize=5)
        upper.plot(*np.asarray(model.mean_m[antenna]), "r+", markersize=12)
        upper.set(aspect="equal")
        upper.set_title(f"antenna {antenna + 1}", fontsize=9)
        along = np.abs(points_m[:, 1]) < 0.5
        lower.plot(
            points_m[along & is_received, 0],
            measured[along & is_received, antenna],
            "k.",
            label="measured, |y| < 0.5 m",
        )
        lower.plot(
            points_m[along & ~is_received, 0],
            measured[along & ~is_received, antenna],
            "x",
            color="0.5",
            label="not received",
        )
        line = jnp.asarray(np.stack([axes_x, np.zeros_like(axes_x)], axis=-1), jnp.float32)
        bell = np.asarray(jax.vmap(lambda point: response_db(model, point))(line))[:, antenna] + floor_dbm
        lower.plot(axes_x, bell, "r", label="Gaussian, y = 0")
        lower.set(xlabel="x (m)")
        lower.grid(alpha=0.3)
    figure.suptitle("RSSI of the tag grid: dots measured, crosses not received, colour modelled", fontsize=9)
    figure.colorbar(shades, ax=grid[0].tolist(), label="dBm", aspect=10)
    grid[0, 0].set_ylabel("y (m)")
    grid[1, 0].set_ylabel("RSSI (dBm)")
    grid[1, 0].legend(fontsize=7, loc="upper right")
    save_figure(figure, path, dpi=110)


def roc_plot(path: Path, curves: Mapping[str, Roc], chosen: Mapping[str, tuple[float, float]]) -> None:
    """Detection against false alarms of each rule, its chosen threshold, and the paper's points.

    `chosen` maps a curve's name to its (P_D, P_FA).
    """
    figure = blank(5.5, 4.5)
    axes: Axes = figure.subplots()
    for number, (name, roc) in enumerate(curves.items()):
        colour = _COLOURS[1 + number]
        axes.step(roc.false_alarm, roc.detection, where="post", color=colour, label=name)
        if name in chosen:
            detection, false_alarm = chosen[name]
            axes.plot(false_alarm, detection, "o", color=colour, label=f"{name}, chosen threshold")
    for rule, (detection, false_alarm) in PAPER_TABLE_1.items():
        label = {"rfid": "RFID only (paper)", "fused": "RFID + CV (paper)"}[rule]
        axes.plot(false_alarm, detection, "x" if rule == "rfid" else "+", color="k", markersize=10, label=label)
    axes.set(xlabel="false alarms of still tags, P_FA", ylabel="detection, P_D", xlim=(-0.02, 1.02), ylim=(-0.02, 1.04))
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize=8)
    save_figure(figure, path, dpi=110)


def association_plot(
    path: Path,
    time_s: Shaped[np.ndarray, " time"],
    probability: Shaped[np.ndarray, "time states"],
    identity: Int[np.ndarray, "time slots"],
    state: Int[np.ndarray, " time"],
    tag_x_m: Shaped[np.ndarray, " time"],
    true_x_m: Shaped[np.ndarray, " time"],
    *,
    title: str = "",
) -> None:
    """Association probability of one tag over time (Fig. 7a): background and every blob; the truth as a band above.

    `state` is the true one (0 background, 1 + slot, -1 unknown). Below, the tag's x, estimated and true.
    """
    figure = blank(8.0, 5.0)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    blobs = [one for one in dict.fromkeys(identity.ravel().tolist()) if one]
    true_blob = np.where(
        state > 0, np.take_along_axis(identity, np.maximum(state - 1, 0)[:, None], axis=1)[:, 0], -state
    )
    true_blob = np.where(state == 0, 0, np.where(state < 0, -1, true_blob))
    for number, blob in enumerate([0, *blobs]):
        colour = _COLOURS[number % len(_COLOURS)]
        values = probability[:, 0] if blob == 0 else np.sum(np.where(identity == blob, probability[:, 1:], 0.0), axis=1)
        is_received = np.ones(len(time_s), bool) if blob == 0 else np.any(identity == blob, axis=1)
        label = "background" if blob == 0 else f"blob {blob}"
        upper.plot(time_s, np.where(is_received, values, np.nan), color=colour, label=label, linewidth=1.6)
        band = (true_blob == blob).tolist()
        upper.fill_between(time_s, 1.03, 1.08, where=band, color=colour, step="mid", linewidth=0)
    upper.set(ylabel="association probability", ylim=(-0.02, 1.1), title=f"{title} (band: true state, where known)")
    upper.legend(loc="center left", fontsize=8)
    lower.plot(time_s, true_x_m, "0.6", linewidth=1.2, label="true")
    lower.plot(time_s, tag_x_m, "k", linewidth=1.2, label="estimated")
    lower.legend(fontsize=8)
    lower.set(xlabel="time (s)", ylabel="tag's x (m)")
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    save_figure(figure, path, dpi=110)


def handover_plot(path: Path, found: Sequence[Handover]) -> None:
    """Mean association probability over recordings by role, aligned at the hand-over; bands: one standard deviation."""
    times, mean, deviation = mean_curve(list(found))
    figure = blank(8.0, 3.6)
    axes: Axes = figure.subplots()
    for role, (name, colour) in enumerate((("background", "0.45"), ("giver", "tab:blue"), ("taker", "tab:orange"))):
        axes.plot(times, mean[:, role], color=colour, label=name)
        low, high = mean[:, role] - deviation[:, role], mean[:, role] + deviation[:, role]
        axes.fill_between(times, np.clip(low, 0, 1), np.clip(high, 0, 1), color=colour, alpha=0.15, linewidth=0)
    axes.axvline(0, color="k", linewidth=0.8)
    stop_s = float(np.median([one.stop_s - one.handover_s for one in found]))
    axes.axvline(stop_s, color="k", linewidth=0.8, linestyle=":")
    title = f"{len(found)} recordings; line: the tag changes hands, dotted: it stops (median)"
    axes.set(xlabel="time from the hand-over (s)", ylabel="association probability", ylim=(-0.02, 1.05), title=title)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    save_figure(figure, path, dpi=110)


def scene_picture(
    path: Path,
    pictures: UInt8[np.ndarray, "some height width 3"],
    boxes_px: Float[np.ndarray, "some slots 4"],
    labels: list[list[str]],
    alarmed: list[list[bool]],
) -> None:
    """Pictures side by side with each blob's box and the tags assigned to it; alarmed ones in red."""
    out = []
    for picture, boxes, texts, red in zip(pictures, boxes_px, labels, alarmed, strict=True):
        canvas = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
        for box, text, is_red in zip(boxes, texts, red, strict=True):
            if not np.isfinite(box).all():
                continue
            colour = (235, 40, 40) if is_red else (40, 90, 235)
            x0, y0, x1, y1 = (int(v) for v in 2 * box)
            cv2.rectangle(canvas, (x0, y0), (x1, y1), colour, 2)
            cv2.putText(
                canvas, text, (max(x0, 2), max(y0 - 6, 14)), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA
            )
        out.append(canvas)
    write_image(path, np.concatenate(out, axis=1))
