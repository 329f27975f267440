"""Data set -> what an image states besides its pixels: size, pixel scale, plane in patient axes (LPS, mm), rescale."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pydicom
from pydicom.uid import UID

from stereoreg_ros.dicom.elements import (
    DicomError,
    element_fault,
    element_integer,
    element_numbers,
    element_value,
    reading,
    tag_text,
)
from stereoreg_ros.dicom.scan_slice import require_scan_slice
from stereoreg_ros.geometry.pose import Pose, nearest_rotation
from stereoreg_ros.geometry.slice import PixelScale

MAX_SIDE_PX: Final = 8192
# How far axes may be from unit vectors at a right angle, and from those of the other slices of a series.
AXES_TOLERANCE: Final = 1e-3
_MONOCHROME: Final = ("MONOCHROME2", "MONOCHROME1")


@dataclass(frozen=True, eq=False)
class SliceHeader:
    """What a DICOM image states besides its pixels.

    path: the file. scale: mm/pixel. scanner_from_slice: plane of the slice in patient axes (LPS), mm; has_plane:
    false where the slice's own axes were asked for, and the pose is the identity, whatever the file says.
    rescale_slope, rescale_intercept: HU = stored value * slope + intercept. frame_of_reference_uid: of the axes, empty
    where the file has none.
    """

    path: Path
    series_uid: str
    instance_number: int | None
    rows: int
    columns: int
    scale: PixelScale
    scanner_from_slice: Pose
    has_plane: bool
    rescale_slope: float
    rescale_intercept: float
    frame_of_reference_uid: str = ""

    @property
    def table_position_mm(self) -> float:
        """Position of the slice along its normal, mm; 0 without a plane."""
        return float(self.scanner_from_slice.rotation[:, 2] @ self.scanner_from_slice.translation)


def read_header(file: Path, dataset: pydicom.Dataset, *, slice_axes: bool = False) -> SliceHeader:
    """The header of an image of one grey frame; raises DicomError.

    slice_axes: take any image for a slice, in its own axes; without, it must be a slice of a scan that says where it
    lies (`require_scan_slice`).
    """
    what = not_image(file, dataset)
    if what is not None:
        raise element_fault(file, "SOPClassUID", what, "a class of images", quoted=False)
    _require_one_grey_frame(file, dataset)
    if not slice_axes:
        require_scan_slice(file, dataset)
    rows, columns = (element_integer(file, dataset, keyword, 1, MAX_SIDE_PX) for keyword in ("Rows", "Columns"))
    scanner_from_slice = Pose.identity() if slice_axes else _read_plane(file, dataset)
    series_uid = element_value(file, dataset, "SeriesInstanceUID")
    if series_uid is None:
        raise element_fault(file, "SeriesInstanceUID", None, "the UID of the series")
    slope, intercept = _read_rescale(file, dataset)
    number = None
    if element_value(file, dataset, "InstanceNumber") is not None:
        number = element_integer(file, dataset, "InstanceNumber", -(2**31), 2**31 - 1)
    return SliceHeader(
        path=file,
        series_uid=str(series_uid),
        instance_number=number,
        rows=rows,
        columns=columns,
        scale=_read_scale(file, dataset),
        scanner_from_slice=scanner_from_slice,
        has_plane=not slice_axes,
        rescale_slope=slope,
        rescale_intercept=intercept,
        frame_of_reference_uid=str(element_value(file, dataset, "FrameOfReferenceUID") or ""),
    )


def not_image(file: Path, dataset: pydicom.Dataset) -> str | None:
    """The name of the object's class where that is not a class of images, else None."""
    uid = element_value(file, dataset, "SOPClassUID")
    if uid is None:
        # A DICOMDIR, or an object from a careless writer: an image if it has rows and columns.
        return None if "Rows" in dataset and "Columns" in dataset else "no image, and no SOP Class UID (0008,0016)"
    with reading(file, f"{tag_text('SOPClassUID')} cannot be read"):
        name = UID(str(uid)).name
    known = name != str(uid)
    if "Image Storage" in name or (not known and "Rows" in dataset and "Columns" in dataset):
        return None
    return name


def _require_one_grey_frame(file: Path, dataset: pydicom.Dataset) -> None:
    element_integer(file, dataset, "SamplesPerPixel", 1, 1)
    if element_value(file, dataset, "NumberOfFrames") is not None:
        element_integer(file, dataset, "NumberOfFrames", 1, 1)
    photometric = element_value(file, dataset, "PhotometricInterpretation")
    if photometric not in _MONOCHROME:
        raise element_fault(file, "PhotometricInterpretation", photometric, " or ".join(_MONOCHROME))


def _read_scale(file: Path, dataset: pydicom.Dataset) -> PixelScale:
    between_rows, between_columns = element_numbers(file, dataset, "PixelSpacing", 2)
    try:
        return PixelScale(sx=between_columns, sy=between_rows)
    except ValueError:
        raise element_fault(
            file, "PixelSpacing", [between_rows, between_columns], "two positive numbers of mm"
        ) from None


def _read_plane(file: Path, dataset: pydicom.Dataset) -> Pose:
    """scanner_from_slice."""
    position = np.array(element_numbers(file, dataset, "ImagePositionPatient", 3))
    cosines = element_numbers(file, dataset, "ImageOrientationPatient", 6)
    x, y = np.array(cosines).reshape(2, 3)
    faults = [abs(np.linalg.norm(x) - 1), abs(np.linalg.norm(y) - 1), abs(x @ y)]
    if max(faults) > AXES_TOLERANCE:
        raise element_fault(file, "ImageOrientationPatient", cosines, "two unit vectors at a right angle")
    return Pose(nearest_rotation(np.column_stack([x, y, np.cross(x, y)])), position)


def _read_rescale(file: Path, dataset: pydicom.Dataset) -> tuple[float, float]:
    """Slope and intercept of HU; 1 and 0 where the object has neither, as in MR."""
    if "ModalityLUTSequence" in dataset:
        raise DicomError(
            file, f"{tag_text('ModalityLUTSequence')} is a table, expected {tag_text('RescaleSlope')} and intercept"
        )
    keywords = ("RescaleSlope", "RescaleIntercept")
    if all(element_value(file, dataset, keyword) is None for keyword in keywords):
        return 1.0, 0.0
    slope, intercept = (element_numbers(file, dataset, keyword, 1)[0] for keyword in keywords)
    if slope <= 0:
        raise element_fault(file, "RescaleSlope", slope, "a positive number")
    return slope, intercept
