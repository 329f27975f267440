"""The real images as the tests use them: what each shows, and how its threshold and standing were chosen."""

from __future__ import annotations

import pytest

from stereoreg_ros.dicom import DicomSlice, read_series, read_slice
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.options import RegistrationOptions
from support.dicom_files import CATPHAN, SHARED_DATA, real
from support.real_rows import Figures, rows_of, run
from support.real_scenes import series_at

# The box as it was mounted: its z axis against the slice normal, its y axis up the picture. Two plates leave the tilt
# weak, so that the frame's origin is known to several millimetres only, which the default does not allow.
LEKSELL_OPTIONS = RegistrationOptions(
    threshold=1000.0, nominal_orientation=(1.0, 0.0, 0.0, 0.0), max_rotation_deg=30.0, max_target_error_mm=15.0
)
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


def leksell9() -> tuple[tuple[str, Slice], ...]:
    """A quarter of the series of the Leksell frame with three plates, 51 slices by name, in table order."""
    return series_at(real(SHARED_DATA / "leksell9_ct"))


def catphan_second() -> tuple[tuple[str, Slice], ...]:
    """The scan of the second CatPhan, 14 slices by name, in table order."""
    return series_at(real(SHARED_DATA / "catphan_second"))


def row_of(name: str, most: int | None = None) -> Figures:
    """A row of `benchmarks.real_frames`, at most so many of its scenes; prints what came of it."""
    row = next(row for row in rows_of() if row.name == name)
    figures = run(row, most)
    if figures.absent:
        pytest.skip(figures.absent)
    for one in figures.attempts:
        print(one)
    return figures


def height(one: DicomSlice) -> float:
    """Table position of a slice, mm."""
    return float(one.ct_slice.scanner_from_slice.translation[2])


def shows_module(one: DicomSlice) -> bool:
    """Whether a slice of the CatPhan shows the CTP404 module."""
    return CATPHAN_MODULE[0] < height(one) < CATPHAN_MODULE[1]
