"""The pixel scale slice by slice, by the paper's solutions, and from all slices together (Maurin 2009, fig. 10)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from stereoreg_ros.calibration.calibrate import calibrate
from stereoreg_ros.calibration.matching import match_slice
from stereoreg_ros.calibration.measured import MIN_LINES
from stereoreg_ros.calibration.outcome import Calibration, CalibrationRefusal
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions
from stereoreg_ros.solvers.arrangement import DegenerateArrangementError
from stereoreg_ros.solvers.calibration import calibrate_linear, calibrate_newton_raphson, calibration_covariance
from stereoreg_ros.spots import find_spots


@dataclass(frozen=True)
class SliceScale:
    """The scale from one slice alone.

    name: of the slice; rods: how many were identified; linear, newton_raphson: mm/pixel; standard_errors: of (sx, sy),
    mm/pixel, for the stated spot noise alone: what the frame is off by is the same in every slice.
    """

    name: str
    rods: int
    linear: PixelScale
    newton_raphson: PixelScale
    standard_errors: tuple[float, float]


@dataclass(frozen=True, eq=False)
class SeriesScale:
    """The scale of a series.

    given: as the files say, mm/pixel; outcome: from all slices together; slices: each by itself, where rods are enough.
    """

    given: PixelScale
    outcome: Calibration | CalibrationRefusal
    slices: tuple[SliceScale, ...]


def scale_of_series(
    slices: Iterable[tuple[str, Slice]],
    frame: Frame,
    options: RegistrationOptions,
    calibration: CalibrationOptions,
    progress: Callable[[float], bool] | None = None,
) -> SeriesScale:
    """Measure the scale from named slices of one spacing, which came with them as files say it.

    Raises ValueError where they have several spacings, or there is no slice.
    """
    named: list[tuple[str, SliceSpots]] = []
    given: PixelScale | None = None
    for name, ct_slice in slices:
        if given is not None and ct_slice.scale != given:
            raise ValueError(
                f"{name}: pixel spacing is ({ct_slice.scale.sx:g}, {ct_slice.scale.sy:g}) mm/pixel, "
                f"expected that of the slices before, ({given.sx:g}, {given.sy:g})"
            )
        given = ct_slice.scale
        spots = find_spots(ct_slice, options)
        if len(spots) >= MIN_LINES:
            named.append((name, replace(spots, stated_scale=ct_slice.scale)))
    if given is None:
        raise ValueError("there is no slice to calibrate from")
    outcome = calibrate([spots for _, spots in named], frame, given, options, calibration, progress)
    if not isinstance(outcome, Calibration):
        return SeriesScale(given, outcome, ())
    alone = (_alone(name, spots, frame, outcome.scale, options) for name, spots in named)
    return SeriesScale(given, outcome, tuple(one for one in alone if one is not None))


def _alone(
    name: str, spots: SliceSpots, frame: Frame, scale: PixelScale, options: RegistrationOptions
) -> SliceScale | None:
    result = match_slice(spots, frame, scale, options)
    if not result or len(result.matches) < MIN_LINES:
        return None
    lines = np.array([match.line_index for match in result.matches])
    spots_px = np.array([match.spot_px for match in result.matches])
    try:
        linear = calibrate_linear(frame, lines, spots_px)
        solution = calibrate_newton_raphson(frame, lines, spots_px)
    except DegenerateArrangementError:
        return None
    pose = solution.frame_from_slice.inverse()
    covariance = calibration_covariance(frame, lines, pose, solution.scale, options.spot_noise_px)
    errors = float(np.sqrt(covariance[0, 0])), float(np.sqrt(covariance[1, 1]))
    return SliceScale(name, len(lines), linear.scale, solution.scale, errors)
