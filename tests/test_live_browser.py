"""The live page in a real headless Chromium: it shows a stream, fits phones, and knows when the stream stops or ends."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from live_views import HOSTILE, TAGS, view

from tagjax.live.page import LivePage, PageSettings


class Stream:
    """A stream of made-up frames, 30 a second, until it pauses or ends."""

    def __init__(self) -> None:
        self.page = LivePage(PageSettings(port=0), "walkers <0>")
        self.running, self.num_tags, self.number = True, 4, 0
        self.notes: tuple[str, ...] = ()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        if not self._ended.is_set():
            self._ended.set()
            self._thread.join()
            self.page.close()

    def _run(self) -> None:
        while not self._ended.wait(1 / 30):
            self.number += self.running
            if self.running and self.page.due():
                self.page.show(view(self.number, num_tags=self.num_tags, notes=self.notes))


@pytest.fixture
def stream() -> Iterator[Stream]:
    one = Stream()
    yield one
    one.close()


def _open(browser: Any, stream: Stream, problems: list[str], **options: Any) -> Any:
    page = browser.new_page(**options)
    page.on("console", lambda message: problems.append(message.text))
    page.on("pageerror", lambda error: problems.append(str(error)))
    own = stream.page.address
    page.on("request", lambda request: None if request.url.startswith((own, "data:")) else problems.append(request.url))
    page.goto(own)
    _until(page, "Number(document.querySelector('canvas').dataset.frame) > 0")
    return page


def _until(page: Any, condition: str, seconds: float = 20.0) -> None:
    """Wait for a condition. (The driver's own way to wait needs `eval`, which the page forbids.)"""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"not within {seconds:g} s: {condition}")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1400])
def test_the_page_shows_the_stream_and_fits(
    browser: Any, stream: Stream, width: int, scheme: str, tmp_path: Path
) -> None:
    problems: list[str] = []
    stream.notes = ("webhook: 3 events dropped; http://127.0.0.1:9000/ answers 503",)
    page = _open(browser, stream, problems, viewport={"width": width, "height": 800}, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    rows = page.locator("#tags tr")
    assert [row.locator("th").inner_text() for row in rows.all()] == sorted(TAGS)
    first = rows.nth(1).inner_text()
    assert all(text in first for text in ("detected", "0.93", "2.43 m", "45"))
    assert "not read: few reads of late, or none" in rows.nth(2).inner_text()
    assert page.locator("h1").inner_text() == "walkers <0>"
    assert page.locator("#state").inner_text().startswith("live, ")
    assert page.locator("#dropped").inner_text() == "3"
    assert page.locator("#rate").inner_text() == "30.0"
    assert page.locator("#notes li").inner_text() == stream.notes[0]
    events = page.locator("#events li")
    assert events.nth(0).inner_text().split() == ["4.5", "s", "▲", next(iter(TAGS)), "alarm:", "in", "exit", "<b>"]
    assert "(occluded: its body is out of view)" in events.nth(1).inner_text()
    assert page.title() == "(▲ 1) walkers <0>"  # data is no markup: neither has the hostile EPC set the title
    assert page.locator("img").count() == 0
    assert HOSTILE in page.locator("#tags").inner_text()
    middle = page.evaluate("[...document.querySelector('canvas').getContext('2d').getImageData(240, 250, 1, 1).data]")
    assert middle[0] > middle[1] > middle[2]  # the first tag's orange tint
    paper, ink = (page.evaluate(f"getComputedStyle(document.body).{name}") for name in ("backgroundColor", "color"))
    assert _brightness(paper) > 200 > 100 > _brightness(ink) if scheme == "light" else _brightness(paper) < 50 < 150 < _brightness(ink)  # fmt: skip
    page.screenshot(path=tmp_path / f"live-{width}-{scheme}.png", full_page=True)
    assert problems == []
    page.close()


def _brightness(colour: str) -> float:
    return sum(float(one) for one in colour.removeprefix("rgb(").rstrip(")").split(",")) / 3


def test_frames_follow_each_other_and_tags_come_and_go(browser: Any, stream: Stream) -> None:
    problems: list[str] = []
    page = _open(browser, stream, problems, viewport={"width": 800, "height": 800})
    first = int(page.evaluate("document.querySelector('canvas').dataset.frame"))
    _until(page, f"Number(document.querySelector('canvas').dataset.frame) > {first + 10}")
    stream.num_tags = 1
    _until(page, "document.querySelectorAll('#tags tr').length === 1")
    stream.num_tags = 3
    _until(page, "document.querySelectorAll('#tags tr').length === 3")
    assert problems == []
    page.close()


def test_a_stream_that_stops_and_one_that_ends_are_told_apart(browser: Any, stream: Stream) -> None:
    problems: list[str] = []
    page = _open(browser, stream, problems)
    stream.running = False
    _until(page, "document.getElementById('state').textContent === 'no new frame'")
    stream.running = True
    _until(page, "document.getElementById('state').textContent.startsWith('live')")
    assert problems == []
    stream.close()
    _until(page, "document.getElementById('state').textContent === 'the stream has ended'")
    assert all("410" in text or "ERR_CONNECTION_REFUSED" in text for text in problems)
    page.close()
