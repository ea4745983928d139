"""Tables that make themselves again: intervals, staleness, pages that agree with their JSON, and resumption."""

from __future__ import annotations

import dataclasses
import io
import json
import re
import subprocess
import sys
import tokenize
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_clips as synthetic
from frame_scores import frame_scores
from hydra import initialize_config_dir
from omegaconf import OmegaConf

from experiments.reproduce import tracer_settings
from experiments.suites import suites_named
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.reproduce import measure as measuring
from tagjax.evaluation.reproduce.commands import CommandRecipe, recipe_from
from tagjax.evaluation.reproduce.make import make_table
from tagjax.evaluation.reproduce.markdown import differing, not_made, rendered, replaced, write_pages
from tagjax.evaluation.reproduce.measure import Inputs, Tracing, measure
from tagjax.evaluation.reproduce.provenance import _code, changes, content_id, dependencies, revision
from tagjax.evaluation.reproduce.recipe import COUNTS, MEASURES, Job, Recipe
from tagjax.evaluation.reproduce.scores import RecordingScores
from tagjax.evaluation.reproduce.status import stale, status
from tagjax.evaluation.reproduce.table import begin, filled, read_table, table_path, write_table
from tagjax.metrics.interval import ratio_estimate
from tagjax.metrics.recordings import RecordingResult, ScoreSettings
from tagjax.metrics.tags import Scores
from tagjax.sim.suites import Item, Suite

ROOT = Path(__file__).parents[1]
RECIPES = sorted((ROOT / "conf" / "table").glob("*.yaml"))


def _settings(path: Path) -> Any:
    return OmegaConf.to_container(OmegaConf.load(path))


def _tracer(name: str) -> Any:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return tracer_settings(name)


SUITE = {
    "name": "small",
    "about": "two variants",
    "paper": "none",
    "story": "handheld",
    "seed": 7,
    "variants": [{"name": "a"}, {"name": "b"}],
    "counts": {"train": 0, "validation": 0, "test": 2},
}

RECIPE: dict[str, Any] = {
    "name": "small",
    "title": "A small table",
    "pages": ["page.md"],
    "columns": {
        "iou": {"heading": "box IoU", "measures": ["iou"], "interval": True},
        "all": {"heading": "error / identified", "measures": ["cle_px", "identification"]},
        "locked": {"heading": "locked", "measures": ["locked"]},
        "counts": {"heading": "recordings / tags / frames", "measures": ["num_recordings", "num_tags", "num_frames"]},
        "reported": {"heading": "the paper's own"},
    },
    "rows": [
        {
            "label": "small, online",
            "suite": "small",
            "protocol": "part",
            "system": "online",
            "recorded": {"reported": {"text": "0.9", "paper": "Fig. 1"}},
        },
        {
            "label": "real | video",
            "kind": "recorded",
            "recorded": {"iou": {"text": "0.7", "command": "evaluate it", "revision": "ab" * 20, "date": "2026-01-02"}},
        },
    ],
    "protocols": {"part": {"frames": [0, 30], "scores": {"from_s": 0.0}}},
    "systems": {"online": {"tracer": "tagattention_literal", "clips": {"stride": 2}}},
    "depends": ["code/*.py", "recipe.yaml"],
}


