"""The comparison of all systems: what a cell says, where methods do not apply, and a run in small."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import synthetic_clips as synthetic
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from rich.console import Console
from rich.table import Table

from experiments.suites import suites_named
from tagjax.baselines.goller import Calibration, GollerTracer, save_calibration
from tagjax.baselines.goller.antennas import AntennaModel
from tagjax.baselines.goller.location import make_location
from tagjax.baselines.goller.matching import make_association
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.compare import NAMES, Cell, CompareConfig, Systems, console_table, markdown, run_comparison
from tagjax.evaluation.compare.run import _score, _Tally
from tagjax.evaluation.compare.table import bars, write_cells
from tagjax.report.comparison import bar_plot
from tagjax.sim.suites import Item, Suite, Variant
from tagjax.tracing.tracer import Trace

CONF = Path(__file__).parents[1] / "conf"


def _config(suites: list[str], **changes: Any) -> CompareConfig:
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        values: Any = OmegaConf.to_container(compose("compare"), resolve=True)
    for name in ("paths", "suites", "progress"):
        values.pop(name)
    return dataclasses.replace(from_mapping(CompareConfig, {**values, "suites": suites_named(suites)}), **changes)


CELLS = [
    Cell("a", "tagattention", 2, 40, 0.9, 0.61, 12.3, 45.6, 1.0, None, 7.8, settings="quick"),
    Cell("a", "tagview", reason="the camera looks along the room", paper="0.97 of theirs"),
    Cell("b", "tagattention", 1, 10, 0.5, None, None, None, 0.0, 0.25, 8.0),
]


def _printed(table: Table) -> str:
    console = Console(width=80, file=io.StringIO())
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_table_holds_values_reasons_and_results_of_the_papers():
    table, legend = markdown(CELLS).split("\n\n", maxsplit=1)
    lines = table.splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert lines[2] == "| `a` | tagattention (quick) | 0.900 | 0.610 | 12 | 46 | 1.000 | - | 8 | 2 |  |"
    assert "does not apply: the camera looks along the room" in lines[3]
    assert lines[3].endswith("| 0.97 of theirs |")
    assert " 0.250 " in lines[4]
    assert "P_D: fraction of those frames with a detection" in legend
    assert "|" not in legend
    table = console_table(CELLS)
    assert table.row_count == 3
    text = _printed(table)
    assert "(1) does not apply: the camera" in text
    assert "tagview, result of its paper, a: 0.97 of theirs" in text
    assert "tagattention (quick): a" in text


def test_no_name_or_value_is_cut_on_eighty_columns():
    """For all suites and systems, with the widest values that can be expected."""
    cells = [
        Cell(path.stem, system, 12, 1234, 0.912, 0.934, 123.4, 1234.5, 0.956, 0.978, 1234.5, settings="fitted widths")
        for path in (CONF / "suite").glob("*.yaml")
        for system in NAMES
    ]
    lines = _printed(console_table(cells)).splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line.split() for line in lines]
    for cell in cells:
        assert [cell.suite, cell.system, "0.912", "0.934", "123", "1234", "0.956", "0.978", "1234"] in rows


def test_results_of_papers_belong_to_their_own_system():
    papers = _config(["occlusion"]).published
    assert set(papers) <= {path.stem for path in (CONF / "suite").glob("*.yaml")}
    assert {suite: list(systems) for suite, systems in papers.items()} == {
        "planar_tracks": ["tagvision"],
        **{f"ceiling_{count}": ["tagview"] for count in range(2, 7)},
        "separated_traces": ["tagview"],
        "half_wavelength": ["tagview"],
        "shop_exit": ["goller"],
    }
    with pytest.raises(ConfigError, match=r"published: found blob; expected some of tagattention, .*goller"):
        _config(["occlusion"], published={"occlusion": {"blob": "0.9"}})


def test_the_csv_holds_every_field(tmp_path: Path):
    write_cells(tmp_path / "t.csv", CELLS)
    rows = list(csv.DictReader((tmp_path / "t.csv").read_text().splitlines()))
    assert [row["system"] for row in rows] == ["tagattention", "tagview", "tagattention"]
    assert float(rows[0]["iou"]) == 0.61
    assert rows[1]["iou"] == ""
    assert rows[1]["reason"] == "the camera looks along the room"
    assert [row["paper"] for row in rows] == ["", "0.97 of theirs", ""]


def test_bars_are_drawn_where_there_are_values(tmp_path: Path):
    assert bars(CELLS, "iou") == {"tagattention": {"a": 0.61, "b": None}, "tagview": {"a": None}}
    bar_plot(tmp_path / "c.png", {"identification": bars(CELLS, "identification"), "box IoU": bars(CELLS, "iou")})
    assert (tmp_path / "c.png").stat().st_size > 5000


def test_false_alarms_are_detections_of_stationary_tags_labelled_or_not(monkeypatch: pytest.MonkeyPatch):
    """Two tags move with labelled objects, one is stationary without a label, and one moves out of sight."""
    drawn, num = synthetic.recording(12), 12
    assert drawn.truth is not None
    names = [*synthetic.EPCS, "shelf", "hidden"]
    epc = np.where(np.arange(len(drawn.reads.epc)) % 7 == 0, "shelf", drawn.reads.epc)
    reads = dataclasses.replace(drawn.reads, epc=np.where(np.arange(len(epc)) % 7 == 1, "hidden", epc))
    going = np.stack([np.linspace(0, 1, num), np.zeros(num), np.full(num, 2.0)], axis=-1)
    stationary = np.broadcast_to(going[:1], going.shape).copy()
    stationary[3] = np.nan  # not known at a frame
    truth = dataclasses.replace(
        drawn.truth, tag_position_m={"tag-a": going, "tag-b": going, "shelf": stationary, "hidden": going}
    )
    recording = dataclasses.replace(drawn.with_reads(reads), truth=truth)
    order = recording.resolve_epcs(None)
    assert sorted(order) == sorted(names)

    def trace_of(number: int) -> Trace:
        detected = {"tag-a": True, "tag-b": False, "shelf": number in (3, 4, 9), "hidden": True}
        return Trace(
            mask=jnp.zeros((4, synthetic.HEIGHT, synthetic.WIDTH)),
            box_px=jnp.zeros((4, 4)),
            centre_px=jnp.zeros((4, 2)),
            centre_m=jnp.zeros((4, 3)),
            step_m=jnp.zeros((4, 1)),
            confidence=jnp.full(4, 0.45),  # P_D and P_FA count every detection, whatever its confidence
            detected=jnp.array([detected[one] for one in order]),
        )

    config = _config(["occlusion"])
    monkeypatch.setattr(Systems, "traces", lambda *_: iter([(number, trace_of(number)) for number in range(num)]))
    monkeypatch.setattr(Systems, "stride", lambda *_: 1)
    systems, tally = Systems(config.systems, config.scores), _Tally()
    item = Item(from_mapping(Suite, config.suites["occlusion"]), Variant("all"), "test", 0, 1)
    scores = dataclasses.replace(config.scores, min_pixels=2)
    _score(systems, "tagview", item, recording, scores, tally)
    assert np.mean(np.concatenate(tally.false_alarms)) == pytest.approx(3 / num)
    assert tally.scores.result()["p_fa"] == pytest.approx((3 + num) / (2 * num))


def test_goller_takes_a_calibration_that_was_fitted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """It replaces the grid's calibration with unfitted widths; another file is refused before anything is simulated."""
    num = 3
    antennas = AntennaModel(jnp.zeros((num, 2)), jnp.zeros((num, 2)), jnp.zeros(num), jnp.zeros(num), jnp.zeros(()))
    location, association = make_location(antennas), make_association(speed_m_s=0.123)
    save_calibration(Calibration(location, association, jnp.asarray(0.4), jnp.asarray(-60.0)), tmp_path / "c.json")
    config = _config(["shop_exit"])
    settings = dataclasses.replace(config.systems, goller_calibration=str(tmp_path / "c.json"), goller_grid=None)
    monkeypatch.setattr(GollerTracer, "install", lambda self, _: self)
    recording = dataclasses.replace(synthetic.recording(4), antennas_m=np.zeros((num, 3)))
    systems = Systems(settings, config.scores)
    found = systems._goller(recording).calibration
    np.testing.assert_allclose(found.association.log_speed_m_s, np.log(0.123), rtol=1e-5)
    assert systems.settings_label("goller") == "fitted widths"
    assert Systems(config.systems, config.scores).settings_label("goller") == "starting widths"
    wrong = dataclasses.replace(settings, goller_calibration=str(tmp_path / "none.json"))
    with pytest.raises(ConfigError, match=r"systems\.goller_calibration: .*none\.json.*experiments\.goller"):
        run_comparison(
            dataclasses.replace(config, systems=wrong, recordings_dir=str(tmp_path / "made")), tmp_path / "out"
        )
    assert not (tmp_path / "made").exists()


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(ValueError, match=r"suites: found nowhere; expected some of .*planar_tracks"):
        suites_named(["nowhere"])
    assert list(suites_named(["occlusion"])) == ["occlusion"]
    with pytest.raises(ConfigError, match="suites is empty"):
        _config([])
    for change, message in (
        ({"only": ("magic",)}, "magic"),
        ({"split": "exam"}, "exam"),
        ({"max_recordings": 0}, "max_recordings"),
    ):
        with pytest.raises(ConfigError, match=message):
            _config(["occlusion"], **change)


