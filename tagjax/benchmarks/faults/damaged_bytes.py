"""Damage of files as bytes."""

from __future__ import annotations

import random


def damaged_bytes(content: bytes, rng: random.Random) -> bytes:
    """The content with one to three random faults: bits flipped, bytes replaced, parts cut, repeated or moved."""
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        content = rng.choice(_FAULTS)(content, rng)
    return content


def _flipped(content: bytes, rng: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 8])):
        if changed:
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _replaced(content: bytes, rng: random.Random) -> bytes:
    begin, end = _part(content, rng)
    return content[:begin] + rng.randbytes(end - begin) + content[end:]


def _zeroed(content: bytes, rng: random.Random) -> bytes:
    begin, end = _part(content, rng)
    return content[:begin] + bytes(end - begin) + content[end:]


def _cut(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randint(0, len(content))]


def _removed(content: bytes, rng: random.Random) -> bytes:
    begin, end = _part(content, rng)
    return content[:begin] + content[end:]


def _repeated(content: bytes, rng: random.Random) -> bytes:
    begin, end = _part(content, rng)
    return content[:end] + content[begin:]


def _inserted(content: bytes, rng: random.Random) -> bytes:
    place = rng.randint(0, len(content))
    return content[:place] + rng.choice(_INSERTED) + content[place:]


def _part(content: bytes, rng: random.Random) -> tuple[int, int]:
    """A random part, mostly of a few bytes."""
    begin = rng.randint(0, len(content))
    return begin, min(len(content), begin + rng.choice([1, 2, 4, 16, 64, len(content)]))


_INSERTED = (b"\0", b"\n", b"\r\n", b'"', b"'", b"\xff\xfe", b"\xef\xbb\xbf", b",", b"\xe2\x80\xa8", b"1", b"-", b"{")
_FAULTS = (_flipped, _flipped, _replaced, _zeroed, _cut, _removed, _repeated, _inserted)
