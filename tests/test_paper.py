"""The papers' figures: the table, which recordings a figure uses, stored traces, what is computed, and small whole runs."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
import synthetic_clips as synthetic
from composed import composed

from experiments.suites import suites_named
from tagjax.baselines.tagvision.experiment.simulated_calibration import PAPER_CAMERA, overhead
from tagjax.core.results import write_json
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.paper import Drawn, PaperConfig, run_paper, suites
from tagjax.evaluation.paper.run import drawn_before
from tagjax.evaluation.paper.sources import MissingRecordingsError, Sources, described, last_frame
from tagjax.evaluation.paper.table import FIGURES, chosen
from tagjax.evaluation.paper.traced import Traced, read_traced, write_traced
from tagjax.metrics.curves import Curve
from tagjax.metrics.recordings import Picture
from tagjax.metrics.tags import FrameScores
from tagjax.tagattention.published import TagAttentionPublished
from tagjax.tagattention.published.tracer import PublishedStages
from tagjax.tracing.tracer import trace

pytest.importorskip("matplotlib")

from tagjax.evaluation.paper import ceiling, curves
from tagjax.report.paper import curves as drawn_curves
from tagjax.report.paper import maps
from tagjax.report.paper.style import around, save_small, sheet


def config(folder: Path, **changes: Any) -> PaperConfig:
    values = composed("paper", "figure=10")
    values.pop("progress")
    values |= {"suites": suites_named(suites()), "recordings_dir": str(folder), **changes}
    return from_mapping(PaperConfig, values)


def test_the_table_has_the_figures_and_its_suites_and_variants_exist():
    wanted = {*map(str, (2, 3, 4, 5, 6, 7, 10, 11, 12, 13, 14, 15, 16, 17, 19, 20, 21)), "tagvision_5"}
    assert set(FIGURES) == wanted | {f"tagview_{number}" for number in range(7, 12)}
    known = suites_named(suites())
    for name, figure in FIGURES.items():
        assert name == (str(figure.number) if name.isdigit() else f"{figure.paper.lower()}_{figure.number}")
        assert figure.caption.endswith("."), name
        for own in figure.recordings:
            variants = [one["name"] for one in known[own.suite].get("variants", [{"name": "all"}])]
            assert set(own.variants or variants) <= set(variants), name


def test_figures_are_chosen_by_name():
    assert chosen(["3", "10", "3"]) == ["3", "10"]
    assert chosen(["all"]) == list(FIGURES)
    with pytest.raises(ConfigError, match="found 8, tagview_1; expected all or some of 2, 3"):
        chosen(["8", "10", "tagview_1"])


def test_wrong_settings_are_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match="splits: found night; expected some of train, validation, test"):
        config(tmp_path, splits=["night"])
    with pytest.raises(ConfigError, match="splits: found none"):
        config(tmp_path, splits=[])
    with pytest.raises(ConfigError, match="max_recordings is 0"):
        config(tmp_path, max_recordings=0)
    with pytest.raises(ConfigError, match="workers is 0"):
        config(tmp_path, workers=0)
    with pytest.raises(ConfigError, match="tracers: found no published"):
        config(tmp_path, tracers={"tagattention": {}})
    assert config(tmp_path, figure=[2, "tagview_7"]).figures() == ("2", "tagview_7")
    assert config(tmp_path).simulates()
    assert not config(tmp_path, figure="all").simulates()
    assert config(tmp_path, figure="all", simulate=True).simulates()


def make_folders(folder: Path, *names: str) -> None:
    for name in names:
        suite, _, split, _ = name.split("-")
        (folder / suite / split / f"{name}.zarr").mkdir(parents=True)


def test_recordings_that_are_there_are_found_in_order(tmp_path: Path):
    variants = ("bottle", "box", "toy", "notebook", "bag")
    make_folders(tmp_path, *(f"single_static-{one}-train-{number}" for one in variants for number in (0, 1)))
    make_folders(tmp_path, *(f"single_static-{one}-validation-0" for one in variants))
    sources = Sources(config(tmp_path, simulate=False, splits=["validation", "train"]), tmp_path)
    names = [item.name for item in sources.items("single_static", ("box", "bottle"))]
    assert names == [
        f"single_static-{one}-{part}" for one in ("box", "bottle") for part in ("validation-0", "train-0", "train-1")
    ]
    limited = dataclasses.replace(sources.config, max_recordings=1)
    few = Sources(limited, tmp_path).items("single_static", ("box",))
    assert [item.name for item in few] == ["single_static-box-validation-0", "single_static-box-train-0"]
    firsts = sources.items("single_static", one=True)
    assert [item.name for item in firsts] == [f"single_static-{one}-validation-0" for one in variants]
    assert described(firsts) == "`single_static`, 5 recordings (validation)"
    with pytest.raises(ConfigError, match="single_static has no variant cup"):
        sources.items("single_static", ("cup",))
    with pytest.raises(MissingRecordingsError, match=r"multi_2, variant all: found no recording of validation, train"):
        sources.items("multi_2")


def test_a_narrower_width_never_widens_a_suite(tmp_path: Path):
    sources = Sources(config(tmp_path, width=320), tmp_path)
    assert sources.suite("single_static").capture.width == 320
    assert sources.suite("ceiling_2").capture.width == 256


def scores(iou: list[float], *, begin: int = 0) -> FrameScores:
    """One tag's scores: detected where the IoU is above 0."""
    count = len(iou)
    values = {field.name: np.zeros(count) for field in dataclasses.fields(FrameScores)}
    values |= {name: np.ones(count, bool) for name in ("visible", "selected")}
    values |= {
        "boundary_f": np.zeros((count, 4)),
        "status": np.ones(count, np.int8),
        "identified": np.ones(count, np.int64),
        "reads": np.ones(count, np.int64),
        "since_motion": np.arange(count) - begin,
    }
    made: dict[str, Any] = {**values, "iou": np.array(iou), "detected": np.array(iou) > 0}
    return FrameScores(**{**made, "label": 1, "moves": True})


