"""Slice in, pose or refusal out. The file to read first.

slice -> spots (`spots`) -> matches (`matching`) -> pose (`solvers`) -> how far to believe it (`uncertainty`) -> here:
accepted, or refused with a reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincc

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_from_quaternion
from stereoreg_ros.geometry.projection import point_line_distances, project
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.matching import maurin2009, three_line
from stereoreg_ros.matching.hypothesis import UNMATCHED, Found, Hypothesis
from stereoreg_ros.matching.near import match_near
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.spots import Spots, Streaks
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.result import Match, PoseEstimate, Reason, Refusal, Registration
from stereoreg_ros.solvers.likelihood_valley import covariance_along_valley
from stereoreg_ros.spots import FoundSpots, find_spots
from stereoreg_ros.uncertainty import checked_scale_covariance, in_scanner_axes, scale_sensitivity

MAX_SPOTS = 300
_MATCHERS = {"three_line": three_line.match, "maurin2009": maurin2009.match}
# Rotation (standard deviation about the weakest axis) beyond which a pose counts as not determined.
_DEGENERATE_ROTATION_DEG = 10.0
# Probabilities of a residual as large by the stated noise alone: less than these, and it is not the noise.
_IMPLAUSIBLE, _DOUBTFUL = 1e-6, 1e-3
# Standard deviations beyond which a pose is accepted with a caution: four of them are 2 mm and 3 degrees.
_WEAK_POSITION_MM, _WEAK_ROTATION_DEG = 0.5, 0.75


def prepare(frame: Frame, scale: PixelScale, options: RegistrationOptions | None = None) -> None:
    """Fill the tables that slices with `frame` need; else the first slices wait for them. Takes long for many rods."""
    for _ in preparation(frame, scale, options):
        pass


def preparation(frame: Frame, scale: PixelScale, options: RegistrationOptions | None = None) -> Iterator[None]:
    """The same in small steps, for those who have other things to do; what most slices need comes first."""
    options = options or RegistrationOptions()
    if options.matcher == "three_line":
        yield from three_line.preparation(frame, _noise_mm(scale, options.spot_noise_px), options)


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
    found = find_spots(ct_slice, options)
    return _register_found(found, ct_slice, frame, options, previous, known)


def register_frames(
    ct_slice: Slice,
    frames: Sequence[Frame],
    options: RegistrationOptions | None = None,
    previous: Sequence[Pose | None] | None = None,
    scale_covariance: Array | None = None,
) -> list[Registration | Refusal]:
    """Register several frames from one slice, one result for each, in their order.

    The spots are found once. Those that an accepted frame has taken are not offered to the next; to a frame, another
    one's spots are false spots. `Match.spot` counts in the spots of that frame's own result. previous: one a frame;
    that and scale_covariance: see `register_spots`.
    """
    options = options or RegistrationOptions()
    known = None if scale_covariance is None else checked_scale_covariance(scale_covariance)
    found = find_spots(ct_slice, options)
    results: list[Registration | Refusal] = []
    for frame, before in zip(frames, previous or [None] * len(frames), strict=True):
        result = _register_found(found, ct_slice, frame, options, before, known)
        if result:
            found = found.take(np.delete(np.arange(len(found)), [match.spot for match in result.matches]))
        results.append(result)
    return results


def _register_found(
    found: FoundSpots,
    ct_slice: Slice,
    frame: Frame,
    options: RegistrationOptions,
    previous: Pose | None = None,
    scale_covariance: Array | None = None,
) -> Registration | Refusal:
    scale = ct_slice.scale
    area_mm2 = ct_slice.hu.size * scale.sx * scale.sy
    streaks = _streaks(found, scale, options.slice_thickness_mm) if options.slice_thickness_mm > 0 else None
    return _register(
        found.centres_px,
        found.covariances_px2,
        streaks,
        frame,
        scale,
        options,
        ct_slice.scanner_from_slice,
        area_mm2,
        previous,
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
    options = options or RegistrationOptions()
    scanner_from_slice = scanner_from_slice or Pose.identity()
    spots_px = np.asarray(spots_px, dtype=np.float64)
    if spots_px.size == 0:
        spots_px = spots_px.reshape(0, 2)
    if spots_px.ndim != 2 or spots_px.shape[1] != 2:
        raise ValueError(f"spots_px has shape {spots_px.shape}, expected (n, 2)")
    if not np.isfinite(spots_px).all():
        raise ValueError("spots_px must be finite")
    covariances_px2 = _checked(covariances_px2, len(spots_px))
    known = None if scale_covariance is None else checked_scale_covariance(scale_covariance)
    return _register(
        spots_px, covariances_px2, None, frame, scale, options, scanner_from_slice, slice_area_mm2, previous, known
    )


def _register(
    spots_px: Array,
    covariances_px2: Array,
    streaks: Streaks | None,
    frame: Frame,
    scale: PixelScale,
    options: RegistrationOptions,
    scanner_from_slice: Pose,
    slice_area_mm2: float | None,
    previous: Pose | None,
    scale_covariance: Array | None,
) -> Registration | Refusal:
    """Match, judge, accept or refuse; see `register_spots`."""

    asked = options

    def refuse(reason: Reason, message: str, estimates: tuple[PoseEstimate, ...] = ()) -> Refusal:
        return Refusal(frame, scale, spots_px, reason, message, estimates, covariances_px2, asked)

    count = len(spots_px)
    if count < options.min_inliers:
        return refuse("too_few_spots", f"{count} spots found, at least {options.min_inliers} are needed")
    if count > MAX_SPOTS:
        return refuse("no_consensus", f"{count} spots found, more than the {MAX_SPOTS} that are searched")

    weighted_px2 = at_least(covariances_px2, options.spot_noise_px)
    covariances_mm2 = scale.matrix @ weighted_px2 @ scale.matrix.T
    spots = Spots.of(scale.to_mm(spots_px), covariances_mm2, slice_area_mm2, streaks)
    nominal = scanner_from_slice.rotation.T @ rotation_from_quaternion(options.nominal_orientation)
    prior = Prior(nominal, math.radians(options.max_rotation_deg))
    found = None
    if previous is not None and options.matcher == "three_line":
        # Each of the two searches gets half of the false alarms that are allowed.
        options = replace(options, max_log10_false_alarms=options.max_log10_false_alarms - math.log10(2))
        found = match_near(spots, frame, prior, options, scanner_from_slice.inverse() @ previous)
    if found is None:
        found = _MATCHERS[options.matcher](spots, frame, prior, options)
    # How weakly a pose is determined matters of the best one: others are told only to say what they are.
    estimates = tuple(
        _estimate(h, rank == 0, spots_px, weighted_px2, frame, scale, scanner_from_slice, scale_covariance)
        for rank, h in enumerate(found.hypotheses)
    )
    if found.given_up:
        return refuse("no_consensus", f"the search among {count} spots was {found.given_up}", estimates)
    if not estimates:
        return refuse("no_consensus", _describe_nothing(found, len(frame), count, options))
    best = estimates[0]
    if best.log10_false_alarms > options.max_log10_false_alarms:
        return refuse(
            "no_consensus",
            f"chance alone would bring 10^{best.log10_false_alarms:.1f} matches as good as the best one, of "
            f"{best.inliers} rods among {count} spots; at most 10^{options.max_log10_false_alarms:.3g} are allowed",
            estimates,
        )
    plausibility = float(gammaincc(best.degrees_of_freedom / 2, best.chi_square / 2))
    if plausibility < _IMPLAUSIBLE:
        return refuse(
            "inaccurate",
            f"the residual of {best.residual_rms_px:.2f} pixel RMS over {best.inliers} rods cannot come from a spot "
            f"noise of {options.spot_noise_px:g} pixel: wrong pixel spacing, frame or noise",
            estimates,
        )
    if len(estimates) > 1:
        return refuse("ambiguous", _describe_ambiguity(estimates), estimates)
    if best.rotation_std_deg > _DEGENERATE_ROTATION_DEG:
        axis = np.linalg.eigh(best.covariance[3:, 3:])[1][:, -1]
        return refuse(
            "degenerate",
            f"the rotation about the axis {np.round(axis, 2).tolist()} of the scanner is known only to "
            f"{best.rotation_std_deg:.1f} degrees",
            estimates,
        )
    if best.position_std_mm > options.max_position_std_mm:
        return refuse(
            "inaccurate",
            f"the position has a standard deviation of {best.position_std_mm:.2f} mm, "
            f"at most {options.max_position_std_mm:g} mm are allowed",
            estimates,
        )
    target_error_mm = best.target_error_95_mm(options.target_in_frame_mm)
    if target_error_mm > options.max_target_error_mm:
        target = ", ".join(f"{value:g}" for value in options.target_in_frame_mm)
        return refuse(
            "inaccurate",
            f"95 % of the errors at the target ({target}) mm of the frame are within {target_error_mm:.2f} mm, "
            f"{options.max_target_error_mm:g} mm are allowed",
            estimates,
        )
    cautions = []
    if plausibility < _DOUBTFUL:
        cautions.append(
            f"the residual of {best.residual_rms_px:.2f} pixel RMS is large for a spot noise of "
            f"{options.spot_noise_px:g} pixel"
        )
    if best.position_std_mm > _WEAK_POSITION_MM or best.rotation_std_deg > _WEAK_ROTATION_DEG:
        cautions.append(
            f"weakly determined: standard deviation {best.position_std_mm:.2f} mm, {best.rotation_std_deg:.2f} degrees"
        )
    caution = "; ".join(cautions)
    return Registration(frame, scale, options, spots_px, best, caution, covariances_px2)


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


def _noise_mm(scale: PixelScale, noise_px: float) -> float:
    return noise_px * max(scale.sx, scale.sy)


def _estimate(
    hypothesis: Hypothesis,
    is_best: bool,
    spots_px: Array,
    weighted_px2: Array,
    frame: Frame,
    scale: PixelScale,
    scanner_from_slice: Pose,
    scale_covariance: Array | None,
) -> PoseEstimate:
    slice_from_frame = Pose(hypothesis.rotation, hypothesis.translation)
    predicted_px, _ = project(frame, slice_from_frame, scale)
    lines = np.flatnonzero(hypothesis.spot_of_line != UNMATCHED)
    spots = hypothesis.spot_of_line[lines]
    distances = point_line_distances(frame, lines, slice_from_frame, scale.to_mm(spots_px[spots]))
    covariance = _covariance(hypothesis.information)
    if is_best and _is_weak(covariance):
        whitening = np.linalg.inv(np.linalg.cholesky(scale.matrix @ weighted_px2[spots] @ scale.matrix.T))
        covariance = covariance_along_valley(frame, slice_from_frame, lines, scale.to_mm(spots_px[spots]), whitening)
    if scale_covariance is not None:
        by_scale = scale_sensitivity(frame, lines, slice_from_frame, spots_px[spots], weighted_px2[spots], scale)
        covariance = covariance + by_scale @ scale_covariance @ by_scale.T
    return PoseEstimate(
        slice_from_frame=slice_from_frame,
        scanner_from_frame=scanner_from_slice @ slice_from_frame,
        covariance=in_scanner_axes(covariance, scanner_from_slice),
        matches=tuple(
            Match(frame.line_names[line], int(line), int(spot), spots_px[spot], predicted_px[line], float(distance))
            for line, spot, distance in zip(lines, spots, distances, strict=True)
        ),
        chi_square=hypothesis.chi_square,
        log10_false_alarms=hypothesis.log10_false_alarms,
    )


def _is_weak(covariance: Array) -> bool:
    """Whether the pose is determined so weakly that the curvature at the solution does not tell how weakly."""
    position = math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    rotation_deg = math.degrees(math.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    # What is not determined at all has no end to walk to, and is refused.
    return rotation_deg < _DEGENERATE_ROTATION_DEG and (
        position > _WEAK_POSITION_MM or rotation_deg > _WEAK_ROTATION_DEG
    )


def _covariance(information: Array) -> Array:
    """Inverse of an information matrix (6, 6); a direction that nothing determines gets a huge variance."""
    values, vectors = np.linalg.eigh(information)
    covariance: Array = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return covariance


def _describe_nothing(found: Found, lines: int, spots: int, options: RegistrationOptions) -> str:
    nothing = f"no pose puts {min(found.least_rods, lines)} of the {lines} rods on any of the {spots} spots"
    if found.least_rods <= options.min_inliers:
        return nothing
    fewer = f"{found.least_rods - 1} rods could hardly be told from chance among so many spots"
    return f"{nothing}, and {fewer}" if found.least_rods <= lines else fewer


def _describe_ambiguity(estimates: tuple[PoseEstimate, ...]) -> str:
    poses = []
    for estimate in estimates:
        pose = estimate.scanner_from_frame
        position = ", ".join(f"{value:.1f}" for value in pose.translation)
        turn = ", ".join(f"{value:.3f}" for value in pose.quaternion_xyzw)
        poses.append(f"position ({position}) mm, quaternion ({turn}), residual {estimate.residual_rms_mm:.2f} mm")
    more = math.inf if len(poses) > 8 else 0
    listed = "; ".join(poses[:8]) + ("; and more" if more else "")
    return (
        f"{len(estimates)} poses explain the slice equally well, tell them apart by nominal_orientation and "
        f"max_rotation_deg: {listed}"
    )