def _recipe(**changed: Any) -> Recipe:
    return from_mapping(Recipe, {**RECIPE, **changed}, where="table small")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A repository in small: code, a recipe and a page with markers."""
    (tmp_path / "code").mkdir()
    for name in ("one", "two"):
        (tmp_path / "code" / f"{name}.py").write_text(f"{name} = 1\n")
    (tmp_path / "recipe.yaml").write_text("name: small\n")
    (tmp_path / "page.md").write_text(f"Above\n<!-- table: small -->\n{not_made('small')}\n<!-- /table -->\nBelow\n")
    return tmp_path


SCORES = [
    RecordingScores(
        "r0", 1, 10, {"iou": (6.0, 10), "cle_px": (30.0, 10), "identification": (9.0, 10), "locked": (1.0, 1)}
    ),
    RecordingScores(
        "r1", 2, 30, {"iou": (24.0, 30), "cle_px": (60.0, 20), "identification": (30.0, 30), "locked": (1.0, 2)}
    ),
]


def _made(recipe: Recipe, root: Path) -> dict[str, Any]:
    """The table of fixed scores, by a fixed machine at a fixed time."""
    begun = {
        **begin(recipe, root),
        "revision": {"commit": "cd" * 20, "dirty": False, "modified": []},
        "date_utc": "2026-03-04T05:06:07+00:00",
        "machine": {"cores": 2, "processor": "x86_64", "jax": "0.10.2"},
    }
    return filled(begun, recipe, {recipe.jobs()[0]: SCORES})


# Intervals


def test_an_interval_agrees_with_the_closed_form_for_a_mean():
    rng = np.random.default_rng(0)
    counts = np.full(400, 50)
    totals = 50 * rng.normal(0.7, 0.1, 400)
    found = ratio_estimate(totals, counts)
    mean, error = totals.sum() / counts.sum(), np.std(totals / 50) / np.sqrt(400)
    assert found.value == pytest.approx(mean, abs=1e-12)
    assert found.low is not None
    assert found.high is not None
    np.testing.assert_allclose((found.low, found.high), [mean - 1.96 * error, mean + 1.96 * error], atol=0.1 * error)


def test_an_interval_agrees_with_resampling_by_hand_where_recordings_differ_in_length():
    rng = np.random.default_rng(1)
    counts = rng.integers(1, 100, 12)
    totals = counts * rng.uniform(0.2, 0.9, 12)
    drawn = np.random.default_rng(5).integers(0, 12, (50_000, 12))
    means = totals[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    found = ratio_estimate(totals, counts)
    assert found.low is not None
    assert found.high is not None
    np.testing.assert_allclose([found.low, found.high], np.quantile(means, [0.025, 0.975]), atol=0.015)
    assert found == ratio_estimate(totals, counts)


def test_frames_count_the_same_and_recordings_without_any_are_left_out():
    found = ratio_estimate(np.array([1.0, 50.0, 0.0]), np.array([1, 100, 0]))
    assert found.value == pytest.approx(51 / 101)
    assert (found.low, found.high) == pytest.approx((0.5, 1.0))
    assert (found.count, found.num_recordings) == (101, 2)
    single = ratio_estimate(np.array([3.0]), np.array([4]))
    assert (single.value, single.low, single.high) == (0.75, None, None)
    assert ratio_estimate(np.zeros(1), np.zeros(1, int)).value is None


# Files that a table follows from


PROSE = '''"""A module."""  # why

SIZE = "# not a comment"  # pixels
"""Of an image."""


def area(a: int) -> int:
    """The area.

    Of a square.
    """
    # The side, twice.

    text = """
        kept
    """
    return a * a if text else 0
'''
CODE = '''
SIZE = "# not a comment"
def area(a: int) -> int:
    text = """
        kept
    """
    return a * a if text else 0
'''


def test_prose_does_not_change_the_id_of_a_file(tmp_path: Path):
    def named(text: str, name: str = "one.py") -> str:
        (tmp_path / name).write_text(text)
        return content_id(tmp_path / name)

    assert named(PROSE) == named(CODE)
    assert named(PROSE) != named(PROSE.replace("a * a", "a + a"))
    assert named(PROSE) != named(PROSE.replace("        kept", "        other"))
    assert named(PROSE) != named(PROSE.replace("not a comment", "another text"))
    assert named("a: {b: 1}  # why\n", "one.yaml") == named("# what\na:\n  b: 1\n", "one.yaml")
    assert named("a: {b: 1}\n", "one.yaml") != named("a: {b: 2}\n", "one.yaml")
    assert named(PROSE, "one.md") != named(CODE, "one.md")


def test_only_prose_is_cut_from_what_is_hashed():
    def code_tokens(source: str) -> list[str]:
        kinds = (tokenize.NAME, tokenize.OP, tokenize.NUMBER)
        return [one.string for one in tokenize.generate_tokens(io.StringIO(source).readline) if one.type in kinds]

    for path in sorted((ROOT / "tagjax").rglob("*.py")):
        source = path.read_text()
        assert code_tokens(_code(source)) == code_tokens(source), path


def test_changes_are_named(root: Path):
    before = dependencies(root, RECIPE["depends"])
    assert list(before) == ["code/one.py", "code/two.py", "recipe.yaml"]
    (root / "code/one.py").write_text("one = 2\n")
    (root / "code/two.py").unlink()
    (root / "code/three.py").write_text("")
    now = dependencies(root, RECIPE["depends"])
    assert changes(before, now) == ["code/one.py (changed)", "code/three.py (added)", "code/two.py (removed)"]
    assert changes(now, now) == []
    with pytest.raises(ValueError, match=r"'code/\*\.txt' matches no file"):
        dependencies(root, ["code/*.txt"])


def test_a_revision_lists_the_files_that_are_not_committed(root: Path):
    assert revision(root, {}) == {"commit": None, "dirty": None, "modified": []}

    def git(*words: str) -> str:
        own = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "core.autocrlf=false"]
        return subprocess.run(["git", *own, *words], cwd=root, check=True, capture_output=True, text=True).stdout

    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    (root / "page.md").write_text("another page\n")
    files = dependencies(root, RECIPE["depends"])
    assert revision(root, files) == {"commit": git("rev-parse", "HEAD").strip(), "dirty": False, "modified": []}
    (root / "code/one.py").write_text("one = 2\n")
    (root / "code/new.py").write_text("")
    found = revision(root, dependencies(root, RECIPE["depends"]))
    assert (found["dirty"], found["modified"]) == (True, ["code/new.py", "code/one.py"])


def test_a_table_is_stale_once_a_file_of_its_recipe_changed(root: Path):
    recipe = _recipe()
    assert stale(recipe, root) == ["not made yet"]
    write_table(table_path(root, "small"), _made(recipe, root))
    write_pages(recipe, root)
    assert stale(recipe, root) == []
    assert status(recipe, root) == []
    (root / "page.md").write_text((root / "page.md").read_text() + "more\n")
    assert status(recipe, root) == []
    (root / "code/two.py").write_text("two = 2\n")
    assert stale(recipe, root) == ["code/two.py (changed)"]
    assert status(recipe, root) == [
        "small is stale: code/two.py (changed). Run `python -m experiments.reproduce table=small`."
    ]


# Markdown


def test_a_page_shows_the_table_of_its_json(root: Path):
    recipe = _recipe()
    assert differing(recipe, root) == []
    write_table(table_path(root, "small"), _made(recipe, root))
    assert differing(recipe, root) == [root / "page.md"]
    assert write_pages(recipe, root) == [root / "page.md"]
    assert differing(recipe, root) == []
    assert write_pages(recipe, root) == []
    page = (root / "page.md").read_text()
    lines = page.splitlines()
    assert lines[:2] == ["Above", "<!-- table: small -->"]
    assert lines[-2:] == ["<!-- /table -->", "Below"]
    assert lines[2] == "| | box IoU | error / identified | locked | recordings / tags / frames | the paper's own |"
    assert lines[4] == "| small, online | 0.75 [0.60, 0.80] | 3.0 px / 0.97 | 2 of 3 | 2 / 3 / 40 | 0.9 (Fig. 1) |"
    assert lines[5] == r"| real \| video \* | 0.7 |  |  |  |  |"
    assert lines[7].startswith(
        "Made by `python -m experiments.reproduce table=small`, revision `cdcdcdcdcd`, 2026-03-04, on 2 cores (x86_64), "
    )
    assert "95% interval by recording (2,000 bootstrap resamples)" in lines[7]
    assert r"\* Recorded by hand, not made by this command: revision `ababababab`, 2026-01-02" in lines[7]
    (root / "page.md").write_text(page.replace("0.75", "0.85"))
    assert differing(recipe, root) == [root / "page.md"]
    assert "page.md does not show the table of its JSON" in status(recipe, root)[0]


def test_values_measured_on_changed_files_are_marked(root: Path):
    table = _made(_recipe(), root)
    table["revision"]["dirty"] = True
    assert "revision `cdcdcdcdcd` with uncommitted changes" in rendered(table)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nothing", r"<!-- table: small --> 0 times"),
        ("<!-- table: small -->\n<!-- /table -->\n" * 2, r"<!-- table: small --> 2 times"),
        ("<!-- table: small -->\n| a |\n", r"no <!-- /table --> after"),
        ("<!-- table: small -->\n<!-- table: other -->\n<!-- /table -->", r"no <!-- /table --> after"),
    ],
)
def test_missing_markers_are_reported(text: str, message: str, root: Path):
    with pytest.raises(ValueError, match=message):
        replaced(text, "small", "body")
    (root / "page.md").write_text(text)
    with pytest.raises(ValueError, match=rf"page\.md: .*{message}"):
        write_pages(_recipe(), root)


def test_json_of_something_else_is_refused(tmp_path: Path):
    path = tmp_path / "table.json"
    assert read_table(path) is None
    for text in ("{", "[]", '{"format": "tagjax-table", "version": 0}'):
        path.write_text(text)
        with pytest.raises(ValueError, match="make the table again, or restore the file"):
            read_table(path)


# Recipes


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"columns": {"iou": {"heading": "IoU", "measures": ["magic"]}}}, "found measure magic; expected some of iou"),
        (
            {"rows": [{"label": "a", "kind": "shell", "suite": "small"}]},
            "found 'shell'; expected one of 'score', 'recorded'",
        ),
        ({"rows": [{"label": "a", "suite": "small"}]}, "a score needs both"),
        ({"rows": [{"label": "a", "kind": "recorded", "suite": "small"}]}, "only recorded values, without a suite"),
        (
            {"rows": [{"label": "a", "suite": "small", "protocol": "whole"}]},
            "protocol: found whole; expected some of part",
        ),
        ({"systems": {}}, "system: found online; expected some of none"),
        (
            {"rows": [{"label": "a", "suite": "small", "protocol": "part", "system": {"ioo": "online"}}]},
            "system: found ioo; expected some of iou, all",
        ),
        (
            {"rows": [{"label": "a", "suite": "small", "protocol": "part", "system": {"iou": "offline"}}]},
            "system: found offline; expected some of online",
        ),
        ({"systems": {"online": {"tracer": "a", "clips": {"strid": 2}}}}, "strid"),
        ({"depends": []}, "depends is empty"),
        ({"depends": ["../other/*.py"]}, "a path within the repository"),
        ({"pages": ["/page.md"]}, "a path within the repository"),
        ({"run": "echo"}, "unknown key 'run'"),
    ],
)
def test_a_recipe_that_cannot_be_made_is_refused(changed: dict[str, Any], message: str):
    with pytest.raises(ConfigError, match=message):
        _recipe(**changed)


def test_every_measure_is_one_that_scores_have():
    scores = _result().scores().merge(Scores.of_false_detections(np.ones(3, bool)))
    assert set(MEASURES) - set(COUNTS) - {"locked"} <= set(scores.means)


def test_columns_of_a_row_may_be_of_other_systems():
    systems = {"a": {"tracer": "tagattention_literal"}, "b": {"tracer": "tagattention"}}
    row = {"label": "a", "suite": "small", "protocol": "part", "system": {"iou": "a", "all": "b"}}
    recipe = _recipe(rows=[row], systems=systems)
    assert [job.system for job in recipe.jobs()] == ["a", "b"]
    assert recipe.job(recipe.rows[0], "locked") is None
    assert recipe.tracers() == ["tagattention_literal", "tagattention"]


@pytest.mark.parametrize(
    "source", [{}, {"command": "c"}, {"command": "c", "revision": "r", "date": "d", "paper": "Fig. 1"}]
)
def test_a_recorded_value_has_one_whole_source(source: dict[str, str]):
    row = {"label": "a", "kind": "recorded", "recorded": {"iou": {"text": "0.7", **source}}}
    with pytest.raises(ConfigError, match="expected the first three"):
        _recipe(rows=[row])


# Measuring


def _result(name: str = "one") -> RecordingResult:
    """One recording's scores, of two tags over four frames."""
    truth = dataclasses.replace(synthetic.recording(num_frames=4), name=name)
    frames = frame_scores(
        [0.2, 0.6, 0.7, 0.8],
        cle_px=[5.0, np.nan, 3.0, 3.0],
        mask_j=np.full(4, 0.5),
        identified=[1, 1, 2, 1],
        since_motion=[-1, 0, 1, 2],
    )
    return RecordingResult(truth, {"tag-a": frames, "tag-b": frames}, [], ScoreSettings(lock_s=0.2))


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Recordings that have been traced, none of which is simulated or looked at."""
    found: list[Path] = []

    def trace(self: Tracing, path: Path) -> RecordingResult:
        found.append(path)
        return _result(path.stem)

    monkeypatch.setattr(Tracing, "trace", trace)
    monkeypatch.setattr(measuring, "make_suite", lambda *_, **__: [])
    return found


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch, traced: list[Path]) -> set[str]:
    """Names of recordings that would have been simulated."""
    found: set[str] = set()

    def make_suite(suite: Suite, folder: Path, *, wanted: Callable[[Item], bool], **_: Any) -> list[Any]:
        found.update(item.name for item in suite.items() if wanted(item))
        return []

    monkeypatch.setattr(measuring, "make_suite", make_suite)
    return found


def _inputs(folder: Path, **changed: Any) -> Inputs:
    code = {"code/one.py": "1" * 40, "recipe.yaml": "2" * 40}
    tracers = {"tagattention_literal": _tracer("tagattention_literal")}
    inputs = Inputs({"small": SUITE}, tracers, folder / "recordings", folder / "finished", code)
    return dataclasses.replace(inputs, **changed)


def test_scores_are_kept_as_sums(tmp_path: Path, traced: list[Path]):
    scores = measure(_recipe(), _inputs(tmp_path))
    assert list(scores) == [Job("small", "test", None, "part", "online")]
    (found,) = scores.values()
    assert len(found) == len(traced) == 4
    assert (found[0].num_tags, found[0].num_frames) == (2, 6)
    assert found[0].sums["iou"] == pytest.approx((4.2, 6))
    assert found[0].sums["cle_px"] == pytest.approx((12.0, 4))
    assert found[0].sums["identification"] == pytest.approx((4.0, 6))
    assert found[0].sums["locked"] == (2.0, 2)


def _whole_table(folder: Path, traced: list[Path]) -> dict[str, list[RecordingScores]]:
    """The table's scores by an older revision."""
    scores = measure(_recipe(), _inputs(folder, revision="a" * 40))
    traced.clear()
    return {job.name: found for job, found in scores.items()}


