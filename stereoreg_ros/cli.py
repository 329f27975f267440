"""`stereoreg`: what the node does, from the shell and without ROS."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final, NoReturn, TextIO, TypeVar

import cv2
import numpy as np
from tqdm import tqdm

from stereoreg_ros.calibration import Calibration
from stereoreg_ros.calibration_series import SeriesScale, scale_of_series
from stereoreg_ros.dicom import DicomError, read_series, read_slice
from stereoreg_ros.drawing import draw_overlay
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import FrameFileError, load_frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions
from stereoreg_ros.registration import register_slice
from stereoreg_ros.result import Match, PoseEstimate, Refusal, Registration, diagnostics

OK: Final = 0
BAD_FILE: Final = 1
WRONG_CALL: Final = 2
INTERRUPTED: Final = 130

_NAME_WIDTH: Final = 32
_TABLE_HEAD: Final = f"{'slice':{_NAME_WIDTH}}  {'outcome':13}  {'rods':>8}  {'residual':>9}  position in the scanner"


class WrongCallError(Exception):
    """The command cannot be carried out as it was given; the text is one sentence."""


class _Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one sentence."""

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_CALL, f"{self.prog}: {message}\n")


_Options = TypeVar("_Options", RegistrationOptions, CalibrationOptions)


@dataclass(frozen=True, eq=False)
class _Registered:
    """A slice that was read: its pixels and what came of them."""

    path: Path
    ct_slice: Slice
    result: Registration | Refusal
    duration_s: float


