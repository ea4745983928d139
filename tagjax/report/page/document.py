"""What all self-contained pages have in common: head, colours, style, and what a browser lets them do."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path
from string import Template

from .html import Html, escaped


def document(title: str, body: Html, *, style: str = "", script: str = "", media: bool = False) -> str:
    """A whole page; `title` is data. It loads nothing but, with `media`, videos beside it, and runs `script` alone.

    `style` is added to that of all pages.
    """
    policy = "; media-src data: 'self' file:" if media else ""
    if script:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        policy += f"; script-src 'sha256-{digest}'"
        body = Html(f"{body}\n<script>{script}</script>")
    css = palette_css() + template("page.css") + style
    return Template(template("document.html")).substitute(title=escaped(title), policy=policy, style=css, body=body)


def palette_css() -> str:
    """The colours of the pages, light and dark, as variables of CSS: paper, ink, and c0 to c7 of the tags."""
    return template("palette.css")


def template(name: str) -> str:
    """A file beside this one, as text."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