CHANGED_CODE = {"code/one.py": "3" * 40}


def test_confirming_takes_over_what_scores_the_same(tmp_path: Path, traced: list[Path], simulated: set[str]):
    before = _whole_table(tmp_path, traced)
    assert len(simulated) == 4
    simulated.clear()
    inputs = _inputs(tmp_path, code=CHANGED_CODE, revision="b" * 40)
    (found,) = measure(_recipe(), inputs, before=before, confirm=1).values()
    assert len(traced) == 1
    assert simulated == {traced[0].stem}
    assert [one.revision[:1] for one in found if one.revision] == ["b", "a", "a", "a"]
    assert [one.sums for one in found] == [one.sums for one in next(iter(before.values()))]


@pytest.mark.parametrize("changed", ["iou", "locked", "num_frames"])
def test_confirming_traces_all_recordings_once_one_scores_otherwise(tmp_path: Path, traced: list[Path], changed: str):
    ((job, scores),) = _whole_table(tmp_path, traced).items()
    first = scores[0]
    if changed == "num_frames":
        other = dataclasses.replace(first, num_frames=first.num_frames + 1)
    else:
        total, count = first.sums[changed]
        other = dataclasses.replace(first, sums={**first.sums, changed: (total + 0.01 * count, count)})
    measure(_recipe(), _inputs(tmp_path, code=CHANGED_CODE), before={job: [other, *scores[1:]]}, confirm=1)
    assert len(traced) == 4


