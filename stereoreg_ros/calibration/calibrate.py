"""The scanner's pixel scale from the spots of several slices, accepted only if it can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from stereoreg_ros.calibration.judgement import judge
from stereoreg_ros.calibration.matching import match_slice
from stereoreg_ros.calibration.measured import MIN_LINES, Explained, measured_scale, why_degenerate
from stereoreg_ros.calibration.outcome import Calibration, CalibrationRefusal
from stereoreg_ros.calibration.scale_search import search_scales
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions
from stereoreg_ros.result import Registration

__all__ = ["Calibration", "CalibrationRefusal", "calibrate"]

# A scale with which fewer of the slices than this share are identified is not taken before others are tried.
_EXPLAINED = 0.8
_ROUNDS = 4


def calibrate(
    slices: Sequence[SliceSpots],
    frame: Frame,
    scale: PixelScale,
    options: RegistrationOptions | None = None,
    calibration: CalibrationOptions | None = None,
    progress: Callable[[float], bool] | None = None,
) -> Calibration | CalibrationRefusal:
    """One pixel scale from slices that show the frame, by joint maximum likelihood with a pose for each.

    scale: the one in use, mm/pixel; where it leaves slices unexplained, others are tried. What came with the slices
    themselves (`SliceSpots.stated_scale`) is known far better than what somebody typed in, and is changed by far less:
    see `CalibrationOptions.calibration_max_change`. The rods are where `frame` has them within their tolerances, those
    of the frame or `frame_tolerance_mm`; a frame of another size altogether looks like another scale. progress: called
    with the share of the scales that was tried, says whether to go on; where not, the calibration is refused.
    """
    options, calibration = options or RegistrationOptions(), calibration or CalibrationOptions()
    if not slices:
        return CalibrationRefusal("calibration refused: there is no slice to calibrate from")
    enough = [one for one in slices if len(one) >= max(MIN_LINES, options.min_inliers)]
    if not enough:
        return CalibrationRefusal(
            f"calibration refused: {MIN_LINES} rods are needed, and none of {len(slices)} slices has that many spots"
        )
    found = _explained(enough, frame, scale, options, calibration)
    if isinstance(found, str) or len(found.matched) < _EXPLAINED * len(enough):
        # A slice may be accepted with a scale that is off, one of its rods left out: what explains more is sought.
        reach = _reach(calibration)
        for start in search_scales(_left_out(enough, found), frame, scale, options, reach, progress):
            if start is None:
                return CalibrationRefusal(
                    f"calibration refused: the search for a pixel spacing that explains {len(enough)} slices was given "
                    "up, it took too long; fewer false spots or a nominal_orientation make it shorter"
                )
            other = _explained(enough, frame, start, options, calibration)
            if isinstance(found, str) or (not isinstance(other, str) and other.rods > found.rods):
                found = other
            if not _left_out(enough, found):
                break
    if isinstance(found, str):
        return CalibrationRefusal(f"calibration refused: {found}")
    return judge(found, scale, calibration)


def _explained(
    slices: Sequence[SliceSpots],
    frame: Frame,
    start: PixelScale,
    options: RegistrationOptions,
    calibration: CalibrationOptions,
) -> Explained | str:
    """The slices that a scale near `start` explains, and that scale, by matching and measuring in turn; or why none."""
    matched = _matched(slices, frame, start, options)
    if not matched:
        return (
            f"in none of {len(slices)} slices the rods could be identified, with the pixel spacing "
            f"({start.sx:.4f}, {start.sy:.4f}) mm/pixel or one up to {100 * _reach(calibration):.3g} % off"
        )
    most = max(len(one.matches) for _, one in matched)
    if most < MIN_LINES:
        return f"{most} rods are identified in a slice at most, {MIN_LINES} are needed"
    degenerate = why_degenerate(frame, [one for _, one in matched])
    if degenerate:
        return f"the rods do not fix the scale, {degenerate}"
    used = _rich(matched)
    for _ in range(_ROUNDS):
        joint = measured_scale(frame, [one for _, one in used], calibration.calibrate_shear)
        before, used = used, _rich(_matched(slices, frame, joint.scale, options))
        if not used:
            return f"with the scale found, {joint.scale.sx:.4f}, {joint.scale.sy:.4f} mm/pixel, no slice is identified"
        if _pairs(used) == _pairs(before):
            break
    registrations = [one for _, one in used]
    joint = measured_scale(frame, registrations, calibration.calibrate_shear)
    return Explained(frame, joint, registrations, [spots for spots, _ in used])


def _matched(
    slices: Sequence[SliceSpots], frame: Frame, scale: PixelScale, options: RegistrationOptions
) -> list[tuple[SliceSpots, Registration]]:
    """The slices that are accepted with this scale."""
    results = ((one, match_slice(one, frame, scale, options)) for one in slices)
    return [(one, result) for one, result in results if result]


def _rich(matched: Sequence[tuple[SliceSpots, Registration]]) -> list[tuple[SliceSpots, Registration]]:
    """Those with rods enough to say something of the scale."""
    return [(spots, one) for spots, one in matched if len(one.matches) >= MIN_LINES]


def _pairs(matched: Sequence[tuple[SliceSpots, Registration]]) -> list[tuple[int, list[tuple[int, int]]]]:
    return [(id(spots), [(match.line_index, match.spot) for match in one.matches]) for spots, one in matched]


def _left_out(slices: Sequence[SliceSpots], found: Explained | str) -> list[SliceSpots]:
    """Slices that are not explained."""
    explained = set() if isinstance(found, str) else {id(one) for one in found.slices}
    return [one for one in slices if id(one) not in explained]


def _reach(calibration: CalibrationOptions) -> float:
    """How far off scales are tried, as a share: farther than what came with slices may change, to say what is found."""
    return calibration.largest_change(came_with_slices=False)
