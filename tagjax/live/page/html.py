"""The page itself: one file of HTML, with its style and script, that loads nothing else."""

from __future__ import annotations

import base64
import functools
import hashlib
import html
from pathlib import Path
from string import Template

from ...report.page import palette_css


def page_html(title: str) -> str:
    """The page of a stream; `title` is data."""
    return Template(_file("page.html")).substitute(title=html.escape(title), style=_style(), script=_file("page.js"))


@functools.cache
def content_security_policy() -> str:
    """What the page may do: run its own script and ask its own server, nothing else."""
    return (
        f"default-src 'none'; script-src '{_digest(_file('page.js'))}'; style-src '{_digest(_style())}'; "
        "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def _style() -> str:
    return palette_css() + _file("page.css")


def _digest(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


@functools.cache
def _file(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