def test_confirming_traces_all_recordings_once_a_setting_changed(tmp_path: Path, traced: list[Path]):
    """Even where the first of them score as before: others may not."""
    before = _whole_table(tmp_path, traced)
    changed = _recipe(systems={"online": {"tracer": "tagattention_literal", "clips": {"stride": 4}}})
    measure(changed, _inputs(tmp_path), before=before, confirm=1)
    assert len(traced) == 4
    unknown = {job: [dataclasses.replace(one, settings=None) for one in scores] for job, scores in before.items()}
    traced.clear()
    measure(_recipe(), _inputs(tmp_path, code=CHANGED_CODE), before=unknown, confirm=1)
    assert len(traced) == 4


def test_confirming_traces_all_recordings_of_a_new_row(tmp_path: Path, traced: list[Path]):
    measure(_recipe(), _inputs(tmp_path), before={}, confirm=1)
    assert len(traced) == 4


def test_confirming_needs_a_recording(tmp_path: Path):
    with pytest.raises(ConfigError, match="confirm is 0; expected 1 or more"):
        measure(_recipe(), _inputs(tmp_path), confirm=0)


def test_a_damaged_table_is_made_again(root: Path, monkeypatch: pytest.MonkeyPatch):
    """As its error says."""
    recipe, path = _recipe(), table_path(root, "small")
    path.parent.mkdir(parents=True)
    path.write_text("<<<<<<< HEAD\n")
    with pytest.raises(ValueError, match=r"not JSON .* make the table again"):
        status(recipe, root)
    monkeypatch.setattr("tagjax.evaluation.reproduce.make.measure", lambda *_, **__: {})
    monkeypatch.setattr("tagjax.evaluation.reproduce.make.filled", lambda *_: _made(recipe, root))
    make_table(recipe, root, suites={}, tracers={}, recordings=root, finished=root)
    assert status(recipe, root) == []


