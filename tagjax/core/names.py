"""Names of recordings and tags: which are allowed, and how any text becomes a file name or is shown as it is."""

from __future__ import annotations

import hashlib
import re

MAX_NAME = 100
"""Longest name of a recording, and longest EPC, in characters."""

_NAME = re.compile(r"\w[\w .,()+@#:-]*")
_NOT_IN_FILES = re.compile(r"[^\w.+-]+")
_LIKE_DIGEST = re.compile(r"-[0-9a-f]{8}$")
_RESERVED = re.compile(r"(con|prn|aux|nul|(com|lpt)[0-9¹²³])(\..*)?", re.IGNORECASE)
"""Names that stand for devices on Windows, with any extension."""

_MAX_FILE_NAME_BYTES = 80


def name_fault(name: object) -> str | None:
    """Why a text can be no name of a recording or tag; None if it can.

    Letters and digits of any script, space and `_ . , ( ) + @ # : -` are allowed, a letter, digit or `_` first.
    """
    if not isinstance(name, str):
        return f"found {name!r} ({type(name).__name__}); expected a text"
    if len(name) > MAX_NAME:
        return f"found {name[:20]!r}... of {len(name)} characters; expected at most {MAX_NAME}"
    if not _NAME.fullmatch(name) or name != name.strip():
        return f"found {name!r}; expected letters, digits, spaces and _.,()+@#:- only, a letter or digit first"
    return None


def short_name(epc: str, mark: str = "..") -> str:
    """The end of an EPC after a mark, where those of one batch differ. Names of up to 12 characters, as of virtual tags, stay whole."""
    return epc if len(epc) <= 12 else f"{mark}{epc[-6:]}"


def safe_file_name(text: str) -> str:
    """A file name of at most 90 bytes that stays in its folder, on every system: `text` itself if it is one already.

    Other characters become `_`. A digest of the text, of 32 bits, follows wherever something was changed and after a text
    that ends like a digest, so that two texts get two names. Only file systems that ignore case or forms of Unicode take
    two such names for one.
    """
    safe = _NOT_IN_FILES.sub("_", text).lstrip("._+-").rstrip("._")
    safe = safe.encode()[:_MAX_FILE_NAME_BYTES].decode(errors="ignore")
    if _RESERVED.fullmatch(safe):
        safe = f"_{safe}"
    if safe == text and safe and not _LIKE_DIGEST.search(safe):
        return safe
    return f"{safe or 'name'}-{hashlib.sha256(text.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"


def valid_name(text: str) -> str:
    """The text itself if it can be a recording's name, else a file name made of it."""
    return text if name_fault(text) is None else safe_file_name(text)


def plain_label(text: str) -> str:
    """A text as matplotlib shows it unchanged: `$` does not begin a formula."""
    return text.replace("$", r"\$")
