"""The scanner's pixel scale from the spots of several slices, accepted only if it can be trusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions
from stereoreg_ros.registration import recognise, register_slice_spots
from stereoreg_ros.result import Recognition, Refusal, Registration
from stereoreg_ros.solvers.arrangement import DegenerateArrangementError
from stereoreg_ros.solvers.calibration import calibrate_linear, calibrate_newton_raphson
from stereoreg_ros.solvers.joint_calibration import calibrate_jointly
from stereoreg_ros.solvers.maximum_likelihood import Refined, refine
from stereoreg_ros.solvers.tolerant_calibration import TolerantScale, calibrate_tolerantly

MIN_LINES = 5
# A scale whose standard error is larger than this share of it is not a measurement worth having.
MAX_RELATIVE_ERROR = 0.01
# A scale with which fewer of the slices than this share are identified is not taken before others are tried.
_EXPLAINED = 0.8
# Residuals that must be left over to judge a scale by.
_LEAST_FREEDOM = 4
# Steps in which scales are tried, and with how many slices at most.
_STEP, _SEARCHED = 0.05, 3
# Standard deviation of what is left of a scale's error, which is half a step at most. A spot at the frame's edge is off
# by that share of the frame's radius.
_OFF = _STEP / 4
# False alarms with which a slice is looked at closer, log10: what it shows is then measured and matched anew.
_LOOK_CLOSER = -1.0
# Probability of a residual as large by the stated noise alone, below which it is not the noise.
_IMPLAUSIBLE = 1e-6
_ROUNDS = 4
# Standard deviations by which the change of sx must differ from that of sy before the frame's size explains neither.
_APART = 3.0
_NOT_TOLD_APART = "Scale and size of the frame cannot be told apart from slices"
# The largest that a limit of a registration can be.
_ANY_MM = 1000.0


@dataclass(frozen=True, eq=False)
class Calibration:
    """An accepted scale. True as a condition.

    scale, previous_scale: mm/pixel; standard_errors: of (sx, sy) and, where it was measured, the shear, mm/pixel;
    covariance: (2, 2) or (3, 3), mm^2/pixel^2; frame_errors: the part of standard_errors that the tolerance of the
    frame's rods brings, which no further slice makes smaller; slices, rods: from how many slices, and how many spots in
    all; residual_before_px, residual_after_px: RMS over these spots, with the frame as in its file; poses:
    slice_from_frame of the slices used; message: what an operator has to know, in one line.
    """

    scale: PixelScale
    previous_scale: PixelScale
    standard_errors: tuple[float, ...]
    covariance: Array
    frame_errors: tuple[float, ...]
    slices: int
    rods: int
    residual_before_px: float
    residual_after_px: float
    poses: tuple[Pose, ...]
    message: str

    def __bool__(self) -> Literal[True]:
        return True


@dataclass(frozen=True)
class CalibrationRefusal:
    """No scale that can be trusted; message: why, with figures. False as a condition."""

    message: str

    def __bool__(self) -> Literal[False]:
        return False


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
            f"calibration refused: {MIN_LINES} rods are needed, and none of {len(slices)} slices has so many spots"
        )
    found = _explained(enough, frame, scale, options, calibration)
    if isinstance(found, str) or len(found.matched) < _EXPLAINED * len(enough):
        # A slice may be accepted with a scale that is off, one of its rods left out: what explains more is sought.
        for start in _search(_left_out(enough, found), frame, scale, options, calibration, progress):
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
    return _judged(found, scale, calibration)


@dataclass(frozen=True, eq=False)
class _Explained:
    """Slices that one scale explains."""

    frame: Frame
    joint: TolerantScale
    matched: list[Registration]
    slices: list[SliceSpots]

    @property
    def rods(self) -> int:
        """Spots of rods in all slices."""
        return sum(len(one.matches) for one in self.matched)

    @property
    def tolerances_mm(self) -> Array:
        """Of the rods (n,)."""
        return self.frame.tolerances_or(self.matched[0].options.frame_tolerance_mm)

    @property
    def covariance(self) -> Array:
        """Of the scale: where the residuals are larger than stated, so are the errors."""
        return self._excess * self.joint.covariance

    @property
    def errors(self) -> tuple[float, ...]:
        """Standard errors of the scale, mm/pixel."""
        return _roots(self.covariance)

    @property
    def frame_errors(self) -> tuple[float, ...]:
        """The part of these that the frame's tolerance brings, mm/pixel."""
        return _roots(self._excess * self.joint.frame_covariance)

    @property
    def stated(self) -> PixelScale | None:
        """The scale that came with the slices, with the last one that has any."""
        return next((one.stated_scale for one in reversed(self.slices) if one.stated_scale is not None), None)

    @property
    def _excess(self) -> float:
        return max(self.joint.chi_square / self.joint.degrees_of_freedom, 1.0)