def test_a_table_says_which_recordings_were_traced_before(root: Path):
    recipe = _recipe()
    table = _made(recipe, root)
    assert "were traced at" not in rendered(table)
    for scores in table["recordings"].values():
        scores[0]["revision"] = "c" * 40
    assert "1 of its 2 recordings were traced at `cccccccccc`; of each row another scores the same now." in rendered(
        table
    )


def test_an_interrupted_measurement_loses_one_recording_at_most(
    tmp_path: Path, traced: list[Path], monkeypatch: pytest.MonkeyPatch
):
    whole = Tracing.trace

    def interrupted(self: Tracing, path: Path) -> RecordingResult:
        if len(traced) == 2:
            raise KeyboardInterrupt
        return whole(self, path)

    monkeypatch.setattr(Tracing, "trace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        measure(_recipe(), _inputs(tmp_path))
    assert len(list((tmp_path / "finished").iterdir())) == 2
    first = list(traced)
    monkeypatch.setattr(Tracing, "trace", whole)
    scores = measure(_recipe(), _inputs(tmp_path))
    assert len(traced) == 4
    assert not set(traced[2:]) & set(first)
    traced.clear()
    assert measure(_recipe(), _inputs(tmp_path)) == scores
    assert not traced


@pytest.mark.parametrize(
    ("recipe", "inputs", "again"),
    [
        ({}, {"code": {"code/one.py": "3" * 40}}, 4),
        ({}, {"code": {"code/one.py": "1" * 40, "recipe.yaml": "3" * 40}}, 0),
        ({"title": "Another title"}, {}, 0),
        ({"protocols": {"part": {"frames": [0, 31], "scores": {"from_s": 0.0}}}}, {}, 4),
        ({"systems": {"online": {"tracer": "tagattention_literal", "clips": {"stride": 4}}}}, {}, 4),
        ({"systems": {"online": {"tracer": "tagattention_literal"}}}, {}, 0),  # 512 pixels wide: every second
        ({}, {"suites": {"small": {**SUITE, "seed": 8}}}, 4),
        ({}, {"suites": {"small": {**SUITE, "about": "in other words"}}}, 0),
        ({}, {"suites": {"small": {**SUITE, "counts": {"train": 0, "validation": 0, "test": 3}}}}, 2),
    ],
)
def test_scores_are_measured_again_where_what_they_follow_from_changed(
    recipe: dict[str, Any], inputs: dict[str, Any], again: int, tmp_path: Path, traced: list[Path]
):
    measure(_recipe(), _inputs(tmp_path))
    traced.clear()
    measure(_recipe(**recipe), _inputs(tmp_path, **inputs))
    assert len(traced) == again


def test_a_damaged_score_is_measured_again(tmp_path: Path, traced: list[Path]):
    scores = measure(_recipe(), _inputs(tmp_path))
    next((tmp_path / "finished").iterdir()).write_text("{")
    traced.clear()
    assert measure(_recipe(), _inputs(tmp_path)) == scores
    assert len(traced) == 1


def test_seeds_draw_recordings_anew(tmp_path: Path, traced: list[Path]):
    row = {"label": "a", "suite": "small", "protocol": "part", "system": "online", "seeds": [1, 2]}
    (found,) = measure(_recipe(rows=[row]), _inputs(tmp_path)).values()
    assert len(found) == 8
    assert {path.relative_to(tmp_path / "recordings").parts[0] for path in traced} == {"small-seed1", "small-seed2"}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"suites": {}}, "found suite 'small'; expected one of none"),
        ({"tracers": {"other": {}}}, "found tracer 'tagattention_literal'; expected one of other"),
        ({"suites": {"small": {**SUITE, "counts": {"test": 0}}}}, "small: found no test recording"),
    ],
)
def test_what_a_recipe_names_must_be_there(changed: dict[str, Any], message: str, tmp_path: Path, traced: list[Path]):
    with pytest.raises(ConfigError, match=message):
        measure(_recipe(), _inputs(tmp_path, **changed))


