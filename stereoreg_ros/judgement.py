"""The only place that accepts a pose or refuses it: each reason with its threshold and its sentence."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import chi2

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import rotation_angle
from stereoreg_ros.matching.consensus import IMPLAUSIBLE
from stereoreg_ros.matching.hypothesis import Found, Hypothesis
from stereoreg_ros.matching.other_scale import OtherScale
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.result import PoseEstimate, Reason

MAX_SPOTS: Final = 300
# Rotation (standard deviation about the weakest axis) beyond which a pose counts as not determined.
DEGENERATE_ROTATION_DEG: Final = 10.0
# Standard deviations beyond which a pose is accepted with a caution: four of them are 2 mm and 3 degrees.
WEAK_POSITION_MM: Final = 0.5
WEAK_ROTATION_DEG: Final = 0.75
# A residual that the stated errors alone would exceed less often than this is doubtful; for refusal see IMPLAUSIBLE.
_DOUBTFUL = 0.05
# Of a scale that fits the spots so much better than the stated one.
_SCALE_IMPLAUSIBLE = 5e-3
# Log-likelihood by which unmatched spots beside rods that have none, and a poor fit, may speak for a mistake: one slice
# in a thousand is taken not to be as it was described.
_MOST_EVIDENCE = math.log(1000.0)
# Poses whose rotations differ by less cannot be told apart by a nominal orientation.
_SAME_ORIENTATION_DEG = 10.0
# Of several poses, how many a sentence lists.
_LISTED = 8


@dataclass(frozen=True)
class Verdict:
    """Accepted with a caution, which may be empty, where `reason` is None; else refused, and the message says why."""

    reason: Reason | None
    message: str


def check_count(spots: int, options: RegistrationOptions) -> Verdict | None:
    """Whether there are too few or too many spots to search."""
    if spots < options.min_inliers:
        return Verdict("too_few_spots", f"{spots} spots found, at least {options.min_inliers} are needed")
    if spots > MAX_SPOTS:
        return Verdict(
            "no_consensus",
            f"{spots} spots found, more than the {MAX_SPOTS} that are searched: raise the threshold or "
            "max_spot_area_mm2 and min_spot_area_mm2 to suit the rods",
        )
    return None


def check_orientation(frame: Frame, options: RegistrationOptions) -> Verdict | None:
    """Whether the frame's file asks for an orientation that was not given."""
    if frame.orientation_required and options.max_rotation_deg >= 180.0:
        return Verdict(
            "ambiguous",
            f"the file of frame '{frame.name}' has orientation_required: it looks the same from several sides; set "
            "nominal_orientation, and max_rotation_deg to less than 180",
        )
    return None


def judge(
    found: Found,
    estimates: Sequence[PoseEstimate],
    frame: Frame,
    spots: int,
    options: RegistrationOptions,
    rivals: Callable[[], Verdict | None],
) -> Verdict:
    """Accept the best explanation of a slice or refuse it.

    estimates: of `found.hypotheses`, best first. spots: how many were searched. rivals: looks for other explanations
    that speak against the best one, which takes long; only asked where nothing else does.
    """
    if found.given_up:
        return Verdict("no_consensus", f"the search among {spots} spots was {found.given_up}")
    if not estimates:
        return Verdict("no_consensus", _describe_nothing(found, len(frame), spots, options))
    for check in (_by_chance, _residual, _several_poses, _near_misses, _pieces):
        verdict = check(found, estimates, frame, spots, options)
        if verdict is not None:
            return verdict
    return _precision(estimates[0], options) or rivals() or Verdict(None, _caution(estimates[0], options))


def contradicted_orientation(best: Hypothesis, other: Hypothesis, prior: Prior, lines: int) -> Verdict:
    """Refused: beyond the configured orientation another explanation is clearly better."""
    angle_deg = math.degrees(float(prior.angles(other.rotation)))
    return Verdict(
        "contradicted",
        f"{best.inliers} of {lines} rods match within {math.degrees(prior.max_rotation):g} degrees of "
        f"nominal_orientation, but {other.inliers}, and clearly better, with the frame at {angle_deg:.0f} degrees from "
        "it: check nominal_orientation, max_rotation_deg and how the patient or frame lies",
    )


