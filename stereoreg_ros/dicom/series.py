"""A folder of DICOM images -> the slices of one series, in table order."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from stereoreg_ros.dicom.dataset import FOLDER, not_dicom, read_dataset
from stereoreg_ros.dicom.elements import DicomError, element_fault
from stereoreg_ros.dicom.header import AXES_TOLERANCE, SliceHeader, not_image, read_header
from stereoreg_ros.dicom.image import DicomSlice, read_slice
from stereoreg_ros.geometry.pose import Array

_SAME_POSITION_MM: Final = 1e-3
_SAME_SPACING: Final = 1e-4


@dataclass(frozen=True)
class Skipped:
    """A file in a folder that is not a DICOM image, and what it is instead."""

    path: Path
    what: str


@dataclass(frozen=True, eq=False)
class DicomSeries:
    """The slices of one series in table order, which is along the normal of the slices.

    headers: of every slice; skipped: what else lies in the folder; slice_axes: whether each slice is in its own axes,
    and the order that of their instance numbers. Iteration reads the pixels, slice by slice.
    """

    headers: tuple[SliceHeader, ...]
    skipped: tuple[Skipped, ...] = ()
    slice_axes: bool = False

    def __len__(self) -> int:
        return len(self.headers)

    def __iter__(self) -> Iterator[DicomSlice]:
        return (read_slice(header.path, slice_axes=self.slice_axes) for header in self.headers)


def read_series(
    path: str | os.PathLike[str],
    on_fault: Callable[[DicomError], None] | None = None,
    *,
    slice_axes: bool = False,
) -> DicomSeries:
    """Read the headers of one series: a DICOM file, or a folder (without its subfolders).

    What is not an image (structure sets, plans, files that are not DICOM) is skipped and listed in the result.
    on_fault: called with the fault of each faulty image, which is then left out; by default the fault is raised.
    slice_axes: take every image for a slice in its own axes, as `read_slice` does, wherever it lies.
    Raises DicomError for a faulty image, and where the images are not one series of parallel slices.
    """
    folder = Path(path)
    if not_dicom(folder) != FOLDER:
        header = read_header(folder, read_dataset(folder, stop_before_pixels=True), slice_axes=slice_axes)
        return DicomSeries((header,), slice_axes=slice_axes)
    headers: list[SliceHeader] = []
    skipped: list[Skipped] = []
    faults = 0
    for file in _listed(folder):
        try:
            what = not_dicom(file)
            if what is None:
                dataset = read_dataset(file, stop_before_pixels=True)
                what = not_image(file, dataset)
                if what is None:
                    headers.append(read_header(file, dataset, slice_axes=slice_axes))
        except DicomError as fault:
            if on_fault is None:
                raise
            on_fault(fault)
            faults += 1
        else:
            if what is not None:
                skipped.append(Skipped(file, what))
    if not headers and not faults:
        raise DicomError(folder, f"holds no DICOM image among {len(skipped)} entries, expected a DICOM file or folder")
    _require_one_series(folder, headers)
    headers.sort(key=_order)
    if not slice_axes:
        _require_distinct(folder, headers)
    return DicomSeries(tuple(headers), tuple(skipped), slice_axes)


def _listed(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError as error:
        raise DicomError(folder, f"cannot be listed: {error.strerror}") from error


def _require_one_series(folder: Path, headers: list[SliceHeader]) -> None:
    counts = Counter(header.series_uid for header in headers)
    if len(counts) > 1:
        series = ", ".join(f"{uid} ({count} slices)" for uid, count in counts.most_common())
        raise DicomError(folder, f"holds {len(counts)} series, expected one (0020,000E): {series}")
    for header in headers:
        first = headers[0]
        turned = header.scanner_from_slice.rotation - first.scanner_from_slice.rotation
        if np.abs(turned).max() > AXES_TOLERANCE:
            raise _differs(header, first, "ImageOrientationPatient", _axes(header), _axes(first))
        spacing, first_spacing = ((h.scale.sy, h.scale.sx) for h in (header, first))
        if not np.allclose(spacing, first_spacing, rtol=_SAME_SPACING, atol=0.0):
            raise _differs(header, first, "PixelSpacing", np.array(spacing), np.array(first_spacing))


def _axes(header: SliceHeader) -> Array:
    return header.scanner_from_slice.rotation[:, :2].T.ravel()


def _differs(header: SliceHeader, first: SliceHeader, keyword: str, found: Array, expected: Array) -> DicomError:
    return element_fault(
        header.path, keyword, found.tolist(), f"{expected.tolist()} as in {first.path}, of the same series"
    )


def _order(header: SliceHeader) -> tuple[int, int]:
    """Table order; slices at the same table position, as in CT fluoroscopy, by instance number."""
    return round(header.table_position_mm / _SAME_POSITION_MM), header.instance_number or 0


def _require_distinct(folder: Path, headers: list[SliceHeader]) -> None:
    for header, following in pairwise(headers):
        if _order(header) == _order(following):
            raise DicomError(
                folder,
                f"{header.path.name} and {following.path.name} lie at the same position, "
                f"{header.table_position_mm:.3f} mm along their normal, and have the same instance number, "
                f"expected them to differ in one of the two (0020,0032; 0020,0013)",
            )
