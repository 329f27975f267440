"""`stereoreg register`: a pose or a refusal for each DICOM slice."""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from stereoreg_ros.cli.output import NAME_WIDTH, complain, print_line
from stereoreg_ros.cli.parsing import BAD_FILE, OK, Commands, WrongCallError, add_options, given, make_folder
from stereoreg_ros.cli.series import add_series_and_frame, slices_of
from stereoreg_ros.dicom import DicomError
from stereoreg_ros.drawing import draw_overlay
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import FrameFileError, load_frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.registration import register_slice
from stereoreg_ros.result import Match, PoseEstimate, Refusal, Registration, diagnostics
from stereoreg_ros.worst_case import WorstCase, worst_case

_TABLE_HEAD: Final = f"{'slice':{NAME_WIDTH}}  {'outcome':13}  {'rods':>8}  {'residual':>9}  position in "
_SCANNER: Final = "the scanner"
_SLICE: Final = "the slice's own axes"
_LARGEST_SPOT_ERROR_PX: Final = 10.0


@dataclass(frozen=True, eq=False)
class _Registered:
    """A slice that was read, and its result."""

    path: Path
    ct_slice: Slice
    result: Registration | Refusal
    duration_s: float
    max_spot_error_px: float | None
    worst: WorstCase | None


@dataclass(frozen=True, eq=False)
class _Unreadable:
    """A file or folder that could not be read, and why."""

    path: Path
    message: str


def add_to(commands: Commands) -> None:
    """Add the command."""
    register = commands.add_parser(
        "register",
        help="find the pose of a frame in DICOM slices",
        description="Finds the pose of a frame in each DICOM slice by itself. A slice whose pose cannot be trusted is "
        "refused with a reason; the exit code is 0 all the same.",
        allow_abbrev=False,
    )
    add_series_and_frame(register)
    register.add_argument("--json", action="store_true", help="print one JSON object per slice, each on a line")
    register.add_argument(
        "--overlay", metavar="DIR", type=Path, help="write an annotated picture of each slice to this folder"
    )
    register.add_argument(
        "--max-spot-error",
        metavar="PX",
        type=float,
        help="also bound the errors of the pose and at the target, if no spot coordinate is off by more, pixel",
    )
    scale = register.add_argument_group("pixel scale")
    scale.add_argument(
        "--pixel-spacing",
        metavar=("SX", "SY"),
        nargs=2,
        type=float,
        help="pixel spacing between columns, between rows, mm/pixel (default: as in the DICOM file)",
    )
    scale.add_argument(
        "--pixel-shear", metavar="N", type=float, default=0.0, help="shear of the pixel grid, mm/pixel (default: 0)"
    )
    add_options(register.add_argument_group("registration"), RegistrationOptions)
    register.set_defaults(command=_register)


def _register(arguments: argparse.Namespace) -> int:
    """`stereoreg register`."""
    try:
        frame = load_frame(arguments.frame)
        options = given(RegistrationOptions, arguments)
        # Where the spacing is the file's, the scale serves only to check the shear.
        sx, sy = arguments.pixel_spacing or (1.0, 1.0)
        own_scale = PixelScale(sx, sy, arguments.pixel_shear)
        _check_spot_error(arguments.max_spot_error)
    except (FrameFileError, ValueError) as error:
        raise WrongCallError(str(error)) from None
    pictures = _Pictures(arguments.overlay) if arguments.overlay is not None else None
    if not arguments.json:
        print_line(_TABLE_HEAD + (_SLICE if arguments.slice_axes else _SCANNER))
    outcomes: Counter[str] = Counter()
    for path, ct_slice in slices_of(arguments.paths, slice_axes=arguments.slice_axes):
        if isinstance(ct_slice, DicomError):
            outcome: _Registered | _Unreadable = _Unreadable(path, str(ct_slice))
            complain(str(ct_slice))
        else:
            scale = own_scale if arguments.pixel_spacing else replace(ct_slice.scale, shear=own_scale.shear)
            outcome = _timed(path, replace(ct_slice, scale=scale), frame, options, arguments.max_spot_error)
        if arguments.json:
            print_line(json.dumps(_record(outcome, frame, slice_axes=arguments.slice_axes), allow_nan=False))
        else:
            print_line(_table_line(outcome))
        outcomes[_word(outcome)] += 1
        if pictures is not None and isinstance(outcome, _Registered):
            pictures.write(outcome)
    if not arguments.json:
        print_line(_summary(outcomes))
    return BAD_FILE if outcomes["bad_image"] else OK


def _check_spot_error(max_spot_error_px: float | None) -> None:
    if max_spot_error_px is not None and not 0 <= max_spot_error_px <= _LARGEST_SPOT_ERROR_PX:
        raise ValueError(
            f"max_spot_error is {max_spot_error_px!r}, expected a number from 0 to {_LARGEST_SPOT_ERROR_PX:g} pixel"
        )


def _timed(
    path: Path, ct_slice: Slice, frame: Frame, options: RegistrationOptions, max_spot_error_px: float | None
) -> _Registered:
    begin = time.perf_counter()
    result = register_slice(ct_slice, frame, options)
    duration_s = time.perf_counter() - begin
    worst = worst_case(result, max_spot_error_px) if result and max_spot_error_px is not None else None
    return _Registered(path, ct_slice, result, duration_s, max_spot_error_px, worst)


