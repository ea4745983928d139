"""The page of a report: made from the run folder's files, self-contained, escaped; states, losses and worst cases."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import synthetic_clips as synthetic
from report_runs import NUM_FRAMES, report_run

from tagjax.core.names import short_name
from tagjax.metrics.recordings import ScoreSettings, evaluate_recording
from tagjax.report.page import PAGE, pictures, write_page
from tagjax.report.page.contents import read_contents
from tagjax.report.page.html import element
from tagjax.report.page.sections import readable_top
from tagjax.report.page.states import (
    DETECTED,
    IDENTIFIED,
    LOST,
    NOT_READ,
    OCCLUDED,
    STATES,
    WRONG,
    TagFrames,
    longest_run,
    lost_iou,
    runs,
    worst_cases,
)
from tagjax.report.stages import MOST_NATS, STAGES, log_odds, stage_picture, write_stages
from tagjax.report.video import VIDEO, read_video, smaller_video, video_writer

ROOT = Path(__file__).parents[1]
HOSTILE = """</title><script>alert(1)</script><img src=x onerror="alert(2)">'&"""


class Parsed(HTMLParser):
    """The elements of a page with their attributes, and its text."""

    def __init__(self, page: str):
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def named(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.elements if tag == name]


@pytest.fixture
def copy(finished_run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(finished_run, tmp_path / "run")


def test_the_page_has_all_parts_and_needs_nothing_else(copy: Path) -> None:
    page = write_page(copy)
    assert page == copy / PAGE
    parsed = Parsed(page.read_text())
    sections = [one["id"] for one in parsed.named("section")]
    assert sections == ["result", "worst", "recordings", "curves", "budget", "table", "made"]
    assert [one["data-recording"] for one in parsed.named("details") if "data-recording" in one] == read_contents(
        copy
    ).recordings()
    assert len(parsed.named("video")) == 4
    assert all((one["src"] or "").startswith("data:video/webm;base64,") for one in parsed.named("video"))
    pictures_there = parsed.named("img")
    assert len(pictures_there) >= 4 * 7  # stages of two recordings and tracers
    assert all((one["src"] or "").startswith("data:image/jpeg;base64,") for one in pictures_there)
    assert all(one["alt"] for one in pictures_there)
    assert not parsed.named("iframe") + [one for one in parsed.named("link") if one["href"] != "data:,"]
    assert "python -m experiments.evaluate tracer=small" in parsed.text
    assert "tracer: small" in parsed.text
    assert page.stat().st_size < 6_000_000


def test_soft_masks_are_shown_as_log_odds_and_beside_binary_ones_the_attention(tmp_path: Path) -> None:
    scene = synthetic.recording(NUM_FRAMES)
    settings = ScoreSettings(num_pictures=3)
    result = evaluate_recording(synthetic.SmallTracer(), scene, synthetic.load, stride=1, settings=settings)
    picture = stage_picture(result.pictures, synthetic.WINDOW - 1)
    assert picture is not None
    assert picture.soft_masks is not None
    clip = synthetic.load(scene, picture.frame - synthetic.WINDOW + 1, picture.frame + 1, epcs=picture.epcs)

    def stages(soft_masks: np.ndarray | None) -> list[str]:
        shown = dataclasses.replace(picture, soft_masks=soft_masks)
        write_stages(tmp_path, scene, shown, clip.camera, clip.frames)
        written = json.loads((tmp_path / STAGES).read_text())["stages"]
        explained = [one["text"] for one in written if "nats" in one["text"]]
        assert len(explained) == (1 if soft_masks is picture.soft_masks else 0), "the first picture explains all"
        return [one["title"] for one in written]

    names = [short_name(epc) for epc in picture.epcs]
    shared = ["colour", "depth", "optical flow", "change of distance to the antenna"]
    assert stages(picture.soft_masks) == [*shared, *(f"log odds of {name}" for name in names), "masks"]
    for binary in (np.round(picture.soft_masks), None):
        assert stages(binary) == [*shared, *(f"attention of {name}" for name in names), "masks"]
    found = log_odds(np.array([[0.0, 0.5, 1.0, 1e-9, 1.0 / (1.0 + np.exp(-2.0))]]))
    np.testing.assert_allclose(found, [[np.nan, 0.0, MOST_NATS, -MOST_NATS, 2.0]], atol=1e-9)


def test_short_names_of_different_tags_differ() -> None:
    assert short_name("E28011000000000000000001") == "..000001"
    assert short_name("label1-seed0") == "label1-seed0"


def test_the_page_is_made_again_from_the_files_alone(copy: Path) -> None:
    first = write_page(copy).read_bytes()
    second = write_page(copy, copy.parent / "other" / "page.html").read_bytes()
    assert first == second


def test_data_never_becomes_markup(copy: Path) -> None:
    frames = (copy / "frames.csv").read_text()
    (copy / "frames.csv").unlink()
    rows = list(csv.DictReader(frames.splitlines()))
    renamed = {"scene0": HOSTILE, "tag-a": HOSTILE, "learned": HOSTILE}
    with (copy / "frames.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows({key: renamed.get(value, value) for key, value in row.items()} for row in rows)

    def hostile(content: object) -> object:
        if isinstance(content, dict):
            return {renamed.get(key, key): hostile(value) for key, value in content.items()}
        return content

    metrics = copy / "metrics.json"
    metrics.write_text(json.dumps(hostile(json.loads(metrics.read_text()))))
    (copy / "config.yaml").write_text(f"name: {HOSTILE}\n")
    (copy / "run.json").write_text(json.dumps({"command": HOSTILE, "versions": {HOSTILE: HOSTILE}}))
    (copy / "parameters.json").write_text(json.dumps({HOSTILE: {HOSTILE: 1.0}}))
    parsed = Parsed(write_page(copy).read_text())
    assert len(parsed.named("script")) == 1
    assert not [one for _, one in parsed.elements if any(name.startswith("on") for name in one)]
    assert all((one["src"] or "").startswith("data:image/jpeg") for one in parsed.named("img"))
    assert parsed.text.count(HOSTILE) >= 8
    assert any(one.get("data-recording") == HOSTILE for one in parsed.named("details"))


def test_without_truth_there_are_detections_and_videos(tmp_path: Path) -> None:
    run = report_run(tmp_path, num_scenes=1, truth=False)
    with (run / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * NUM_FRAMES
    assert {row["label"] for row in rows} == {"0"}
    assert {row["iou"] for row in rows} == {"nan"}
    parsed = Parsed(write_page(run).read_text())
    assert "no scores" in parsed.text
    assert "no truth" in parsed.text
    assert len(parsed.named("video")) == 2
    assert [one["id"] for one in parsed.named("section")] == ["result", "worst", "recordings", "table", "made"]
    assert DETECTED.meaning in parsed.text


def test_videos_that_a_page_cannot_hold_lie_beside_it(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    contents = read_contents(copy)
    first, tracer = contents.recordings()[0], contents.tracers[0]
    video = contents.video(first, tracer)
    assert video is not None
    size = video.stat().st_size
    monkeypatch.setattr(pictures, "VIDEO_BYTES", size // 2)
    monkeypatch.setattr(pictures, "_SMALLEST", size)
    sources = [one["src"] or "" for one in Parsed(write_page(copy).read_text()).named("video")]
    embedded = [one for one in sources if one.startswith("data:")]
    assert len(embedded) == 1  # the first, made smaller
    assert len(embedded[0]) < 0.75 * size
    assert len(sources) == 4
    assert all((copy / one).is_file() for one in sources if not one.startswith("data:"))


def test_a_video_is_read_back_frame_by_frame_and_made_smaller(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (48, 64, 3), np.uint8).repeat(4, axis=0).repeat(4, axis=1)
    with video_writer(tmp_path / VIDEO, 10.0) as write:
        for number in range(12):
            image = np.roll(noise, 16 * number, axis=1)
            image[:40, :40] = (20 * number, 0, 255 - 20 * number)
            write(image)
    found = [image[20, 20].astype(int) for image in read_video(tmp_path / VIDEO)]
    assert len(found) == 12
    np.testing.assert_allclose([one[0] for one in found], 20 * np.arange(12), atol=12)
    size = (tmp_path / VIDEO).stat().st_size
    content = smaller_video(tmp_path / VIDEO, size // 2)
    assert len(content) <= size // 2
    (tmp_path / "small.webm").write_bytes(content)
    assert len(list(read_video(tmp_path / "small.webm"))) == 12
    assert smaller_video(tmp_path / VIDEO, size) == (tmp_path / VIDEO).read_bytes()
    assert capfd.readouterr().err == ""
    (tmp_path / "broken.webm").write_bytes(b"no video")
    with pytest.raises(ValueError, match="found no video"):
        list(read_video(tmp_path / "broken.webm"))


def test_an_interrupted_video_leaves_no_file(tmp_path: Path) -> None:
    def interrupted() -> None:
        with video_writer(tmp_path / "a" / VIDEO, 10.0) as write:
            write(np.zeros((32, 32, 3), np.uint8))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list((tmp_path / "a").iterdir()) == []


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("frames.csv", None, "found no metrics.json and frames.csv"),
        ("metrics.json", "{", "expected JSON"),
        ("metrics.json", "{}", "expected the scores of each tracer"),
        ("metrics.json", '{"other": {"all": {}, "recordings": {}}}', "expected other"),
        ("frames.csv", "tracer,recording\n", "found no column"),
        ("frames.csv", "cut", "Evaluate again"),
        ("run.json", "[]", "expected a JSON object"),
    ],
)
def test_damaged_runs_are_refused_with_the_file_and_the_reason(
    copy: Path, name: str, content: str | None, message: str
) -> None:
    (copy / PAGE).unlink(missing_ok=True)
    if content is None:
        (copy / name).unlink()
    else:
        (copy / name).write_text((copy / name).read_text()[:-40] if content == "cut" else content)
    with pytest.raises(ValueError, match=message):
        write_page(copy)
    assert not (copy / PAGE).exists()


def test_the_command_makes_the_page_and_prints_its_path(copy: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "experiments.report", f"hydra.run.dir={tmp_path / 'own'}"]
    done = subprocess.run([*command, f"run={copy}"], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == str(copy / PAGE)
    assert (copy / PAGE).is_file()
    missing = subprocess.run([*command, f"run={tmp_path / 'gone'}"], capture_output=True, text=True, cwd=ROOT)
    assert missing.returncode == 1
    assert "found no such folder" in missing.stderr
    assert not (tmp_path / "gone").exists()


def _tag(states: str, iou: list[float], *, label: int = 1, epc: str = "tag") -> TagFrames:
    """A tag with a letter a frame: i identified, w wrong, o occluded, n not read, l lost; all frames count."""
    detected = np.array([one in "iw" for one in states])
    words = {"o": "occluded", "n": "not_read", "l": "unknown"}
    return TagFrames(
        epc=epc,
        label=label,
        frame=np.arange(10, 10 + len(states)),
        time_s=np.arange(len(states)) / 10,
        detected=detected,
        status=tuple(words.get(one, "detected") for one in states),
        identified=np.array([label if one == "i" else 7 for one in states]),
        valid=np.full(len(states), label > 0),
        iou=np.where(detected, iou, 0.0),
        cle_px=np.where(detected, 1.0, np.nan),
        confidence=detected.astype(float),
    )


def test_states_and_losses_of_a_tag_by_hand() -> None:
    tag = _tag("iiwonl", [0.9, 0.5, 0.1, 0, 0, 0])
    assert [STATES[one] for one in tag.states()] == [IDENTIFIED, IDENTIFIED, WRONG, OCCLUDED, NOT_READ, LOST]
    lost = lost_iou([tag])
    assert lost[IDENTIFIED] == pytest.approx((0.1 + 0.5) / 6)
    assert lost[WRONG] == pytest.approx(0.9 / 6)
    assert lost[OCCLUDED] == lost[NOT_READ] == lost[LOST] == pytest.approx(1 / 6)
    assert sum(lost.values()) + np.mean(tag.iou) == pytest.approx(1.0)
    assert lost_iou([_tag("iw", [1, 1], label=0)]) == {}
    assert [STATES[one] for one in _tag("iwn", [1, 1, 0], label=0).states()] == [DETECTED, DETECTED, NOT_READ]


def test_every_state_differs_by_its_height_or_by_what_it_needs() -> None:
    """Colours alone do not tell states apart; detected and identified never occur for one tag."""
    heights = [state.height for state in STATES if state != DETECTED]
    assert len(set(heights)) == len(heights)


def test_the_worst_tag_comes_first_with_the_middle_of_its_longest_failure() -> None:
    good, bad = _tag("iiii", [0.9] * 4, epc="good"), _tag("wiooowi", [0.1, 0.8, 0, 0, 0, 0, 0.9], epc="bad")
    middling, blind = _tag("iiw", [0.9, 0.8, 0.0], epc="middling"), _tag("wwwl", [1] * 4, label=0, epc="blind")
    found = worst_cases([("a", [good, bad]), ("b", [middling, blind])], 5)
    assert [case.tag.epc for case in found] == ["bad", "middling", "blind"]
    assert (found[0].recording, found[0].failed, found[0].frame) == ("a", (12, 15), 13)
    assert found[2].score == pytest.approx(0.75)
    assert len(worst_cases([("a", [good, bad]), ("b", [middling])], 1)) == 1


def test_a_few_large_errors_do_not_flatten_a_chart() -> None:
    small = np.linspace(0.0, 5.0, 30)
    assert readable_top(small) == (None, False)
    assert readable_top(np.array([*small, 350.0, np.nan])) == (10.0, True)
    assert readable_top(np.array([*small, *(30.0 * small)])) == (None, False)  # no exception: many are large
    assert readable_top(np.full(3, np.nan)) == (None, False)


def test_runs_of_values() -> None:
    assert runs(np.array([3, 3, 1, 1, 1, 3])) == [(0, 2, 3), (2, 3, 1), (5, 1, 3)]
    assert runs(np.array([], int)) == []
    assert longest_run(np.array([True, False, True, True])) == (2, 3)
    assert longest_run(np.zeros(3, bool)) == (0, -1)


def test_elements_escape_what_is_no_element() -> None:
    made = element("p", "a < b", element("b", "&"), None, class_="x", aria_label='"', hidden=True, id=None)
    assert made == '<p class="x" aria-label="&quot;" hidden>a &lt; b<b>&amp;</b></p>'
