"""The animation of a traced recording: what it shows at each time, and what its file holds."""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageSequence
from test_segment_tracer import EPCS, scene

from tagjax.core.settings import ConfigError
from tagjax.evaluation.picture import PictureConfig, make_picture, tag_curves
from tagjax.evaluation.traced import Traced
from tagjax.recording.store import save_recording
from tagjax.report.animation import write_animation
from tagjax.report.charts import GrowingCharts, TagCurves
from tagjax.report.overlay import PALETTE_RGB, scaled_boxes

TRACER = {"_target_": "tagjax.tagattention.TagAttention", "segments": {"segmenter": {"num_segments": 256}}}
CLIPS = {"stride": 1, "flow": "zero"}
NAN = np.nan


def _curves(name: str = "..1", **changed: Any) -> TagCurves:
    read_s = np.arange(0.05, 2.0, 0.1)
    values = {"read_s": read_s, "phase_rad": np.full_like(read_s, np.pi), "range_m": np.linspace(2.0, 3.0, 21), "true_range_m": np.full(21, NAN)}  # fmt: skip
    return TagCurves(name, **{**values, **changed})


def test_distances_are_changes_compared_in_the_median() -> None:
    truth = np.array([4.0, 4.2, 4.4, 4.6])
    found, true = _curves(range_m=np.array([NAN, 4.0, 4.2, 9.0]), true_range_m=truth).changes_m()
    np.testing.assert_allclose(true, truth - 4.0)
    np.testing.assert_allclose(found, [NAN, 0.2, 0.4, 5.2])  # 0.2 m before the tag in the median; the last one is wrong


def test_a_distance_without_truth_begins_at_zero_and_what_is_not_known_stays_so() -> None:
    nothing = np.full(3, NAN)
    found, true = _curves(range_m=np.array([NAN, 2.0, 2.5]), true_range_m=nothing).changes_m()
    np.testing.assert_allclose(found, [NAN, 0.0, 0.5])
    assert np.isnan(true).all()
    found, true = _curves(range_m=nothing, true_range_m=np.array([NAN, 1.0, 3.0])).changes_m()
    np.testing.assert_allclose(true, [NAN, 0.0, 2.0])
    assert np.isnan(found).all()
    assert all(np.isnan(one).all() for one in _curves(range_m=nothing, true_range_m=nothing).changes_m())


