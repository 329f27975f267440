"""The slices given to a command, and the frame that it looks for in them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from tqdm import tqdm

from stereoreg_ros.cli.output import complain
from stereoreg_ros.dicom import DicomError, read_series, read_slice
from stereoreg_ros.geometry.slice import Slice


def add_series_and_frame(parser: argparse.ArgumentParser) -> None:
    """The arguments `paths`, `frame` and `slice_axes`."""
    parser.add_argument("paths", metavar="PATH", nargs="+", type=Path, help="DICOM file, or folder with one series")
    parser.add_argument("--frame", metavar="F", required=True, help="frame file, or name of a shipped frame")
    parser.add_argument(
        "--slice-axes",
        action="store_true",
        help="take every image for a slice, also one without a plane, and work in its own axes, not the scanner's: "
        "origin at the centre of pixel (0, 0), x along a row, y down the rows",
    )


def slices_of(paths: Sequence[Path], *, slice_axes: bool) -> Iterator[tuple[Path, Slice | DicomError]]:
    """Every slice of every path, read one by one; in place of one that cannot be read, its fault.

    slice_axes: whether each is in its own axes, whatever its file says.
    """
    for path in paths:
        faults: list[DicomError] = []
        try:
            series = read_series(path, faults.append, slice_axes=slice_axes)
        except DicomError as error:
            faults.append(error)
        else:
            for skipped in series.skipped:
                complain(f"skipped {skipped.path}: {skipped.what}")
            watched = len(series) > 1 and sys.stderr.isatty()
            bar = tqdm(series.headers, desc=path.name, unit="slice", leave=False, disable=not watched, file=sys.stderr)
            for header in bar:
                try:
                    yield header.path, read_slice(header.path, slice_axes=slice_axes).ct_slice
                except DicomError as error:
                    yield header.path, error
        for fault in faults:
            yield fault.path, fault
