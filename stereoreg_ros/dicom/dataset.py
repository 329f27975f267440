"""A DICOM file, or its bytes -> pydicom data set, within a limit of size."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import Final

import pydicom
from pydicom.dataset import FileMetaDataset
from pydicom.filereader import read_dataset as read_elements
from pydicom.filereader import read_file_meta_info
from pydicom.filewriter import write_file_meta_info
from pydicom.uid import DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian

from stereoreg_ros.dicom.elements import DicomError, reading
from stereoreg_ros.files.whole_file import read_whole

# For a file on disk. What comes over the network has a limit of its own.
_MAX_INFLATED_BYTES: Final = 2**30
FOLDER: Final = "a folder"
_NO_LETTERS: Final = "not a DICOM file: found no letters DICM at byte 128"
# Preamble and letters; then the length of the file meta information, itself an element of twelve bytes.
_META_START: Final = 132
_META_LENGTH: Final = struct.Struct("<8sI")
_META_LENGTH_TAG: Final = b"\x02\x00\x00\x00UL\x04\x00"


def not_dicom(file: Path) -> str | None:
    """What the file is if it is not a DICOM file, else None; judged by the four letters in every DICOM file."""
    try:
        # Opening a pipe or a device could block forever.
        if file.is_dir():
            return FOLDER
        if not file.exists():
            return "no such file"
        if not file.is_file():
            return "not a regular file"
        with file.open("rb") as stream:
            start = stream.read(132)
    except OSError as error:
        raise DicomError(file, f"cannot be read: {error.strerror}") from error
    return None if start[128:] == b"DICM" else _NO_LETTERS


def read_dataset(file: Path, *, stop_before_pixels: bool) -> pydicom.Dataset:
    """The data set of a file; raises DicomError."""
    what = not_dicom(file)
    if what is not None:
        raise DicomError(file, f"{what}, expected a DICOM file")
    with reading(file, "is damaged, expected file meta information (group 0002)"):
        deflated = read_file_meta_info(file).get("TransferSyntaxUID") == DeflatedExplicitVRLittleEndian
    if not deflated:
        return _parse(file, file, stop_before_pixels=stop_before_pixels)
    try:
        content = read_whole(file, _MAX_INFLATED_BYTES)
    except OSError as error:
        raise DicomError(file, f"cannot be read: {error.strerror}") from error
    return _parse(file, BytesIO(_inflated(file, content, _MAX_INFLATED_BYTES)), stop_before_pixels=stop_before_pixels)


def parsed(name: Path, content: bytes, max_bytes: int) -> pydicom.Dataset:
    """The data set of a file in memory; max_bytes: the most it may take when inflated. Raises DicomError."""
    if content[128:_META_START] != b"DICM":
        raise DicomError(name, f"{_NO_LETTERS}, expected a DICOM file")
    return _parse(name, BytesIO(_inflated(name, content, max_bytes)), stop_before_pixels=False)


def _parse(file: Path, source: Path | BytesIO, *, stop_before_pixels: bool) -> pydicom.Dataset:
    with reading(file, "is damaged, expected a whole DICOM file"):
        dataset: pydicom.Dataset = pydicom.dcmread(source, stop_before_pixels=stop_before_pixels)
    return dataset


def _inflated(name: Path, content: bytes, max_bytes: int) -> bytes:
    """The file with its data set inflated, if it has the deflated transfer syntax.

    pydicom itself would inflate without a limit.
    """
    if len(content) < _META_START + _META_LENGTH.size:
        raise DicomError(name, f"is damaged: has {len(content)} bytes, expected a whole DICOM file")
    tag, length = _META_LENGTH.unpack_from(content, _META_START)
    if tag != _META_LENGTH_TAG:
        raise DicomError(name, "is damaged: found no length of the file meta information (0002,0000) at byte 132")
    start = _META_START + _META_LENGTH.size + length
    with reading(name, "is damaged, expected file meta information (group 0002)"):
        meta = FileMetaDataset(read_elements(BytesIO(content[_META_START:start]), False, True))
        syntax = meta.TransferSyntaxUID
    if syntax != DeflatedExplicitVRLittleEndian:
        return content
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        data = inflater.decompress(content[start:], max_bytes)
    except zlib.error as error:
        raise DicomError(name, f"is damaged: its deflated data cannot be inflated: {error}") from None
    if inflater.unconsumed_tail:
        raise DicomError(name, f"its deflated data inflate to more than {max_bytes} bytes, expected fewer")
    if not inflater.eof:
        raise DicomError(name, "is damaged: its deflated data end too soon")
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    inflated = BytesIO()
    with reading(name, "is damaged, expected file meta information (group 0002)"):
        write_file_meta_info(inflated, meta, enforce_standard=False)  # type: ignore[arg-type]
    return content[:_META_START] + inflated.getvalue() + data
