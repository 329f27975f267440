"""Slice in, pose or refusal out. The file to read first.

slice -> spots (`spots`) -> matches (`matching`) -> pose (`solvers`) -> how far to believe it (`uncertainty`) -> here:
accepted, or refused with a reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_from_quaternion
from stereoreg_ros.geometry.projection import Cuts, cut_jacobian, point_line_distances, project
from stereoreg_ros.geometry.slice import PixelScale, Slice
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
from stereoreg_ros.spots import FoundSpots, find_spots
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
    seen = _seen(find_spots(ct_slice, options), ct_slice, options, known)
    return _register(seen, frame, options, previous)


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
    whole = _seen(find_spots(ct_slice, options), ct_slice, options, known)
    before = list(previous or [None] * len(frames))
    if len(before) != len(frames):
        raise ValueError(f"previous has {len(before)} poses, expected one for each of {len(frames)} frames")
    offered = [np.arange(len(whole.spots_px)) for _ in frames]
    results = [_register(whole, frame, options, guess) for frame, guess in zip(frames, before, strict=True)]
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
        results[loser] = _register(whole.only(offered[loser]), frames[loser], options, before[loser])


@dataclass(frozen=True, eq=False)
class _Seen:
    """What a slice shows: n spots, and what is known of them.

    spots_px: (n, 2); covariances_px2: (n, 2, 2) of their centres, zero where not known; streaks: their lengths, None
    where not known; area_mm2: over which they could have been found, None where not known; scale_covariance: see
    `register_spots`.
    """

    spots_px: Array
    covariances_px2: Array
    streaks: Streaks | None
    scale: PixelScale
    scanner_from_slice: Pose
    area_mm2: float | None
    scale_covariance: Array | None

    def only(self, rows: NDArray[np.intp]) -> _Seen:
        """Some of the spots."""
        streaks = None if self.streaks is None else self.streaks.only(rows)
        return replace(self, spots_px=self.spots_px[rows], covariances_px2=self.covariances_px2[rows], streaks=streaks)


def _seen(found: FoundSpots, ct_slice: Slice, options: RegistrationOptions, scale_covariance: Array | None) -> _Seen:
    scale = ct_slice.scale
    return _Seen(
        found.centres_px,
        found.covariances_px2,
        _streaks(found, scale, options.slice_thickness_mm) if options.slice_thickness_mm > 0 else None,
        scale,
        ct_slice.scanner_from_slice,
        ct_slice.hu.size * scale.sx * scale.sy,
        scale_covariance,
    )


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
    seen = _given(spots_px, scale, scanner_from_slice, slice_area_mm2, covariances_px2, scale_covariance)
    return _register(seen, frame, options or RegistrationOptions(), previous)


def recognise_spots(
    spots_px: ArrayLike,
    frame: Frame,
    scale: PixelScale,
    options: RegistrationOptions | None = None,
    scanner_from_slice: Pose | None = None,
    slice_area_mm2: float | None = None,
    covariances_px2: ArrayLike | None = None,
) -> Recognition | None:
    """What the spots look most like, the most rods before the best fit, or None where they look like no part of it.

    It is not judged, and nothing is sought that speaks against it: a pose for those who test it in another way, as the
    calibration does with scales. Arguments and errors: see `register_spots`.
    """
    options = options or RegistrationOptions()
    seen = _given(spots_px, scale, scanner_from_slice, slice_area_mm2, covariances_px2, None)
    if check_orientation(frame, options) or check_count(len(seen.spots_px), options):
        return None
    spots, prior = _sought(seen, frame, options)
    found = by_levels.match_most(spots, frame, prior, options)
    if not found:
        return None
    estimate = _estimate(found[0], False, spots, frame, seen)
    return Recognition(scale, options, seen.spots_px, estimate, seen.covariances_px2)


def _given(
    spots_px: ArrayLike,
    scale: PixelScale,
    scanner_from_slice: Pose | None,
    slice_area_mm2: float | None,
    covariances_px2: ArrayLike | None,
    scale_covariance: ArrayLike | None,
) -> _Seen:
    """Spots that somebody else has found, checked; see `register_spots`."""
    spots_px = np.asarray(spots_px, dtype=np.float64)
    if spots_px.size == 0:
        spots_px = spots_px.reshape(0, 2)
    if spots_px.ndim != 2 or spots_px.shape[1] != 2:
        raise ValueError(f"spots_px has shape {spots_px.shape}, expected (n, 2)")
    if not np.isfinite(spots_px).all():
        raise ValueError("spots_px must be finite")
    covariances_px2 = _checked(covariances_px2, len(spots_px))
    known = None if scale_covariance is None else checked_scale_covariance(scale_covariance)
    return _Seen(spots_px, covariances_px2, None, scale, scanner_from_slice or Pose.identity(), slice_area_mm2, known)


def _sought(seen: _Seen, frame: Frame, options: RegistrationOptions) -> tuple[Spots, Prior]:
    """The spots in mm with their errors, and the rotations allowed, as the matchers want them."""
    scale = seen.scale
    covariances_mm2 = scale.matrix @ at_least(seen.covariances_px2, options.spot_noise_px) @ scale.matrix.T
    tolerances = _tolerances(frame, scale, options, seen.scale_covariance)
    spots = Spots.of(scale.to_mm(seen.spots_px), covariances_mm2, seen.area_mm2, tolerances, seen.streaks)
    nominal = seen.scanner_from_slice.rotation.T @ rotation_from_quaternion(options.nominal_orientation)
    return spots, Prior(nominal, math.radians(options.max_rotation_deg))


def _register(seen: _Seen, frame: Frame, options: RegistrationOptions, previous: Pose | None) -> Registration | Refusal:
    """Match, estimate, judge; see `register_spots`."""

    def refusal(verdict: Verdict, estimates: tuple[PoseEstimate, ...] = ()) -> Refusal:
        assert verdict.reason is not None
        return Refusal(
            frame, seen.scale, seen.spots_px, verdict.reason, verdict.message, estimates, seen.covariances_px2, options
        )

    unfit = check_orientation(frame, options) or check_count(len(seen.spots_px), options)
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
        len(seen.spots_px),
        allowed,
        lambda: _rivals(found.hypotheses[0], spots, frame, prior, allowed, is_near),
    )
    if verdict.reason is not None:
        return refusal(verdict, estimates)
    return Registration(frame, seen.scale, options, seen.spots_px, estimates[0], verdict.message, seen.covariances_px2)


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


def _streaks(found: FoundSpots, scale: PixelScale, thickness_mm: float) -> Streaks:
    """How long the spots are: a uniform streak has a twelfth of its squared length as second moment."""
    moments_mm2 = scale.matrix @ found.extents_px2 @ scale.matrix.T
    values, vectors = np.linalg.eigh(moments_mm2)
    length_mm = np.sqrt(12 * np.maximum(values[:, 1] - values[:, 0], 0.0))
    return Streaks(length_mm[:, None] * vectors[:, :, 1], found.cut_short, thickness_mm)


def _checked(covariances_px2: ArrayLike | None, spots: int) -> Array:
    """Covariances (spots, 2, 2); zero where there are none."""
    if covariances_px2 is None:
        return np.zeros((spots, 2, 2))
    covariances = np.asarray(covariances_px2, dtype=np.float64)
    if covariances.shape != (spots, 2, 2):
        raise ValueError(f"covariances_px2 has shape {covariances.shape}, expected ({spots}, 2, 2)")
    turned = np.swapaxes(covariances, 1, 2)
    if not np.isfinite(covariances).all() or not np.allclose(covariances, turned, rtol=1e-6, atol=1e-12):
        raise ValueError("covariances_px2 must be finite and symmetric")
    covariances = 0.5 * (covariances + turned)
    if spots and np.linalg.eigvalsh(covariances).min() < -1e-9:
        raise ValueError("covariances_px2 holds a matrix with a negative variance")
    return covariances


def at_least(covariances_px2: Array, noise_px: float) -> Array:
    """Covariances (n, 2, 2) without a direction of a smaller standard deviation than noise_px."""
    if not covariances_px2.any():
        return np.tile(noise_px**2 * np.eye(2), (len(covariances_px2), 1, 1))
    values, vectors = np.linalg.eigh(covariances_px2)
    raised: Array = (vectors * np.maximum(values, noise_px**2)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return raised


def _estimate(hypothesis: Hypothesis, is_best: bool, spots: Spots, frame: Frame, seen: _Seen) -> PoseEstimate:
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
                frame.line_names[line], int(line), int(spot), seen.spots_px[spot], predicted_px[line], float(distance)
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
    seen: _Seen,
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