def picture(frame: int, rng: np.random.Generator) -> Picture:
    return Picture(
        frame, ("a", "b"), rng.random((2, 5, 7)) < 0.3, rng.random((2, 4)), rng.random(2), rng.random(2) < 0.5,
        np.array([1, 0], np.int8),
    )  # fmt: skip


def test_a_trace_is_read_as_it_was_written(tmp_path: Path):
    rng = np.random.default_rng(0)
    before = Traced(
        {"b": scores([0.0, 0.5, 0.7], begin=1), "a": scores([0.1] * 3)}, [picture(n, rng) for n in (0, 1, 2)]
    )
    path = tmp_path / "traces" / "one.npz"
    write_traced(path, before)
    after = read_traced(path, pictures=True)
    assert after is not None
    assert list(after.frames) == ["b", "a"]
    for epc, frames in before.frames.items():
        for field in dataclasses.fields(FrameScores):
            np.testing.assert_array_equal(getattr(after.frames[epc], field.name), getattr(frames, field.name))
    for one, other in zip(before.pictures, after.pictures, strict=True):
        assert (other.frame, other.epcs) == (one.frame, one.epcs)
        for name in ("masks", "boxes_px", "confidence", "detected", "status"):
            np.testing.assert_array_equal(getattr(other, name), getattr(one, name))
    few = read_traced(path, pictures=False)
    assert few is not None
    assert few.pictures == []


