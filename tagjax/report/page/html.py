"""HTML and SVG elements as text. Whatever is no `Html` is escaped, so data cannot become markup."""

from __future__ import annotations

import base64
import html
from typing import Any

_VOID = {"input", "img"}
"""Elements of HTML that have no content and no end."""


class Html(str):
    """Text that is markup already."""


def element(name: str, /, *children: Any, **attributes: Any) -> Html:
    """An element; its children are `Html`, or data, which is escaped; None is left out.

    Names of attributes: `class_` stands for `class`, `aria_label` for `aria-label`. An attribute that is None or False is
    left out, one that is True has no value.
    """
    written = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in _VOID:
        return Html(f"<{name}{written}>")
    return Html(f"<{name}{written}>{together(*children)}</{name}>")


def _attribute(key: str, value: Any) -> str:
    name = key.rstrip("_").replace("_", "-")
    if value is None or value is False:
        return ""
    return f" {name}" if value is True else f' {name}="{escaped(value)}"'


def together(*children: Any) -> Html:
    """Several elements or data, one after the other."""
    return Html(
        "".join(child if isinstance(child, Html) else escaped(child) for child in children if child is not None)
    )


def escaped(value: Any) -> Html:
    """Data as text of a page."""
    return Html(html.escape(str(value), quote=True))


def data_uri(kind: str, content: bytes) -> str:
    """A file's content as an address, for `src`."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def table(header: list[Any], rows: list[list[Any]], *, caption: str | None = None, number_columns: int = 0) -> Html:
    """A table that scrolls sideways where it is too wide; its last `number_columns` columns are aligned right."""
    first = len(header) - number_columns

    def cells(kind: str, row: list[Any]) -> Html:
        drawn = []
        for place, cell in enumerate(row):
            scope = "col" if kind == "th" else "row" if place == 0 else None
            name = "th" if scope else "td"
            drawn.append(element(name, cell, scope=scope, class_="number" if place >= first else None))
        return element("tr", *drawn)

    body = element("tbody", *(cells("td", row) for row in rows))
    title = None if caption is None else element("caption", caption)
    whole = element("table", title, element("thead", cells("th", header)), body)
    return element("div", whole, class_="scroll", tabindex="0", role="region", aria_label=caption or "table")
