"""The size that a compressed image states, before a decoder allocates memory for it."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

_JPEG_START: Final = b"\xff\xd8"
_JPEG_2000_START: Final = b"\xff\x4f\xff\x51"
# Length and capabilities; then size and offset of the image, size and offset of a tile, number of components.
_JPEG_2000_SIZE: Final = struct.Struct(">HH8IH")
_JPEG_2000_FILE: Final = b"\0\0\0\x0cjP  \r\n\x87\n"
_JPEG_2000_BOX: Final = struct.Struct(">I4s")
_JPEG_FRAME: Final = struct.Struct(">HBHHB")
# Start of frame of every process of JPEG, and of JPEG-LS; among them are three markers that mean something else.
_JPEG_FRAME_MARKERS: Final = ({*range(0xC0, 0xD0)} | {0xF7}) - {0xC4, 0xC8, 0xCC}
_MARKER_PREFIX: Final = 0xFF
# Number of segments, and where each begins.
_RLE_HEADER: Final = struct.Struct("<16I")
_RLE_NOTHING: Final = 128
# Bytes behind a segment that are harmless.
_RLE_PADDING: Final = 256
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
    """Size of a JPEG, JPEG-LS or JPEG 2000 image; ValueError where it is not stated properly."""
    if codestream.startswith(_JPEG_START):
        return _jpeg(codestream)
    # A whole JPEG 2000 file, which DICOM forbids but which occurs, has other boxes before the image.
    start = _in_boxes(codestream) if codestream.startswith(_JPEG_2000_FILE) else 0
    if not codestream.startswith(_JPEG_2000_START, start):
        raise ValueError("found the start of no JPEG and of no JPEG 2000 image")
    try:
        _, _, x, y, left, top, _, _, _, _, components = _JPEG_2000_SIZE.unpack_from(codestream, start + 4)
    except struct.error:
        raise ValueError("a JPEG 2000 image ends before its size") from None
    return CodestreamSize(y - top, x - left, components)


def _in_boxes(file: bytes) -> int:
    """Where the codestream begins in the boxes of a JPEG 2000 file."""
    place = 0
    while place + _JPEG_2000_BOX.size <= len(file):
        length, kind = _JPEG_2000_BOX.unpack_from(file, place)
        if kind == b"jp2c":
            return place + _JPEG_2000_BOX.size
        # No scanner writes a box of length 0, which extends to the end, or one whose length is stored elsewhere.
        if length < _JPEG_2000_BOX.size:
            break
        place += length
    raise ValueError("a JPEG 2000 file holds no image")


def require_rle_size(codestream: bytes, pixels: int) -> None:
    """ValueError where a segment of an RLE image unpacks to many more bytes than there are pixels.

    A packet of two bytes unpacks to up to 128: a decoder that checks only afterwards takes sixty times the memory.
    """
    count, *offsets = _RLE_HEADER.unpack(codestream[: _RLE_HEADER.size].ljust(_RLE_HEADER.size, b"\0"))
    if not 1 <= count <= len(offsets):
        raise ValueError(f"an RLE image has {count} segments, expected 1 to {len(offsets)}")
    starts = offsets[:count]
    for start, end in zip(starts, [*starts[1:], len(codestream)], strict=True):
        segment = codestream[start:end]
        length = place = 0
        while place < len(segment) and length <= 2 * pixels + _RLE_PADDING:
            packet = segment[place]
            if packet < _RLE_NOTHING:
                length += packet + 1
                place += packet + 2
            elif packet > _RLE_NOTHING:
                length += 257 - packet
                place += 2
            else:
                # Each takes time to skip, and no encoder writes many.
                length += 1
                place += 1
        if place < len(segment):
            raise ValueError(f"an RLE segment unpacks to more than twice the {pixels} bytes of {pixels} pixels")


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