def _word(outcome: _Registered | _Unreadable) -> str:
    """`accepted`, or the reason of the refusal."""
    if isinstance(outcome, _Unreadable):
        return "bad_image"
    return "accepted" if outcome.result else outcome.result.reason


def _record(outcome: _Registered | _Unreadable, frame: Frame, *, slice_axes: bool) -> dict[str, Any]:
    """The JSON object of one slice: the same keys for every outcome, null for a number that does not exist."""
    record: dict[str, Any] = {"file": str(outcome.path)}
    if isinstance(outcome, _Unreadable):
        nothing = Refusal(frame, SliceSpots(np.empty((0, 2)), PixelScale(1.0, 1.0)), "bad_image", outcome.message)
        record |= diagnostics(nothing, "configured", 0.0)
        record |= {"pixel_spacing_x_mm": None, "pixel_spacing_y_mm": None, "message": outcome.message}
        result: Registration | Refusal = nothing
    else:
        result = outcome.result
        record |= diagnostics(result, "configured", outcome.duration_s)
        if not result:
            record["message"] = result.message
        elif result.caution:
            record["caution"] = result.caution
        if outcome.max_spot_error_px is not None:
            record |= _worst_record(outcome.worst)
    if slice_axes:
        record["axes"] = "slice"
    record["scanner_from_frame"] = _pose_record(result.scanner_from_frame) if result else None
    record["matches"] = [_match_record(match) for match in result.matches] if result else []
    if not result and result.reason == "ambiguous":
        record["alternatives"] = [_alternative_record(estimate) for estimate in result.estimates]
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in record.items()
    }


def _worst_record(worst: WorstCase | None) -> dict[str, Any]:
    """Bounds on the errors; null where there is no pose, or where none can be proven."""
    return {
        "worst_case_target_error_mm": worst.target_error_mm if worst else None,
        "worst_case_position_mm": worst.position_mm.tolist() if worst else None,
        "worst_case_rotation_deg": worst.rotation_deg.tolist() if worst else None,
    }


def _pose_record(pose: Pose) -> dict[str, list[float]]:
    return {"position_mm": pose.translation.tolist(), "quaternion_xyzw": pose.quaternion_xyzw.tolist()}


def _match_record(match: Match) -> dict[str, Any]:
    return {"line": match.line, "spot_px": match.spot_px.tolist(), "residual_mm": float(match.residual_mm)}


def _alternative_record(estimate: PoseEstimate) -> dict[str, Any]:
    return {
        "scanner_from_frame": _pose_record(estimate.scanner_from_frame),
        "inliers": estimate.inliers,
        "residual_rms_mm": estimate.residual_rms_mm,
    }


def _table_line(outcome: _Registered | _Unreadable) -> str:
    name = outcome.path.name
    if len(name) > NAME_WIDTH:
        name = "..." + name[3 - NAME_WIDTH :]
    rods, residual = "", ""
    if isinstance(outcome, _Unreadable):
        last = outcome.message
    else:
        result = outcome.result
        best = result.estimate if result else next(iter(result.estimates), None)
        if best is not None:
            rods, residual = f"{best.inliers} of {len(result.frame)}", f"{best.residual_rms_mm:.2f} mm"
        if result:
            x, y, z = result.scanner_from_frame.translation
            last = f"{x:.1f}, {y:.1f}, {z:.1f} mm"
            if outcome.max_spot_error_px is not None:
                last += f"; {_worst_words(outcome.max_spot_error_px, outcome.worst)}"
            last += f"; {result.caution}" if result.caution else ""
        else:
            last = result.message
    return f"{name:{NAME_WIDTH}}  {_word(outcome):13}  {rods:>8}  {residual:>9}  {last}"


def _worst_words(max_spot_error_px: float, worst: WorstCase | None) -> str:
    if worst is None:
        return f"no bound on the target error for spots {max_spot_error_px:g} pixel off"
    return f"target off by at most {worst.target_error_mm:.2f} mm"


def _summary(outcomes: Counter[str]) -> str:
    slices = outcomes.total() - outcomes["bad_image"]
    refused = {word: count for word, count in outcomes.most_common() if word not in ("accepted", "bad_image") and count}
    reasons = ", ".join(f"{count} {word}" for word, count in refused.items())
    summary = f"{outcomes['accepted']} of {slices} slices accepted, {sum(refused.values())} refused"
    if reasons:
        summary += f" ({reasons})"
    if outcomes["bad_image"]:
        summary += f", {outcomes['bad_image']} not readable"
    return summary


class _Pictures:
    """Writes overlays to a folder, which it creates, each under a name of its own."""

    def __init__(self, folder: Path) -> None:
        make_folder("--overlay", folder)
        self._folder = folder
        self._taken: set[str] = set()

    def write(self, registered: _Registered) -> None:
        """Write the picture of one slice as PNG; OSError where that fails."""
        stem = registered.path.stem
        name, number = stem, 1
        while name in self._taken:
            number += 1
            name = f"{stem}_{number}"
        self._taken.add(name)
        picture = draw_overlay(registered.ct_slice, registered.result)
        done, content = cv2.imencode(".png", picture)
        if not done:
            raise OSError(f"{name}.png: cannot be encoded")
        # Not by imwrite, which reports a full disk or a missing permission only by False.
        (self._folder / f"{name}.png").write_bytes(content.tobytes())
