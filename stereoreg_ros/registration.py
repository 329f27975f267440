"""Slice in, pose or refusal out. The file to read first.

slice -> spots (`spots`) -> matches (`matching`) -> pose (`solvers`) -> how far to believe it (`uncertainty`) -> here:
accepted, or refused with a reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_from_quaternion
from stereoreg_ros.geometry.projection import Cuts, cut_jacobian, point_line_distances, project
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.judgement import (
    DEGENERATE_ROTATION_DEG,
    WEAK_POSITION_MM,
    WEAK_ROTATION_DEG,
    Verdict,
    check_count,
    check_orientation,
    contradicted_orientation,
    judge,
    other_scale,
    second_frame,
)
from stereoreg_ros.matching import by_levels, maurin2009
from stereoreg_ros.matching.by_levels import SearchGivenUpError, find_better
from stereoreg_ros.matching.consensus import decades_apart, score
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.near import match_near
from stereoreg_ros.matching.other_scale import with_other_scale
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.spots import Spots, Streaks, whitening_of
from stereoreg_ros.matching.tolerances import Tolerances
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.result import Match, PoseEstimate, Recognition, Refusal, Registration
from stereoreg_ros.solvers.likelihood_valley import covariance_along_valley
from stereoreg_ros.spots import find_spots
from stereoreg_ros.uncertainty import Whitened, checked_scale_covariance, enclosing_covariance, in_scanner_axes

_MATCHERS = {"three_line": by_levels.match, "maurin2009": maurin2009.match}
# An explanation that chance brings more often (log10) speaks against no other.
_LOG10_RIVAL = -3.0
# A second frame of the same kind is looked for that shows as many rods as the first one, or one less.
_FEWER_RODS = 1


def prepare(frame: Frame, scale: PixelScale, options: RegistrationOptions | None = None) -> None:
    """Fill the tables that slices with `frame` need; else the first slices wait for them. Takes long for many rods."""
    for _ in preparation(frame, scale, options):
        pass


def preparation(frame: Frame, scale: PixelScale, options: RegistrationOptions | None = None) -> Iterator[None]:
    """The same in small steps, for those who have other things to do; what most slices need comes first."""
    options = options or RegistrationOptions()
    if options.matcher == "three_line":
        noise_mm = options.spot_noise_px * max(scale.sx, scale.sy)
        extent_mm = _tolerances(frame, scale, options, None).extent_mm
        yield from by_levels.preparation(frame, math.hypot(noise_mm, extent_mm), options)


def register_slice(
    ct_slice: Slice,
    frame: Frame,
    options: RegistrationOptions | None = None,
    previous: Pose | None = None,
    scale_covariance: ArrayLike | None = None,
) -> Registration | Refusal:
    """Register `frame` from one slice: scanner_from_frame in mm, or a refusal with its reason.

    previous, scale_covariance: see `register_spots`.
    """
    options = options or RegistrationOptions()
    known = None if scale_covariance is None else checked_scale_covariance(scale_covariance)
    spots = replace(find_spots(ct_slice, options), scale_covariance=known)
    return register_slice_spots(spots, frame, options, previous)


def register_frames(
    ct_slice: Slice,
    frames: Sequence[Frame],
    options: RegistrationOptions | None = None,
    previous: Sequence[Pose | None] | None = None,
    scale_covariance: Array | None = None,
) -> list[Registration | Refusal]:
    """Register several frames from one slice, one result for each, in their order.

    The spots are found once, and each frame is sought among all of them. Where two accepted frames lay claim to a spot,
    the one that chance would bring less often keeps it, and the other one is sought again among the rest: the result
    does not depend on the frames' order. `Match.spot` counts in the spots of that frame's own result. previous: one a
    frame; that and scale_covariance: see `register_spots`.
    """
    options = options or RegistrationOptions()
    known = None if scale_covariance is None else checked_scale_covariance(scale_covariance)
    whole = replace(find_spots(ct_slice, options), scale_covariance=known)
    before = list(previous or [None] * len(frames))
    if len(before) != len(frames):
        raise ValueError(f"previous has {len(before)} poses, expected one for each of {len(frames)} frames")
    offered = [np.arange(len(whole)) for _ in frames]
    results = [register_slice_spots(whole, frame, options, guess) for frame, guess in zip(frames, before, strict=True)]
    while True:
        claims = {
            row: set(offered[row][[match.spot for match in result.matches]].tolist())
            for row, result in enumerate(results)
            if result
        }
        # The surest first; each takes what is left by those before.
        surest = sorted(claims, key=lambda row: (results[row].estimate.log10_false_alarms, row))  # type: ignore[union-attr]
        kept: set[int] = set()
        loser = None
        for row in surest:
            if claims[row] & kept:
                loser = row
                break
            kept |= claims[row]
        if loser is None:
            return results
        offered[loser] = np.array([spot for spot in offered[loser] if spot not in kept], dtype=np.intp)
        left = whole.take(offered[loser])
        results[loser] = register_slice_spots(left, frames[loser], options, before[loser])


def register_spots(
    spots_px: ArrayLike,
    frame: Frame,
    scale: PixelScale,
    options: RegistrationOptions | None = None,
    scanner_from_slice: Pose | None = None,
    slice_area_mm2: float | None = None,
    previous: Pose | None = None,
    covariances_px2: ArrayLike | None = None,
    scale_covariance: ArrayLike | None = None,
) -> Registration | Refusal:
    """Register `frame` from the centres of bright spots (n, 2) in pixel (u, v), false ones among them.

    scanner_from_slice: where the slice lies in the scanner; by default the scanner is the slice. slice_area_mm2: the
    area over which spots could have been found; by default it is judged by the spots themselves. previous: a guess,
    scanner_from_frame of the slice before; where the frame is still near it, little else has to be searched, and chance
    brings less. Half of the false alarms that are allowed are for poses near the guess, half for all poses, so that a
    guess however wrong costs no certainty. The matcher `maurin2009` makes no use of it. covariances_px2: (n, 2, 2), of
    the centres, pixel^2, as their image shows them; where they are smaller than `spot_noise_px` has it, that counts, as
    the frame is known no better. scale_covariance: (2, 2) of (sx, sy) or (3, 3) of (sx, sy, shear), mm^2/pixel^2, where
    the scale was measured: what it makes the pose uncertain by is added to the pose's covariance.
    Raises ValueError where the spots are not of shape (n, 2) or not finite, or a covariance is none.
    """
    spots = SliceSpots(
        np.asarray(spots_px, dtype=np.float64),
        scale,
        scanner_from_slice=scanner_from_slice or Pose.identity(),
        area_mm2=slice_area_mm2,
        scale_covariance=None if scale_covariance is None else checked_scale_covariance(scale_covariance),
    )
    if covariances_px2 is not None:
        spots = replace(spots, covariances_px2=np.asarray(covariances_px2, dtype=np.float64))
    return register_slice_spots(spots, frame, options, previous)


def recognise(spots: SliceSpots, frame: Frame, options: RegistrationOptions | None = None) -> Recognition | None:
    """What the spots look most like, the most rods before the best fit, or None where they look like no part of it.

    It is not judged, and nothing is sought that speaks against it: a pose for those who test it in another way, as the
    calibration does with scales.
    """
    options = options or RegistrationOptions()
    if check_orientation(frame, options) or check_count(len(spots), options):
        return None
    sought, prior = _sought(spots, frame, options)
    found = by_levels.match_most(sought, frame, prior, options)
    return Recognition(spots, options, _estimate(found[0], False, sought, frame, spots)) if found else None


def _sought(seen: SliceSpots, frame: Frame, options: RegistrationOptions) -> tuple[Spots, Prior]:
    """The spots in mm with their errors, and the rotations allowed, as the matchers want them."""
    scale = seen.scale
    covariances_mm2 = scale.matrix @ seen.noise_px2(options.spot_noise_px) @ scale.matrix.T
    tolerances = _tolerances(frame, scale, options, seen.scale_covariance)
    streaks = Streaks.of(seen, options.slice_thickness_mm)
    spots = Spots.of(seen.centres_mm, covariances_mm2, seen.area_mm2, tolerances, streaks)
    nominal = seen.scanner_from_slice.rotation.T @ rotation_from_quaternion(options.nominal_orientation)
    return spots, Prior(nominal, math.radians(options.max_rotation_deg))


def register_slice_spots(
    seen: SliceSpots, frame: Frame, options: RegistrationOptions | None = None, previous: Pose | None = None
) -> Registration | Refusal:
    """Register `frame` from the spots of a slice, whoever found them: match, estimate, judge.

    previous: see `register_spots`.
    """
    options = options or RegistrationOptions()

    def refusal(verdict: Verdict, estimates: tuple[PoseEstimate, ...] = ()) -> Refusal:
        assert verdict.reason is not None
        return Refusal(frame, seen, verdict.reason, verdict.message, estimates, options)

    unfit = check_orientation(frame, options) or check_count(len(seen), options)
    if unfit is not None:
        return refusal(unfit)
    spots, prior = _sought(seen, frame, options)
    allowed, found = options, None
    if previous is not None and options.matcher == "three_line":
        # Each of the two searches gets half of the false alarms that are allowed.
        allowed = replace(options, max_log10_false_alarms=options.max_log10_false_alarms - math.log10(2))
        found = match_near(spots, frame, prior, allowed, seen.scanner_from_slice.inverse() @ previous)
    is_near = found is not None
    if found is None:
        found = _MATCHERS[options.matcher](spots, frame, prior, allowed)
    # How weakly a pose is determined matters of the best one: the others are only listed.
    estimates = tuple(_estimate(one, rank == 0, spots, frame, seen) for rank, one in enumerate(found.hypotheses))
    verdict = judge(
        found,
        estimates,
        frame,
        len(seen),
        allowed,
        lambda: _rivals(found.hypotheses[0], spots, frame, prior, allowed, is_near),
    )
    if verdict.reason is not None:
        return refusal(verdict, estimates)
    return Registration(frame, seen, options, estimates[0], verdict.message)


def _rivals(
    best: Hypothesis, spots: Spots, frame: Frame, prior: Prior, options: RegistrationOptions, is_near: bool
) -> Verdict | None:
    """What else the slice shows that speaks against the best explanation within the prior.

    is_near: whether it is where the frame was before; then another frame of the same kind may be elsewhere.
    """
    verdict = other_scale(best, with_other_scale(best, spots, frame, prior), len(frame))
    if verdict is not None:
        return verdict
    try:
        if prior.max_rotation < math.pi:
            anywhere = replace(prior, max_rotation=math.pi)
            least = score(best, spots.gains(frame)) + decades_apart(options) * math.log(10)
            other = find_better(spots, frame, anywhere, options, _LOG10_RIVAL, least)
            if other is not None:
                return contradicted_orientation(best, other, prior, len(frame))
        rest = np.setdiff1d(np.arange(len(spots.mm)), best.spot_of_line)
        if not is_near and len(rest) >= options.min_inliers:
            fewest = best.inliers - _FEWER_RODS
            other = find_better(spots.only(rest), frame, prior, options, _LOG10_RIVAL, fewest=fewest)
            if other is not None:
                return second_frame(best, other, len(frame))
    except SearchGivenUpError:
        return Verdict(
            "no_consensus",
            f"a pose of {best.inliers} rods was found, but the search for one that contradicts it among "
            f"{len(spots.mm)} spots took too long: raise the threshold, or reduce clutter",
        )
    return None


def _tolerances(
    frame: Frame, scale: PixelScale, options: RegistrationOptions, scale_covariance: Array | None
) -> Tolerances:
    rods_mm = frame.tolerances_or(options.frame_tolerance_mm)
    return Tolerances.of(frame, rods_mm, scale, options.scale_tolerance, scale_covariance, options.slice_thickness_mm)


def _estimate(hypothesis: Hypothesis, is_best: bool, spots: Spots, frame: Frame, seen: SliceSpots) -> PoseEstimate:
    slice_from_frame = Pose(hypothesis.rotation, hypothesis.translation)
    predicted_px, cuts = project(frame, slice_from_frame, seen.scale)
    lines = np.flatnonzero(hypothesis.spot_of_line != UNMATCHED)
    rows = hypothesis.spot_of_line[lines]
    distances = point_line_distances(frame, lines, slice_from_frame, spots.mm[rows])
    whitening = whitening_of(spots.match_covariances(frame, cuts, hypothesis.spot_of_line)[lines])
    used = hypothesis.spot_of_line != UNMATCHED
    common = spots.tolerances.common(frame, cuts, spots.mm[hypothesis.spot_of_line], used)[lines]
    whitened = _whitened(slice_from_frame, cuts, lines, spots, rows, whitening, common, seen)
    covariance = _covariance(hypothesis.information)
    if is_best and _is_weak(covariance):
        along = covariance_along_valley(frame, slice_from_frame, lines, spots.mm[rows], whitening, common)
        # The valley is that of these matches; what others have widened it by stays.
        covariance = enclosing_covariance(covariance, along) if hypothesis.is_widened else along
    return PoseEstimate(
        slice_from_frame=slice_from_frame,
        scanner_from_frame=seen.scanner_from_slice @ slice_from_frame,
        covariance=in_scanner_axes(covariance + whitened.covariance_by_shifts(), seen.scanner_from_slice),
        matches=tuple(
            Match(
                frame.line_names[line], int(line), int(spot), seen.centres_px[spot], predicted_px[line], float(distance)
            )
            for line, spot, distance in zip(lines, rows, distances, strict=True)
        ),
        chi_square=hypothesis.chi_square,
        log10_false_alarms=hypothesis.log10_false_alarms,
        scale_misfit=whitened.scale_misfit(),
    )


def _whitened(
    slice_from_frame: Pose,
    cuts: Cuts,
    lines: NDArray[np.intp],
    spots: Spots,
    rows: NDArray[np.intp],
    whitening: Array,
    common: Array,
    seen: SliceSpots,
) -> Whitened:
    """The residuals of the matched rods at a pose.

    A scale that is off moves all spots away from the point that the scanner's origin has in the slice: pixel (0, 0)
    where the scanner is the slice, else the point nearest to the scanner's origin, as a scanner's images are
    reconstructed about its axis.
    """
    residual = spots.mm[rows] - cuts.points_mm[lines]
    jacobian = cut_jacobian(cuts, slice_from_frame.translation)[lines]
    origin_mm = seen.scanner_from_slice.inverse().translation[:2]
    stretches = spots.tolerances.stretches
    is_scale = np.arange(common.shape[-1]) < len(stretches)
    shifts = np.zeros((6, common.shape[-1]))
    shifts[:2, is_scale] = (stretches @ (spots.mm[rows].mean(axis=0) - origin_mm)).T
    count = 2 * len(lines)
    return Whitened(
        (whitening @ jacobian).reshape(count, 6),
        (whitening @ common).reshape(count, -1),
        (whitening @ residual[..., None]).reshape(count),
        shifts,
        is_scale,
        spots.tolerances.scale_std,
    )


def _is_weak(covariance: Array) -> bool:
    """Whether the pose is determined so weakly that the curvature at the solution does not tell how weakly."""
    position = math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    rotation_deg = math.degrees(math.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    # What is not determined at all has no end to walk to, and is refused.
    return rotation_deg < DEGENERATE_ROTATION_DEG and (position > WEAK_POSITION_MM or rotation_deg > WEAK_ROTATION_DEG)


def _covariance(information: Array) -> Array:
    """Inverse of an information matrix (6, 6); a direction that nothing determines gets a huge variance."""
    values, vectors = np.linalg.eigh(information)
    covariance: Array = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return covariance