def test_a_table_is_made_with_all_that_its_values_can_be_computed_from(root: Path, traced: list[Path]):
    recipe, steps = _recipe(), []
    made = make_table(
        recipe,
        root,
        suites={"small": SUITE},
        tracers={"tagattention_literal": _tracer("tagattention_literal")},
        recordings=root / "recordings",
        finished=root / "finished",
        on_progress=lambda *step: steps.append(step),
    )
    table = read_table(table_path(root, "small"))
    assert table == json.loads(json.dumps(made))
    assert table is not None
    cell = table["rows"][0]["cells"]["iou"]
    assert (cell["num_recordings"], cell["num_tags"], cell["num_frames"]) == (4, 8, 24)
    sums = [one["sums"]["iou"] for one in table["recordings"][cell["job"]]]
    totals, counts = np.array([one[0] for one in sums]), np.array([one[1] for one in sums])
    assert dataclasses.asdict(ratio_estimate(totals, counts)) == cell["values"]["iou"]
    assert table["depends"] == dependencies(root, RECIPE["depends"])
    assert {"platform", "processor", "cores", "load", "devices", "jax"} <= set(table["machine"])
    assert table["revision"]["commit"] is None
    assert table["command"] == "python -m experiments.reproduce table=small"
    assert rendered(table) in (root / "page.md").read_text()
    assert status(recipe, root) == []
    assert steps[-1] == ("trace", 4, 4)
    assert [done for _, done, _, now in steps[:-1] if now.endswith(": online")] == [0, 1, 2, 3]


