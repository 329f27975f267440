"""The real images as the tests use them: what each shows, and how its threshold and standing were chosen."""

from __future__ import annotations

from dicom_files import CATPHAN, SHARED_DATA, real

from stereoreg_ros.dicom import DicomSlice, read_series, read_slice
from stereoreg_ros.options import RegistrationOptions

# The box as it was mounted: its z axis against the slice normal, its y axis up the picture.
LEKSELL_OPTIONS = RegistrationOptions(threshold=1000.0, nominal_orientation=(1.0, 0.0, 0.0, 0.0), max_rotation_deg=30.0)
ZFRAME_OPTIONS = RegistrationOptions(threshold=200.0, max_rotation_deg=30.0)
CATPHAN_OPTIONS = RegistrationOptions(threshold=300.0, max_rotation_deg=30.0)
# Heights of the slices, mm, that show the CTP404 module from one end of its wires to the other.
CATPHAN_MODULE = (-12.0, 9.5)


def leksell() -> DicomSlice:
    """The head phantom in the Leksell frame."""
    return read_slice(real(SHARED_DATA / "leksell_ct" / "slice.dcm"))


def zframe() -> list[DicomSlice]:
    """The MR volume of the Z-frame, 20 slices in table order."""
    return list(read_series(real(SHARED_DATA / "zframe_mr")))


def catphan() -> list[DicomSlice]:
    """The scan of the CatPhan, 64 slices in table order."""
    return list(read_series(real(CATPHAN)))


def height(one: DicomSlice) -> float:
    """Table position of a slice, mm."""
    return float(one.ct_slice.scanner_from_slice.translation[2])


def shows_module(one: DicomSlice) -> bool:
    """Whether a slice of the CatPhan shows the CTP404 module."""
    return CATPHAN_MODULE[0] < height(one) < CATPHAN_MODULE[1]
