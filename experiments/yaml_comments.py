"""The comments of the keys of a YAML file, from its text: parsers of YAML drop them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

_LINE = re.compile(r"^(\s*)(?:- )?([\w.]+):(.*)$")
_COMMENT = re.compile(r"(?:^|\s)# (.*)$")


def key_comments(path: Path, package: str) -> Iterator[tuple[str, str]]:
    """(dotted path, comment) of every key of a file that has a comment on its own line."""
    lines = path.read_text(encoding="utf-8").splitlines()
    prefix = "" if any(line.startswith("# @package _global_") for line in lines) or not package else f"{package}."
    for key, line in lines_with_keys(lines):
        found = _COMMENT.search(line)
        if key and found:
            yield prefix + key, found[1]


def lines_with_keys(lines: list[str]) -> Iterator[tuple[str, str]]:
    """Every line of a YAML text with the dotted path of its key; an empty path for lines without a key."""
    open_keys: list[tuple[int, str]] = []
    for line in lines:
        found = _LINE.match(line)
        if found is None or line.lstrip().startswith(("#", "- ")):
            yield "", line
            continue
        indent = len(found[1])
        open_keys = [(depth, key) for depth, key in open_keys if depth < indent]
        open_keys.append((indent, found[2]))
        yield ".".join(key for _, key in open_keys), line
