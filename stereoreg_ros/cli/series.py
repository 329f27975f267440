"""The slices that a command is given, and the frame that it looks for in them."""

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
    """The arguments `paths` and `frame`."""
    parser.add_argument("paths", metavar="PATH", nargs="+", type=Path, help="DICOM file, or folder with one series")
    parser.add_argument("--frame", metavar="F", required=True, help="frame file, or name of a shipped frame")


def slices_of(paths: Sequence[Path]) -> Iterator[tuple[Path, Slice | DicomError]]:
    """Every slice of every path, read when it is its turn; in place of one that cannot be read, why."""
    for path in paths:
        faults: list[DicomError] = []
        try:
            series = read_series(path, faults.append)
        except DicomError as error:
            faults.append(error)
        else:
            for skipped in series.skipped:
                complain(f"skipped {skipped.path}: {skipped.what}")
            watched = len(series) > 1 and sys.stderr.isatty()
            bar = tqdm(series.headers, desc=path.name, unit="slice", leave=False, disable=not watched, file=sys.stderr)
            for header in bar:
                try:
                    yield header.path, read_slice(header.path).ct_slice
                except DicomError as error:
                    yield header.path, error
        for fault in faults:
            yield fault.path, fault
