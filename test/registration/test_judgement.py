"""Each reason of a refusal from both sides of its threshold, with its figures, and on slices that deserve it."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stereoreg_ros import Pose, RegistrationOptions, judgement, load_frame, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.judgement import (
    DEGENERATE_ROTATION_DEG,
    MAX_SPOTS,
    WEAK_POSITION_MM,
    WEAK_ROTATION_DEG,
    Case,
    Verdict,
    check_count,
    check_orientation,
    judge,
)
from stereoreg_ros.matching import level_search, rivals
from stereoreg_ros.matching.by_levels import ByLevels
from stereoreg_ros.matching.consensus import IMPLAUSIBLE
from stereoreg_ros.matching.hypothesis import UNMATCHED, Found, Hypothesis
from stereoreg_ros.matching.level_search import LevelSearch, SearchGivenUpError
from stereoreg_ros.matching.other_scale import OtherScale
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.rivals import Rivals
from stereoreg_ros.result import Match, PoseEstimate, Refusal, Registration
from stereoreg_ros.simulation import ScannerSettings, centred_pose, random_pose
from stereoreg_ros.simulation.mistakes import Surroundings, contradicted_prior, sister
from stereoreg_ros.uncertainty import ScaleMisfit

FRAME = load_frame("cube6")
SCANNER = ScannerSettings()
SCALE = SCANNER.scale
AREA_MM2 = float(np.prod(SCANNER.size_mm))
# With an orientation, so that nothing is said of mirrored images.
STANDING = RegistrationOptions(max_rotation_deg=40.0)
SURE = np.diag([0.01, 0.01, 0.01, 1e-6, 1e-6, 1e-6])
SPOTS = 9
HANDEDNESS = "one slice cannot show a mirrored image or a left-handed frame file"


def estimate(rods: int = 6, pose: Pose | None = None, first_spot: int = 0) -> PoseEstimate:
    """One that nothing speaks against, with residuals of 0.5 pixel."""
    at, aside = np.zeros(2), np.array([0.3, 0.4])
    matches = tuple(Match(FRAME.line_names[row], row, first_spot + row, at, at + aside, 0.25) for row in range(rods))
    where = pose or Pose(np.eye(3), np.array([12.0, -3.5, 400.0]))
    return PoseEstimate(where, where, SURE, matches, 2.0 * rods - 6, -9.0, ScaleMisfit(1.0, 2, 0.002))


def hypothesis(rods: int = 6, pose: Pose | None = None, near_misses: float = 0.0, pieces: float = 0.0) -> Hypothesis:
    where = pose or Pose.identity()
    spot_of_line = np.where(np.arange(6) < rods, np.arange(6), UNMATCHED)
    return Hypothesis(where.rotation, where.translation, spot_of_line, 1.0, np.eye(6), 0, near_misses, pieces)


class Told(Rivals):
    """Rivals as they are told; notes which were asked for."""

    def __init__(
        self,
        scale: OtherScale | None = None,
        orientation: Hypothesis | None = None,
        second: Hypothesis | None = None,
        given_up: bool = False,
    ) -> None:
        self.scale, self.orientation, self.second, self.given_up = scale, orientation, second, given_up
        self.asked: list[str] = []

    def other_scale(self) -> OtherScale | None:
        self.asked.append("scale")
        return self.scale

    def beyond_prior(self) -> Hypothesis | None:
        self.asked.append("orientation")
        if self.given_up:
            raise SearchGivenUpError
        return self.orientation

    def second_frame(self) -> Hypothesis | None:
        self.asked.append("second")
        return self.second


def judged(
    *estimates: PoseEstimate,
    options: RegistrationOptions = STANDING,
    near_misses: float = 0.0,
    pieces: float = 0.0,
    rivals: Told | None = None,
) -> Verdict:
    best = hypothesis(estimates[0].inliers, near_misses=near_misses, pieces=pieces)
    found = Found([best, *[hypothesis() for _ in estimates[1:]]], 4)
    return judge(case_of(found, estimates, options=options, rivals=rivals))


def case_of(
    found: Found,
    estimates: tuple[PoseEstimate, ...] = (),
    frame: Frame = FRAME,
    spots: int = SPOTS,
    options: RegistrationOptions = STANDING,
    rivals: Told | None = None,
) -> Case:
    problem = Problem.of(SliceSpots(np.zeros((spots, 2)), SCALE), frame, options)
    return Case(problem, options, found, estimates, rivals or Told())


def with_errors(position_mm: float, rotation_deg: float) -> PoseEstimate:
    """Standard deviations along the worst axes, x and z."""
    variances = np.array([position_mm, 0.0, 0.0, 0.0, 0.0, math.radians(rotation_deg)]) ** 2
    return replace(estimate(), covariance=np.diag(variances + 1e-12))


class TestCounts:
    @pytest.mark.parametrize(
        ("spots", "reason"),
        [(0, "too_few_spots"), (4, "too_few_spots"), (5, None), (MAX_SPOTS, None), (MAX_SPOTS + 1, "no_consensus")],
    )
    def test_of_spots(self, spots: int, reason: str | None) -> None:
        verdict = check_count(spots, RegistrationOptions(min_inliers=5))
        assert (verdict.reason if verdict else None) == reason
        if verdict is not None:
            assert str(spots) in verdict.message
            assert str(MAX_SPOTS if spots > MAX_SPOTS else 5) in verdict.message


class TestOrientationRequired:
    ASKING = replace(FRAME, name="a symmetric one", orientation_required=True)

    @pytest.mark.parametrize("degrees", [0.1, 90.0, 179.9])
    def test_is_met_by_any_that_excludes_something(self, degrees: float) -> None:
        assert check_orientation(self.ASKING, RegistrationOptions(max_rotation_deg=degrees)) is None

    def test_is_not_asked_of_other_frames(self) -> None:
        assert check_orientation(FRAME, RegistrationOptions()) is None

    def test_refuses_every_slice_without_one(self) -> None:
        verdict = check_orientation(self.ASKING, RegistrationOptions())
        assert verdict is not None
        assert verdict.reason == "ambiguous"
        for told in ("'a symmetric one'", "orientation_required", "nominal_orientation", "max_rotation_deg"):
            assert told in verdict.message

    def test_of_a_slice(self) -> None:
        pose = random_pose(np.random.default_rng(1), FRAME, SCANNER)
        spots, _ = project(FRAME, pose, SCALE)
        refused = register_spots(spots, self.ASKING, SCALE)
        assert not refused
        assert (refused.reason, refused.estimates) == ("ambiguous", ())
        assert "orientation_required" in refused.message
        # Even of a slice with too few spots it is the first thing to be cured.
        assert "orientation_required" in message(register_spots([], self.ASKING, SCALE))
        assert register_spots(spots, self.ASKING, SCALE, STANDING)


def message(result: Registration | Refusal) -> str:
    assert not result
    return result.message


class TestAccepted:
    def test_what_nothing_speaks_against_without_a_caution(self) -> None:
        assert judged(estimate()) == Verdict(None, "")

    def test_with_a_caution_where_no_orientation_is_configured(self) -> None:
        for degrees, told in ((180.0, True), (179.9, False)):
            verdict = judged(estimate(), options=RegistrationOptions(max_rotation_deg=degrees))
            assert verdict.reason is None
            assert (HANDEDNESS in verdict.message) == told

    @pytest.mark.parametrize(
        ("position_mm", "rotation_deg", "told"),
        [
            (0.99 * WEAK_POSITION_MM, 0.99 * WEAK_ROTATION_DEG, False),
            (1.01 * WEAK_POSITION_MM, 0.1, True),
            (0.1, 1.01 * WEAK_ROTATION_DEG, True),
        ],
    )
    def test_with_a_caution_where_it_is_weak(self, position_mm: float, rotation_deg: float, told: bool) -> None:
        verdict = judged(with_errors(position_mm, rotation_deg))
        assert verdict.reason is None
        assert bool(verdict.message) == told
        if told:
            assert f"weakly determined: standard deviation {position_mm:.2f} mm, {rotation_deg:.2f} degrees" in (
                verdict.message
            )

    def test_all_cautions_are_told(self) -> None:
        doubtful = replace(with_errors(0.6, 0.1), chi_square=chi2.isf(0.9 * judgement._DOUBTFUL, 6))
        verdict = judged(doubtful, options=RegistrationOptions())
        assert verdict.reason is None
        assert len(verdict.message.split("; ")) == 3


class TestChance:
    @pytest.mark.parametrize(("log10", "reason"), [(-6.5, "no_consensus"), (-7.0, None)])
    def test_is_ruled_out_at_what_is_allowed(self, log10: float, reason: str | None) -> None:
        options = replace(STANDING, max_log10_false_alarms=-7.0)
        verdict = judged(replace(estimate(5), log10_false_alarms=log10), options=options)
        assert verdict.reason == reason
        if reason:
            assert "10^-6.5 matches as good as the best one, of 5 rods among 9 spots" in verdict.message
            assert "at most 10^-7 are allowed" in verdict.message


class TestNothingFound:
    def test_a_search_given_up_says_why(self) -> None:
        verdict = judge(case_of(Found([], 5, "given up: a reason"), spots=120))
        assert verdict.reason == "no_consensus"
        assert "120 spots was given up: a reason" in verdict.message

    @pytest.mark.parametrize(
        ("least_rods", "told"),
        [
            (4, r"^no pose puts 4 of the 6 rods on any of the 9 spots$"),
            (
                5,
                r"^no pose puts 5 of the 6 rods on any of the 9 spots, "
                r"and 4 rods could hardly be distinguished from chance",
            ),
            (7, r"^6 rods could hardly be distinguished from chance among that many spots$"),
        ],
    )
    def test_says_how_far_was_searched(self, least_rods: int, told: str) -> None:
        verdict = judge(case_of(Found([], least_rods)))
        assert verdict.reason == "no_consensus"
        assert re.search(told, verdict.message), verdict.message


class TestResidual:
    @pytest.mark.parametrize("rods", [4, 6])
    def test_is_refused_and_doubted_by_its_probability(self, rods: int) -> None:
        freedom = 2 * rods - 6
        refused, doubted = IMPLAUSIBLE, judgement._DOUBTFUL
        # A few of a thousand true slices at most are lost for it, and more are doubted.
        assert 1e-3 <= refused <= 0.02
        assert refused < doubted <= 0.1
        for probability, reason, told in (
            (0.98 * refused, "inaccurate", "cannot come from"),
            (1.02 * refused, None, "is large for"),
            (0.98 * doubted, None, "is large for"),
            (1.02 * doubted, None, ""),
        ):
            verdict = judged(replace(estimate(rods), chi_square=float(chi2.isf(probability, freedom))))
            assert verdict.reason == reason
            assert told in verdict.message
            assert bool(told) == bool(verdict.message)

    def test_sentence_names_all_that_was_stated(self) -> None:
        options = replace(STANDING, spot_noise_px=0.25, frame_tolerance_mm=0.4, scale_tolerance=0.015)
        verdict = judged(replace(estimate(), chi_square=99.0), options=options)
        for told in ("0.50 pixel RMS over 6 rods", "noise of 0.25 pixel", "tolerance of 0.4 mm", "tolerance of 1.5 %"):
            assert told in verdict.message
        # The frame file's own tolerance counts before the option, and the largest of them.
        own = replace(FRAME, tolerances_mm=np.array([0.1, 0.1, 0.7, 0.1, 0.1, 0.1]))
        found = Found([hypothesis()], 4)
        verdict = judge(case_of(found, (replace(estimate(), chi_square=99.0),), own, options=options))
        assert "frame tolerance of 0.7 mm" in verdict.message


class TestScale:
    @pytest.mark.parametrize("freedom", [2, 3])
    @pytest.mark.parametrize(("probability", "reason"), [(4.9e-3, "contradicted"), (5.1e-3, None)])
    def test_that_fits_far_better_contradicts(self, probability: float, reason: str | None, freedom: int) -> None:
        misfit = float(chi2.isf(probability, freedom))
        verdict = judged(replace(estimate(), scale_misfit=ScaleMisfit(misfit, freedom, 0.002)))
        assert verdict.reason == reason
        if reason:
            assert "6 matched rods fit far better with another pixel spacing or size of the frame" in verdict.message
            assert f"chi-square falls by {misfit:.0f}" in verdict.message
            assert "known to 0.2 %" in verdict.message
            assert "pixel_spacing and the frame file" in verdict.message

    def test_is_told_before_the_residual_that_it_causes(self) -> None:
        both = replace(estimate(), scale_misfit=ScaleMisfit(50.0, 2, 0.002), chi_square=70.0)
        assert judged(both).reason == "contradicted"


class TestSeveralPoses:
    def test_are_ambiguous_and_listed(self) -> None:
        turned = Pose(rotation_exp(np.array([0.0, 0.0, math.pi])), np.array([1.0, 2.0, 3.0]))
        verdict = judged(estimate(), estimate(pose=turned))
        assert verdict.reason == "ambiguous"
        assert "2 poses explain the slice equally well, tell them apart by nominal_orientation" in verdict.message
        assert "position (12.0, -3.5, 400.0) mm" in verdict.message
        assert "position (1.0, 2.0, 3.0) mm, quaternion (0.000, 0.000, 1.000, 0.000)" in verdict.message

    def test_of_one_orientation_are_not_told_apart_by_one(self) -> None:
        """Of other spots, and the frame standing as before: it is the spots or the frame that are off."""
        near = Pose(rotation_exp(np.array([0.0, 0.0, math.radians(9.0)])), np.array([13.0, -3.5, 400.0]))
        verdict = judged(estimate(), estimate(5, near, first_spot=1))
        assert verdict.reason == "ambiguous"
        assert "they differ in which spots are rods" in verdict.message
        assert "frame tolerance of 0.2 mm" in verdict.message
        far = Pose(rotation_exp(np.array([0.0, 0.0, math.radians(11.0)])), near.translation)
        assert "nominal_orientation" in judged(estimate(), estimate(5, far, first_spot=1)).message
        # The same matches twice: a turn is all that parts them.
        assert "nominal_orientation" in judged(estimate(), estimate(6, near)).message

    def test_are_told_after_a_residual_that_cannot_be(self) -> None:
        """Of poses none of which fits, it is no help to be told apart."""
        turned = Pose(rotation_exp(np.array([0.0, 0.0, math.pi])), np.array([1.0, 2.0, 3.0]))
        assert judged(replace(estimate(), chi_square=99.0), estimate(pose=turned)).reason == "inaccurate"

    def test_no_more_than_eight_are_listed(self) -> None:
        verdict = judged(*[estimate() for _ in range(11)])
        assert verdict.message.startswith("11 poses explain")
        assert verdict.message.count("residual 0.25 mm") == 8
        assert verdict.message.endswith("; and more")


class TestNearMisses:
    @pytest.mark.parametrize(("factor", "reason"), [(1.01, "contradicted"), (0.99, None)])
    def test_speak_against_a_pose(self, factor: float, reason: str | None) -> None:
        most = judgement._MOST_EVIDENCE
        # One frame in some hundreds to thousands is not as described.
        assert math.log(100) < most < math.log(1e4)
        verdict = judged(estimate(), near_misses=factor * most)
        assert verdict.reason == reason
        if reason:
            assert "6 of 6 rods are matched, but beside the places of others" in verdict.message
            for told in ("frame file", "pixel spacing", "nominal orientation"):
                assert told in verdict.message

    @pytest.mark.parametrize(("near_misses", "probability", "reason"), [(5.5, 0.02, "contradicted"), (5.5, 0.3, None)])
    def test_and_a_poor_fit_speak_together(self, near_misses: float, probability: float, reason: str | None) -> None:
        """The same of a scale that fits better, and of the residual: 0.02 makes up for a factor of four to five."""
        assert judged(estimate(), near_misses=near_misses).reason is None
        scale = ScaleMisfit(float(chi2.isf(probability, 2)), 2, 0.002)
        residual = float(chi2.isf(probability, 6))
        for doubted in (replace(estimate(), scale_misfit=scale), replace(estimate(), chi_square=residual)):
            verdict = judged(doubted, near_misses=near_misses)
            assert verdict.reason == reason
            assert ("those matched do not fit well" in verdict.message) == bool(reason)

    def test_the_residual_and_what_another_scale_takes_from_it_are_one_witness(self) -> None:
        scale, residual = ScaleMisfit(float(chi2.isf(0.3, 2)), 2, 0.002), float(chi2.isf(0.3, 6))
        both = replace(estimate(), scale_misfit=scale, chi_square=residual)
        assert judged(both, near_misses=judgement._MOST_EVIDENCE - 0.3).reason is None
        assert judged(both, near_misses=judgement._MOST_EVIDENCE - 0.01).reason == "contradicted"


@pytest.mark.parametrize(("probability", "evidence"), [(0.4, 0.0), (0.05, math.log(2.456)), (0.001, math.log(53.26))])
def test_what_a_small_probability_says_at_most(probability: float, evidence: float) -> None:
    """Sellke, Bayarri and Berger 2001: one over -e p log p; of 0.05 that is odds of five to two, no more."""
    assert judgement._evidence(probability) == pytest.approx(evidence, abs=1e-3)


class TestPrecision:
    @pytest.mark.parametrize(("degrees", "reason"), [(1.01, "degenerate"), (0.99, None)])
    def test_a_rotation_that_is_open_is_named(self, degrees: float, reason: str | None) -> None:
        degrees *= DEGENERATE_ROTATION_DEG
        open_end = replace(STANDING, max_target_error_mm=1000.0)
        verdict = judged(with_errors(0.1, degrees), options=open_end)
        assert verdict.reason == reason
        if reason:
            assert f"known only to {degrees:.1f} degrees" in verdict.message
            assert "axis [" in verdict.message
            assert "1.0]" in verdict.message

    @pytest.mark.parametrize(("position_mm", "reason"), [(1.01, "inaccurate"), (0.99, None)])
    def test_a_position(self, position_mm: float, reason: str | None) -> None:
        options = replace(STANDING, max_position_std_mm=1.0)
        verdict = judged(with_errors(position_mm, 0.1), options=options)
        assert verdict.reason == reason
        if reason:
            assert "standard deviation of 1.01 mm, at most 1 mm are allowed" in verdict.message

    def test_the_error_at_the_target_is_three_millimetres_at_most_by_default(self) -> None:
        """Of an error along one direction the ball that holds 95 % has a radius of 1.96 standard deviations."""
        deviation = 3.0 / math.sqrt(chi2.isf(0.05, 1))
        weak, good = with_errors(1.001 * deviation, 0.01), with_errors(0.999 * deviation, 0.01)
        assert judged(good).reason is None
        verdict = judged(weak)
        assert verdict.reason == "inaccurate"
        assert "target (0, 0, 0) mm of the frame are within 3.00 mm, 3 mm are allowed" in verdict.message
        assert "raise max_target_error_mm" in verdict.message
        assert judged(weak, options=replace(STANDING, max_target_error_mm=1000.0)).reason is None

    def test_is_that_at_the_target(self) -> None:
        """A degree about z moves what is 100 mm away along x by 1.7 mm."""
        turned = with_errors(0.01, 1.0)
        assert judged(turned).reason is None
        away = replace(STANDING, target_in_frame_mm=(100.0, 0.0, 0.0))
        verdict = judged(turned, options=away)
        assert verdict.reason == "inaccurate"
        assert f"target (100, 0, 0) mm of the frame are within {1.96 * math.radians(100):.2f} mm" in verdict.message


@pytest.mark.parametrize(("pieces", "reason"), [(math.log(1001), "inaccurate"), (math.log(999), None)])
def test_pieces(pieces: float, reason: str | None) -> None:
    verdict = judged(estimate(), pieces=pieces)
    assert verdict.reason == reason
    if reason:
        assert "unmatched spots crowd about theirs" in verdict.message
        assert "check threshold and min_spot_area_mm2" in verdict.message


class TestOrder:
    def test_rivals_are_sought_only_where_nothing_else_refuses(self) -> None:
        rivals = Told(second=hypothesis(5))
        for one in (
            replace(estimate(), log10_false_alarms=0.0),
            replace(estimate(), chi_square=99.0),
            with_errors(5.0, 0.1),
            with_errors(0.1, 20.0),
        ):
            assert judged(one, rivals=rivals).reason in ("no_consensus", "inaccurate", "degenerate")
        assert judged(estimate(), estimate(), rivals=rivals).reason == "ambiguous"
        assert judged(estimate(), near_misses=99.0, rivals=rivals).reason == "contradicted"
        assert rivals.asked == []
        assert "shows the frame twice" in judged(estimate(), rivals=rivals).message
        assert rivals.asked == ["scale", "orientation", "second"]

    def test_chance_comes_first(self) -> None:
        """What chance could bring has no residual to be judged, and twins."""
        verdict = judged(
            replace(estimate(), log10_false_alarms=-1.0, chi_square=99.0, scale_misfit=ScaleMisfit(99.0, 2, 0.002)),
            estimate(),
            near_misses=99,
        )
        assert verdict.reason == "no_consensus"


class TestRivals:
    """One after the other, each with its figures."""

    WRONG = np.array([0.051, -0.004])

    def test_of_another_orientation(self) -> None:
        other = Pose(rotation_exp(np.array([0.0, 0.0, math.radians(170.0)])), np.zeros(3))
        options = replace(STANDING, max_rotation_deg=30.0)
        verdict = judged(estimate(5), options=options, rivals=Told(orientation=hypothesis(6, other)))
        assert verdict.reason == "contradicted"
        assert "5 of 6 rods match within 30 degrees of nominal_orientation, but 6" in verdict.message
        assert "at 170 degrees" in verdict.message

    def test_of_another_scale(self) -> None:
        """Refused from a thousand to one."""
        verdict = judged(estimate(5), rivals=Told(OtherScale(6, self.WRONG, math.log(1001))))
        assert verdict.reason == "contradicted"
        assert "5 of 6 rods match with the stated pixel spacing, but 6" in verdict.message
        assert "changed by -5.1 % along x and +0.4 % along y: check pixel_spacing" in verdict.message
        assert judged(estimate(5), rivals=Told(OtherScale(6, self.WRONG, math.log(999)))).reason is None

    def test_a_second_frame(self) -> None:
        other = Pose(np.eye(3), np.array([30.0, 40.0, 0.0]))
        verdict = judged(estimate(6), rivals=Told(second=hypothesis(5, other)))
        assert verdict.reason == "ambiguous"
        assert "twice: 6 of 6 rods match, and 5 of them match other spots with the frame 50 mm away" in verdict.message

    def test_what_refuses_first_ends_the_search(self) -> None:
        rivals = Told(OtherScale(6, self.WRONG, 50.0), hypothesis(6), hypothesis(5))
        assert "pixel spacing" in judged(estimate(5), rivals=rivals).message
        assert rivals.asked == ["scale"]

    def test_a_search_that_takes_too_long_is_no_acceptance(self) -> None:
        verdict = judged(estimate(5), rivals=Told(given_up=True))
        assert verdict.reason == "no_consensus"
        assert "a pose of 5 rods was found, but the search for one that contradicts it among 9 spots took too long" in (
            verdict.message
        )


def noisy(rng: np.random.Generator, frame: Frame, pose: Pose) -> Array:
    spots: Array = project(frame, pose, SCALE)[0] + rng.normal(0.0, 0.3, (len(frame), 2))
    return spots


def narrow() -> tuple[Frame, Array]:
    """Five rods that stand together, and their spots, pixel."""
    starts = np.array([[0.0, 0, -30], [9, 0, -30], [0, 9, -30], [9, 9, -30], [4, 5, -30]])
    ends = np.array([[4.0, 2, 30], [6, 7, 30], [5, 3, 30], [0, 5, 30], [9, 0, 30]])
    wider = np.array([2.0, 2.0, 1.0])
    frame = Frame("narrow", tuple("abcde"), wider * starts, wider * ends, np.ones(5))
    pose = Pose(rotation_exp(np.array([0.05, -0.08, 0.2])), np.array([128.0, 128.0, 4.0]))
    return frame, project(frame, pose, SCALE)[0]


class TestSlices:
    """What deserves its refusal, from spots."""

    def test_half_a_turn_is_never_registered_within_thirty_degrees(self) -> None:
        """A patient written as supine who lies prone: 39 of 300 were accepted, half a turn wrong."""
        frame = load_frame("cube8")
        rng = np.random.default_rng(1)
        around = Surroundings(SCANNER, max_rotation_deg=30.0)
        reasons = []
        for _ in range(6):
            scene = contradicted_prior(rng, frame, around, turn_deg=180.0)
            options = RegistrationOptions(max_rotation_deg=30.0)
            result = register_spots(
                scene.spots_px, frame, SCALE, options, slice_area_mm2=scene.slice_area_mm2, previous=scene.previous
            )
            assert not result
            reasons.append(result.reason)
            assert register_spots(scene.spots_px, frame, SCALE, slice_area_mm2=scene.slice_area_mm2)
        assert set(reasons) <= {"contradicted", "no_consensus", "inaccurate", "ambiguous"}

    def test_a_clearly_better_explanation_elsewhere_contradicts_the_orientation(self) -> None:
        """Five of eight rods as configured, and all eight, spots between them, upside down."""
        frame = load_frame("cube8")
        rng = np.random.default_rng(2)
        here = random_pose(rng, frame, SCANNER, nominal=centred_pose(frame, SCANNER, share=(0.5, 0.25)))
        turn = rotation_exp(np.array([math.pi, 0.0, 0.0]))
        nominal = centred_pose(frame, SCANNER, share=(0.5, 0.75), rotation=turn)
        there = random_pose(rng, frame, SCANNER, nominal=nominal)
        false = rng.uniform(0, 512, (3, 2))
        few, many = noisy(rng, frame, here)[:6], noisy(rng, frame, there)
        options = RegistrationOptions(max_rotation_deg=40.0)
        assert register_spots(np.concatenate([few, false]), frame, SCALE, options)
        result = register_spots(np.concatenate([few, many, false]), frame, SCALE, options)
        assert not result
        assert result.reason == "contradicted"
        assert "6 of 8 rods match within 40 degrees of nominal_orientation, but 8" in result.message
        angle = math.degrees(float(rotation_angle(there.rotation)))
        stated = float(re.findall(r"at (\d+) degrees", result.message)[0])
        assert stated == pytest.approx(angle, abs=2.0)
        # Told the other way round, the six are a second frame that stands as it may not.
        upside_down = replace(options, nominal_orientation=(1.0, 0.0, 0.0, 0.0))
        told = register_spots(np.concatenate([few, many, false]), frame, SCALE, upside_down)
        assert told
        assert told.estimate.inliers == 8

    @pytest.mark.parametrize("away_mm", [2.0, 5.0])
    def test_a_rod_whose_spot_lies_millimetres_aside_contradicts(self, away_mm: float) -> None:
        frame = load_frame("cube8")
        rng = np.random.default_rng(3)
        options = RegistrationOptions(max_rotation_deg=60.0)
        for _ in range(5):
            pose = random_pose(rng, frame, SCANNER)
            spots = noisy(rng, frame, pose)
            assert register_spots(spots[1:], frame, SCALE, options, slice_area_mm2=AREA_MM2)
            aside = rng.normal(size=2)
            moved = spots.copy()
            moved[0] = project(frame, pose, SCALE)[0][0] + away_mm / 0.5 * aside / np.linalg.norm(aside)
            result = register_spots(moved, frame, SCALE, options, slice_area_mm2=AREA_MM2)
            assert not result
            assert result.reason in ("contradicted", "ambiguous", "inaccurate"), result.message

    def test_a_second_frame_is_seen_even_where_a_rod_of_either_is_missing(self) -> None:
        rng = np.random.default_rng(4)
        for missing in (0, 1, 1, 1):
            scene = sister(rng, FRAME, Surroundings(SCANNER), missing=missing)
            result = register_spots(scene.spots_px, FRAME, scene.scale, slice_area_mm2=scene.slice_area_mm2)
            assert not result
            assert result.reason == "ambiguous"
            # Of two whole ones neither is the better.
            assert ("shows the frame twice" in result.message) == (missing > 0)

    def test_a_search_that_takes_too_long_is_refused_and_says_so(self, monkeypatch: pytest.MonkeyPatch) -> None:
        spots = noisy(np.random.default_rng(6), FRAME, random_pose(np.random.default_rng(6), FRAME, SCANNER))
        assert register_spots(spots, FRAME, SCALE, STANDING)
        monkeypatch.setattr(level_search, "_MOST_WORK", 1.0)
        result = register_spots(spots, FRAME, SCALE, STANDING)
        assert not result
        assert result.reason == "no_consensus"
        assert "6 spots was given up: too many of them look like parts of the frame" in result.message

    def test_what_was_found_before_a_search_was_given_up_is_no_pose(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Its twins are not known."""

        def endless(*_: object, **__: object) -> None:
            raise SearchGivenUpError

        spots = noisy(np.random.default_rng(6), FRAME, random_pose(np.random.default_rng(6), FRAME, SCANNER))
        monkeypatch.setattr(LevelSearch, "twins_of", endless)
        result = register_spots(spots, FRAME, SCALE, STANDING)
        assert not result
        assert "given up" in result.message
        assert result.estimates == ()

    def test_what_nothing_is_known_to_contradict_for_lack_of_time_is_no_pose(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def endless(*_: object, **__: object) -> None:
            raise SearchGivenUpError

        spots = noisy(np.random.default_rng(6), FRAME, random_pose(np.random.default_rng(6), FRAME, SCANNER))
        monkeypatch.setattr(ByLevels, "find_better", endless)
        result = register_spots(spots, FRAME, SCALE, STANDING)
        assert not result
        assert result.reason == "no_consensus"
        assert "a pose of 6 rods was found, but the search for one that contradicts it among 6 spots took too long" in (
            result.message
        )

    @pytest.mark.parametrize("left", [3, 4])
    def test_rivals_are_sought_elsewhere_among_all_spots_and_as_configured_among_those_left(
        self, left: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Elsewhere only what is told apart from the best; of what is left, where it may be a frame, one rod less."""
        asked: list[tuple[object, ...]] = []

        def nothing(_: ByLevels, problem: Problem, *more: object, **named: object) -> None:
            asked.append((len(problem.spots.mm), math.degrees(problem.prior.max_rotation), *more, named))

        monkeypatch.setattr(ByLevels, "find_better", nothing)
        monkeypatch.setattr(rivals, "score", lambda *_: 100.0)
        rng = np.random.default_rng(6)
        spots = noisy(rng, FRAME, random_pose(np.random.default_rng(6), FRAME, SCANNER))
        spots = np.concatenate([rng.uniform(0, 60, (left, 2)), spots])
        assert register_spots(spots, FRAME, SCALE, STANDING)
        elsewhere: tuple[object, ...] = (6 + left, 180.0, -3.0, 100.0 + 3.0 * math.log(10), {})
        here: tuple[object, ...] = (left, pytest.approx(40.0), -3.0, {"fewest": 5})
        assert asked == ([elsewhere, here] if left >= 4 else [elsewhere])

    @pytest.mark.parametrize("max_rotation_deg", [40.0, 180.0])
    def test_another_scale_is_looked_for_whatever_is_known_of_the_orientation(
        self, max_rotation_deg: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        rng = np.random.default_rng(6)
        spots = noisy(rng, FRAME, random_pose(np.random.default_rng(6), FRAME, SCANNER))
        options = RegistrationOptions(max_rotation_deg=max_rotation_deg)
        assert register_spots(spots[:5], FRAME, SCALE, options, slice_area_mm2=AREA_MM2)
        found = OtherScale(6, np.array([0.03, 0.03]), 50.0)
        monkeypatch.setattr(rivals, "with_other_scale", lambda *_: found)
        result = register_spots(spots[:5], FRAME, SCALE, options, slice_area_mm2=AREA_MM2)
        assert not result
        assert result.reason == "contradicted"
        assert "spacing" in result.message

    def test_a_second_frame_elsewhere_does_not_matter_beside_the_one_that_was_there(self) -> None:
        """Where the pose before is known, that one is meant."""
        rng = np.random.default_rng(5)
        scene = sister(rng, FRAME, Surroundings(SCANNER))
        assert scene.truth is not None
        result = register_spots(
            scene.spots_px, FRAME, scene.scale, slice_area_mm2=scene.slice_area_mm2, previous=scene.truth
        )
        assert result
        assert np.linalg.norm(result.scanner_from_frame.translation - scene.truth.translation) < 1.0

    def test_a_weak_pose_is_refused_and_accepted_only_on_purpose(self) -> None:
        """Five rods that stand together tell the tilt badly."""
        frame, spots = narrow()
        options = RegistrationOptions(max_rotation_deg=20.0, max_log10_false_alarms=0.0)
        refused = register_spots(spots, frame, SCALE, options, slice_area_mm2=AREA_MM2)
        assert not refused
        assert refused.reason == "inaccurate"
        assert "raise max_target_error_mm" in refused.message
        error = refused.estimates[0].target_error_95_mm((0.0, 0.0, 0.0))
        assert error > 3.0
        on_purpose = replace(options, max_target_error_mm=1000.0)
        accepted = register_spots(spots, frame, SCALE, on_purpose, slice_area_mm2=AREA_MM2)
        assert accepted
        assert "weakly determined" in accepted.caution

    def test_a_weak_pose_that_others_have_widened_stays_as_wide(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """What is seen along the valley of its own matches takes nothing from that."""
        frame, spots = narrow()
        options = RegistrationOptions(
            max_rotation_deg=20.0,
            max_log10_false_alarms=0.0,
            max_target_error_mm=1000.0,
            spot_noise_px=0.15,
            frame_tolerance_mm=0.1,
            scale_tolerance=0.0,
        )

        def widening(matcher: ByLevels, problem: Problem) -> Found:
            (one,) = match(matcher, problem).hypotheses
            widened = replace(one, information=one.information / 2, is_widened=True)
            widest.append(np.asarray(np.linalg.inv(widened.information), dtype=np.float64))
            return Found([widened], 5)

        widest: list[Array] = []
        match = ByLevels.match
        monkeypatch.setattr(ByLevels, "match", widening)
        result = register_spots(spots, frame, SCALE, options, slice_area_mm2=AREA_MM2)
        assert result
        assert "weakly determined" in result.caution
        root = np.linalg.inv(np.linalg.cholesky(widest[0]))
        assert np.linalg.eigvalsh(root @ result.covariance @ root.T).min() > 1 - 1e-6
