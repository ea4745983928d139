"""The drawings of the papers' figures, from small arrays: files appear, are small, and show what they are given."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tagjax.metrics.curves import Curve
from tagjax.metrics.interval import Estimate

pytest.importorskip("matplotlib")

from tagjax.report.paper import bars, curves, maps, signals, strips
from tagjax.report.paper.style import MAX_BYTES, heat, shrink

HEIGHT, WIDTH = 24, 32
CROP = (0, 0, WIDTH, HEIGHT)


def drawn(path: Path) -> np.ndarray:
    """The picture, of a size that a page takes."""
    assert 1_000 < path.stat().st_size <= MAX_BYTES
    picture = cv2.imread(str(path))
    assert picture is not None
    assert 700 <= picture.shape[1] <= 1100
    return picture


def has_colour(picture: np.ndarray, red: int, green: int, blue: int) -> bool:
    return bool(np.any(np.abs(picture.astype(int) - np.array([blue, green, red])).max(axis=-1) <= 12))


def colour_picture() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def true_mask() -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[8:16, 10:22] = True
    return mask


def map_frame() -> maps.MapFrame:
    level = np.where(true_mask(), 0.9, 0.1)
    return maps.MapFrame("frame 1", colour_picture(), true_mask(), level, level, level)


def curve(level: float) -> dict[str, Curve]:
    count = 100
    one = Curve(np.full(count, level), np.full(count, level - 0.1), np.full(count, level + 0.1), np.full(count, 2))
    return {"iou": one, "cle_px": one}


def test_curves_have_a_line_for_each_tracer(tmp_path: Path):
    path = tmp_path / "one.png"
    panels = [curves.Panel(title, {"ours": curve(0.8), "published": curve(0.4)}) for title in ("a", "b")]
    curves.score_figure(path, panels)
    picture = drawn(path)
    assert has_colour(picture, 0x00, 0x72, 0xB2)
    assert has_colour(picture, 0xD5, 0x5E, 0x00)
    curves.score_figure(path, [panels[0], curves.Panel("c", {"box": curve(0.5)})], scores=("iou",))
    drawn(path)


def test_signals(tmp_path: Path):
    time_s, path = np.linspace(0, 1, 30), tmp_path / "one.png"
    signals.phase_figure(path, time_s, np.mod(9 * time_s, 6), 9 * time_s, {"a": time_s, "b": time_s}, time_s, time_s)
    drawn(path)
    reads = {"tag 1": time_s[::3], "tag 2": time_s[::4]}
    signals.synchronisation_figure(path, reads, "tag 2", time_s[::4], time_s, time_s, time_s)
    drawn(path)
    signals.offset_figure(path, time_s, 9 * time_s + 3, 9 * time_s)
    drawn(path)


def test_maps(tmp_path: Path):
    path, frame = tmp_path / "one.png", map_frame()
    window = np.linspace(0.0, 0.13, 5)
    anchors = [maps.Anchor((12, 10), True, window / 3), maps.Anchor((2, 2), False, 0 * window)]
    maps.attention_figure(path, frame, colour_picture(), 30.0, anchors, window, window / 3, CROP)
    drawn(path)
    maps.propagation_figure(path, [frame, frame], CROP)
    drawn(path)
    maps.distribution_figure(path, frame.probability.ravel(), frame.true_mask.ravel(), 0.1, [0.1, 0.9])
    assert has_colour(drawn(path), 0xE6, 0x9F, 0x00)  # the corners
    cluster = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) // 200
    both = true_mask(), ~true_mask()
    maps.refinement_figure(path, frame.colour, cluster, *both, true_mask(), ("IoU 1.00", "IoU 0.00"), CROP)
    drawn(path)
    maps.heat_figure(path, [("a", frame.colour, frame.attention, frame.true_mask)] * 5, CROP)
    drawn(path)


def test_heat_grows_brighter_and_is_white_where_it_is_unknown():
    levels = np.array([[0.0, 0.25, 0.5, 0.75, 1.0, np.nan]])
    brightness = heat(levels)[0].astype(int).sum(axis=-1)
    assert np.all(np.diff(brightness[:5]) > 0)
    assert brightness[5] == 3 * 255


def test_strips_show_detected_tags_only(tmp_path: Path):
    path = tmp_path / "one.png"

    def cell(*detected: bool) -> strips.Cell:
        box_px = np.array([[10.0, 8.0, 21.0, 15.0], [1.0, 1.0, 5.0, 5.0]])
        masks = np.stack([true_mask(), np.zeros_like(true_mask())])
        grey = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
        return strips.Cell(grey, masks, box_px, np.array(detected), box_px, "frame 1", "IoU 1.00")

    rows = [strips.Row("a", CROP, [cell(True, True), cell(True, False)]), strips.Row("b", CROP, [cell(False, False)])]
    strips.strip_figure(path, rows, names=("tag 1", "tag 2"))
    assert has_colour(drawn(path), 230, 159, 0)
    strips.strip_figure(path, [strips.Row("a", CROP, [cell(False, False)] * 3)])
    assert not has_colour(drawn(path), 230, 159, 0)


def test_bars_leave_out_what_is_unknown(tmp_path: Path):
    path = tmp_path / "one.png"
    known, unknown = Estimate(0.8, 0.6, 0.9, 8.0, 10, 3), Estimate(None, None, None, 0.0, 0, 0)
    bars.bar_figure(path, {"a": known, "b": unknown}, ylabel="accuracy", reported={"a": 0.9})
    picture = drawn(path)
    assert has_colour(picture, 38, 135, 190)  # the first colour at 0.85
    assert not has_colour(picture, 219, 118, 38)


def test_a_picture_is_written_again_with_fewer_colours(tmp_path: Path):
    path = tmp_path / "one.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (200, 300, 3), dtype=np.uint8))
    before = path.stat().st_size
    shrink(path, max_bytes=before // 2)
    assert path.stat().st_size <= before // 2