def _explained(
    slices: Sequence[SliceSpots],
    frame: Frame,
    start: PixelScale,
    options: RegistrationOptions,
    calibration: CalibrationOptions,
) -> _Explained | str:
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
    degenerate = _degenerate(frame, [one for _, one in matched])
    if degenerate:
        return f"the rods do not fix the scale, {degenerate}"
    used = _rich(matched)
    for _ in range(_ROUNDS):
        joint = _joint(frame, [one for _, one in used], calibration.calibrate_shear)
        before, used = used, _rich(_matched(slices, frame, joint.scale, options))
        if not used:
            return f"with the scale found, {joint.scale.sx:.4f}, {joint.scale.sy:.4f} mm/pixel, no slice is identified"
        if _pairs(used) == _pairs(before):
            break
    registrations = [one for _, one in used]
    joint = _joint(frame, registrations, calibration.calibrate_shear)
    return _Explained(frame, joint, registrations, [spots for spots, _ in used])


def _matched(
    slices: Sequence[SliceSpots], frame: Frame, scale: PixelScale, options: RegistrationOptions
) -> list[tuple[SliceSpots, Registration]]:
    """The slices that are accepted with this scale."""
    results = ((one, match_slice(one, frame, scale, options)) for one in slices)
    return [(one, result) for one, result in results if result]


def match_slice(
    spots: SliceSpots, frame: Frame, scale: PixelScale, options: RegistrationOptions
) -> Registration | Refusal:
    """Register the frame from the spots of a slice with this scale, mm/pixel, however weakly its pose is known."""
    # Which spot is which rod is all that is asked.
    options = replace(options, max_position_std_mm=_ANY_MM, max_target_error_mm=_ANY_MM)
    return register_slice_spots(spots.with_scale(scale), frame, options)


def _recognised(spots: SliceSpots, frame: Frame, scale: PixelScale, options: RegistrationOptions) -> Recognition | None:
    """What the spots of a slice look most like with this scale, where that says something of the scale."""
    seen = recognise(spots.with_scale(scale), frame, options)
    return None if seen is None or len(seen.matches) < MIN_LINES or _degenerate(frame, [seen]) else seen


def _rich(matched: Sequence[tuple[SliceSpots, Registration]]) -> list[tuple[SliceSpots, Registration]]:
    """Those with rods enough to say something of the scale."""
    return [(spots, one) for spots, one in matched if len(one.matches) >= MIN_LINES]


def _pairs(matched: Sequence[tuple[SliceSpots, Registration]]) -> list[tuple[int, list[tuple[int, int]]]]:
    return [(id(spots), [(match.line_index, match.spot) for match in one.matches]) for spots, one in matched]


def _left_out(slices: Sequence[SliceSpots], found: _Explained | str) -> list[SliceSpots]:
    """Slices that are not explained."""
    explained = set() if isinstance(found, str) else {id(one) for one in found.slices}
    return [one for one in slices if id(one) not in explained]


