"""`stereoreg inspect`: how well a frame can be registered."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Final

from stereoreg_ros.cli.output import print_line, progress_bar
from stereoreg_ros.cli.parsing import OK, Commands, WrongCallError, add_options, given
from stereoreg_ros.frames.inspection import Inspection, inspect_frame
from stereoreg_ros.frames.inspection_table import table_of
from stereoreg_ros.geometry.frame_file import FrameFileError, load_frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.options import RegistrationOptions

USED_OPTIONS: Final = (
    "spot_noise_px",
    "frame_tolerance_mm",
    "scale_tolerance",
    "slice_thickness_mm",
    "min_inliers",
    "max_log10_false_alarms",
    "nominal_orientation",
    "max_rotation_deg",
    "target_in_frame_mm",
    "max_target_error_mm",
)


def add_to(commands: Commands) -> None:
    """Add the command."""
    inspect = commands.add_parser(
        "inspect",
        help="report how well a frame can be registered",
        description="Reports, over the slices that can cut a frame, which rods they show, what error to expect at the "
        "frame's origin and at a target, how often another pose explains them as well, and the frame's weak points.",
        allow_abbrev=False,
    )
    inspect.add_argument("--frame", metavar="F", required=True, help="frame file, or name of a shipped frame")
    inspect.add_argument("--json", action="store_true", help="print one JSON object")
    inspect.add_argument("--picture", metavar="FILE", type=Path, help="write a picture of rods and errors, PNG")
    add_slices(inspect.add_argument_group("slices"))
    add_options(inspect.add_argument_group("registration"), RegistrationOptions, USED_OPTIONS)
    inspect.set_defaults(command=_inspect)


def add_slices(group: argparse._ArgumentGroup) -> None:
    """Options of the slices, and of the random numbers."""
    group.add_argument(
        "--pixel-spacing",
        metavar=("SX", "SY"),
        nargs=2,
        type=float,
        default=(0.5, 0.5),
        help="pixel spacing between columns, between rows, mm/pixel (default: 0.5 0.5)",
    )
    group.add_argument(
        "--tilt", metavar="DEG", type=float, default=30.0, help="largest tilt of a slice, degrees (default: 30)"
    )
    group.add_argument("--poses", metavar="N", type=int, default=200, help="number of slices to inspect (default: 200)")
    group.add_argument("--seed", metavar="N", type=int, default=0, help="seed of everything random (default: 0)")


def inspected(arguments: argparse.Namespace, source: str | Path) -> Inspection:
    """Inspect a frame with the options of the command line; WrongCallError where they are invalid."""
    if arguments.seed < 0:
        raise WrongCallError(f"--seed is {arguments.seed}, expected 0 or more")
    if not 1 <= arguments.poses <= 100_000:
        raise WrongCallError(f"--poses is {arguments.poses}, expected 1 to 100000")
    try:
        frame = load_frame(source)
        options = given(RegistrationOptions, arguments, USED_OPTIONS)
        scale = PixelScale(*arguments.pixel_spacing)
        with progress_bar(f"inspecting {frame.name}") as report:
            return inspect_frame(frame, options, scale, arguments.tilt, arguments.poses, arguments.seed, report)
    except (FrameFileError, ValueError) as error:
        raise WrongCallError(str(error)) from None


def draw(inspection: Inspection, path: Path) -> None:
    """Write the picture; WrongCallError where matplotlib is missing."""
    try:
        # Imported only here: without a picture, matplotlib is not needed.
        from stereoreg_ros.frames.inspection_plot import draw_inspection
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.split(".")[0] not in ("matplotlib", "mpl_toolkits"):
            raise
        raise WrongCallError(
            "--picture draws with matplotlib, which is not installed; it is python3-matplotlib in Ubuntu"
        ) from None
    draw_inspection(inspection, path)


def _inspect(arguments: argparse.Namespace) -> int:
    """`stereoreg inspect`."""
    inspection = inspected(arguments, arguments.frame)
    if arguments.picture is not None:
        draw(inspection, arguments.picture)
    if arguments.json:
        print_line(json.dumps(inspection.record(), allow_nan=False))
    else:
        for line in table_of(inspection):
            print_line(line)
    return OK