@pytest.mark.ci
def test_systems_meet_on_a_suite_in_small(tmp_path: Path):
    config = _config(
        ["planar_tracks"], smoke=True, max_recordings=1, recordings_dir=str(tmp_path / "made"), only=("tagattention_published", "tagvision", "goller")
    )  # fmt: skip
    config = dataclasses.replace(config, scores=dataclasses.replace(config.scores, min_pixels=2))
    reported: list[tuple[str, int, int, str]] = []

    def report(stage: str, done: int, total: int, now: str = "") -> None:
        reported.append((stage, done, total, now))

    cells = run_comparison(config, tmp_path / "out", on_progress=report)
    published, vision, goller = cells
    assert goller.reason == "location by proximity needs several antennas"
    assert (published.num_recordings, vision.num_recordings) == (2, 2)  # one of each variant
    assert published.num_frames == vision.num_frames > 5
    for cell in (published, vision):
        assert cell.p_d is not None
        assert 0 <= cell.p_d <= 1
        assert cell.p_fa is None  # everything moves
        assert (cell.ms_a_frame or 0) > 0
    written = json.loads((tmp_path / "out" / "table.json").read_text())
    assert [one["system"] for one in written] == ["tagattention_published", "tagvision", "goller"]
    assert [one["paper"] for one in written] == [None, config.published["planar_tracks"]["tagvision"], None]
    assert "several antennas" in (tmp_path / "out" / "table.md").read_text()
    assert (tmp_path / "out" / "comparison.png").is_file()
    assert reported[0][:3] == ("simulate planar_tracks", 0, 2)
    assert reported[-1][:3] == ("trace", 6, 6)
    assert (published.settings, vision.settings) == (None, None)  # one setting each
    assert (vision.error_mm is None) == (vision.identification == 0)  # the error is over correctly identified frames


def test_a_suite_without_pictures_is_skipped_with_a_reason(tmp_path: Path):
    config = _config(
        ["planar_101", "planar_tracks"],
        smoke=True,
        max_recordings=1,
        recordings_dir=str(tmp_path / "made"),
        only=("goller",),
    )
    lines, table = run_comparison(config, tmp_path / "out")
    assert lines.reason == "no pictures: lines only"
    assert table.reason == "location by proximity needs several antennas"
    alone = dataclasses.replace(config, suites={"planar_101": config.suites["planar_101"]})
    assert [cell.reason for cell in run_comparison(alone, tmp_path / "alone")] == [lines.reason]