def _search(
    slices: Sequence[SliceSpots],
    frame: Frame,
    scale: PixelScale,
    options: RegistrationOptions,
    calibration: CalibrationOptions,
    progress: Callable[[float], bool] | None,
) -> Iterator[PixelScale | None]:
    """Scales with which one of the slices is accepted, at most one for each slice; None where it is given up.

    With a scale that is a little off, a slice is recognised at a noise that allows for that; the scale is then measured
    from it, and the slice must be accepted with it at the noise that is stated, as rarely by chance as all scales tried
    require. The scales nearest to the one in use come first.
    """
    waiting = list(slices[-_SEARCHED:])
    factors = _factors(_reach(calibration))
    ends = np.concatenate([frame.starts, frame.ends])
    off_mm = _OFF * float(np.linalg.norm(np.ptp(ends, axis=0))) / 2
    loose = replace(
        options,
        max_log10_false_alarms=max(_LOOK_CLOSER, options.max_log10_false_alarms),
        scale_tolerance=max(_OFF, options.scale_tolerance),
        min_inliers=max(MIN_LINES, options.min_inliers),
    )
    tried = len(factors) * max(len(waiting), 1)
    strict = replace(options, max_log10_false_alarms=options.max_log10_false_alarms - math.log10(tried))
    for number, (by_x, by_y) in enumerate(factors):
        start = replace(scale, sx=by_x * scale.sx, sy=by_y * scale.sy)
        # The same in mm for all scales, as the matcher keeps a table for each noise.
        noise_px = min(max(options.spot_noise_px, off_mm / max(start.sx, start.sy)), 10.0)
        loose = replace(loose, spot_noise_px=noise_px)
        for spots in list(waiting):
            if progress is not None and not progress(number / len(factors)):
                yield None
            seen = _recognised(spots, frame, start, loose)
            if seen is None:
                continue
            measured = _joint(frame, [seen], with_shear=False).scale
            if match_slice(spots, frame, measured, strict):
                waiting = [one for one in waiting if one is not spots]
                yield measured
        if not waiting:
            return


def _reach(calibration: CalibrationOptions) -> float:
    """How far off scales are tried, as a share: farther than what came with slices may change, to say what is found."""
    return calibration.largest_change(came_with_slices=False)


def _factors(max_change: float) -> list[tuple[float, float]]:
    """Factors of (sx, sy) in steps within the allowed change, the smallest change first."""
    count = math.ceil(max_change / _STEP - 1e-9)
    steps = [_STEP * step for step in range(-count, count + 1)]
    both = [(x, y) for x, y in product(steps, steps) if max(abs(x), abs(y)) <= max_change + _STEP / 2]
    return [(1 + x, 1 + y) for x, y in sorted(both, key=lambda pair: (max(map(abs, pair)), sum(map(abs, pair)), pair))]


def _joint(frame: Frame, matched: Sequence[Registration | Recognition], with_shear: bool) -> TolerantScale:
    """The scale from slices whose rods are known, from the Newton-Raphson solution of one (Maurin 2009, section 3)."""
    richest = max(matched, key=lambda one: len(one.matches))
    first = calibrate_newton_raphson(frame, *_couples(richest))
    start = richest.scale
    change = max(abs(first.scale.sx / start.sx - 1), abs(first.scale.sy / start.sy - 1))
    if first.converged and change < 2 * _STEP:
        # A shear that is not measured stays as it is; that solution has none.
        start = replace(start, sx=first.scale.sx, sy=first.scale.sy)
    rotations, translations, spots_px, used, covariances = _posed(frame, matched)
    exact = calibrate_jointly(frame, rotations, translations, spots_px, used, covariances, start, with_shear)
    return calibrate_tolerantly(
        frame,
        frame.tolerances_or(richest.options.frame_tolerance_mm),
        exact.rotations,
        exact.translations,
        spots_px,
        used,
        covariances,
        exact.scale,
        3 if with_shear else 2,
    )


def _posed(
    frame: Frame, matched: Sequence[Registration | Recognition]
) -> tuple[Array, Array, Array, NDArray[np.bool_], Array]:
    """Rotations, translations, the spot of each rod (m, n, 2), whether it has one, and the spots' covariances."""
    m, n = len(matched), len(frame)
    spots_px, covariances = np.zeros((m, n, 2)), np.tile(np.eye(2), (m, n, 1, 1))
    used = np.zeros((m, n), dtype=bool)
    for row, one in enumerate(matched):
        lines, spots = _couples(one)
        spots_px[row, lines], used[row, lines] = spots, True
        own = [match.spot for match in one.matches]
        covariances[row, lines] = one.spots.noise_px2(one.options.spot_noise_px)[own]
    poses = [one.estimate.slice_from_frame for one in matched]
    rotations = np.array([pose.rotation for pose in poses])
    translations = np.array([pose.translation for pose in poses])
    return rotations, translations, spots_px, used, covariances


