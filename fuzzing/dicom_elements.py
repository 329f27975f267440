"""Changes of a DICOM file element by element, so that most of what comes out still is one."""

from __future__ import annotations

import random
import struct
import zlib
from dataclasses import dataclass
from typing import Final

from fuzzing.mutation import NUMBERS, mutate_bytes

_META_START: Final = 132
_LONG: Final = (b"OB", b"OW", b"OF", b"OD", b"OL", b"OV", b"SQ", b"UC", b"UN", b"UR", b"UT", b"SV", b"UV")
_VRS: Final = (
    *_LONG,
    b"US",
    b"SS",
    b"UL",
    b"SL",
    b"FL",
    b"FD",
    b"AT",
    b"DS",
    b"IS",
    b"UI",
    b"CS",
    b"LO",
    b"PN",
    b"DA",
    b"??",
)
_ITEM: Final = b"\xfe\xff\x00\xe0"
_SEQUENCE_END: Final = b"\xfe\xff\xdd\xe0\0\0\0\0"
_PIXEL_DATA: Final = b"\xe0\x7f\x10\x00"
_GROUP_LENGTH: Final = b"\x02\x00\x00\x00"
_SYNTAX: Final = b"\x02\x00\x10\x00"
_DEFLATED: Final = b"1.2.840.10008.1.2.1.99"
_UNDEFINED: Final = 0xFFFFFFFF
_TAGS: Final = tuple(
    struct.pack("<HH", tag >> 16, tag & 0xFFFF)
    for tag in (
        *(0x00080008, 0x00080016, 0x00080018, 0x00080060, 0x0020000E, 0x00200013, 0x00200032, 0x00200037, 0x00280002),
        *(0x00280004, 0x00280008, 0x00280010, 0x00280011, 0x00280030, 0x00280100, 0x00280101, 0x00280102, 0x00280103),
        *(0x00280106, 0x00280120, 0x00280121, 0x00281050, 0x00281052, 0x00281053, 0x00283000, 0x00089206, 0x52009229),
        *(0x52009230, 0x7FE00010, 0x7FE00008, 0x7FE00009, 0x7FE00001, 0x7FE00002, 0x00080005, 0xFFFEE000, 0x00020010),
    )
)
_UIDS: Final = (
    *(b"1.2.840.10008.1.2", b"1.2.840.10008.1.2.1", _DEFLATED, b"1.2.840.10008.1.2.2", b"1.2.840.10008.1.2.5"),
    *(b"1.2.840.10008.1.2.4.50", b"1.2.840.10008.1.2.4.51", b"1.2.840.10008.1.2.4.57", b"1.2.840.10008.1.2.4.70"),
    *(b"1.2.840.10008.1.2.4.80", b"1.2.840.10008.1.2.4.81", b"1.2.840.10008.1.2.4.90", b"1.2.840.10008.1.2.4.91"),
    *(b"1.2.840.10008.1.2.4.201", b"1.2.840.10008.1.2.4.100", b"1.2.840.10008.5.1.4.1.1.2", b"1.2.840.10008.1.1"),
    *(b"1.2.840.10008.5.1.4.1.1.2.1", b"1.2.840.10008.5.1.4.1.1.4", b"", b"../../x", b"1.2\\3.4", b"9" * 200),
)
_TEXTS: Final = (
    *(b"", b"MONOCHROME1", b"MONOCHROME2", b"RGB", b"PALETTE COLOR", b"LOCALIZER", b"ISO_IR 192", b"\\ISO 2022 IR 87"),
    *(
        b"\xff\xfe",
        b"\\",
        b"\\\\\\",
        b"a" * 300,
        b"../../etc/passwd",
        b"VOLUME",
        b"ORIGINAL\\PRIMARY\\AXIAL",
        b"\x1b$B\x1b(B",
    ),
)


@dataclass
class _Element:
    """length: as it is written; None: that of the value."""

    tag: bytes
    vr: bytes
    value: bytes
    length: int | None = None

    def __bytes__(self) -> bytes:
        length = len(self.value) if self.length is None else self.length
        if self.vr in _LONG:
            return self.tag + self.vr + b"\0\0" + struct.pack("<I", length) + self.value
        return self.tag + self.vr + struct.pack("<H", length % 2**16) + self.value


def mutate_dicom(data: bytes, rng: random.Random) -> bytes:
    """One to three changes of elements, or of bytes where the file is not in explicit little endian."""
    if rng.random() < 0.15:
        return mutate_bytes(data, rng)
    try:
        meta, rest = _meta(data)
        syntax = next(element.value.rstrip(b"\0") for element in meta if element.tag == _SYNTAX)
        body = zlib.decompress(rest, -zlib.MAX_WBITS) if syntax == _DEFLATED else rest
        elements = _parsed(body)
    except (ValueError, StopIteration, struct.error, zlib.error):
        return mutate_bytes(data, rng)
    for _ in range(rng.randint(1, 3)):
        _change(meta if rng.random() < 0.08 else elements, rng)
    body = b"".join(map(bytes, elements))
    if syntax == _DEFLATED:
        deflater = zlib.compressobj(wbits=-zlib.MAX_WBITS)
        # Sometimes with extra data behind it.
        body = deflater.compress(body + bytes(2**22 if rng.random() < 0.02 else 0)) + deflater.flush()
    inner = b"".join(map(bytes, meta[1:]))
    if meta and meta[0].tag == _GROUP_LENGTH and meta[0].length is None and len(meta[0].value) == 4:
        meta[0].value = struct.pack("<I", len(inner))
    return data[:_META_START] + b"".join(map(bytes, meta[:1])) + inner + body