def other_scale(best: Hypothesis, other: OtherScale | None, lines: int) -> Verdict | None:
    """Refused where one rod more has its spot with another scale, and that is clearly likelier."""
    if other is None or other.evidence <= _MOST_EVIDENCE:
        return None
    along_x, along_y = -100 * other.too_large
    return Verdict(
        "contradicted",
        f"{best.inliers} of {lines} rods match with the stated pixel spacing, but {other.inliers}, and clearly better, "
        f"with one changed by {along_x:+.1f} % along x and {along_y:+.1f} % along y: check pixel_spacing and the size "
        "of the frame in its file",
    )


def second_frame(best: Hypothesis, other: Hypothesis, lines: int) -> Verdict:
    """Refused: the spots that are left show the frame a second time."""
    away_mm = float(np.linalg.norm(other.translation - best.translation))
    return Verdict(
        "ambiguous",
        f"the slice shows the frame twice: {best.inliers} of {lines} rods match, and {other.inliers} of them match "
        f"other spots with the frame {away_mm:.0f} mm away: remove the second frame, or tell them apart by "
        "nominal_orientation and max_rotation_deg",
    )


def _by_chance(
    found: Found, estimates: Sequence[PoseEstimate], frame: Frame, spots: int, options: RegistrationOptions
) -> Verdict | None:
    best = estimates[0]
    if best.log10_false_alarms <= options.max_log10_false_alarms:
        return None
    return Verdict(
        "no_consensus",
        f"chance alone would bring 10^{best.log10_false_alarms:.1f} matches as good as the best one, of "
        f"{best.inliers} rods among {spots} spots; at most 10^{options.max_log10_false_alarms:.3g} are allowed",
    )


def _residual(
    found: Found, estimates: Sequence[PoseEstimate], frame: Frame, spots: int, options: RegistrationOptions
) -> Verdict | None:
    """A residual that the stated errors cannot have caused, or that another scale removes."""
    best = estimates[0]
    misfit = best.scale_misfit
    if misfit.probability < _SCALE_IMPLAUSIBLE:
        return Verdict(
            "contradicted",
            f"the {best.inliers} matched rods fit far better with another pixel spacing or size of the frame: "
            f"chi-square falls by {misfit.fall:.0f} where the spacing is free; it was stated as known to "
            f"{100 * misfit.stated:.2g} %. Check pixel_spacing and the frame file",
        )
    if _plausibility(best) < IMPLAUSIBLE:
        return Verdict(
            "inaccurate",
            f"the residual of {best.residual_rms_px:.2f} pixel RMS over {best.inliers} rods cannot come from "
            f"{_stated(frame, options)}: check pixel spacing and frame file",
        )
    return None


def _several_poses(
    found: Found, estimates: Sequence[PoseEstimate], frame: Frame, spots: int, options: RegistrationOptions
) -> Verdict | None:
    if len(estimates) == 1:
        return None
    poses = []
    for estimate in estimates[:_LISTED]:
        pose = estimate.scanner_from_frame
        position = ", ".join(f"{value:.1f}" for value in pose.translation)
        turn = ", ".join(f"{value:.3f}" for value in pose.quaternion_xyzw)
        poses.append(f"position ({position}) mm, quaternion ({turn}), residual {estimate.residual_rms_mm:.2f} mm")
    listed = "; ".join(poses) + ("; and more" if len(estimates) > _LISTED else "")
    matched = {frozenset((match.line, match.spot) for match in estimate.matches) for estimate in estimates}
    turns = [one.scanner_from_frame.rotation @ estimates[0].scanner_from_frame.rotation.T for one in estimates]
    same_orientation = math.degrees(float(rotation_angle(np.array(turns)).max())) < _SAME_ORIENTATION_DEG
    if same_orientation and len(matched) > 1:
        advice = (
            "they differ in which spots are rods, not in how the frame stands: rods that are off their places, or "
            f"{_stated(frame, options)} stated too small, look so"
        )
    else:
        advice = "tell them apart by nominal_orientation and max_rotation_deg"
    return Verdict("ambiguous", f"{len(estimates)} poses explain the slice equally well, {advice}: {listed}")


