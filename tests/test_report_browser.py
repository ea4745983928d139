"""The page of a report in a real headless Chromium: it shows everything, plays, follows the keyboard and fits phones."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from report_runs import NUM_FRAMES

from tagjax.report.page import PAGE, write_page

_PATIENCE_S = 30.0
"""How long a condition of the page may take to come true: the machine may be busy."""


@pytest.fixture(scope="module")
def address(finished_run: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_page(finished_run, tmp_path_factory.mktemp("page") / PAGE).as_uri()


@pytest.fixture
def problems() -> list[str]:
    return []


def _open(browser: Any, address: str, problems: list[str], **options: Any) -> Any:
    page = browser.new_page(**options)
    page.on("console", lambda message: problems.append(message.text))
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("request", lambda request: problems.append(request.url) if request.url.startswith("http") else None)
    page.goto(address)
    _until(page, "[...document.querySelectorAll('video')].every(one => one.readyState >= 2)")
    return page


def _until(page: Any, condition: str) -> None:
    """Wait for a condition. (The driver's own way to wait needs `eval`, which the page forbids.)"""
    deadline = time.monotonic() + _PATIENCE_S
    while not page.evaluate(condition):
        if time.monotonic() > deadline:
            pytest.fail(f"not within {_PATIENCE_S:g} s: {condition}")
        page.wait_for_timeout(50)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1400])
def test_the_page_fits_and_reports_no_error(
    browser: Any, address: str, problems: list[str], width: int, scheme: str, tmp_path: Path
) -> None:
    page = _open(browser, address, problems, viewport={"width": width, "height": 800}, color_scheme=scheme)
    for part in page.locator("details").all():
        part.evaluate("one => one.open = true")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    _until(page, "[...document.images].every(one => one.complete)")
    assert page.evaluate("[...document.images].every(one => one.naturalWidth > 0)")
    for name in ("result", "worst", "recordings", "curves", "budget", "table", "made"):
        assert page.locator(f"#{name} h2").is_visible()
    for name in (".timeline .bar", ".chart", ".slider input", ".cards img", ".stages img", "video", "pre"):
        assert page.locator(name).first.is_visible(), name
    scores = page.locator("#table thead th", has_text="box IoU").bounding_box()
    assert scores is not None
    assert scores["x"] + scores["width"] <= width, "the scores are seen without scrolling sideways"
    paper, ink = (page.evaluate(f"getComputedStyle(document.body).{name}") for name in ("backgroundColor", "color"))
    assert _brightness(paper) > 200 > 100 > _brightness(ink) if scheme == "light" else _brightness(paper) < 50 < 150 < _brightness(ink)  # fmt: skip
    page.screenshot(path=tmp_path / "page.png", full_page=True)
    assert (tmp_path / "page.png").stat().st_size > 20_000
    assert problems == []
    page.close()


def _brightness(colour: str) -> float:
    return sum(float(one) for one in colour.removeprefix("rgb(").rstrip(")").split(",")) / 3


def test_the_video_plays_and_the_slider_follows(browser: Any, address: str, problems: list[str]) -> None:
    page = _open(browser, address, problems)
    part = page.locator(".recording").first
    page.evaluate("document.querySelector('.recording video').playbackRate = 0.25")  # not at its end before the pause
    part.get_by_role("button", name="Play").click()
    _until(page, "document.querySelector('.recording video').currentTime > 0.5")
    part.get_by_role("button", name="Pause").click()
    part.get_by_role(
        "button", name="Play"
    ).wait_for()  # the page has taken note of the pause, after which nothing moves
    shown = int(part.locator(".slider input").input_value())
    played = float(page.evaluate("document.querySelector('.recording video').currentTime"))
    assert 0.5 < played < NUM_FRAMES / 10.0 - 0.05
    assert shown == pytest.approx(played * 10.0, abs=1.5)  # 10 frames a second
    assert problems == []
    page.close()


def test_the_keyboard_moves_video_timeline_and_charts_to_a_frame(
    browser: Any, address: str, problems: list[str]
) -> None:
    page = _open(browser, address, problems)
    part = page.locator(".recording").first
    slider = part.locator(".slider input")
    slider.focus()
    page.keyboard.press("End")
    assert part.locator("output").inner_text().startswith(f"frame {NUM_FRAMES - 1},")
    page.keyboard.press("Home")
    for _ in range(6):
        page.keyboard.press("ArrowRight")
    part.get_by_role("button", name="previous frame").press("Enter")
    assert part.locator("output").inner_text() == "frame 5, 0.50 s"
    _until(page, "Math.abs(document.querySelector('.recording video').currentTime - 0.55) < 0.06")
    assert part.locator(".bar .cursor").first.evaluate("one => one.style.left") == f"{100 * 5.5 / NUM_FRAMES:.4f}%"
    assert problems == []
    page.close()


def test_a_worst_case_opens_its_recording_at_its_frame(browser: Any, address: str, problems: list[str]) -> None:
    page = _open(browser, address, problems)
    button = page.locator(".go").first
    name, frame = button.get_attribute("data-recording"), button.get_attribute("data-frame")
    page.locator("details.recording").evaluate_all("all => all.forEach(one => one.open = false)")
    button.focus()
    page.keyboard.press("Enter")
    part = page.locator(f".recording[data-recording='{name}']")
    assert part.get_attribute("open") is not None
    assert part.locator("output").inner_text().startswith(f"frame {frame},")
    assert problems == []
    page.close()


def test_another_tracer_is_shown_at_the_same_frame(browser: Any, address: str, problems: list[str]) -> None:
    page = _open(browser, address, problems)
    part = page.locator(".recording").first
    part.locator(".slider input").focus()
    page.keyboard.press("End")
    part.get_by_label("blunt").check()
    views = part.locator(".view")
    assert [views.nth(number).is_visible() for number in range(2)] == [False, True]
    assert part.locator("output").inner_text().startswith(f"frame {NUM_FRAMES - 1},")
    assert problems == []
    page.close()
