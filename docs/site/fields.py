"""Griffe extension: the comment behind a field is its description in the API reference, in one table a class."""

from __future__ import annotations

import functools
import io
import tokenize
from pathlib import Path
from typing import Any

import griffe


class Fields(griffe.Extension):
    """Adds a section "Attributes" to the docstring of every class whose fields have none of their own."""

    def on_class(self, *, cls: griffe.Class, **kwargs: Any) -> None:
        """Of a field the table has the comment and the default; name and type come from the class."""
        rows = [
            f"    {name}: {_description(one)}"
            for name, one in cls.attributes.items()
            if not (one.is_alias or name.startswith("_") or one.docstring or one.lineno is None)
        ]
        if rows:
            text = cls.docstring.value if cls.docstring else ""
            text = "\n".join([text, "", "Attributes:", *rows])
            cls.docstring = griffe.Docstring(text, parent=cls, parser="google")


def _description(field: griffe.Attribute) -> str:
    assert field.lineno is not None
    parts = _comment(Path(str(field.filepath)), field.lineno, field.endlineno or field.lineno)
    default = _default(field.value)
    if default is not None and "property" not in field.labels:
        parts.append(f"Default: `{default}`.")
    return " ".join(parts) or " "


def _default(value: Any) -> Any:
    """What a field is without a value given; of `field(default=..., converter=...)` the default."""
    if isinstance(value, griffe.ExprCall) and value.canonical_path.rpartition(".")[2] == "field":
        given = {one.name: one.value for one in value.arguments if isinstance(one, griffe.ExprKeyword)}
        return given.get("default", given.get("default_factory"))
    return value


def _comment(path: Path, first: int, last: int) -> list[str]:
    """The comment in the lines of a field, and, where there is one, the lines of comment right below."""
    comments = _comments(path)
    texts = [comments[line][1] for line in range(first, last + 1) if line in comments]
    while texts and comments.get(last + 1, (False, ""))[0]:
        last += 1
        texts.append(comments[last][1])
    text = " ".join(texts)
    return [f"{text[:1].upper()}{text[1:].rstrip('.')}."] if text else []


@functools.cache
def _comments(path: Path) -> dict[int, tuple[bool, str]]:
    """By line the comment, and whether it has the line for itself."""
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
    return {
        token.start[0]: (token.line.lstrip().startswith("#"), token.string.lstrip("# ").strip())
        for token in tokens
        if token.type == tokenize.COMMENT
    }