def test_a_missing_damaged_or_incomplete_trace_is_none(tmp_path: Path):
    path = tmp_path / "one.npz"
    assert read_traced(path, pictures=False) is None
    write_traced(path, Traced({"a": scores([0.1])}, []))
    assert read_traced(path, pictures=False) is not None
    assert read_traced(path, pictures=True) is None
    content = path.read_bytes()
    for damaged in (b"", content[: len(content) // 2], b"no zip at all"):
        path.write_bytes(damaged)
        assert read_traced(path, pictures=False) is None
    np.savez(path, epcs=np.array(["a"]))
    assert read_traced(path, pictures=False) is None


def curve(values: list[float], counts: list[int]) -> Curve:
    nothing = np.full(len(values), np.nan)
    return Curve(np.array(values), nothing, nothing, np.array(counts, np.int64))


def test_the_late_mean_weighs_each_tag_alike():
    values, counts = [0.0] * 40 + [0.5] * 10 + [0.9] * 5 + [np.nan], [3] * 50 + [1] * 5 + [0]
    assert curves.late_iou({"iou": curve(values, counts)}) == pytest.approx((10 * 3 * 0.5 + 5 * 0.9) / 35)
    assert np.isnan(curves.late_iou({"iou": curve([0.3] * 20, [2] * 20)}))
    gap = curve([0.5] * 91, [2] * 60 + [0] * 10 + [2] * 21)
    assert curves._frames_that_count([curve([0.5] * 91, [2] * 91)]) == ""
    assert curves._frames_that_count([curve([0.5] * 91, [2] * 91), gap]).endswith(
        "in view in 51, 41 of these 51 frames."
    )


def test_a_curve_ends_where_half_of_its_tags_are_left():
    one = curve([0.1] * 120, [4] * 60 + [2] * 20 + [1] * 40)
    assert np.flatnonzero(drawn_curves.shown(one)).tolist() == list(range(80))
    gap = curve([0.1] * 120, [1] * 50 + [0] * 5 + [1] * 65)
    assert np.flatnonzero(~drawn_curves.shown(gap)).tolist() == list(range(50, 55))
    assert len(drawn_curves.shown(gap)) == 91
    assert not len(drawn_curves.shown(curve([], [])))


def test_the_distribution_and_its_corners():
    values = np.concatenate([np.zeros(970), np.full(20, 0.3), np.full(10, 0.7)])
    np.testing.assert_allclose(maps.below(values, np.array([0.0, 0.29, 0.3, 0.69, 0.7])), [0.97, 0.97, 0.99, 0.99, 1.0])
    np.testing.assert_allclose(maps.below(np.zeros(0), np.array([0.5])), [1.0])
    corners = maps.cdf_corners(values)
    for level in (0.3, 0.7):  # a step has its corners where the slope over 0.04 begins to see it
        assert min(abs(one - level) for one in corners) <= 0.05
    assert all(min(abs(one - 0.3), abs(one - 0.7)) <= 0.1 for one in corners)
    assert maps.cdf_corners(np.zeros(10)) == [0.0]


def test_a_crop_has_the_pictures_proportions_and_holds_the_boxes():
    boxes = np.array([[10.0, 20.0, 49.0, 39.0], [30.0, 20.0, 69.0, 59.0], [np.nan] * 4])
    x0, y0, x1, y1 = around(boxes, 100, 200)
    assert (x1 - x0) / (y1 - y0) == pytest.approx(2.0, rel=0.05)
    assert x0 <= 10
    assert y0 <= 20
    assert x1 > 69
    assert y1 > 59
    assert around(np.full((1, 4), np.nan), 100, 200) == (0, 0, 200, 100)
    assert around(np.array([[0.0, 0.0, 199.0, 99.0]]), 100, 200) == (0, 0, 200, 100)


def test_a_figure_of_noise_is_small(tmp_path: Path):
    figure = sheet(3.0)
    figure.subplots().imshow(np.random.default_rng(0).random((300, 600, 3)))
    save_small(figure, tmp_path / "one.png", max_bytes=60_000)
    assert (tmp_path / "one.png").stat().st_size <= 60_000
    with pytest.raises(ValueError, match=r"expected \.png"):
        save_small(figure, tmp_path / "one.svg")


def test_a_path_seen_by_a_moved_camera_is_turned_and_shifted():
    camera = overhead(PAPER_CAMERA, (0.0, 0.0, 2.0))
    path = np.array([[0.1, 0.2, 0.05], [-0.3, 0.1, 0.05], [np.nan, np.nan, np.nan]])
    np.testing.assert_allclose(ceiling.through(path, camera, camera, 0.05)[:2], path[:2], atol=1e-6)
    found = ceiling.through(path, camera, ceiling.moved(camera), 0.05)
    angle = -ceiling.MOVED_RAD
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    np.testing.assert_allclose(found[:2, :2], path[:2, :2] @ turn.T + ceiling.MOVED_M[:2], atol=1e-6)
    assert np.isnan(found[2]).all()


def test_the_stages_of_the_published_tracer_are_those_of_its_step():
    clip = synthetic.load(synthetic.recording(8), 0, 8)
    tracer = TagAttentionPublished(num_clusters=12)
    out = trace(tracer, clip.camera, clip.frames)

    @eqx.filter_jit
    def all_stages() -> PublishedStages:
        first = jax.tree.map(lambda leaf: leaf[0], clip.frames)
        state = tracer.init(clip.camera, first)
        return jax.lax.scan(lambda s, f: tracer.stages(clip.camera, s, f), state, clip.frames)[1]

    stages = all_stages()
    np.testing.assert_array_equal(stages.mask, out.mask)
    probability, cut = np.asarray(stages.probability), np.asarray(stages.cut)
    assert np.all((probability >= 0) & (probability <= 1))
    np.testing.assert_array_equal(cut, (probability >= 0.1) & cut)
    assert np.all(np.asarray(stages.attention)[:, :, ~np.asarray(stages.complete)[-1]][-1] == 0)


def test_a_trace_ends_ninety_frames_after_the_last_first_motion():
    recording = synthetic.recording(num_frames=12)
    assert last_frame(recording) == 12
    assert last_frame(dataclasses.replace(recording, truth=None)) == 12


def test_all_without_recordings_leaves_figures_out_with_the_reason(tmp_path: Path):
    drawn = run_paper(config(tmp_path / "none", figure="all"), tmp_path / "run")
    assert [one.name for one in drawn] == list(FIGURES)
    assert [one.name for one in drawn if one.picture is not None] == ["tagvision_5"]
    assert drawn[0].seen.startswith("not drawn: hopping_fixed, variant box: found no recording of test in ")
    page = (tmp_path / "run" / "figures.md").read_text()
    assert "![TagVision, Fig. 5](tagvision_5.png)" in page
    assert "## TagAttention, Fig. 10\n\nnot drawn: " in page
    with (tmp_path / "run" / "tagvision_5.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 300
    apart = [float(row["measured_rad"]) - float(row["theory_rad"]) for row in rows]
    assert np.angle(np.mean(np.exp(1j * np.array(apart)))) % (2 * np.pi) == pytest.approx(3.2, abs=0.03)
    with pytest.raises(MissingRecordingsError, match="Set simulate=true"):
        run_paper(config(tmp_path / "none", figure=2, simulate=False), tmp_path / "run")


def test_the_page_keeps_the_figures_of_runs_before(tmp_path: Path):
    old = Drawn("2", "TagAttention, Fig. 2", "two.png", "two.csv", "`a`, 1 recording (train)", "seen.")
    gone = dataclasses.replace(old, name="3", picture="three.png")
    (tmp_path / "two.png").touch()
    write_json(tmp_path / "figures.json", [dataclasses.asdict(one) for one in (old, gone)])
    run_paper(config(tmp_path, figure="tagvision_5"), tmp_path)
    listed = json.loads((tmp_path / "figures.json").read_text())
    assert [one["name"] for one in listed] == ["2", "tagvision_5"]
    assert "![TagAttention, Fig. 2](two.png)" in (tmp_path / "figures.md").read_text()
    for damaged in ("{", "[1]", '{"a": 1}', '[{"name": "2"}]'):
        (tmp_path / "figures.json").write_text(damaged)
        assert drawn_before(tmp_path) == []


@pytest.mark.ci
@pytest.mark.parametrize(
    "names", [("2", "3"), ("4", "5", "6", "7", "11"), ("14", "15"), ("20", "21"), ("tagview_7", "tagview_9")]
)
def test_figures_are_drawn_from_suites_in_small(tmp_path: Path, names: tuple[str, ...]):
    pytest.importorskip("mujoco")
    drawn = run_paper(config(tmp_path / "recordings", figure=list(names), smoke=True), tmp_path / "run")
    assert [one.name for one in drawn] == list(names)
    for one in drawn:
        assert one.picture is not None
        assert one.numbers is not None
        picture = tmp_path / "run" / one.picture
        assert 3_000 < picture.stat().st_size <= 150_000
        assert len((tmp_path / "run" / one.numbers).read_text().splitlines()) > 1
        assert one.recordings.startswith("`")
