"""Matroska files (.mkv): tracks, tags, attachments, and the blocks of the tracks one after the other.

Only what uncompressed video and Motion-JPEG need (RFC 8794, EBML; RFC 9559, Matroska): no lacing, no encryption, no
compression of blocks by the container.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from ....core.errors import RecordingError

_EBML, _SEGMENT, _CLUSTER = 0x1A45DFA3, 0x18538067, 0x1F43B675
_INFO, _SCALE, _DATE = 0x1549A966, 0x2AD7B1, 0x4461
_TRACKS, _ENTRY, _NUMBER, _NAME, _CODEC, _PRIVATE = 0x1654AE6B, 0xAE, 0xD7, 0x536E, 0x86, 0x63A2
_VIDEO, _WIDTH, _HEIGHT, _ENCODINGS = 0xE0, 0xB0, 0xBA, 0x6D80
_ATTACHMENTS, _FILE, _FILE_NAME, _FILE_DATA = 0x1941A469, 0x61A7, 0x466E, 0x465C
_TAGS, _TAG, _SIMPLE_TAG, _TAG_NAME, _TAG_TEXT = 0x1254C367, 0x7373, 0x67C8, 0x45A3, 0x4487
_TIME, _SIMPLE_BLOCK, _GROUP, _BLOCK = 0xE7, 0xA3, 0xA0, 0xA1

_MAX_HEADER_BYTES = 64_000_000  # of tracks, tags and attachments
_MAX_BLOCK_BYTES = 256_000_000
_LACING = 0x06


@dataclasses.dataclass(frozen=True)
class Track:
    """A track of video."""

    number: int
    name: str
    codec: str
    private: bytes  # of codec V_MS/VFW/FOURCC: a BITMAPINFOHEADER
    width: int
    height: int
    compressed: bool  # by the container


@dataclasses.dataclass(frozen=True)
class Block:
    """One picture as it is stored."""

    track: int
    time_ns: int  # since the start of the file
    data: bytes


@dataclasses.dataclass(frozen=True)
class _Element:
    id: int
    start: int  # of the content
    size: int

    @property
    def end(self) -> int:
        return self.start + self.size


class Matroska:
    """The description of a file; `blocks()` reads its pictures. Raises `RecordingError` for a file that is cut short."""

    def __init__(self, path: Path):
        self.path = path
        self.scale_ns = 1_000_000
        self.tracks: dict[int, Track] = {}
        self.tags: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self._clusters: list[_Element] = []
        self._file_size = path.stat().st_size
        with path.open("rb") as file:
            head = self._element(file, 0, self._file_size)
            if head.id != _EBML:
                raise RecordingError(f"{path}: no Matroska file; expected .mkv. Is it another format?")
            segment = self._element(file, head.end, self._file_size)
            if segment.id != _SEGMENT:
                raise self._damaged(head.end)
            for element in self._children(file, segment):
                if element.id == _CLUSTER:
                    self._clusters.append(element)
                elif element.id in (_INFO, _TRACKS, _ATTACHMENTS, _TAGS):
                    self._describe(file, element)

    def _describe(self, file: BinaryIO, element: _Element) -> None:
        if element.size > _MAX_HEADER_BYTES:
            raise self._damaged(element.start)
        for child in self._children(file, element):
            if element.id == _INFO and child.id == _SCALE:
                self.scale_ns = self._whole(file, child)
            elif child.id == _ENTRY:
                track = self._track(file, child)
                self.tracks[track.number] = track
            elif child.id == _FILE:
                found = self._content(file, child)
                self.attachments[_text(found.get(_FILE_NAME, b""))] = found.get(_FILE_DATA, b"")
            elif child.id == _TAG:
                for simple in (one for one in self._children(file, child) if one.id == _SIMPLE_TAG):
                    found = self._content(file, simple)
                    self.tags[_text(found.get(_TAG_NAME, b""))] = _text(found.get(_TAG_TEXT, b""))

    def _track(self, file: BinaryIO, entry: _Element) -> Track:
        found = self._content(file, entry)
        video: dict[int, bytes] = {}
        for child in self._children(file, entry):
            if child.id == _VIDEO:
                video = self._content(file, child)
        return Track(
            number=int.from_bytes(found.get(_NUMBER, b"\x00"), "big"),
            name=_text(found.get(_NAME, b"")),
            codec=_text(found.get(_CODEC, b"")),
            private=found.get(_PRIVATE, b""),
            width=int.from_bytes(video.get(_WIDTH, b""), "big"),
            height=int.from_bytes(video.get(_HEIGHT, b""), "big"),
            compressed=_ENCODINGS in found,
        )

    def blocks(self, tracks: set[int]) -> Iterator[Block]:
        """The blocks of these tracks in the order of the file. Raises `RecordingError` where the file is cut or damaged."""
        with self.path.open("rb") as file:
            for cluster in self._clusters:
                begin = 0
                for child in self._children(file, cluster):
                    if child.id == _TIME:
                        begin = self._whole(file, child)
                    elif child.id == _SIMPLE_BLOCK:
                        yield from self._block(file, child, begin, tracks)
                    elif child.id == _GROUP:
                        for one in self._children(file, child):
                            if one.id == _BLOCK:
                                yield from self._block(file, one, begin, tracks)

    def _block(self, file: BinaryIO, element: _Element, begin: int, tracks: set[int]) -> Iterator[Block]:
        if not 4 <= element.size <= _MAX_BLOCK_BYTES:
            raise self._damaged(element.start)
        number, place = self._number(file, element.start, keep_marker=False)
        head = self._bytes(file, place, 3)
        if number not in tracks:
            return
        if head[2] & _LACING:
            raise RecordingError(
                f"{self.path}: track {number} has several pictures in one block; expected one. Remux the file with mkvmerge."
            )
        time_ns = (begin + int.from_bytes(head[:2], "big", signed=True)) * self.scale_ns
        yield Block(number, time_ns, self._bytes(file, place + 3, element.end - place - 3))

    def _children(self, file: BinaryIO, parent: _Element) -> Iterator[_Element]:
        place = parent.start
        while place < parent.end:
            element = self._element(file, place, parent.end)
            yield element
            place = element.end

    def _element(self, file: BinaryIO, place: int, end: int) -> _Element:
        """The element at a place. One of unknown size lasts to the end of its parent."""
        kind, after = self._number(file, place, keep_marker=True)
        size, start = self._number(file, after, keep_marker=False)
        if size == (1 << 7 * (start - after)) - 1:  # unknown: a recording that was not ended, or a live one
            if kind == _CLUSTER:
                raise RecordingError(
                    f"{self.path}: a cluster of unknown size at byte {place}: the recording was not ended. Repair it: mkvmerge -o "
                    "<new>.mkv <file>"
                )
            size = end - start
        if start + size > min(end, self._file_size):
            raise self._damaged(place)
        return _Element(kind, start, size)

    def _number(self, file: BinaryIO, place: int, *, keep_marker: bool) -> tuple[int, int]:
        """An EBML number of variable length, with or without its length marker, and the place after it."""
        first = self._bytes(file, place, 1)[0]
        length = 9 - first.bit_length()
        if length > 8:
            raise self._damaged(place)
        value = int.from_bytes(self._bytes(file, place, length), "big")
        return (value if keep_marker else value & ((1 << 7 * length) - 1)), place + length

    def _content(self, file: BinaryIO, parent: _Element) -> dict[int, bytes]:
        """The children of an element by their identifiers; of several of one kind the last."""
        return {child.id: self._bytes(file, child.start, child.size) for child in self._children(file, parent)}

    def _whole(self, file: BinaryIO, element: _Element) -> int:
        return int.from_bytes(self._bytes(file, element.start, min(element.size, 8)), "big")

    def _bytes(self, file: BinaryIO, place: int, count: int) -> bytes:
        file.seek(place)
        data = file.read(count)
        if len(data) < count:
            raise self._damaged(place)
        return data

    def _damaged(self, place: int) -> RecordingError:
        return RecordingError(
            f"{self.path}: truncated or damaged at byte {place} of {self._file_size}; expected a whole Matroska file. Copy it again, "
            "or repair a recording that was not ended: mkvmerge -o <new>.mkv <file>"
        )


def _text(data: bytes) -> str:
    return data.rstrip(b"\x00").decode("utf-8", errors="replace")