def _couples(registration: Registration | Recognition) -> tuple[NDArray[np.intp], Array]:
    """The rods (k,) that were identified, and their spots (k, 2) in pixel."""
    lines = np.array([match.line_index for match in registration.matches])
    return lines, np.array([match.spot_px for match in registration.matches])


def _degenerate(frame: Frame, matched: Sequence[Registration | Recognition]) -> str:
    """Why no slice by itself fixes the scale (Maurin 2009, section 3.1); empty where one does."""
    reason = ""
    for one in matched:
        if len(one.matches) >= MIN_LINES:
            try:
                calibrate_linear(frame, *_couples(one))
            except DegenerateArrangementError as fault:
                reason = str(fault)
            else:
                return ""
    return reason


def _judged(
    found: _Explained, previous: PixelScale, calibration: CalibrationOptions
) -> Calibration | CalibrationRefusal:
    kept = _refined(found, previous)
    fault = _untrusted(found, previous, kept)
    if fault:
        return CalibrationRefusal(f"calibration refused: {fault}")
    scale, errors, stated = found.joint.scale, found.errors, found.stated
    reference = stated or previous
    measured = f"({scale.sx:.4f} +- {errors[0]:.4f}, {scale.sy:.4f} +- {errors[1]:.4f}) mm/pixel"
    size, of_frame = _other_size(reference, scale, errors), _of_frame(found)
    limit = calibration.largest_change(came_with_slices=stated is not None)
    change = max(abs(scale.sx / reference.sx - 1), abs(scale.sy / reference.sy - 1))
    if change > limit:
        origin = "came with the slices" if stated is not None else "is in use"
        return CalibrationRefusal(
            f"calibration refused: scanner, or frame file? The pixel spacing that {origin} is ({reference.sx:.4f}, "
            f"{reference.sy:.4f}) mm/pixel, the one measured is {measured}: {100 * change:.1f} % off, more than "
            f"{100 * limit:.3g} %; if the first is right, the frame {size}. {_NOT_TOLD_APART}, and {of_frame}; measure "
            "the frame, or set calibration_max_change to allow such a change"
        )
    slices = len(found.matched)
    shear = f", shear {scale.shear:.4f} +- {errors[2]:.4f}" if len(errors) > 2 else ""
    before, after = _rms_px(found, kept, previous), _rms_px(found, _refined(found, scale), scale)
    message = (
        f"pixel spacing changed from ({previous.sx:.4f}, {previous.sy:.4f}) to {measured}{shear} from {slices} "
        f"slice{'s' if slices > 1 else ''} with {found.rods} rods; residual {before:.3f} pixel before, {after:.3f} "
        f"pixel after; {of_frame}. {_NOT_TOLD_APART}: if ({reference.sx:.4f}, {reference.sy:.4f}) is right, the frame "
        f"{size}"
    )
    joint = found.joint
    poses = tuple(Pose(nearest_rotation(r), t) for r, t in zip(joint.rotations, joint.translations, strict=True))
    return Calibration(
        scale,
        previous,
        errors,
        found.covariance,
        found.frame_errors,
        slices,
        found.rods,
        before,
        after,
        poses,
        message,
    )


