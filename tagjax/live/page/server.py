"""The web server of the live page, in threads of its own: a browser asks for the next frame, and there is no queue at all.

A browser that is slow asks less often, and gets the newest frame then. Tracing only ever leaves the newest frame for it. By
default the server is reached from this machine alone, and it answers only requests that name this machine: no other web page
can read it through the browser.
"""

from __future__ import annotations

import contextlib
import dataclasses
import http.server
import ipaddress
import secrets
import socket
import threading
import time
import urllib.parse
from http import HTTPStatus
from typing import Any

from ...core.settings import ConfigError
from ..view import View
from .html import content_security_policy, page_html

_MAX_CONNECTIONS = 24
_WATCHED_S = 3.0  # after a browser's last request
_WAIT_S = 5.0  # for a frame, until a request is answered without one
_TIMEOUT_S = 15.0  # of a browser that takes nothing


@dataclasses.dataclass(frozen=True, kw_only=True)
class PageSettings:
    """The web page. Raises `ValueError` for a port, rate or width that cannot be."""

    port: int | None = None  # None: no page; 0: any that is free
    address: str = "127.0.0.1"  # of this machine; with another than loopback everybody in the network sees the page
    rate_hz: float = 15.0  # pictures at most
    width: int = 640  # of the picture at most, pixels

    def __post_init__(self) -> None:
        if self.port is not None and not 0 <= self.port < 65536:
            raise ValueError(f"port is {self.port}; expected 0 to 65535, or null.")
        if not 0 < self.rate_hz <= 240 or self.width < 64:
            raise ValueError(
                f"rate_hz is {self.rate_hz} and width {self.width}; expected 0 to 240, and at least 64 px."
            )


class LivePage:
    """Serves the page until `close`. Raises `ConfigError` where the port cannot be had.

    `due` says whether somebody wants a frame now; only then `show` needs to be called. Neither waits for a browser.
    """

    def __init__(self, settings: PageSettings, title: str):
        self.stream = secrets.token_hex(8)  # of the page: another stream at this port counts its frames anew
        self._interval_s = 1 / settings.rate_hz
        self._changed, self._ended = threading.Condition(), False
        self._view: View | None = None
        self._asked_s = self._shown_s = -float("inf")
        self.html = page_html(title).encode()
        try:
            self._server = _Server((settings.address, settings.port or 0), self)
        except OSError as error:
            raise ConfigError(
                f"page.port: {settings.address}:{settings.port} cannot be used: {error.strerror or error}. Choose another port."
            ) from error
        self.address = f"http://{_in_address(settings.address)}:{self._server.server_port}/"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="page", daemon=True)
        self._thread.start()

    def due(self) -> bool:
        """Whether a browser waits for a frame, and the last one was shown long enough ago."""
        now = time.monotonic()
        return now - self._asked_s < _WATCHED_S and now - self._shown_s >= self._interval_s

    @property
    def begun(self) -> bool:
        """Whether there has been a frame."""
        return self._view is not None

    def show(self, view: View) -> None:
        """Take the newest frame; the last one is forgotten."""
        with self._changed:
            self._view, self._shown_s = view, time.monotonic()
            self._changed.notify_all()

    def close(self) -> None:
        """Let every browser know that the stream has ended, and serve no more."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def next_view(self, after: int) -> tuple[View | None, bool]:
        """The newest frame, once it is later than frame `after`, or None after a while; and whether the stream has ended."""
        self._asked_s = time.monotonic()
        with self._changed:
            self._changed.wait_for(
                lambda: self._ended or (self._view is not None and self._view.number > after), _WAIT_S
            )
            self._asked_s = time.monotonic()
            view = self._view
            return (view if view is not None and view.number > after else None), self._ended


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False  # a browser that takes nothing holds up nobody

    def __init__(self, place: tuple[str, int], page: LivePage):
        loopback = ipaddress.ip_address(place[0])
        if loopback.version == 6:
            self.address_family = socket.AF_INET6
        self.page, self.only_loopback = page, loopback.is_loopback
        self._free = threading.BoundedSemaphore(_MAX_CONNECTIONS)
        super().__init__(place, _Handler)

    def server_bind(self) -> None:
        # Without the look-up of the machine's name, which may take seconds.
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._free.acquire(blocking=False):
            request.settimeout(0.1)
            with contextlib.suppress(OSError):
                request.sendall(b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that went away, or takes nothing, is no error."""


class _Handler(http.server.BaseHTTPRequestHandler):
    server: _Server  # pyright: ignore[reportIncompatibleVariableOverride]
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "tagjax", ""
    timeout = _TIMEOUT_S

    def do_GET(self) -> None:
        """The page, or the next frame."""
        asked = urllib.parse.urlsplit(self.path)
        if self.server.only_loopback and not _names_loopback(self.headers.get("Host", "")):
            self._answer(HTTPStatus.FORBIDDEN, b"This page is served to this machine alone.", "text/plain")
        elif asked.path == "/":
            self._answer(HTTPStatus.OK, self.server.page.html, "text/html; charset=utf-8")
        elif asked.path == "/frame":
            self._frame(dict(urllib.parse.parse_qsl(asked.query)))
        else:
            self._answer(HTTPStatus.NOT_FOUND, b"Not found.", "text/plain")

    def _frame(self, asked: dict[str, str]) -> None:
        page, after = self.server.page, asked.get("after", "")
        same = asked.get("stream") == page.stream and after.isascii() and after.isdigit() and len(after) < 16
        view, ended = page.next_view(int(after) if same else 0)
        if view is not None:
            self._answer(HTTPStatus.OK, view.body(), "application/octet-stream")
        else:
            self.close_connection = ended
            self._answer(HTTPStatus.GONE if ended else HTTPStatus.NO_CONTENT, b"", None)

    def _answer(self, status: HTTPStatus, body: bytes, kind: str | None) -> None:
        self.send_response(status)
        if kind is not None:
            self.send_header("Content-Type", kind)
        if status != HTTPStatus.NO_CONTENT:
            self.send_header("Content-Length", str(len(body)))
        self.send_header("Tagjax-Stream", self.server.page.stream)
        if not self.server.page.begun:
            self.send_header("Tagjax-State", "starting")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", content_security_policy())
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing is logged."""


def _names_loopback(host: str) -> bool:
    """Whether a request's `Host` is this machine: a page elsewhere whose name was made to lead here is not."""
    try:
        name = urllib.parse.urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def _in_address(host: str) -> str:
    return f"[{host}]" if ":" in host else host
