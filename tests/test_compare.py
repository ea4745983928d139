"""The comparison of all systems: what a cell says, where methods do not apply, and a run in small."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from experiments.compare import suites_named, with_suites
from tagjax.config import ConfigError, from_mapping
from tagjax.evaluation.compare import Cell, CompareConfig, console_table, markdown, run_comparison
from tagjax.evaluation.compare._table import bars, write_csv
from tagjax.viz.comparison import bar_plot

CONF = Path(__file__).parents[1] / "conf"


def _config(suites: list[str], **changes: Any) -> CompareConfig:
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        values: Any = OmegaConf.to_container(compose("compare"), resolve=True)
    for name in ("suites", "progress"):
        values.pop(name)
    return dataclasses.replace(from_mapping(CompareConfig, {**values, "suites": suites_named(suites)}), **changes)


CELLS = [
    Cell("a", "tagattention", 2, 40, 0.9, 0.61, 12.3, 45.6, 1.0, None, 7.8, settings="people"),
    Cell("a", "tagview", reason="the camera looks along the room"),
    Cell("b", "tagattention", 1, 10, 0.5, None, None, None, 0.0, 0.25, 8.0),
]


def test_the_table_says_figures_reasons_and_what_the_papers_say():
    lines = markdown(CELLS, {"a": "0.97 of theirs"}).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert lines[2] == "| `a` | tagattention (people) | 0.900 | 0.610 | 12 | 46 | 1.000 | - | 8 | 2 | 0.97 of theirs |"
    assert "does not apply: the camera looks along the room" in lines[3]
    assert "0.97 of theirs" not in lines[3]
    assert " 0.250 " in lines[4]
    table = console_table(CELLS)
    assert table.row_count == 3
    assert "(1) does not apply: the camera" in str(table.caption)


def test_the_csv_holds_every_field(tmp_path: Path):
    write_csv(tmp_path / "t.csv", CELLS)
    rows = list(csv.DictReader((tmp_path / "t.csv").read_text().splitlines()))
    assert [row["system"] for row in rows] == ["tagattention", "tagview", "tagattention"]
    assert float(rows[0]["iou"]) == 0.61
    assert rows[1]["iou"] == ""
    assert rows[1]["reason"] == "the camera looks along the room"


def test_bars_are_drawn_where_there_are_figures(tmp_path: Path):
    assert bars(CELLS, "iou") == {"tagattention": {"a": 0.61, "b": None}, "tagview": {"a": None}}
    bar_plot(tmp_path / "c.png", {"identification": bars(CELLS, "identification"), "box IoU": bars(CELLS, "iou")})
    assert (tmp_path / "c.png").stat().st_size > 5000


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(SystemExit, match=r"unknown suite nowhere; known are .*planar_tracks"):
        suites_named(["nowhere"])
    assert list(suites_named("occlusion")) == ["occlusion"]
    assert with_suites(["benchmark=[a,b]", "most=2"]) == ["suites=[a,b]", "most=2"]
    with pytest.raises(ConfigError, match="No suite"):
        _config([])
    for change, told in (({"only": ("magic",)}, "magic"), ({"split": "exam"}, "exam"), ({"most": 0}, "most")):
        with pytest.raises(ConfigError, match=told):
            _config(["occlusion"], **change)


def test_systems_meet_on_a_suite_in_small(tmp_path: Path):
    config = _config(
        ["planar_tracks"], smoke=True, most=1, out=str(tmp_path / "made"), only=("tagattention_paper", "tagvision", "goller")
    )  # fmt: skip
    config = dataclasses.replace(config, scores=dataclasses.replace(config.scores, moved_for_s=0.2, min_pixels=2))
    told: list[str] = []
    cells = run_comparison(config, tmp_path / "out", on_progress=told.append)
    paper, vision, goller = cells
    assert goller.reason == "location by proximity needs several antennas"
    assert (paper.num_recordings, vision.num_recordings) == (2, 2)  # one of each variant
    assert paper.num_frames == vision.num_frames > 5
    for cell in (paper, vision):
        assert cell.p_d is not None
        assert 0 <= cell.p_d <= 1
        assert cell.p_fa is None  # everything moves
        assert (cell.ms_a_frame or 0) > 0
    written = json.loads((tmp_path / "out" / "table.json").read_text())
    assert [one["system"] for one in written] == ["tagattention_paper", "tagvision", "goller"]
    assert "several antennas" in (tmp_path / "out" / "table.md").read_text()
    assert (tmp_path / "out" / "comparison.png").is_file()
    assert any("simulated" in line for line in told)
    assert (paper.settings, vision.settings) == ("people", None)
    assert np.isfinite(vision.error_mm if vision.error_mm is not None else 0.0)