def _untrusted(found: _Explained, previous: PixelScale, kept: Refined) -> str:
    """Why what was found cannot be trusted, or nothing. kept: the poses with the previous scale."""
    joint, scale, options = found.joint, found.joint.scale, found.matched[0].options
    if not joint.converged:
        return "the joint solution did not converge"
    if joint.degrees_of_freedom < _LEAST_FREEDOM:
        return (
            f"{found.rods} rods in {len(found.matched)} slice leave too little to check the scale by, another slice or "
            "another rod is needed"
        )
    if float(gammaincc(joint.degrees_of_freedom / 2, joint.chi_square / 2)) < _IMPLAUSIBLE:
        rms = math.sqrt(float((joint.residuals_px**2).sum()) / found.rods)
        return (
            f"the residual of {rms:.3f} pixel RMS cannot come from the stated spot noise of {options.spot_noise_px:g} "
            f"pixel and rod ends that are known to {_tolerance(found)}"
        )
    for name, new, error in (("sx", scale.sx, found.errors[0]), ("sy", scale.sy, found.errors[1])):
        if not error <= MAX_RELATIVE_ERROR * new:
            return (
                f"{name} = {new:.4f} mm/pixel has a standard error of {error:.4f} mm/pixel, more than "
                f"{100 * MAX_RELATIVE_ERROR:.3g} %"
            )
    _, _, spots_px, used, covariances = _posed(found.frame, found.matched)
    before = calibrate_tolerantly(
        found.frame,
        found.tolerances_mm,
        kept.rotations,
        kept.translations,
        spots_px,
        used,
        covariances,
        previous,
        measured=0,
    ).chi_square
    if joint.chi_square > before + 1e-6:
        return (
            f"the slices fit ({previous.sx:.4f}, {previous.sy:.4f}) mm/pixel with a chi-square of {before:.1f}, better "
            f"than ({scale.sx:.4f}, {scale.sy:.4f}) mm/pixel with {joint.chi_square:.1f}"
        )
    return ""


def _other_size(stated: PixelScale, measured: PixelScale, errors: Sequence[float]) -> str:
    """What the frame's size would have to be for the stated scale to be right: a larger frame has more pixels."""
    by_x, by_y = 100 * (stated.sx / measured.sx - 1), 100 * (stated.sy / measured.sy - 1)
    apart = math.hypot(100 * errors[0] / measured.sx, 100 * errors[1] / measured.sy)
    if abs(by_x - by_y) <= _APART * apart + 0.05:
        both = 0.5 * (by_x + by_y)
        return (
            "is as large as its file says"
            if abs(both) < 0.05
            else f"would have to be {_larger(both)} than its file says"
        )
    return (
        f"would have to be {_larger(by_x)} along the rows and {_larger(by_y)} along the columns than its file says, "
        "which no other size of it is"
    )


def _larger(percent: float) -> str:
    return f"{abs(percent):.1f} % {'smaller' if percent < 0 else 'larger'}"


def _of_frame(found: _Explained) -> str:
    """What the frame's tolerance does to the standard errors."""
    by_x, by_y = found.frame_errors[:2]
    if not found.tolerances_mm.any():
        return "the frame is taken to be exact"
    return f"rod ends known to {_tolerance(found)} contribute {by_x:.4f} and {by_y:.4f} to the errors"


def _tolerance(found: _Explained) -> str:
    """The tolerance of the rods, the least and the largest where they differ."""
    least, most = float(found.tolerances_mm.min()), float(found.tolerances_mm.max())
    return f"{most:g} mm" if least == most else f"{least:g} to {most:g} mm"


def _roots(covariance: Array) -> tuple[float, ...]:
    """Standard deviations."""
    return tuple(float(error) for error in np.sqrt(np.diag(covariance)))


def _refined(found: _Explained, scale: PixelScale) -> Refined:
    """The poses fitted to a scale, with the rods where the frame's file has them."""
    _, _, spots_px, used, covariances = _posed(found.frame, found.matched)
    whitening = np.linalg.inv(np.linalg.cholesky(covariances)) @ scale.inverse_matrix
    joint = found.joint
    return refine(found.frame, joint.rotations, joint.translations, scale.to_mm(spots_px), used, whitening)


def _rms_px(found: _Explained, fitted: Refined, scale: PixelScale) -> float:
    """RMS of the distances between the rods' spots and their predictions, pixel."""
    _, _, spots_px, used, _ = _posed(found.frame, found.matched)
    residual = np.where(used[..., None], scale.to_px(fitted.cuts.points_mm) - spots_px, 0.0)
    return math.sqrt(float((residual**2).sum()) / found.rods)
