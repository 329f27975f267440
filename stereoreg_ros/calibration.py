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
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions
from stereoreg_ros.registration import at_least, register_spots
from stereoreg_ros.result import Refusal, Registration
from stereoreg_ros.solvers.arrangement import DegenerateArrangementError
from stereoreg_ros.solvers.calibration import calibrate_linear, calibrate_newton_raphson
from stereoreg_ros.solvers.joint_calibration import JointScale, calibrate_jointly
from stereoreg_ros.solvers.maximum_likelihood import refine

MIN_LINES = 5
# A scale whose standard error is larger than this share of it is not a measurement worth having.
MAX_RELATIVE_ERROR = 0.01
# A scale with which fewer of the slices than this share are identified is not taken before others are tried.
_EXPLAINED = 0.8
# Residuals that must be left over to judge a scale by.
_LEAST_FREEDOM = 4
# Steps in which scales are tried, and with how many slices at most.
_STEP, _SEARCHED = 0.05, 3
# Half a step off, a spot at the frame's edge is off by a fortieth of the frame's radius; most are nearer.
_OFF = _STEP / 4
# False alarms with which a slice is looked at closer, log10: what it shows is then measured and matched anew.
_LOOK_CLOSER = -1.0
# Probability of a residual as large by the stated noise alone, below which it is not the noise.
_IMPLAUSIBLE = 1e-6
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Sighting:
    """The spots of one slice, whatever was made of them.

    spots_px: (n, 2); covariances_px2: (n, 2, 2) of their centres; pixels: of the slice, None where not known;
    scanner_from_slice: its plane.
    """

    spots_px: Array
    covariances_px2: Array
    pixels: int | None = None
    scanner_from_slice: Pose | None = None


@dataclass(frozen=True, eq=False)
class Calibration:
    """An accepted scale. True as a condition.

    scale, previous_scale: mm/pixel; standard_errors: of (sx, sy) and, where it was measured, the shear, mm/pixel;
    covariance: (2, 2) or (3, 3), mm^2/pixel^2; slices, rods: from how many slices, and how many spots in all;
    residual_before_px, residual_after_px: RMS over these spots; poses: slice_from_frame of the slices used; message:
    one sentence for an operator.
    """

    scale: PixelScale
    previous_scale: PixelScale
    standard_errors: tuple[float, ...]
    covariance: Array
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


def sighting_of(result: Registration | Refusal, pixels: int | None = None, plane: Pose | None = None) -> Sighting:
    """The spots of a registered or refused slice."""
    return Sighting(result.spots_px, _covariances(result), pixels, plane)


