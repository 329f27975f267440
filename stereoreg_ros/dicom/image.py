"""One DICOM image -> slice, or every frame of an Enhanced CT image."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import pydicom
from pydicom.uid import EnhancedCTImageStorage

from stereoreg_ros.dicom.dataset import parsed, read_dataset
from stereoreg_ros.dicom.elements import DicomError, element_fault, element_integer, element_value, reading
from stereoreg_ros.dicom.header import MAX_SIDE_PX, SliceHeader, read_header
from stereoreg_ros.dicom.multiframe import single_frames
from stereoreg_ros.dicom.pixels import read_hu
from stereoreg_ros.geometry.slice import Slice


@dataclass(frozen=True, eq=False)
class DicomSlice:
    """A DICOM image: its header, and its pixels in HU with scale and plane."""

    header: SliceHeader
    ct_slice: Slice


def read_slice(path: str | os.PathLike[str], *, slice_axes: bool = False) -> DicomSlice:
    """Read one DICOM image with its pixels; DicomError where that is not possible.

    slice_axes: take any image for a slice, in its own axes: origin at the centre of pixel (0, 0), x along a row, y down
    the rows. Without, it must be a slice of a scan that says where it lies.
    """
    file = Path(path)
    return _slice_of(file, read_dataset(file, stop_before_pixels=False), slice_axes=slice_axes)


def read_frames(name: Path, content: bytes, max_bytes: int, uid: str = "") -> tuple[DicomSlice, ...]:
    """The slices of a DICOM object in memory, in the form of a file: one, or every frame of an Enhanced CT image.

    Meant for what arrives unasked. name: stands for the object in errors. max_bytes: most that its data or its pixels
    may take when unpacked. uid: the SOP Instance UID that it was announced with; empty: none. Raises DicomError.
    """
    dataset = parsed(name, content, max_bytes)
    if uid and str(element_value(name, dataset, "SOPInstanceUID")) != uid:
        raise element_fault(
            name, "SOPInstanceUID", element_value(name, dataset, "SOPInstanceUID"), f"{uid}, as announced"
        )
    _require_decoded_size(name, dataset, max_bytes)
    frames = [dataset]
    if element_value(name, dataset, "SOPClassUID") == EnhancedCTImageStorage:
        with reading(name, "the frames of the Enhanced CT image cannot be separated"):
            frames = single_frames(dataset)
    return tuple(_slice_of(name, frame) for frame in frames)


def _slice_of(file: Path, dataset: pydicom.Dataset, *, slice_axes: bool = False) -> DicomSlice:
    header = read_header(file, dataset, slice_axes=slice_axes)
    return DicomSlice(header, Slice(read_hu(header, dataset), header.scale, header.scanner_from_slice))


def _require_decoded_size(name: Path, dataset: pydicom.Dataset, max_bytes: int) -> None:
    """Before anything is decoded: a small object may unpack to a very large image."""
    rows, columns = (element_integer(name, dataset, keyword, 1, MAX_SIDE_PX) for keyword in ("Rows", "Columns"))
    allocated = element_integer(name, dataset, "BitsAllocated", 8, 32)
    frames = 1
    if element_value(name, dataset, "NumberOfFrames") is not None:
        frames = element_integer(name, dataset, "NumberOfFrames", 1, 2**31 - 1)
    size = rows * columns * frames * allocated // 8
    if size > max_bytes:
        raise DicomError(name, f"its pixels take {size} bytes, expected {max_bytes} at most")
