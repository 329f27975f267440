"""Changes of bytes and of text that parsers are known to stumble over."""

from __future__ import annotations

import random
import re
from typing import Final

_LONGEST: Final = 8192
# One in this many inputs may be longer, up to a limit beyond those of the readers.
_LONG_ONCE_IN: Final = 400
_LONGEST_OF_ALL: Final = 80_000

NUMBERS: Final = (
    *("0", "-0", "1", "-1", "3", "1e5", "100001", "1e-7", "1e-320", "1e200", "-1e308", "1e999", "1.0e+10", ".5", "5."),
    *("nan", ".nan", "inf", "-.inf", "0x7fffffff", "0xffffffffffffffff", "0o17", "017", "0b1", "1_000", "1:30:30"),
    *("1:30.5", "2147483648", "18446744073709551616", "9" * 40, "9" * 400, "0x" + "f" * 400, "0.1.2", "1,5", "--1"),
)
_PIECES: Final = (
    *(
        "&a ",
        "*a",
        "<<: ",
        "!!",
        "!!int ",
        "!!float ",
        "!!bool ",
        "!!null ",
        "!!timestamp ",
        "!!binary ",
        "!!set ",
        "!!omap ",
    ),
    *("!!python/object/apply:os.system [true]", "!!python/name:os.system ", "!<tag:x> ", "%YAML 1.1\n", "%TAG ! x\n"),
    *(
        "---\n",
        "...\n",
        "? ",
        ": ",
        "- ",
        "{",
        "}",
        "[",
        "]",
        ", ",
        "|",
        ">\n",
        "|9\n",
        '"',
        "'",
        "#",
        "\t",
        "\n",
        "\r",
        "@",
        "`",
    ),
    *(
        "\\",
        '"\\ud800"',
        '"\\U7fffffff"',
        '"\\x00"',
        "\u2028",
        "\ufeff",
        "\u0661",
        "2001-01-01",
        "yes",
        "~",
        "null",
        "=",
        "%",
    ),
    *("a: &a [*a]", "&b [&a [1, 1], *a, *a]", "{? [a] : b}", "../../etc/passwd", "/dev/zero", "name: x\n", "kind: y\n"),
)
_NUMBER: Final = re.compile(rb"[-+]?[0-9][0-9.eE+-]*")
_WORD: Final = re.compile(rb"[A-Za-z_]+")


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """One to four changes at places of no meaning."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(changed) + 1)
        many = 1 << rng.randrange(8)
        match rng.randrange(7):
            case 0 if place < len(changed):
                changed[place] ^= 1 << rng.randrange(8)
            case 1 if place < len(changed):
                changed[place] = rng.choice((0, 1, 0x7F, 0x80, 0xFE, 0xFF, rng.randrange(256)))
            case 2:
                del changed[place : place + many]
            case 3:
                changed[place:place] = rng.randbytes(many)
            case 4:
                changed[place:place] = changed[rng.randrange(len(changed) + 1) :][:many]
            case 5:
                size = rng.choice((1, 2, 4, 8))
                number = rng.choice((0, 1, 2**7, 2**15, 2**31, 2**32 - 1, 2**63, 2**64 - 1)) % 2 ** (8 * size)
                changed[place : place + size] = number.to_bytes(size, rng.choice(("big", "little")))
            case 6 if rng.random() < 0.3:
                del changed[place:]
    return bounded(bytes(changed), rng)


def mutate_text(data: bytes, rng: random.Random) -> bytes:
    """One to three changes of lines, numbers and words, or of bytes."""
    for _ in range(rng.randint(1, 3)):
        match rng.randrange(8):
            case 0 | 1:
                data = _replaced(data, _NUMBER, rng.choice(NUMBERS).encode(), rng)
            case 2:
                words = _WORD.findall(data) or [b"a"]
                data = _replaced(data, _WORD, rng.choice((rng.choice(words), _piece(rng))), rng)
            case 3:
                data = _inserted(data, _piece(rng), rng)
            case 4:
                lines = data.splitlines(keepends=True) or [b""]
                place = rng.randrange(len(lines))
                lines[place : place + rng.randint(0, 2)] = rng.choices(lines, k=rng.randint(0, 2))
                data = b"".join(lines)
            case 5:
                data = _inserted(data, rng.choice(NUMBERS).encode(), rng)
            case 6:
                piece = rng.choice((_piece(rng), data[rng.randrange(len(data) + 1) :][: rng.randint(1, 40)]))
                data = _inserted(data, piece * (1 << rng.randrange(16)), rng)
            case 7:
                data = mutate_bytes(data, rng)
        data = bounded(data, rng)
    return data


def bounded(data: bytes, rng: random.Random) -> bytes:
    """Cut to a length that is tried in a moment, at times to one that is too long for any reader."""
    return data[: _LONGEST_OF_ALL if rng.randrange(_LONG_ONCE_IN) == 0 else _LONGEST]


def _piece(rng: random.Random) -> bytes:
    return rng.choice(_PIECES).encode("utf-8", "surrogatepass")


def _inserted(data: bytes, piece: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + piece + data[place:]


def _replaced(data: bytes, pattern: re.Pattern[bytes], piece: bytes, rng: random.Random) -> bytes:
    places = [match.span() for match in pattern.finditer(data)]
    if not places:
        return data
    start, end = rng.choice(places)
    return data[:start] + piece + data[end:]
