"""Events handed to a file, to standard output and to a webhook: order, retries, a bounded queue, and no waiting."""

from __future__ import annotations

import http.server
import io
import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from composed import settings

from tagjax.core.settings import ConfigError
from tagjax.live.config import StreamConfig
from tagjax.live.event_log import EventLog, EventSettings
from tagjax.live.events import Sighting
from tagjax.live.outlet import DeliveryError, Outlet, OutletSettings
from tagjax.live.webhook import TOKEN, webhook

QUICK = OutletSettings(queue=5, attempts=3, first_delay_s=0.01, max_delay_s=0.02, timeout_s=2.0, close_s=2.0)


class Receiver:
    """An HTTP server that keeps what is posted to it, and answers with the given codes first."""

    def __init__(self) -> None:
        self.answers: list[int] = []
        self.hold = threading.Event()
        self.hold.set()
        self.posts: list[tuple[dict[str, str], str]] = []
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"])).decode()
                outer.hold.wait(5)
                code = outer.answers.pop(0) if outer.answers else 204
                outer.posts.append((dict(self.headers), body))
                self.send_response(code)
                if code == 302:
                    self.send_header("Location", "/elsewhere")
                self.send_header("Content-Length", "0")
                self.end_headers()

            do_GET = do_POST  # noqa: N815

            def log_message(self, format: str, *args: Any) -> None: ...

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self._server.server_port}/tags"
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def close(self) -> None:
        self.hold.set()
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    one = Receiver()
    yield one
    one.close()


def test_lines_are_delivered_in_order_and_counted():
    got: list[str] = []
    outlet = Outlet(got.append, OutletSettings(queue=100))
    for number in range(100):
        outlet.put(str(number))
    outlet.close()
    assert got == [str(number) for number in range(100)]
    assert outlet.summary() == {"delivered": 100, "dropped": 0, "retries": 0}
    outlet.put("late")
    assert outlet.summary()["dropped"] == 1


def test_a_slow_receiver_delays_nobody_and_the_oldest_lines_are_dropped():
    entered, release, got = threading.Event(), threading.Event(), []

    def slow(line: str) -> None:
        entered.set()
        release.wait(5)
        got.append(line)

    outlet = Outlet(slow, QUICK)
    outlet.put("0")
    assert entered.wait(2)
    begun = time.monotonic()
    for number in range(1, 1001):
        outlet.put(str(number))
    assert time.monotonic() - begun < 1.0
    release.set()
    outlet.close()
    assert got == ["0", "996", "997", "998", "999", "1000"]
    assert outlet.summary() == {"delivered": 6, "dropped": 995, "retries": 0}


def test_a_line_is_tried_again_and_given_up_at_last():
    tried: list[str] = []

    def fails(line: str) -> None:
        tried.append(line)
        if line == "never" or tried.count(line) < 3:
            raise DeliveryError("away", again=line != "refused")

    outlet = Outlet(fails, QUICK)
    for line in ("third", "never", "refused"):
        outlet.put(line)
    outlet.close()
    assert tried == ["third"] * 3 + ["never"] * 3 + ["refused"]
    assert outlet.summary() == {"delivered": 1, "dropped": 2, "retries": 4, "last_error": "away"}


def test_the_end_waits_for_a_bounded_time():
    blocked = threading.Event()
    outlet = Outlet(lambda line: blocked.wait(5) and None, OutletSettings(close_s=0.1))
    for _ in range(3):
        outlet.put("a")
    begun = time.monotonic()
    outlet.close()
    outlet.close()
    assert time.monotonic() - begun < 2.0
    blocked.set()
    time.sleep(0.05)
    assert outlet.summary() == {"delivered": 0, "dropped": 3, "retries": 0}


def test_a_webhook_gets_json_by_post(receiver, monkeypatch):
    monkeypatch.setenv(TOKEN, "secret")
    webhook(receiver.address, 2.0)('{"epc": "é"}')
    (headers, body) = receiver.posts[0]
    assert json.loads(body) == {"epc": "é"}
    assert headers["Content-Type"] == "application/json"
    assert headers["Authorization"] == "Bearer secret"


@pytest.mark.parametrize(("code", "again"), [(500, True), (503, True), (429, True), (404, False), (302, False)])
def test_which_answers_are_tried_again(receiver, code, again):
    receiver.answers = [code]
    with pytest.raises(DeliveryError, match=str(code)) as found:
        webhook(receiver.address, 2.0)("{}")
    assert found.value.again is again
    assert len(receiver.posts) == 1  # a redirection is not followed


def test_nobody_at_the_address_and_no_answer_in_time(receiver):
    receiver.hold.clear()
    for address in ("http://127.0.0.1:9/", receiver.address):
        with pytest.raises(DeliveryError) as found:
            webhook(address, 0.1)("{}")
        assert found.value.again
        assert address in str(found.value)


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("file:///etc/passwd", "expected http"),
        ("ftp://host/", "expected http"),
        ("host:80", "expected http"),
        ("http://", "expected http"),
        ("http://host:port/", "expected http"),
        ("http://user:word@host/", TOKEN),
    ],
)
def test_an_address_that_cannot_be_is_refused(address, text):
    with pytest.raises(ConfigError, match=text) as found:
        webhook(address, 1.0)
    assert "word@" not in str(found.value)


def test_a_log_numbers_events_and_hands_them_to_all(receiver):
    receiver.answers = [503]  # one failure is made good
    file, out = io.StringIO(), io.StringIO()
    rules = EventSettings(detected_s=0.1, lost_s=0.2, stdout=True, webhook=receiver.address, delivery=QUICK)
    log = EventLog(rules, file, stdout=out)
    seen = Sighting("detected", True, float("nan"), (0.0, 1.0, 2.0, 3.0), (0.0, 0.0, 1.0))
    for number in range(8):
        log.add(number * 10**8, {"A": seen if number < 4 else Sighting("occluded")})
    log.close()
    lines = [json.loads(line) for line in file.getvalue().splitlines()]
    assert [(line["number"], line["event"], line["status"]) for line in lines] == [(1, "detected", "detected"), (2, "lost", "occluded")]  # fmt: skip
    assert lines[0]["confidence"] is None  # NaN is no JSON
    assert out.getvalue() == file.getvalue()
    assert [json.loads(body) for _, body in receiver.posts] == [lines[0], *lines]
    summary = log.summary()
    assert (summary["detected"], summary["lost"], summary["alarm"]) == (1, 1, 0)
    assert summary["webhook"]["delivered"] == 2
    assert log.problems()[0].startswith("webhook: 0 events dropped; ")


def test_a_closed_standard_output_is_survived():
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError("nobody reads")

    log = EventLog(EventSettings(detected_s=0.0, stdout=True, delivery=QUICK), io.StringIO(), stdout=Closed())
    log.add(0, {"A": Sighting("detected", True, 0.9)})
    log.close()
    assert log.summary()["stdout"]["dropped"] == 1


def test_the_groups_of_the_command():
    assert settings(StreamConfig, "stream", "recording=a").events == EventSettings()
    chosen = settings(
        StreamConfig,
        "stream",
        "recording=a",
        "events=stdout",
        "events.webhook=http://127.0.0.1:9000/tags",
        "events.regions=[{name: exit, floor_m: [[-1,0],[1,0],[1,2],[-1,2]]}]",
    ).events
    assert chosen.stdout
    assert chosen.webhook == "http://127.0.0.1:9000/tags"
    assert chosen.regions[0].corners[2] == (1, 2)
