"""One DICOM image -> slice, or every frame of an Enhanced CT image."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import pydicom
from pydicom.uid import CTImageStorage, EnhancedCTImageStorage

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


def read_slice(path: str | os.PathLike[str]) -> DicomSlice:
    """Read one DICOM image with its pixels; DicomError where that is not possible."""
    file = Path(path)
    dataset = read_dataset(file, stop_before_pixels=False)
    header = read_header(file, dataset)
    return DicomSlice(header, Slice(read_hu(header, dataset), header.scale, header.scanner_from_slice))


def read_frames(name: Path, content: bytes, max_bytes: int, uid: str = "") -> tuple[DicomSlice, ...]:
    """The slices of a DICOM object in memory, in the form of a file: one, or every frame of an Enhanced CT image.

    Meant for what arrives unasked, and stricter than `read_slice`: every slice must say where it lies, CT must say how
    values become HU, and projections (localizers) are no slices. name: stands for the object in errors.
    max_bytes: most that its data or its pixels may take when unpacked. uid: the SOP Instance UID that it was announced
    with; empty: none. Raises DicomError.
    """
    dataset = parsed(name, content, max_bytes)
    if uid and str(element_value(name, dataset, "SOPInstanceUID")) != uid:
        raise element_fault(
            name, "SOPInstanceUID", element_value(name, dataset, "SOPInstanceUID"), f"{uid}, as announced"
        )
    _require_decoded_size(name, dataset, max_bytes)
    _require_no_projection(name, dataset)
    frames = [dataset]
    if element_value(name, dataset, "SOPClassUID") == EnhancedCTImageStorage:
        with reading(name, "the frames of the Enhanced CT image cannot be told apart"):
            frames = single_frames(dataset)
    return tuple(_read_placed(name, frame) for frame in frames)


def _read_placed(name: Path, dataset: pydicom.Dataset) -> DicomSlice:
    header = read_header(name, dataset)
    if not header.has_plane:
        raise element_fault(name, "ImagePositionPatient", None, "the position of the slice")
    is_ct = element_value(name, dataset, "SOPClassUID") in (CTImageStorage, EnhancedCTImageStorage)
    if is_ct and element_value(name, dataset, "RescaleSlope") is None:
        raise element_fault(name, "RescaleSlope", None, "that of a CT image")
    return DicomSlice(header, Slice(read_hu(header, dataset), header.scale, header.scanner_from_slice))


def _require_decoded_size(name: Path, dataset: pydicom.Dataset, max_bytes: int) -> None:
    """Before anything is decoded: a small object may claim, and fill, a very large image."""
    rows, columns = (element_integer(name, dataset, keyword, 1, MAX_SIDE_PX) for keyword in ("Rows", "Columns"))
    allocated = element_integer(name, dataset, "BitsAllocated", 8, 32)
    frames = 1
    if element_value(name, dataset, "NumberOfFrames") is not None:
        frames = element_integer(name, dataset, "NumberOfFrames", 1, 2**31 - 1)
    size = rows * columns * frames * allocated // 8
    if size > max_bytes:
        raise DicomError(name, f"its pixels take {size} bytes, expected {max_bytes} at most")


def _require_no_projection(name: Path, dataset: pydicom.Dataset) -> None:
    image_type = element_value(name, dataset, "ImageType") or ()
    if "LOCALIZER" in image_type:
        raise element_fault(name, "ImageType", list(image_type), "a slice")
    volume = element_value(name, dataset, "VolumetricProperties")
    if volume not in (None, "VOLUME"):
        raise element_fault(name, "VolumetricProperties", volume, "VOLUME")
