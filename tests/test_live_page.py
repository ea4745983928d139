"""The server of the live page: what it answers and to whom, and that no browser holds up tracing."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
import urllib.parse
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from live_views import HOSTILE, TAGS, overlay, view

from tagjax.core.settings import ConfigError
from tagjax.live.durations import ReadRates
from tagjax.live.page import LivePage, PageSettings


@pytest.fixture
def page() -> Iterator[LivePage]:
    one = LivePage(PageSettings(port=0, rate_hz=100.0), "a <b> stream")
    yield one
    one.close()


def ask(page: LivePage, path: str, **headers: str) -> tuple[http.client.HTTPResponse, bytes]:
    parts = urllib.parse.urlsplit(page.address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def taken_apart(body: bytes) -> tuple[dict, np.ndarray]:
    length = int.from_bytes(body[:4], "big")
    picture = cv2.imdecode(np.frombuffer(body[4 + length :], np.uint8), cv2.IMREAD_COLOR)
    return json.loads(body[4 : 4 + length]), picture[..., ::-1]


def test_the_page_escapes_its_title_and_may_load_nothing(page):
    answer, body = ask(page, "/")
    assert answer.status == 200
    assert b"a &lt;b&gt; stream" in body
    policy = answer.headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    assert answer.headers["X-Frame-Options"] == "DENY"
    assert b"http://" not in body
    assert b"https://" not in body


def test_a_frame_is_its_figures_and_its_picture(page):
    page.show(view(7))
    answer, body = ask(page, f"/frame?stream={page.stream}&after=6")
    assert answer.status == 200
    state, picture = taken_apart(body)
    assert state["number"] == 7
    assert [tag["epc"] for tag in state["tags"]] == sorted(TAGS)
    assert [tag["colour"] for tag in state["tags"]] == [1, 0, 2, 3]  # as in the picture
    assert [tag["reads_hz"] for tag in state["tags"]] == [61.0, 45.2, 0.0, 0.0]
    assert state["tags"][1]["distance_m"] == pytest.approx(np.sqrt(0.09 + 0.04 + 5.76), abs=0.01)
    assert state["tags"][2]["distance_m"] is None
    assert state["tags"][3]["text"].startswith("stationary")
    assert [event["kind"] for event in state["events"]] == ["alarm", "lost", "detected"]
    assert picture.shape == (480, 640, 3)


def test_the_picture_shows_detected_tags_in_their_colours():
    picture = cv2.imdecode(np.frombuffer(overlay().jpeg(640), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    plain = 50.0
    for (y, x), shade in (((250, 240), (230, 159, 0)), ((200, 480), (86, 180, 233))):
        np.testing.assert_allclose(picture[y - 20 : y + 20, x - 20 : x + 20].mean((0, 1)), 0.65 * plain + 0.35 * np.array(shade), atol=4)  # fmt: skip
    np.testing.assert_allclose(picture[420:470, 20:120].mean((0, 1)), plain, atol=2)  # no mask
    half = cv2.imdecode(np.frombuffer(overlay().jpeg(320), np.uint8), cv2.IMREAD_COLOR)
    assert half.shape == (480, 640, 3)  # half as large, and enlarged again for its letters


def test_a_smaller_picture_has_masks_and_boxes_at_the_same_places():
    scale = 500 / 640
    whole, smaller = (
        cv2.imdecode(np.frombuffer(overlay().jpeg(width), np.uint8), cv2.IMREAD_COLOR).astype(int)
        for width in (640, 500)
    )
    assert smaller.shape == (375, 500, 3)
    for picture, factor in ((whole, 1.0), (smaller, scale)):
        orange = picture[..., 2] - picture[..., 0] > 40  # of the first tag: its tint, outline and box
        columns = np.flatnonzero(orange[round(300 * factor)])
        rows = np.flatnonzero(orange[:, round(200 * factor)])
        # The edges of the box, 160 to 319 and 120 to 399, and of its line, two pixels wide.
        np.testing.assert_allclose(columns[[0, -1]], [160 * factor, 319.5 * factor], atol=2.1)
        np.testing.assert_allclose(rows[-1], 399.5 * factor, atol=2.1)


def test_before_the_first_frame_the_answer_says_so(page, monkeypatch):
    monkeypatch.setattr("tagjax.live.page.server._WAIT_S", 0.05)
    answer, _ = ask(page, "/frame")
    assert (answer.status, answer.headers["Tagjax-State"]) == (204, "starting")
    page.show(view(1))
    answer, _ = ask(page, "/frame")
    assert (answer.status, answer.headers["Tagjax-State"]) == (200, None)


def test_figures_that_are_not_finite_are_null(page):
    page.show(view(1))
    assert taken_apart(ask(page, "/frame")[1])[0]["latency_ms"] is None


def test_a_browser_waits_for_a_later_frame_and_gets_the_newest(page):
    page.show(view(1))
    found = []
    waiting = threading.Thread(target=lambda: found.append(ask(page, f"/frame?stream={page.stream}&after=1")))
    waiting.start()
    time.sleep(0.2)
    assert not found
    page.show(view(2))
    waiting.join(10)
    assert taken_apart(found[0][1])[0]["number"] == 2
    page.show(view(3))
    page.show(view(4))
    assert taken_apart(ask(page, f"/frame?stream={page.stream}&after=2")[1])[0]["number"] == 4


def test_another_stream_counts_anew(page):
    page.show(view(1))
    for query in ("after=900", f"stream={'0' * 16}&after=900", f"stream={page.stream}&after=x", ""):
        assert ask(page, f"/frame?{query}")[0].status == 200


def test_frames_are_due_only_while_somebody_asks():
    page = LivePage(PageSettings(port=0, rate_hz=1.0), "slow")
    assert not page.due()  # nobody asks
    page.show(view(1))
    time.sleep(1.1)
    assert not page.due()
    ask(page, "/frame")
    assert page.due()
    page.show(view(2))
    assert not page.due()  # a second has to pass
    page.close()


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1", 404),
        ("localhost:8080", 404),
        ("[::1]:8080", 404),
        ("evil.example", 403),
        ("127.0.0.1.evil.example", 403),
        ("192.168.0.7", 403),
        ("[", 403),
    ],
)
def test_only_this_machine_is_answered(page, host, status):
    assert ask(page, "/other", Host=host)[0].status == status


def test_other_methods_and_broken_requests_are_refused(page):
    parts = urllib.parse.urlsplit(page.address)
    for request in (b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n", b"NONSENSE / HTTP/1.1\r\nHost: localhost\r\n\r\n"):
        with socket.create_connection((parts.hostname, parts.port), timeout=5) as client:
            client.sendall(request)
            assert client.recv(100).split()[1][:1] in (b"4", b"5")


def test_browsers_that_take_nothing_hold_up_nobody(page):
    parts = urllib.parse.urlsplit(page.address)
    page.show(view(1))
    lazy = []
    for _ in range(20):
        client = socket.create_connection((parts.hostname, parts.port), timeout=5)
        client.sendall(b"GET /frame HTTP/1.1\r\nHost: localhost\r\n\r\n" * 50)  # and reads no answer
        lazy.append(client)
    slowest = 0.0
    try:
        for number in range(2, 200):
            begun = time.monotonic()
            page.due()
            page.show(view(number, num_tags=1))
            slowest = max(slowest, time.monotonic() - begun)
        # Such a browser is given up after 15 s: what waits for it takes as long, what does not only waits for the processor.
        assert slowest < 5.0
        assert ask(page, "/")[0].status == 200  # there is room for another
    finally:
        for client in lazy:
            client.close()


def test_the_number_of_connections_is_bounded(page):
    parts = urllib.parse.urlsplit(page.address)
    clients = [socket.create_connection((parts.hostname, parts.port), timeout=5) for _ in range(30)]
    answers = []
    for client in clients[-6:]:
        client.settimeout(5)
        answers.append(client.recv(20))
    assert all(answer.startswith(b"HTTP/1.1 503") for answer in answers)
    for client in clients:
        client.close()


def test_the_end_of_the_stream_is_told_apart_from_a_failure(page):
    found = []
    waiting = threading.Thread(target=lambda: found.append(ask(page, "/frame")[0].status))
    waiting.start()
    time.sleep(0.2)
    page.close()
    waiting.join(10)
    assert found == [410]
    page.close = lambda: None  # the fixture's


def test_a_port_in_use_is_named():
    taken = socket.socket()
    taken.bind(("127.0.0.1", 0))
    taken.listen()
    with pytest.raises(ConfigError, match=r"page\.port.*Choose another port"):
        LivePage(PageSettings(port=taken.getsockname()[1]), "another")
    taken.close()


@pytest.mark.parametrize("wrong", [{"port": -1}, {"port": 70000}, {"rate_hz": 0.0}, {"width": 10}])
def test_a_page_that_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match="expected"):
        PageSettings(**wrong)


def test_read_rates_are_those_of_the_last_three_seconds():
    rates = ReadRates()
    assert rates.rates_hz() == {}
    for number in range(100):  # ten frames a second
        epcs = ["A"] * 4 + (["B"] * 2 if number < 50 else [])
        rates.add(number * 100_000_000, np.array(epcs))
    assert rates.rates_hz() == {"A": pytest.approx(40.0)}
    assert HOSTILE not in rates.rates_hz()