@pytest.mark.ci
@pytest.mark.parametrize(
    "system", [RECIPE["systems"]["online"], {"tracer": "blobs"}], ids=lambda system: system["tracer"]
)
def test_a_table_of_a_simulated_suite_is_made(root: Path, system: dict[str, Any]):
    """Nothing is replaced here: two small recordings are simulated, traced and scored."""
    suite = {
        **SUITE,
        "duration_s": 2.4,
        "capture": {"width": 64, "frame_rate_hz": 10.0},
        "variants": [{"name": "a", "settings": {"kinds": ["box"]}}],
        "settings": {"room": "meeting_room"},
    }
    protocol = {"frames": [0, 16], "scores": {"min_pixels": 1}}
    make: Callable[[], dict[str, Any]] = lambda: make_table(  # noqa: E731
        _recipe(protocols={"part": protocol}, systems={"online": system}),
        root,
        suites={"small": suite},
        tracers={system["tracer"]: _tracer(system["tracer"])},
        recordings=root / "recordings",
        finished=root / "finished",
    )
    table = make()
    cell = table["rows"][0]["cells"]["iou"]
    assert cell["num_recordings"] == 2
    assert cell["num_tags"] == 2
    assert 0 < cell["num_frames"] <= 24
    assert 0 <= cell["values"]["iou"]["value"] <= 1
    again = make()
    assert again["rows"] == table["rows"]