def _columns_of(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Columns with a pixel of about this colour."""
    return np.flatnonzero((np.abs(image.astype(int) - colour).max(axis=-1) < 12).any(axis=0))


def test_charts_grow_with_time() -> None:
    charts = GrowingCharts([_curves(), _curves("..2")], np.linspace(0.0, 2.0, 21), 320, 400)
    images = [charts.drawn(frame) for frame in (0, 10, 20)]
    assert {image.shape for image in images} == {(400, 320, 3)}
    for colour in PALETTE_RGB[:2]:
        start, half, all_of_it = (_columns_of(image[:160], colour) for image in images)  # the charts of phase
        assert len(start) == 0
        assert all_of_it[-1] - all_of_it[0] == pytest.approx(2 * (half[-1] - half[0]), abs=20)
        assert half[0] == all_of_it[0]
    line = _columns_of(images[1][260:], PALETTE_RGB[1])
    assert 100 < line[-1] - line[0] < 170  # half of the time, in the chart of distance
    np.testing.assert_array_equal(charts.drawn(10), images[1])  # time may go back


def test_charts_of_tags_that_are_never_found_are_empty() -> None:
    nothing = _curves(read_s=np.zeros(0), phase_rad=np.zeros(0), range_m=np.full(21, NAN))
    image = GrowingCharts([nothing], np.linspace(0.0, 2.0, 21), 320, 400).drawn(20)
    assert len(_columns_of(image[:90], PALETTE_RGB[0])) == 0


def _num_frames(file: Image.Image) -> int:
    return sum(1 for _ in ImageSequence.Iterator(file))


@pytest.mark.parametrize("suffix", [".webp", ".gif", ".png"])
def test_an_animation_is_read_back(suffix: str, tmp_path: Path) -> None:
    images = [np.full((40, 60, 3), level, np.uint8) for level in (0, 120, 250)]
    write_animation(tmp_path / f"a{suffix}", images, rate_hz=10.0, hold_s=1.5)
    with Image.open(tmp_path / f"a{suffix}") as file:
        assert (_num_frames(file), file.size, file.info["loop"]) == (3, (60, 40), 0)
        durations = []
        for number, image in enumerate(images):
            file.seek(number)
            file.load()
            durations.append(file.info["duration"])
            np.testing.assert_allclose(np.asarray(file.convert("RGB")), image, atol=4)
    assert durations == [100, 100, 1600]
    assert [one.name for one in tmp_path.iterdir()] == [f"a{suffix}"]


def test_another_suffix_no_picture_and_wrong_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"a\.mp4; expected a file that ends in \.webp, \.gif, \.png"):
        write_animation(tmp_path / "a.mp4", [np.zeros((4, 4, 3), np.uint8)], rate_hz=10.0)
    with pytest.raises(ValueError, match="found no picture"):
        write_animation(tmp_path / "a.webp", [], rate_hz=10.0)
    for changed, message in (
        ({"width": 640}, "width is 640"),
        ({"hold_s": -1.0}, "hold_s is"),
        ({"quality": 101}, "quality 101"),
    ):
        with pytest.raises(ConfigError, match=message):
            PictureConfig(recording="a.zarr", tracer=TRACER, out="a.webp", **changed)


def test_boxes_are_enlarged_about_the_edges_of_their_pixels() -> None:
    boxes = np.array([[0.0, 0.0, 9.0, 4.0], [3.0, 2.0, 3.0, 2.0]])  # ten by five pixels, and one pixel
    np.testing.assert_allclose(scaled_boxes(boxes, 2.0), [[0, 0, 19, 9], [6, 4, 7, 5]])
    np.testing.assert_allclose(scaled_boxes(boxes, 1.0), boxes)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    save_recording(scene(40), folder / "scene.zarr")
    return folder / "scene.zarr"


def test_the_reads_of_the_frames_are_shown_with_the_true_distance(path: Path) -> None:
    config = PictureConfig(recording=str(path), tracer=TRACER, clips=CLIPS, out="a.webp")
    traced = Traced.open(config)
    recording = traced.recording
    ranges_m = np.arange(40.0).reshape(20, 2)
    for tag, (epc, one) in enumerate(zip(EPCS, tag_curves(traced, (10, 30), ranges_m), strict=True)):
        reads = recording.reads.select(epc)
        within = (reads.time_ns >= recording.time_ns[10]) & (reads.time_ns <= recording.time_ns[29])
        assert 0 < within.sum() < reads.num_reads
        np.testing.assert_allclose(one.read_s, (reads.time_ns[within] - recording.time_ns[10]) * 1e-9)
        np.testing.assert_allclose(one.phase_rad, reads.phase_rad[within] % (2 * np.pi))
        np.testing.assert_array_equal(one.range_m, ranges_m[:, tag])
        assert one.true_range_m.shape == (20,)


def test_a_traced_recording_becomes_an_animation(path: Path, tmp_path: Path) -> None:
    done = []
    config = PictureConfig(
        recording=str(path),
        tracer=TRACER,
        clips=CLIPS,
        out=str(tmp_path / "new" / "a.webp"),
        frames=(0, 40),
        shown=(30, 40),
    )
    out = make_picture(config, on_progress=lambda *one: done.append(one[:3]))
    with Image.open(out) as file:
        assert (_num_frames(file), file.width) == (10, 800)
        file.seek(9)
        last = np.asarray(file.convert("RGB")).astype(int)
    assert ("trace", 40, 40) in done
    assert done[-1] == ("draw", 10, 10)
    shades = np.array(PALETTE_RGB[:2])
    near = np.abs(last[:, :480, None] - shades).max(axis=-1) < 40
    assert near.any(axis=(0, 1)).all()  # a box of each tag


def test_frames_that_are_not_traced_cannot_be_shown(path: Path, tmp_path: Path) -> None:
    for shown in ((10, 30), (30, 30), (25, 41)):
        config = PictureConfig(
            recording=str(path), tracer=TRACER, out=str(tmp_path / "a.webp"), frames=(20, 40), shown=shown
        )
        with pytest.raises(ConfigError, match=r"expected a part of the traced frames, \[20, 40\]"):
            make_picture(config)


def test_a_missing_package_is_reported_before_the_work(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *more: Any, **named: Any) -> Any:
        if name == "report.animation":
            raise ImportError(name)
        return real(name, *more, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError, match=r"needs the viz extra: pip install .*\[viz\]"):
        make_picture(PictureConfig(recording=str(path), tracer=TRACER, out="a.webp"))