def _near_misses(
    found: Found, estimates: Sequence[PoseEstimate], frame: Frame, spots: int, options: RegistrationOptions
) -> Verdict | None:
    best = found.hypotheses[0]
    # The residual and what another scale takes from it are no two witnesses.
    probability = min(_plausibility(estimates[0]), estimates[0].scale_misfit.probability)
    if best.near_misses + _evidence(probability) <= _MOST_EVIDENCE:
        return None
    both = "" if best.near_misses > _MOST_EVIDENCE else ", and those matched do not fit well"
    return Verdict(
        "contradicted",
        f"{best.inliers} of {len(frame)} rods are matched, but beside the places of others, which have no spot, there "
        f"are unmatched spots that would be theirs if something were slightly wrong{both}: check frame file, pixel "
        "spacing and nominal orientation",
    )


def _pieces(
    found: Found, estimates: Sequence[PoseEstimate], frame: Frame, spots: int, options: RegistrationOptions
) -> Verdict | None:
    best = found.hypotheses[0]
    if best.pieces <= _MOST_EVIDENCE:
        return None
    return Verdict(
        "inaccurate",
        f"{best.inliers} of {len(frame)} rods are matched, but unmatched spots crowd about theirs, as where spots have "
        "fallen to pieces: the centre of such a spot is at none of its pieces; check threshold and min_spot_area_mm2",
    )


def _precision(best: PoseEstimate, options: RegistrationOptions) -> Verdict | None:
    """A pose that is determined too weakly."""
    if best.rotation_std_deg > DEGENERATE_ROTATION_DEG:
        axis = np.linalg.eigh(best.covariance[3:, 3:])[1][:, -1]
        return Verdict(
            "degenerate",
            f"the rotation about the axis {np.round(axis, 2).tolist()} of the scanner is known only to "
            f"{best.rotation_std_deg:.1f} degrees",
        )
    if best.position_std_mm > options.max_position_std_mm:
        return Verdict(
            "inaccurate",
            f"the position has a standard deviation of {best.position_std_mm:.2f} mm, "
            f"at most {options.max_position_std_mm:g} mm are allowed",
        )
    target_error_mm = best.target_error_95_mm(options.target_in_frame_mm)
    if target_error_mm > options.max_target_error_mm:
        target = ", ".join(f"{value:g}" for value in options.target_in_frame_mm)
        return Verdict(
            "inaccurate",
            f"95 % of the errors at the target ({target}) mm of the frame are within {target_error_mm:.2f} mm, "
            f"{options.max_target_error_mm:g} mm are allowed; where that is enough for what is planned, raise "
            "max_target_error_mm",
        )
    return None


def _caution(best: PoseEstimate, options: RegistrationOptions) -> str:
    cautions = []
    if _plausibility(best) < _DOUBTFUL:
        cautions.append(
            f"the residual of {best.residual_rms_px:.2f} pixel RMS is large for a spot noise of "
            f"{options.spot_noise_px:g} pixel"
        )
    if best.position_std_mm > WEAK_POSITION_MM or best.rotation_std_deg > WEAK_ROTATION_DEG:
        cautions.append(
            f"weakly determined: standard deviation {best.position_std_mm:.2f} mm, {best.rotation_std_deg:.2f} degrees"
        )
    if options.max_rotation_deg >= 180.0:
        cautions.append(
            "no nominal orientation is configured: one slice cannot show a mirrored image or a left-handed frame file"
        )
    return "; ".join(cautions)


def _evidence(probability: float) -> float:
    """The most that so small a probability says against a hypothesis, log (Sellke, Bayarri and Berger 2001)."""
    if probability >= math.exp(-1.0):
        return 0.0
    probability = max(probability, sys.float_info.min)
    return -math.log(-math.e * probability * math.log(probability))


def _plausibility(best: PoseEstimate) -> float:
    return float(chi2.sf(best.chi_square, best.degrees_of_freedom))


def _stated(frame: Frame, options: RegistrationOptions) -> str:
    tolerances_mm = frame.tolerances_or(options.frame_tolerance_mm)
    return (
        f"a spot noise of {options.spot_noise_px:g} pixel, a frame tolerance of {tolerances_mm.max():g} mm and a scale "
        f"tolerance of {100 * options.scale_tolerance:g} %"
    )


def _describe_nothing(found: Found, lines: int, spots: int, options: RegistrationOptions) -> str:
    nothing = f"no pose puts {min(found.least_rods, lines)} of the {lines} rods on any of the {spots} spots"
    if found.least_rods <= options.min_inliers:
        return nothing
    fewer = f"{found.least_rods - 1} rods could hardly be told from chance among so many spots"
    return f"{nothing}, and {fewer}" if found.least_rods <= lines else fewer
