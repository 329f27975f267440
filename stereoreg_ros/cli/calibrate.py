"""`stereoreg calibrate`: the pixel spacing from DICOM slices."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stereoreg_ros.calibration.calibrate import Calibration
from stereoreg_ros.calibration.series import SeriesScale, scale_of_series
from stereoreg_ros.cli.output import NAME_WIDTH, complain, print_line, progress_bar
from stereoreg_ros.cli.parsing import BAD_FILE, OK, Commands, WrongCallError, add_options, given
from stereoreg_ros.cli.series import add_series_and_frame, slices_of
from stereoreg_ros.dicom import DicomError
from stereoreg_ros.geometry.frame_file import FrameFileError, load_frame
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions


def add_to(commands: Commands) -> None:
    """Add the command."""
    calibrate = commands.add_parser(
        "calibrate",
        help="measure the pixel spacing from DICOM slices that show a frame",
        description="Measures the pixel spacing from all slices together, with a pose for each, and from each slice "
        "alone, and compares it with what the files say. In slices, a spacing that is too large looks the same as a "
        "frame that is too large.",
        allow_abbrev=False,
    )
    add_series_and_frame(calibrate)
    calibrate.add_argument("--json", action="store_true", help="print one JSON object")
    calibrate.add_argument(
        "--plot", metavar="FILE", type=Path, help="write a plot of the scale slice by slice to this PNG file"
    )
    add_options(calibrate.add_argument_group("calibration"), CalibrationOptions)
    add_options(calibrate.add_argument_group("registration"), RegistrationOptions)
    calibrate.set_defaults(command=_calibrate)


def _calibrate(arguments: argparse.Namespace) -> int:
    """`stereoreg calibrate`."""
    try:
        frame = load_frame(arguments.frame)
        options, calibration = given(RegistrationOptions, arguments), given(CalibrationOptions, arguments)
    except (FrameFileError, ValueError) as error:
        raise WrongCallError(str(error)) from None
    unreadable = 0

    def readable() -> Iterator[tuple[str, Slice]]:
        nonlocal unreadable
        for path, ct_slice in slices_of(arguments.paths, slice_axes=arguments.slice_axes):
            if isinstance(ct_slice, DicomError):
                unreadable += 1
                complain(str(ct_slice))
            else:
                yield path.name, ct_slice

    with progress_bar("scales tried") as report:
        try:
            series = scale_of_series(readable(), frame, options, calibration, report)
        except ValueError as error:
            complain(str(error))
            return BAD_FILE
    if arguments.plot is not None:
        try:
            # Imported only here: the rest of the command does not need matplotlib.
            from stereoreg_ros.calibration.plot import draw_series_scale
        except ModuleNotFoundError:
            raise WrongCallError(
                "--plot draws with matplotlib, which is not installed; it is python3-matplotlib in Ubuntu"
            ) from None
        draw_series_scale(series, arguments.plot)
    if arguments.json:
        print_line(json.dumps(_series_record(series), allow_nan=False))
    else:
        _print_series(series)
    return BAD_FILE if unreadable else OK


def _series_record(series: SeriesScale) -> dict[str, Any]:
    """The JSON object of a series; null for missing results."""
    outcome = series.outcome
    found = outcome if isinstance(outcome, Calibration) else None
    return {
        "outcome": "accepted" if found else "refused",
        "message": outcome.message,
        "given_pixel_spacing": [series.given.sx, series.given.sy],
        "pixel_spacing": [found.scale.sx, found.scale.sy] if found else None,
        "pixel_shear": found.scale.shear if found else None,
        "standard_errors": list(found.standard_errors) if found else None,
        "frame_errors": list(found.frame_errors) if found else None,
        "residual_before_px": found.residual_before_px if found else None,
        "residual_after_px": found.residual_after_px if found else None,
        "slices": [
            {
                "file": one.name,
                "rods": one.rods,
                "linear": [one.linear.sx, one.linear.sy],
                "newton_raphson": [one.newton_raphson.sx, one.newton_raphson.sy],
                "standard_errors": list(one.standard_errors),
            }
            for one in series.slices
        ],
    }


def _print_series(series: SeriesScale) -> None:
    given = series.given
    print_line(
        f"{'slice':{NAME_WIDTH}}  rods  linear sx, sy     Newton-Raphson sx, sy +- spot noise beside the files' /%"
    )
    for one in series.slices:
        found, (error_x, error_y) = one.newton_raphson, one.standard_errors
        print_line(
            f"{one.name[-NAME_WIDTH:]:{NAME_WIDTH}}  {one.rods:4d}  {one.linear.sx:.4f}, {one.linear.sy:.4f}    "
            f"{found.sx:.4f} +- {error_x:.4f}, {found.sy:.4f} +- {error_y:.4f}    "
            f"{100 * (found.sx / given.sx - 1):+.2f}, {100 * (found.sy / given.sy - 1):+.2f}"
        )
    print_line(series.outcome.message)
