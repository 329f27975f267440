"""The only place that accepts a pose or refuses it: each reason with its threshold and its sentence."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtrc

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import rotation_angle
from stereoreg_ros.matching.consensus import IMPLAUSIBLE
from stereoreg_ros.matching.hypothesis import Found
from stereoreg_ros.matching.level_search import SearchGivenUpError
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.rivals import Rivals
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
# A nominal orientation cannot distinguish poses whose rotations differ by less.
_SAME_ORIENTATION_DEG = 10.0
# Of several poses, how many a sentence lists.
_LISTED = 8


@dataclass(frozen=True)
class Verdict:
    """Accepted with a caution, which may be empty, where `reason` is None; else refused, and the message says why."""

    reason: Reason | None
    message: str


@dataclass(frozen=True, eq=False)
class Case:
    """All that a judgement rests on.

    problem: what was to be matched; options: as the caller gave them; found: what the matcher came to; estimates: of
    `found.hypotheses`, best first; rivals: other explanations that speak against the best one, which take long to seek
    and are asked for only where nothing else does.
    """

    problem: Problem
    options: RegistrationOptions
    found: Found
    estimates: tuple[PoseEstimate, ...]
    rivals: Rivals

    @property
    def best(self) -> PoseEstimate:
        """The best explanation."""
        return self.estimates[0]

    @property
    def rods(self) -> int:
        """How many the frame has."""
        return len(self.problem.frame)

    @property
    def spots(self) -> int:
        """How many were offered."""
        return len(self.problem.spots.mm)

    @property
    def matched(self) -> str:
        """How many rods of how many the best explanation matches, in words."""
        return f"{self.best.inliers} of {self.rods} rods"

    @property
    def stated(self) -> str:
        """What spots, frame and scale were stated to be known to, in words."""
        tolerances_mm = self.problem.frame.tolerances_or(self.options.frame_tolerance_mm)
        return (
            f"a spot noise of {self.options.spot_noise_px:g} pixel, a frame tolerance of {tolerances_mm.max():g} mm "
            f"and a scale tolerance of {100 * self.options.scale_tolerance:g} %"
        )


def unfit(frame: Frame, spots: int, options: RegistrationOptions) -> Verdict | None:
    """Why a slice is refused before anything is sought, by the number of its spots; None where it is not."""
    return check_orientation(frame, options) or check_count(spots, options)


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


def judge(case: Case) -> Verdict:
    """Accept the best explanation of a slice, or refuse it for the first reason there is."""
    try:
        for reason in _REASONS:
            verdict = reason(case)
            if verdict is not None:
                return verdict
    except SearchGivenUpError:
        return Verdict(
            "no_consensus",
            f"a pose of {case.best.inliers} rods was found, but the search for one that contradicts it among "
            f"{case.spots} spots took too long: raise the threshold, or reduce clutter",
        )
    return Verdict(None, _caution(case.best, case.options))


def _given_up(case: Case) -> Verdict | None:
    if not case.found.given_up:
        return None
    return Verdict("no_consensus", f"the search among {case.spots} spots was {case.found.given_up}")


def _nothing_found(case: Case) -> Verdict | None:
    if case.estimates:
        return None
    fewest = case.found.least_rods
    nothing = f"no pose puts {min(fewest, case.rods)} of the {case.rods} rods on any of the {case.spots} spots"
    if fewest <= case.problem.min_inliers:
        return Verdict("no_consensus", nothing)
    fewer = f"{fewest - 1} rods could hardly be distinguished from chance among that many spots"
    return Verdict("no_consensus", f"{nothing}, and {fewer}" if fewest <= case.rods else fewer)


def _by_chance(case: Case) -> Verdict | None:
    best, allowed = case.best, case.problem.max_log10_false_alarms
    if best.log10_false_alarms <= allowed:
        return None
    return Verdict(
        "no_consensus",
        f"chance alone would bring 10^{best.log10_false_alarms:.1f} matches as good as the best one, of "
        f"{best.inliers} rods among {case.spots} spots; at most 10^{allowed:.3g} are allowed",
    )


def _fits_another_scale(case: Case) -> Verdict | None:
    """A residual that another scale removes."""
    best = case.best
    misfit = best.scale_misfit
    if misfit.probability < _SCALE_IMPLAUSIBLE:
        return Verdict(
            "contradicted",
            f"the {best.inliers} matched rods fit far better with another pixel spacing or size of the frame: "
            f"chi-square falls by {misfit.fall:.0f} where the spacing is free; it was stated as known to "
            f"{100 * misfit.stated:.2g} %. Check pixel_spacing and the frame file",
        )
    return None


def _residual(case: Case) -> Verdict | None:
    """A residual that the stated errors cannot have caused."""
    best = case.best
    if _plausibility(best) < IMPLAUSIBLE:
        return Verdict(
            "inaccurate",
            f"the residual of {best.residual_rms_px:.2f} pixel RMS over {best.inliers} rods cannot come from "
            f"{case.stated}: check pixel spacing and frame file",
        )
    return None


def _several_poses(case: Case) -> Verdict | None:
    estimates = case.estimates
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
            f"{case.stated} stated too small, look so"
        )
    else:
        advice = "tell them apart by nominal_orientation and max_rotation_deg"
    return Verdict("ambiguous", f"{len(estimates)} poses explain the slice equally well, {advice}: {listed}")


def _near_misses(case: Case) -> Verdict | None:
    best = case.found.hypotheses[0]
    # The residual and what another scale takes from it are no two witnesses.
    probability = min(_plausibility(case.best), case.best.scale_misfit.probability)
    if best.near_misses + _evidence(probability) <= _MOST_EVIDENCE:
        return None
    both = "" if best.near_misses > _MOST_EVIDENCE else ", and those matched do not fit well"
    return Verdict(
        "contradicted",
        f"{case.matched} are matched, but beside the places of others, which have no spot, there "
        f"are unmatched spots that would be theirs if something were slightly wrong{both}: check frame file, pixel "
        "spacing and nominal orientation",
    )


def _pieces(case: Case) -> Verdict | None:
    if case.found.hypotheses[0].pieces <= _MOST_EVIDENCE:
        return None
    return Verdict(
        "inaccurate",
        f"{case.matched} are matched, but unmatched spots crowd about theirs, as where spots have "
        "fallen to pieces: the centre of such a spot is at none of its pieces; check threshold and min_spot_area_mm2",
    )


def _open_rotation(case: Case) -> Verdict | None:
    best = case.best
    if best.rotation_std_deg > DEGENERATE_ROTATION_DEG:
        axis = np.linalg.eigh(best.covariance[3:, 3:])[1][:, -1]
        return Verdict(
            "degenerate",
            f"the rotation about the axis {np.round(axis, 2).tolist()} of the scanner is known only to "
            f"{best.rotation_std_deg:.1f} degrees",
        )
    return None


def _weak_position(case: Case) -> Verdict | None:
    best, options = case.best, case.options
    if best.position_std_mm > options.max_position_std_mm:
        return Verdict(
            "inaccurate",
            f"the position has a standard deviation of {best.position_std_mm:.2f} mm, "
            f"at most {options.max_position_std_mm:g} mm are allowed",
        )
    return None


def _weak_at_target(case: Case) -> Verdict | None:
    options = case.options
    target_error_mm = case.best.target_error_95_mm(options.target_in_frame_mm)
    if target_error_mm > options.max_target_error_mm:
        target = ", ".join(f"{value:g}" for value in options.target_in_frame_mm)
        return Verdict(
            "inaccurate",
            f"95 % of the errors at the target ({target}) mm of the frame are within {target_error_mm:.2f} mm, "
            f"{options.max_target_error_mm:g} mm are allowed; where that is enough for what is planned, raise "
            "max_target_error_mm",
        )
    return None


def _other_scale(case: Case) -> Verdict | None:
    """One rod more has its spot with another scale, and that is clearly likelier."""
    other = case.rivals.other_scale()
    if other is None or other.evidence <= _MOST_EVIDENCE:
        return None
    along_x, along_y = -100 * other.too_large
    return Verdict(
        "contradicted",
        f"{case.matched} match with the stated pixel spacing, but {other.inliers}, and clearly better, "
        f"with one changed by {along_x:+.1f} % along x and {along_y:+.1f} % along y: check pixel_spacing and the size "
        "of the frame in its file",
    )


def _other_orientation(case: Case) -> Verdict | None:
    """Beyond the configured orientation another explanation is clearly better."""
    other, prior = case.rivals.beyond_prior(), case.problem.prior
    if other is None:
        return None
    angle_deg = math.degrees(float(prior.angles(other.rotation)))
    return Verdict(
        "contradicted",
        f"{case.matched} match within {math.degrees(prior.max_rotation):g} degrees of "
        f"nominal_orientation, but {other.inliers}, and clearly better, with the frame at {angle_deg:.0f} degrees from "
        "it: check nominal_orientation, max_rotation_deg and how the patient or frame lies",
    )


def _second_frame(case: Case) -> Verdict | None:
    """The spots that are left show the frame a second time."""
    other = case.rivals.second_frame()
    if other is None:
        return None
    away_mm = float(np.linalg.norm(other.translation - case.found.hypotheses[0].translation))
    return Verdict(
        "ambiguous",
        f"the slice shows the frame twice: {case.matched} match, and {other.inliers} of them match "
        f"other spots with the frame {away_mm:.0f} mm away: remove the second frame, or tell them apart by "
        "nominal_orientation and max_rotation_deg",
    )


# In this order: what comes first is to be cured first, and the rivals, which take long, are sought last.
_REASONS: Final[tuple[Callable[[Case], Verdict | None], ...]] = (
    _given_up,
    _nothing_found,
    _by_chance,
    _fits_another_scale,
    _residual,
    _several_poses,
    _near_misses,
    _pieces,
    _open_rotation,
    _weak_position,
    _weak_at_target,
    _other_scale,
    _other_orientation,
    _second_frame,
)


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
    return float(chdtrc(best.degrees_of_freedom, best.chi_square))