def calibrate(
    sightings: Sequence[Sighting],
    frame: Frame,
    scale: PixelScale,
    options: RegistrationOptions | None = None,
    calibration: CalibrationOptions | None = None,
    progress: Callable[[float], bool] | None = None,
) -> Calibration | CalibrationRefusal:
    """One pixel scale from slices that show the frame, by joint maximum likelihood with a pose for each.

    scale: the configured one, mm/pixel; where it leaves slices unexplained, scales up to `calibration_max_change` off
    are tried. progress: told the share of these that was, says whether to go on; where not, the calibration is refused.
    """
    options, calibration = options or RegistrationOptions(), calibration or CalibrationOptions()
    if not sightings:
        return CalibrationRefusal("calibration refused: there is no slice to calibrate from")
    enough = [one for one in sightings if len(one.spots_px) >= max(MIN_LINES, options.min_inliers)]
    if not enough:
        return CalibrationRefusal(
            f"calibration refused: {MIN_LINES} rods are needed, and none of {len(sightings)} slices has so many spots"
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
    if isinstance(found, str):
        return CalibrationRefusal(f"calibration refused: {found}")
    return _judged(found, frame, scale, calibration)


@dataclass(frozen=True, eq=False)
class _Explained:
    """Slices that one scale explains."""

    joint: JointScale
    matched: list[Registration]
    sightings: list[Sighting]

    @property
    def rods(self) -> int:
        """Spots of rods in all slices."""
        return sum(len(one.matches) for one in self.matched)


def _explained(
    sightings: Sequence[Sighting],
    frame: Frame,
    start: PixelScale,
    options: RegistrationOptions,
    calibration: CalibrationOptions,
) -> _Explained | str:
    """The slices that a scale near `start` explains, and that scale, by matching and measuring in turn; or why none."""
    matched = _matched(sightings, frame, start, options)
    if not matched:
        return (
            f"in none of {len(sightings)} slices the rods could be identified, with the pixel spacing "
            f"({start.sx:.4f}, {start.sy:.4f}) mm/pixel or one up to "
            f"{100 * calibration.calibration_max_change:.3g} % off"
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
        before, used = used, _rich(_matched(sightings, frame, joint.scale, options))
        if not used:
            return f"with the scale found, {joint.scale.sx:.4f}, {joint.scale.sy:.4f} mm/pixel, no slice is identified"
        if _pairs(used) == _pairs(before):
            break
    registrations = [one for _, one in used]
    joint = _joint(frame, registrations, calibration.calibrate_shear)
    return _Explained(joint, registrations, [sighting for sighting, _ in used])


def _matched(
    sightings: Sequence[Sighting], frame: Frame, scale: PixelScale, options: RegistrationOptions
) -> list[tuple[Sighting, Registration]]:
    """The slices that are accepted with this scale."""
    results = ((one, match_sighting(one, frame, scale, options)) for one in sightings)
    return [(one, result) for one, result in results if result]


def match_sighting(
    sighting: Sighting, frame: Frame, scale: PixelScale, options: RegistrationOptions
) -> Registration | Refusal:
    """Register the frame from the spots of a slice with this scale, mm/pixel."""
    area_mm2 = sighting.pixels * scale.sx * scale.sy if sighting.pixels else None
    plane, covariances = sighting.scanner_from_slice, sighting.covariances_px2
    return register_spots(sighting.spots_px, frame, scale, options, plane, area_mm2, covariances_px2=covariances)


def _rich(matched: Sequence[tuple[Sighting, Registration]]) -> list[tuple[Sighting, Registration]]:
    """Those with rods enough to say something of the scale."""
    return [(sighting, one) for sighting, one in matched if len(one.matches) >= MIN_LINES]


def _pairs(matched: Sequence[tuple[Sighting, Registration]]) -> list[tuple[int, list[tuple[int, int]]]]:
    return [(id(sighting), [(match.line_index, match.spot) for match in one.matches]) for sighting, one in matched]


def _left_out(sightings: Sequence[Sighting], found: _Explained | str) -> list[Sighting]:
    """Slices that are not explained."""
    explained = set() if isinstance(found, str) else {id(one) for one in found.sightings}
    return [one for one in sightings if id(one) not in explained]


def _search(
    sightings: Sequence[Sighting],
    frame: Frame,
    scale: PixelScale,
    options: RegistrationOptions,
    calibration: CalibrationOptions,
    progress: Callable[[float], bool] | None,
) -> Iterator[PixelScale | None]:
    """Scales with which one of the slices is accepted, at most one for each slice; None where it is given up.

    With a scale that is a little off, a slice is recognised at a noise that allows for that; the scale is then measured
    from it, and the slice must be accepted with it at the noise that is stated, as rarely by chance as all scales tried
    require. The scales nearest to the configured one come first.
    """
    waiting = list(sightings[-_SEARCHED:])
    factors = _factors(calibration.calibration_max_change)
    ends = np.concatenate([frame.starts, frame.ends])
    off_mm = _OFF * float(np.linalg.norm(np.ptp(ends, axis=0))) / 2
    loose = replace(
        options,
        max_log10_false_alarms=max(_LOOK_CLOSER, options.max_log10_false_alarms),
        max_position_std_mm=1000.0,
        min_inliers=max(MIN_LINES, options.min_inliers),
    )
    tried = len(factors) * max(len(waiting), 1)
    strict = replace(options, max_log10_false_alarms=options.max_log10_false_alarms - math.log10(tried))
    for number, (by_x, by_y) in enumerate(factors):
        start = replace(scale, sx=by_x * scale.sx, sy=by_y * scale.sy)
        # The same in mm for all scales, as the matcher keeps a table for each noise.
        noise_px = min(max(options.spot_noise_px, off_mm / max(start.sx, start.sy)), 10.0)
        loose = replace(loose, spot_noise_px=noise_px)
        for sighting in list(waiting):
            if progress is not None and not progress(number / len(factors)):
                yield None
            seen = match_sighting(sighting, frame, start, loose)
            if not seen or len(seen.matches) < MIN_LINES or _degenerate(frame, [seen]):
                continue
            measured = _joint(frame, [seen], with_shear=False).scale
            if match_sighting(sighting, frame, measured, strict):
                waiting = [one for one in waiting if one is not sighting]
                yield measured
        if not waiting:
            return


def _factors(max_change: float) -> list[tuple[float, float]]:
    """Factors of (sx, sy) in steps within the allowed change, the smallest change first."""
    count = math.ceil(max_change / _STEP - 1e-9)
    steps = [_STEP * step for step in range(-count, count + 1)]
    both = [(x, y) for x, y in product(steps, steps) if max(abs(x), abs(y)) <= max_change + _STEP / 2]
    return [(1 + x, 1 + y) for x, y in sorted(both, key=lambda pair: (max(map(abs, pair)), sum(map(abs, pair)), pair))]


def _joint(frame: Frame, matched: Sequence[Registration], with_shear: bool) -> JointScale:
    """The scale from slices whose rods are known, from the Newton-Raphson solution of one (Maurin 2009, section 3)."""
    richest = max(matched, key=lambda one: len(one.matches))
    first = calibrate_newton_raphson(frame, *_couples(richest))
    start = richest.scale
    change = max(abs(first.scale.sx / start.sx - 1), abs(first.scale.sy / start.sy - 1))
    if first.converged and change < 2 * _STEP:
        start = first.scale
    return calibrate_jointly(frame, *_posed(frame, matched), start, with_shear)


def _posed(frame: Frame, matched: Sequence[Registration]) -> tuple[Array, Array, Array, NDArray[np.bool_], Array]:
    """Rotations, translations, the spot of each rod (m, n, 2), whether it has one, and the spots' covariances."""
    m, n = len(matched), len(frame)
    spots_px, covariances = np.zeros((m, n, 2)), np.tile(np.eye(2), (m, n, 1, 1))
    used = np.zeros((m, n), dtype=bool)
    for row, one in enumerate(matched):
        lines, spots = _couples(one)
        spots_px[row, lines], used[row, lines] = spots, True
        own = _covariances(one)[[match.spot for match in one.matches]]
        covariances[row, lines] = at_least(own, one.options.spot_noise_px)
    poses = [one.estimate.slice_from_frame for one in matched]
    rotations = np.array([pose.rotation for pose in poses])
    translations = np.array([pose.translation for pose in poses])
    return rotations, translations, spots_px, used, covariances


def _couples(registration: Registration) -> tuple[NDArray[np.intp], Array]:
    """The rods (k,) that were identified, and their spots (k, 2) in pixel."""
    lines = np.array([match.line_index for match in registration.matches])
    return lines, np.array([match.spot_px for match in registration.matches])


def _covariances(result: Registration | Refusal) -> Array:
    known = result.covariances_px2
    return np.zeros((len(result.spots_px), 2, 2)) if known is None else known


def _degenerate(frame: Frame, matched: Sequence[Registration]) -> str:
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
    found: _Explained, frame: Frame, previous: PixelScale, calibration: CalibrationOptions
) -> Calibration | CalibrationRefusal:
    joint, matched = found.joint, found.matched
    scale = joint.scale
    for name, new, old in (("sx", scale.sx, previous.sx), ("sy", scale.sy, previous.sy)):
        if abs(new / old - 1) > calibration.calibration_max_change:
            return CalibrationRefusal(
                f"calibration refused: {name} would change from {old:.4f} to {new:.4f} mm/pixel, "
                f"more than {100 * calibration.calibration_max_change:.3g} %"
            )
    if not joint.converged:
        return CalibrationRefusal("calibration refused: the joint solution did not converge")
    if joint.degrees_of_freedom < _LEAST_FREEDOM:
        return CalibrationRefusal(
            f"calibration refused: {found.rods} rods in {len(matched)} slice leave too little to check the scale by, "
            "another slice or another rod is needed"
        )
    _, _, spots_px, used, covariances = _posed(frame, matched)
    after = math.sqrt(float((joint.residuals_px**2).sum()) / found.rods)
    if float(gammaincc(joint.degrees_of_freedom / 2, joint.chi_square / 2)) < _IMPLAUSIBLE:
        return CalibrationRefusal(
            f"calibration refused: the residual of {after:.3f} pixel RMS cannot come from the stated spot noise of "
            f"{matched[0].options.spot_noise_px:g} pixel"
        )
    # Where the residuals are larger than stated, so are the errors.
    covariance = joint.covariance * max(joint.chi_square / joint.degrees_of_freedom, 1.0)
    errors = tuple(float(error) for error in np.sqrt(np.diag(covariance)))
    for name, new, error in (("sx", scale.sx, errors[0]), ("sy", scale.sy, errors[1])):
        if not error <= MAX_RELATIVE_ERROR * new:
            return CalibrationRefusal(
                f"calibration refused: {name} = {new:.4f} mm/pixel has a standard error of {error:.4f} mm/pixel, more "
                f"than {100 * MAX_RELATIVE_ERROR:.3g} %"
            )
    before = _residual_rms_px(frame, joint, spots_px, used, covariances, previous)
    if after > before + 1e-6:
        return CalibrationRefusal(
            f"calibration refused: the residual would grow from {before:.3f} to {after:.3f} pixel RMS"
        )
    slices = len(matched)
    shear = f", shear {scale.shear:.4f} +- {errors[2]:.4f}" if len(errors) > 2 else ""
    message = (
        f"pixel spacing changed from ({previous.sx:.4f}, {previous.sy:.4f}) to ({scale.sx:.4f} +- {errors[0]:.4f}, "
        f"{scale.sy:.4f} +- {errors[1]:.4f}) mm/pixel{shear} from {slices} slice{'s' if slices > 1 else ''} with "
        f"{found.rods} rods; residual {before:.3f} pixel before, {after:.3f} pixel after"
    )
    poses = tuple(Pose(nearest_rotation(r), t) for r, t in zip(joint.rotations, joint.translations, strict=True))
    return Calibration(scale, previous, errors, covariance, slices, found.rods, before, after, poses, message)


def _residual_rms_px(
    frame: Frame,
    joint: JointScale,
    spots_px: Array,
    used: NDArray[np.bool_],
    covariances: Array,
    scale: PixelScale,
) -> float:
    """Of the same spots with another scale, the poses being fitted to it."""
    whitening = np.linalg.inv(np.linalg.cholesky(covariances)) @ scale.inverse_matrix
    fitted = refine(frame, joint.rotations, joint.translations, scale.to_mm(spots_px), used, whitening)
    residual = np.where(used[..., None], scale.to_px(fitted.cuts.points_mm) - spots_px, 0.0)
    return math.sqrt(float((residual**2).sum()) / int(used.sum()))
