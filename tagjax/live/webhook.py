"""Lines sent to a web address: one POST each, with JSON as its body."""

from __future__ import annotations

import http.client
import os
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from typing import Any

from ..core.settings import ConfigError
from .outlet import DeliveryError

TOKEN = "TAGJAX_WEBHOOK_TOKEN"
"""Environment variable with a token, sent as `Authorization: Bearer <token>`; no file holds it."""

_AGAIN = {408, 425, 429}  # and all of 500 and more
_LOOPBACK = {"localhost", "127.0.0.1", "::1"}


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Follows no redirection: it would turn a POST into a GET, and may carry the token elsewhere."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


def webhook(address: str, timeout_s: float) -> Callable[[str], None]:
    """A function that sends one line, and raises `DeliveryError`. Raises `ConfigError` for what is no address of the web.

    An answer of 2xx is a delivery. Others of 408, 425, 429 and from 500 on, and failed connections, may be tried again.
    """
    try:
        parts = urllib.parse.urlsplit(address)
        host, _ = parts.hostname, parts.port
    except ValueError as error:
        raise ConfigError(
            f"events.webhook: found {address!r} ({error}); expected http://<host>:<port>/<path>."
        ) from error
    if parts.scheme not in ("http", "https") or not host:
        raise ConfigError(f"events.webhook: found {address!r}; expected http://<host>:<port>/<path>, or https.")
    if parts.username is not None or parts.password is not None:
        raise ConfigError(
            f"events.webhook: found a user or password in the address; expected none, because the run folder keeps it. "
            f"Set the environment variable {TOKEN}."
        )
    handlers: list[urllib.request.BaseHandler] = [_NoRedirect()]
    if host in _LOOPBACK:
        handlers.append(urllib.request.ProxyHandler({}))
    opener = urllib.request.build_opener(*handlers)
    headers = {"Content-Type": "application/json", "User-Agent": "tagjax"}
    if token := os.environ.get(TOKEN):
        headers["Authorization"] = f"Bearer {token}"

    def send(line: str) -> None:
        request = urllib.request.Request(address, line.encode(), headers, method="POST")
        try:
            with opener.open(request, timeout=timeout_s):
                return
        except urllib.error.HTTPError as error:
            with error:
                again = error.code in _AGAIN or error.code >= 500
            raise DeliveryError(f"{address} answers {error.code} {error.reason}", again=again) from error
        except (OSError, http.client.HTTPException) as error:
            reason = getattr(error, "reason", None) or error or type(error).__name__
            raise DeliveryError(f"{address}: {reason}", again=True) from error

    return send
