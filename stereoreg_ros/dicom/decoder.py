"""The process that decodes for `decoding`: a program that imports nothing of this package, so that it starts quickly.

On standard input come messages, each after its length in eight bytes: the elements of an image as JSON, and its
compressed pixels. On standard output go messages, first an empty one: `a` and the array as numpy writes it, or `e` and
what went wrong. It ends where its input does.
"""

from __future__ import annotations

import io
import json
import os
import sys
import warnings
from typing import BinaryIO

import numpy as np
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import UID


def main() -> None:
    """Decode one image after the other."""
    warnings.simplefilter("ignore")
    # What a decoder prints must not come between the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    _write(answers, b"")
    while (elements := _read(sys.stdin.buffer)) is not None:
        pixels = _read(sys.stdin.buffer)
        if pixels is None:
            return
        try:
            array = io.BytesIO()
            np.save(array, _decoded(json.loads(elements), pixels), allow_pickle=False)
            answer = b"a" + array.getvalue()
        # Decoders and pydicom may raise almost anything.
        except Exception as error:
            answer = b"e" + (str(error) or type(error).__name__).encode(errors="replace")
        _write(answers, answer)


def _decoded(elements: dict[str, str | int], pixels: bytes) -> np.ndarray:
    meta = FileMetaDataset()
    syntax = meta.TransferSyntaxUID = UID(str(elements.pop("TransferSyntaxUID")))
    undefined_length = bool(elements.pop("undefined_length"))
    dataset = FileDataset(
        "", {}, file_meta=meta, is_implicit_VR=syntax.is_implicit_VR, is_little_endian=syntax.is_little_endian
    )
    for keyword, value in elements.items():
        setattr(dataset, keyword, value)
    dataset.add_new("PixelData", "OB", pixels)
    dataset["PixelData"].is_undefined_length = undefined_length
    return np.asarray(dataset.pixel_array)


def _read(stream: BinaryIO) -> bytes | None:
    length = int.from_bytes(stream.read(8), "big")
    message = stream.read(length)
    return message if message and len(message) == length else None


def _write(stream: BinaryIO, message: bytes) -> None:
    stream.write(len(message).to_bytes(8, "big") + message)
    stream.flush()


if __name__ == "__main__":
    main()
