"""DICOM -> slices: pixels in HU, pixel scale, and where the plane lies in the patient axes (LPS, mm)."""

from stereoreg_ros.dicom.elements import DicomError
from stereoreg_ros.dicom.header import SliceHeader
from stereoreg_ros.dicom.image import DicomSlice, read_frames, read_slice
from stereoreg_ros.dicom.series import DicomSeries, Skipped, read_series

__all__ = [
    "DicomError",
    "DicomSeries",
    "DicomSlice",
    "Skipped",
    "SliceHeader",
    "read_frames",
    "read_series",
    "read_slice",
]
