"""What a compressed image says of its size, before a decoder takes memory for it."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

_JPEG_START: Final = b"\xff\xd8"
_JPEG_2000_START: Final = b"\xff\x4f\xff\x51"
# Length and capabilities; then size and offset of the image, size and offset of a tile, number of components.
_JPEG_2000_SIZE: Final = struct.Struct(">HH8IH")
_JPEG_FRAME: Final = struct.Struct(">HBHHB")
# Start of frame of every process of JPEG, and of JPEG-LS; among them are three markers that mean something else.
_JPEG_FRAME_MARKERS: Final = ({*range(0xC0, 0xD0)} | {0xF7}) - {0xC4, 0xC8, 0xCC}
_MARKER_PREFIX: Final = 0xFF
_ALONE: Final = {0x01, *range(0xD0, 0xDA)}


@dataclass(frozen=True)
class CodestreamSize:
    """Size in pixels, and the number of values of each."""

    rows: int
    columns: int
    components: int

    def __str__(self) -> str:
        return f"{self.rows} rows, {self.columns} columns, {self.components} components"


def size_of(codestream: bytes) -> CodestreamSize:
    """Size of a JPEG, JPEG-LS or JPEG 2000 image; ValueError where it does not say it as it should."""
    if codestream.startswith(_JPEG_START):
        return _jpeg(codestream)
    start = codestream.find(_JPEG_2000_START)
    if start < 0:
        raise ValueError("found the start of no JPEG and of no JPEG 2000 image")
    try:
        _, _, x, y, left, top, _, _, _, _, components = _JPEG_2000_SIZE.unpack_from(codestream, start + 4)
    except struct.error:
        raise ValueError("a JPEG 2000 image ends before its size") from None
    return CodestreamSize(y - top, x - left, components)


def _jpeg(codestream: bytes) -> CodestreamSize:
    place = len(_JPEG_START)
    try:
        while codestream[place] == _MARKER_PREFIX:
            marker = codestream[place + 1]
            if marker in _JPEG_FRAME_MARKERS:
                _, _, rows, columns, components = _JPEG_FRAME.unpack_from(codestream, place + 2)
                return CodestreamSize(rows, columns, components)
            if marker == _MARKER_PREFIX:
                place += 1
            elif marker in _ALONE:
                place += 2
            else:
                place += 2 + int.from_bytes(codestream[place + 2 : place + 4], "big")
    except (IndexError, struct.error):
        raise ValueError("a JPEG image ends before its size") from None
    raise ValueError(f"a JPEG image has no marker at its byte {place}, where one has to be")