@dataclass(frozen=True, eq=False)
class _Unreadable:
    """A file or folder that could not be read, and why."""

    path: Path
    message: str


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code: 0, 1 where a file could not be read or written, 2 for a wrong call."""
    given = sys.argv[1:] if arguments is None else arguments
    parsed = _parser().parse_args([_shielded(argument) for argument in given])
    try:
        code: int = parsed.command(parsed)
    except WrongCallError as error:
        _complain(str(error))
        return WRONG_CALL
    except BrokenPipeError:
        # Whoever read the output has seen enough. What is still buffered must not fail again at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BAD_FILE
    except OSError as error:
        _complain(str(error))
        return BAD_FILE
    except KeyboardInterrupt:
        return INTERRUPTED
    return code


def _parser() -> _Parser:
    parser = _Parser(
        prog="stereoreg",
        description="Registers a stereotactic frame to a CT scanner from one slice through its straight rods.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"stereoreg {_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    _add_register(commands)
    _add_calibrate(commands)
    _add_reproduce(commands)
    return parser


def _version() -> str:
    try:
        return version("stereoreg_ros")
    except PackageNotFoundError:
        return "(not installed)"


def _shielded(argument: str) -> str:
    """A negative number that argparse cannot mistake for an option, as it does with -1e-3 before Python 3.14."""
    try:
        float(argument)
    except ValueError:
        return argument
    return f" {argument}"


def _complain(sentence: str) -> None:
    _write(f"stereoreg: {sentence}", sys.stderr)


def _print(line: str) -> None:
    _write(line, sys.stdout)


def _write(line: str, stream: TextIO) -> None:
    """Write a line and draw the progress bar anew below it, if there is one."""
    # File names need not be text, nor text that the terminal can show.
    encoding = stream.encoding or "utf-8"
    tqdm.write(line.encode(encoding, errors="replace").decode(encoding), file=stream)
    stream.flush()


def _add_register(commands: argparse._SubParsersAction[_Parser]) -> None:
    register = commands.add_parser(
        "register",
        help="find the pose of a frame in DICOM slices",
        description="Finds the pose of a frame in each DICOM slice by itself. A slice without a pose that may be "
        "believed is refused with the reason; that is no error.",
        allow_abbrev=False,
    )
    register.add_argument("paths", metavar="PATH", nargs="+", type=Path, help="DICOM file, or folder with one series")
    register.add_argument("--frame", metavar="F", required=True, help="frame file, or name of a shipped frame")
    register.add_argument("--json", action="store_true", help="print one JSON object per slice, each on a line")
    register.add_argument("--overlay", metavar="DIR", type=Path, help="write a picture of each slice to this folder")
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
    _add_options(register.add_argument_group("registration"), RegistrationOptions)
    register.set_defaults(command=_register)


def _add_options(group: argparse._ArgumentGroup, options: type[RegistrationOptions | CalibrationOptions]) -> None:
    """A command-line option for every field."""
    for entry in fields(options):
        if isinstance(entry.default, bool):
            group.add_argument(
                f"--{entry.name.replace('_', '-')}",
                action="store_true",
                help=entry.metadata["description"].replace("%", "%%"),
            )
            continue
        default: Any = entry.default
        several = isinstance(default, tuple)
        kind = type(default[0] if several else default)
        word = entry.metadata["word"]
        shown = " ".join(f"{value:g}" for value in default) if several else default
        group.add_argument(
            f"--{entry.name.replace('_', '-')}",
            metavar="NAME" if kind is str else "N",
            nargs=len(default) if several else None,
            type=kind if word is None else _number_or(word),
            default=default,
            help=f"{entry.metadata['description']} (default: {shown})".replace("%", "%%"),
        )


def _number_or(word: str) -> Callable[[str], float | str]:
    """What reads a number or the word."""

    def read(text: str) -> float | str:
        return word if text.strip() == word else float(text)

    read.__name__ = "float"  # as argparse names it where it can be read as neither
    return read


def _given(options: type[_Options], arguments: argparse.Namespace) -> _Options:
    """The options as given on the command line; ValueError where one is out of its range."""
    return options(**{entry.name: getattr(arguments, entry.name) for entry in fields(options)})


def _register(arguments: argparse.Namespace) -> int:
    """`stereoreg register`."""
    try:
        frame = load_frame(arguments.frame)
        options = _given(RegistrationOptions, arguments)
        # A scale for nothing but the check, where the spacing is the file's.
        sx, sy = arguments.pixel_spacing or (1.0, 1.0)
        own_scale = PixelScale(sx, sy, arguments.pixel_shear)
    except (FrameFileError, ValueError) as error:
        raise WrongCallError(str(error)) from None
    pictures = _Pictures(arguments.overlay) if arguments.overlay is not None else None
    if not arguments.json:
        _print(_TABLE_HEAD)
    outcomes: Counter[str] = Counter()
    for path, ct_slice in _slices(arguments.paths):
        if isinstance(ct_slice, DicomError):
            outcome: _Registered | _Unreadable = _Unreadable(path, str(ct_slice))
            _complain(str(ct_slice))
        else:
            scale = own_scale if arguments.pixel_spacing else replace(ct_slice.scale, shear=own_scale.shear)
            outcome = _timed(path, replace(ct_slice, scale=scale), frame, options)
        _print(json.dumps(_record(outcome, frame), allow_nan=False) if arguments.json else _table_line(outcome))
        outcomes[_word(outcome)] += 1
        if pictures is not None and isinstance(outcome, _Registered):
            pictures.write(outcome)
    if not arguments.json:
        _print(_summary(outcomes))
    return BAD_FILE if outcomes["bad_image"] else OK


def _timed(path: Path, ct_slice: Slice, frame: Frame, options: RegistrationOptions) -> _Registered:
    begin = time.perf_counter()
    result = register_slice(ct_slice, frame, options)
    return _Registered(path, ct_slice, result, time.perf_counter() - begin)


def _slices(paths: Sequence[Path]) -> Iterator[tuple[Path, Slice | DicomError]]:
    """Every slice of every path, read when it is its turn; in place of one that cannot be read, why."""
    for path in paths:
        faults: list[DicomError] = []
        try:
            series = read_series(path, faults.append)
        except DicomError as error:
            faults.append(error)
        else:
            for skipped in series.skipped:
                _complain(f"skipped {skipped.path}: {skipped.what}")
            watched = len(series) > 1 and sys.stderr.isatty()
            bar = tqdm(series.headers, desc=path.name, unit="slice", leave=False, disable=not watched, file=sys.stderr)
            for header in bar:
                try:
                    yield header.path, read_slice(header.path).ct_slice
                except DicomError as error:
                    yield header.path, error
        for fault in faults:
            yield fault.path, fault


def _word(outcome: _Registered | _Unreadable) -> str:
    """`accepted`, or the reason of the refusal."""
    if isinstance(outcome, _Unreadable):
        return "bad_image"
    return "accepted" if outcome.result else outcome.result.reason


def _record(outcome: _Registered | _Unreadable, frame: Frame) -> dict[str, Any]:
    """The JSON object of one slice: the same keys for every outcome, null for a number that does not exist."""
    record: dict[str, Any] = {"file": str(outcome.path)}
    if isinstance(outcome, _Unreadable):
        nothing = Refusal(frame, PixelScale(1.0, 1.0), np.empty((0, 2)), "bad_image", outcome.message)
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
    record["scanner_from_frame"] = _pose_record(result.scanner_from_frame) if result else None
    record["matches"] = [_match_record(match) for match in result.matches] if result else []
    if not result and result.reason == "ambiguous":
        record["alternatives"] = [_alternative_record(estimate) for estimate in result.estimates]
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in record.items()
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
    if len(name) > _NAME_WIDTH:
        name = "..." + name[3 - _NAME_WIDTH :]
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
            last = f"{x:.1f}, {y:.1f}, {z:.1f} mm" + (f"; {result.caution}" if result.caution else "")
        else:
            last = result.message
    return f"{name:{_NAME_WIDTH}}  {_word(outcome):13}  {rods:>8}  {residual:>9}  {last}"


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


def _add_calibrate(commands: argparse._SubParsersAction[_Parser]) -> None:
    calibrate = commands.add_parser(
        "calibrate",
        help="measure the pixel spacing from DICOM slices that show a frame",
        description="Measures the pixel spacing from all slices together, with a pose for each, and from each slice "
        "alone, beside what the files say.",
        allow_abbrev=False,
    )
    calibrate.add_argument("paths", metavar="PATH", nargs="+", type=Path, help="DICOM file, or folder with one series")
    calibrate.add_argument("--frame", metavar="F", required=True, help="frame file, or name of a shipped frame")
    calibrate.add_argument("--json", action="store_true", help="print one JSON object")
    calibrate.add_argument("--plot", metavar="FILE", type=Path, help="write a picture of the scale slice by slice, PNG")
    _add_options(calibrate.add_argument_group("calibration"), CalibrationOptions)
    _add_options(calibrate.add_argument_group("registration"), RegistrationOptions)
    calibrate.set_defaults(command=_calibrate)


def _calibrate(arguments: argparse.Namespace) -> int:
    """`stereoreg calibrate`."""
    try:
        frame = load_frame(arguments.frame)
        options, calibration = _given(RegistrationOptions, arguments), _given(CalibrationOptions, arguments)
    except (FrameFileError, ValueError) as error:
        raise WrongCallError(str(error)) from None
    unreadable = 0

    def readable() -> Iterator[tuple[str, Slice]]:
        nonlocal unreadable
        for path, ct_slice in _slices(arguments.paths):
            if isinstance(ct_slice, DicomError):
                unreadable += 1
                _complain(str(ct_slice))
            else:
                yield path.name, ct_slice

    with tqdm(total=1.0, desc="scales tried", leave=False, disable=not sys.stderr.isatty(), file=sys.stderr) as bar:
        try:
            series = scale_of_series(
                readable(), frame, options, calibration, lambda share: bar.update(max(share - bar.n, 0.0))
            )
        except ValueError as error:
            _complain(str(error))
            return BAD_FILE
    if arguments.plot is not None:
        try:
            # Only here: nothing else in the package needs matplotlib.
            from stereoreg_ros.calibration_plot import draw_series_scale
        except ModuleNotFoundError:
            raise WrongCallError(
                "--plot draws with matplotlib, which is not installed; it is python3-matplotlib in Ubuntu"
            ) from None
        draw_series_scale(series, arguments.plot)
    if arguments.json:
        _print(json.dumps(_series_record(series), allow_nan=False))
    else:
        _print_series(series)
    return BAD_FILE if unreadable else OK


def _series_record(series: SeriesScale) -> dict[str, Any]:
    """The JSON object of a series; null for what was not found."""
    outcome = series.outcome
    found = outcome if isinstance(outcome, Calibration) else None
    return {
        "outcome": "accepted" if found else "refused",
        "message": outcome.message,
        "given_pixel_spacing": [series.given.sx, series.given.sy],
        "pixel_spacing": [found.scale.sx, found.scale.sy] if found else None,
        "pixel_shear": found.scale.shear if found else None,
        "standard_errors": list(found.standard_errors) if found else None,
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
    _print(f"{'slice':{_NAME_WIDTH}}  rods  linear sx, sy     Newton-Raphson sx, sy               beside the files' /%")
    for one in series.slices:
        found, (error_x, error_y) = one.newton_raphson, one.standard_errors
        _print(
            f"{one.name[-_NAME_WIDTH:]:{_NAME_WIDTH}}  {one.rods:4d}  {one.linear.sx:.4f}, {one.linear.sy:.4f}    "
            f"{found.sx:.4f} +- {error_x:.4f}, {found.sy:.4f} +- {error_y:.4f}    "
            f"{100 * (found.sx / given.sx - 1):+.2f}, {100 * (found.sy / given.sy - 1):+.2f}"
        )
    _print(series.outcome.message)


def _add_reproduce(commands: argparse._SubParsersAction[_Parser]) -> None:
    reproduce = commands.add_parser(
        "reproduce",
        help="repeat the results section of Maurin 2009, simulated",
        description="Repeats section 6 of Maurin 2009 with simulated data and writes a report (report.md, PNG, CSV) "
        "that puts the paper's figures beside ours. The full run takes about a quarter of an hour.",
        allow_abbrev=False,
    )
    reproduce.add_argument(
        "--output", metavar="DIR", type=Path, required=True, help="folder for the report, made where it is missing"
    )
    reproduce.add_argument("--quick", action="store_true", help="fewer poses and levels: done within two minutes")
    reproduce.add_argument("--seed", metavar="N", type=int, default=0, help="seed of everything random (default: 0)")
    reproduce.set_defaults(command=_reproduce)


def _reproduce(arguments: argparse.Namespace) -> int:
    """`stereoreg reproduce`."""
    if arguments.seed < 0:
        raise WrongCallError(f"--seed is {arguments.seed}, expected 0 or more")
    try:
        # Only here: nothing else in the package needs matplotlib.
        from stereoreg_ros.reproduction.run import reproduce
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.split(".")[0] != "matplotlib":
            raise
        raise WrongCallError(
            "reproduce draws plots with matplotlib, which is not installed; it is python3-matplotlib in Ubuntu"
        ) from None
    from stereoreg_ros.reproduction.effort import FULL, QUICK

    _make_folder("--output", arguments.output)
    report = reproduce(arguments.output, QUICK if arguments.quick else FULL, arguments.seed)
    _print(str(report))
    return OK


def _make_folder(option: str, folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WrongCallError(f"{option}: {folder} cannot be made a folder: {error.strerror}") from None


class _Pictures:
    """Writes overlays to a folder, which is made; each under a name of its own."""

    def __init__(self, folder: Path) -> None:
        _make_folder("--overlay", folder)
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
        # Not by imwrite, which tells of a full disk or a missing right by nothing but False.
        (self._folder / f"{name}.png").write_bytes(content.tobytes())


if __name__ == "__main__":
    raise SystemExit(main())
