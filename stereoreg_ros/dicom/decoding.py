"""Compressed pixels -> values, in a process of its own: decoders are C code, which a damaged image can hang or crash.

One process (`decoder`) serves all images, one at a time, and is started for the first one. It has a time limit for
each image; where it exceeds that, it is killed, and the next image gets a new one. It ends with the process that
started it.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import json
import os
import selectors
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset

_PROGRAM: Final = Path(__file__).with_name("decoder.py")
# What decoders need besides the pixels and the transfer syntax.
_KEYWORDS: Final = (
    "SamplesPerPixel",
    "PhotometricInterpretation",
    "Rows",
    "Columns",
    "BitsAllocated",
    "BitsStored",
    "HighBit",
    "PixelRepresentation",
)
# To start Python and find the decoders; then for an image. 512 x 512 pixels take some hundredths of a second.
_START_S: Final = 30.0
_LEAST_S: Final = 1.5
_S_PER_PIXEL: Final = 1e-6
_LENGTH_BYTES: Final = 8


class DecodingError(Exception):
    """A compressed image that cannot be decoded; the text says why."""


class _EndedError(DecodingError):
    """The decoder process ended instead of answering."""


def decoded(dataset: Dataset) -> NDArray[Any]:
    """Stored values (rows, columns) of a data set with one compressed image, whose elements have been checked.

    Raises DecodingError where the decoder cannot decode it, takes too long, or ends.
    """
    elements = {keyword: dataset.get(keyword) for keyword in _KEYWORDS}
    elements["TransferSyntaxUID"] = str(dataset.file_meta.TransferSyntaxUID)
    elements["undefined_length"] = dataset["PixelData"].is_undefined_length
    limit_s = _LEAST_S + _S_PER_PIXEL * int(dataset.Rows) * int(dataset.Columns)
    messages = json.dumps(elements).encode(), dataset.PixelData
    with _lock:
        try:
            answer = _decoder().ask(messages, limit_s)
        except _EndedError:
            # Perhaps for another reason than this image.
            answer = _decoder().ask(messages, limit_s)
    if not answer.startswith(b"a"):
        raise DecodingError(answer[1:].decode(errors="replace"))
    values: NDArray[Any] = np.load(io.BytesIO(answer[1:]), allow_pickle=False)
    return values


class _Decoder:
    """The process, as seen by the one that started it."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(_PROGRAM)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            # It ends when its input does, not by a terminal's Ctrl-C.
            start_new_session=True,
            # It finds the modules that this process finds, and does not take files beside the program for modules.
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "PYTHONSAFEPATH": "1"},
        )
        self.ask((), _START_S)

    @property
    def is_alive(self) -> bool:
        """Whether the process is running."""
        return self._process.poll() is None

    def ask(self, messages: tuple[bytes, ...], limit_s: float) -> bytes:
        """Its answer within `limit_s` seconds; else DecodingError, and the process is gone."""
        assert self._process.stdin is not None
        try:
            for message in messages:
                self._process.stdin.write(len(message).to_bytes(_LENGTH_BYTES, "big") + message)
            self._process.stdin.flush()
            answer = self._answer(time.monotonic() + limit_s)
        except TimeoutError:
            self.end()
            raise DecodingError(f"the decoder took more than {limit_s:.1f} s") from None
        except OSError:
            answer = None
        if answer is None:
            self.end()
            raise _EndedError(f"the decoder's process ended with status {self._process.returncode}")
        return answer

    def _answer(self, deadline_s: float) -> bytes | None:
        """The answer; None where the process ends instead."""
        assert self._process.stdout is not None
        received, wanted = bytearray(), _LENGTH_BYTES
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            while len(received) < wanted:
                if not selector.select(max(0.0, deadline_s - time.monotonic())):
                    raise TimeoutError
                some = os.read(self._process.stdout.fileno(), 1 << 20)
                if not some:
                    return None
                received += some
                if wanted == _LENGTH_BYTES <= len(received):
                    wanted += int.from_bytes(received[:_LENGTH_BYTES], "big")
        return bytes(received[_LENGTH_BYTES:])

    def end(self) -> None:
        """End the process, if it is still running."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        if self.is_alive:
            self._process.kill()
        self._process.wait()
        self._process.stdout.close()
        with contextlib.suppress(OSError):  # Unwritten input may be left.
            self._process.stdin.close()


_lock: Final = threading.Lock()
# By the id of the process that started it: a forked one must not share the pipes.
_decoders: Final[dict[int, _Decoder]] = {}


def _decoder() -> _Decoder:
    decoder = _decoders.get(os.getpid())
    if decoder is None or not decoder.is_alive:
        _end()
        decoder = _decoders[os.getpid()] = _Decoder()
    return decoder


@atexit.register
def _end() -> None:
    decoder = _decoders.pop(os.getpid(), None)
    if decoder is not None:
        decoder.end()
