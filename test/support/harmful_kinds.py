"""Kinds of input for the test of the fuzzer itself: those with an exclamation mark do harm, in one way each."""

from __future__ import annotations

import ctypes
import random
import time
import warnings
from collections.abc import Callable

import numpy as np

from fuzzing.kind import Kind


class _NamedError(ValueError):
    pass


def _hang() -> None:
    while True:
        pass


def _crash() -> None:
    ctypes.string_at(0)


def _swell() -> None:
    np.ones(2**25)


def _ask() -> None:
    try:
        np.ones(2**40)
    except MemoryError as error:
        raise _NamedError("field: cannot be read") from error


def _fail() -> None:
    raise KeyError("field")


def _name_nothing() -> None:
    raise ValueError("bad")


def _kind(name: str, harm: Callable[[], None]) -> Kind:
    def attempt(data: bytes) -> None:
        if b"!" in data:
            harm()
        if b"?" in data:
            raise _NamedError("field: found '?', expected none")

    def mutate(data: bytes, rng: random.Random) -> bytes:
        return b"abc!"

    return Kind(
        name,
        ".txt2",
        attempt,
        (_NamedError, ValueError),
        lambda text: text.startswith("field"),
        lambda: [b"abc", b"abc?"],
        mutate,
    )


KINDS = {
    name: _kind(name, harm)
    for name, harm in {
        "hangs": _hang,
        "waits": lambda: time.sleep(1000),
        "crashes": _crash,
        "swells": _swell,
        "asks for much": _ask,
        "fails": _fail,
        "names nothing": _name_nothing,
        "warns": lambda: warnings.warn("overflow", RuntimeWarning, stacklevel=1),
        "harmless": lambda: None,
    }.items()
}