def _meta(data: bytes) -> tuple[list[_Element], bytes]:
    """The elements of the file meta information, and what comes after it."""
    first = _parsed(data[_META_START : _META_START + 12])
    if len(first) != 1 or first[0].tag != _GROUP_LENGTH:
        raise ValueError
    end = _META_START + 12 + struct.unpack("<I", first[0].value)[0]
    return first + _parsed(data[_META_START + 12 : end]), data[end:]


def _parsed(body: bytes) -> list[_Element]:
    elements = []
    place = 0
    while place < len(body):
        tag, vr = body[place : place + 4], body[place + 4 : place + 6]
        if vr not in _VRS:
            raise ValueError
        if vr in _LONG:
            length, place = struct.unpack_from("<I", body, place + 8)[0], place + 12
        else:
            length, place = struct.unpack_from("<H", body, place + 6)[0], place + 8
        if length == _UNDEFINED:
            end = body.find(_SEQUENCE_END, place)
            end = len(body) if end < 0 else end + len(_SEQUENCE_END)
            elements.append(_Element(tag, vr, body[place:end], _UNDEFINED))
        else:
            end = place + length
            elements.append(_Element(tag, vr, body[place:end]))
        place = end
    return elements


def _change(elements: list[_Element], rng: random.Random) -> None:
    if not elements:
        elements.append(_Element(rng.choice(_TAGS), rng.choice(_VRS), rng.randbytes(8)))
        return
    place = rng.randrange(len(elements))
    element = elements[place]
    if rng.random() < 0.25:
        element = next((one for one in elements if one.tag == _PIXEL_DATA), element)
    match rng.randrange(12):
        case 0 | 1 | 2 | 3:
            element.value = _value(element, rng)
        case 4 | 5:
            _change_within(element, rng)
        case 6:
            element.length = (
                rng.choice((0, 1, len(element.value) + rng.randint(-9, 9), 2**16 - 1, 2**31, _UNDEFINED, 2**32 - 2))
                % 2**32
            )
        case 7:
            del elements[place]
        case 8:
            elements.insert(rng.randrange(len(elements) + 1), _Element(element.tag, element.vr, element.value))
        case 9:
            element.vr = rng.choice(_VRS)
        case 10:
            element.tag = rng.choice(_TAGS)
        case 11:
            tag = rng.choice(_TAGS)
            vr = next((one.vr for one in elements if one.tag == tag), rng.choice(_VRS))
            new = _Element(tag, vr, b"")
            new.value = _value(new, rng)
            elements.insert(place, new)


def _change_within(element: _Element, rng: random.Random) -> None:
    """Change the items of a sequence as data sets of their own; of anything else the bytes."""
    if element.vr == b"SQ" and element.value.startswith(_ITEM) and len(element.value) >= 8:
        (length,) = struct.unpack_from("<I", element.value, 4)
        try:
            inner = _parsed(element.value[8 : 8 + length])
        except (ValueError, struct.error):
            inner = []
        if inner:
            _change(inner, rng)
            body = b"".join(map(bytes, inner))
            element.value = _ITEM + struct.pack("<I", len(body)) + body + element.value[8 + length :]
            return
    element.value = mutate_bytes(element.value, rng)


def _value(element: _Element, rng: random.Random) -> bytes:
    many = rng.choice((1, 1, 1, 2, 3, 6))
    match element.vr:
        case b"US" | b"SS":
            return b"".join(
                struct.pack("<H", rng.choice((0, 1, 2, 8, 12, 15, 16, 31, 32, 33, 8192, 8193, 2**15, 2**16 - 1)))
                for _ in range(many)
            )
        case b"UL" | b"SL":
            return struct.pack("<I", rng.choice((0, 1, 2**31 - 1, 2**31, 2**32 - 1)))
        case b"FD" | b"FL":
            number = rng.choice((0.0, -1.0, 0.8, 1e300, float("nan"), float("inf")))
            return struct.pack("<d", number)[: 8 if element.vr == b"FD" else 4]
        case b"DS" | b"IS":
            value = "\\".join(rng.choice((*NUMBERS, "0.5", "512", "-1024", " 1 ", "")) for _ in range(many)).encode()
        case b"UI":
            value = rng.choice(_UIDS)
        case b"SQ" | b"OB" | b"OW" | b"UN":
            return rng.choice(
                (b"", element.value[: rng.randrange(len(element.value) + 1)], element.value * 2, bytes(64))
            )
        case _:
            value = rng.choice((*_TEXTS, *_UIDS))
    return value + b" " * (len(value) % 2)
