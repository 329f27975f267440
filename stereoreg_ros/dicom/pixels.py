"""Data set -> pixels in HU: decoded, unused bits removed, padding made dark."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from numpy.typing import NDArray
from pydicom.uid import UID, RLELossless

from stereoreg_ros.dicom.codestream import CodestreamSize, require_rle_size, size_of
from stereoreg_ros.dicom.decoding import decoded
from stereoreg_ros.dicom.elements import DicomError, element_fault, element_integer, element_value, reading, tag_text
from stereoreg_ros.dicom.header import SliceHeader
from stereoreg_ros.dicom.multiframe import single_frame
from stereoreg_ros.geometry.slice import LARGEST_HU


def read_hu(header: SliceHeader, dataset: pydicom.Dataset) -> NDArray[np.float32]:
    """HU (rows, columns) of an image whose header has been read; raises DicomError."""
    file = header.path
    stored = _read_stored(header, dataset)
    hu = stored.astype(np.float64) * header.rescale_slope + header.rescale_intercept
    padding = _padding(file, dataset, stored)
    if padding is not None:
        if padding.all():
            raise DicomError(file, f"every pixel has a {tag_text('PixelPaddingValue')}, expected an image")
        # Padding may stand for any HU, even one above the threshold: it must not look like metal.
        hu[padding] = hu[~padding].min()
    if not np.abs(hu).max() <= LARGEST_HU:
        raise DicomError(file, f"HU reach {np.abs(hu).max():g}, expected {LARGEST_HU:g} at most")
    return hu.astype(np.float32)


def _read_stored(header: SliceHeader, dataset: pydicom.Dataset) -> NDArray[Any]:
    """Stored values (rows, columns), as integers."""
    file = header.path
    allocated = element_integer(file, dataset, "BitsAllocated", 8, 32)
    if allocated not in (8, 16, 32):
        raise element_fault(file, "BitsAllocated", allocated, "8, 16 or 32")
    bits = element_integer(file, dataset, "BitsStored", 1, allocated)
    element_integer(file, dataset, "HighBit", bits - 1, bits - 1)
    signed = element_integer(file, dataset, "PixelRepresentation", 0, 1) == 1
    expected = header.rows * header.columns * allocated // 8
    expectation = f"{expected} bytes for {header.rows} rows, {header.columns} columns and {allocated} bits a pixel"
    data = element_value(file, dataset, "PixelData")
    if not isinstance(data, bytes):
        raise element_fault(file, "PixelData", None, expectation)
    if not dataset["PixelData"].is_undefined_length and len(data) < expected:
        raise DicomError(file, f"{tag_text('PixelData')} has {len(data)} bytes, expected {expectation}")
    syntax = getattr(getattr(dataset, "file_meta", None), "TransferSyntaxUID", None)
    if syntax is None:
        raise element_fault(file, "TransferSyntaxUID", None, "that of the pixel data")
    with reading(file, "Transfer Syntax UID (0002,0010) cannot be read"):
        uid = UID(str(syntax))
        name = uid.name
    _require_codestream_size(header, dataset, uid)
    with reading(
        file,
        f"{tag_text('PixelData')} cannot be decoded: {len(data)} bytes in transfer syntax {name} (0002,0010), "
        "expected a whole image in one that can be decoded here",
    ):
        stored = decoded(dataset) if uid.is_encapsulated else np.asarray(dataset.pixel_array)
    if stored.shape != (header.rows, header.columns):
        raise DicomError(
            file,
            f"{tag_text('PixelData')} decodes to an image of shape {stored.shape}, "
            f"expected {(header.rows, header.columns)}",
        )
    return _without_unused_bits(stored, bits, signed)


def _require_codestream_size(header: SliceHeader, dataset: pydicom.Dataset, syntax: UID) -> None:
    """A decoder follows the size in the compressed image, whatever the object states."""
    with reading(header.path, f"{tag_text('TransferSyntaxUID')} is {syntax}, expected one of images"):
        if not syntax.is_encapsulated:
            return
    with reading(header.path, f"{tag_text('PixelData')} cannot be decoded"):
        codestream = single_frame(dataset)
        if syntax == RLELossless:
            return require_rle_size(codestream, header.rows * header.columns)
        size = size_of(codestream)
    if size != CodestreamSize(header.rows, header.columns, 1):
        raise DicomError(
            header.path,
            f"{tag_text('PixelData')} holds an image of {size}, expected {header.rows} rows, "
            f"{header.columns} columns and one component",
        )


def _without_unused_bits(stored: NDArray[Any], bits: int, signed: bool) -> NDArray[Any]:
    """Values of `bits` bits: higher bits (overlays, in old files) removed, the sign extended."""
    unused = 8 * stored.dtype.itemsize - bits
    if unused <= 0:
        return stored
    # Values of a big-endian file keep that order; viewed as native integers, they would be other values.
    stored = stored.astype(stored.dtype.newbyteorder("="), copy=False)
    integer = stored.view(np.dtype(f"{'i' if signed else 'u'}{stored.dtype.itemsize}"))
    clean: NDArray[Any] = (integer << unused) >> unused
    return clean


def _padding(file: Path, dataset: pydicom.Dataset, stored: NDArray[Any]) -> NDArray[np.bool_] | None:
    """Which pixels are padding (PixelPaddingValue, with its range limit), or None where none can be."""
    if element_value(file, dataset, "PixelPaddingValue") is None:
        return None
    limits = [_padding_value(file, dataset, "PixelPaddingValue")]
    if element_value(file, dataset, "PixelPaddingRangeLimit") is not None:
        limits.append(_padding_value(file, dataset, "PixelPaddingRangeLimit"))
    return (stored >= min(limits)) & (stored <= max(limits))


def _padding_value(file: Path, dataset: pydicom.Dataset, keyword: str) -> int:
    """The element's value as a stored one: signed or not as the pixels are, and within the bits that count.

    Many scanners write the padding of signed pixels as an unsigned number of 16 bits, whichever number of bits the
    pixels have: -2000 as 63536 (0xF830).
    """
    value = element_integer(file, dataset, keyword, -(2**31), 2**32 - 1)
    signed = int(dataset.PixelRepresentation) == 1
    value = _wrapped(value, 16, signed) if -(2**15) <= value < 2**16 else value
    allocated, bits = int(dataset.BitsAllocated), int(dataset.BitsStored)
    # No pixel has what does not fit into it.
    return _wrapped(value, bits, signed) if -(2 ** (allocated - 1)) <= value < 2**allocated else value


def _wrapped(value: int, bits: int, signed: bool) -> int:
    """The lowest bits of a number, read as a signed or an unsigned one."""
    count: int = 1 << bits
    lowest = value % count
    return lowest - count if signed and 2 * lowest >= count else lowest