# The repository's own tables


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_every_recipe_names_what_is_there_and_depends_on_it(path: Path):
    recipe = recipe_from(_settings(path))
    assert recipe.name == path.stem
    files = dependencies(ROOT, recipe.depends)
    assert f"conf/table/{path.name}" in files
    if isinstance(recipe, CommandRecipe):
        settings = {f"conf/{one.command}.yaml" for one in recipe.commands.values()}
        assert {*files} >= settings | {f"conf/suite/{name}.yaml" for name in recipe.suites()}
        return
    assert {Path(name).stem for name in files} >= {*recipe.suites(), *recipe.tracers()}
    code = [name for name in files if name.startswith("tagjax/")]
    assert {Path(name).parts[1] for name in code} >= {"radio", "flow", "sim", "tracing", "tagattention", "metrics"}
    assert _follows_from(recipe)


def _follows_from(recipe: Recipe) -> dict[str, dict[str, Any]]:
    """What the scores of the first recording follow from, by job."""
    files = dependencies(ROOT, recipe.depends)
    tracers = {name: _tracer(name) for name in recipe.tracers()}
    inputs = Inputs(suites_named(recipe.suites()), tracers, ROOT, ROOT, files)
    return {
        job.name: measuring._tracing(recipe, inputs, job).determinants(
            from_mapping(Suite, inputs.suites[job.suite]).items()[0], files
        )
        for job in recipe.jobs()
    }


def test_tables_that_need_the_same_scores_share_them():
    """What one table has measured, the other takes from the folder of finished scores."""
    main, suites = (
        _follows_from(from_mapping(Recipe, _settings(ROOT / "conf" / "table" / f"{name}.yaml")))
        for name in ("main", "suites")
    )
    for suite in ("single_static", "multi_4", "walkers"):
        for system in ("learned", "published"):
            assert main[f"{suite}/test/whole/{system}"] == suites[f"{suite}/test/whole/{system}"]


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_every_page_shows_the_table_of_its_json(path: Path):
    recipe = recipe_from(_settings(path))
    assert differing(recipe, ROOT) == [], f"run `python -m experiments.reproduce table={path.stem} render=true`"


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_stale_tables_are_reported(path: Path):
    """A stale table is no failure: measuring takes long, and most changes of code change no value."""
    recipe = recipe_from(_settings(path))
    if reasons := status(recipe, ROOT):
        pytest.xfail(" ".join(reasons))


def test_no_json_is_without_a_recipe():
    made = {path.stem for path in (ROOT / "docs" / "tables").glob("*.json")}
    assert made <= {path.stem for path in RECIPES}


@pytest.mark.parametrize(
    ("words", "message"),
    [([], "expected table=<name>, one of .*main.*suites"), (["table=magic"], "(?s)'table/magic'.*main.*suites")],
)
def test_an_unknown_table_is_answered_with_those_there_are(words: list[str], message: str, tmp_path: Path):
    run = [sys.executable, "-m", "experiments.reproduce", *words, f"hydra.run.dir={tmp_path}"]
    done = subprocess.run(run, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert re.search(message, done.stderr), done.stderr
