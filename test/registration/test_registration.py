"""Spots in, pose or refusal out: right, ambiguous, or refused with the reason that fits; never wrong."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from stereoreg_ros import Pose, RegistrationOptions, judgement, load_frame, register_slice, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import rotation_angle
from stereoreg_ros.geometry.projection import cut, cut_jacobian, project
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.judgement import MAX_SPOTS
from stereoreg_ros.matching.consensus import IMPLAUSIBLE
from stereoreg_ros.registration import recognise
from stereoreg_ros.simulation import ScannerSettings, SpotSetSettings, centred_pose, random_pose, random_spot_set

SCANNER = ScannerSettings()
SCALE = SCANNER.scale
# Of a frame as its file has it, in slices as large as they say.
PERFECT = RegistrationOptions(frame_tolerance_mm=0.0, scale_tolerance=0.0)


def is_wrong(found: Pose, truth: Pose, mm: float = 1.5, degrees: float = 2.0) -> bool:
    turn = np.degrees(rotation_angle(found.rotation @ truth.rotation.T))
    return bool(np.linalg.norm(found.translation - truth.translation) > mm or turn > degrees)


@pytest.fixture(scope="module")
def cube():
    return load_frame("cube6")


def test_exact_spots_give_the_exact_pose_and_matches(cube):
    rng = np.random.default_rng(1)
    for _ in range(20):
        truth = random_pose(rng, cube, SCANNER)
        spots, _ = project(cube, truth, SCALE)
        order = rng.permutation(len(spots))
        result = register_spots(spots[order], cube, SCALE)
        assert result
        np.testing.assert_allclose(result.scanner_from_frame.translation, truth.translation, atol=1e-6)
        np.testing.assert_allclose(result.scanner_from_frame.rotation, truth.rotation, atol=1e-8)
        assert [match.line for match in result.matches] == list(cube.line_names)
        assert all(order[match.spot] == match.line_index for match in result.matches)
        assert result.estimate.residual_rms_mm < 1e-6


def test_result_does_not_depend_on_the_order_of_the_spots_and_is_deterministic(cube):
    rng = np.random.default_rng(2)
    problem = random_spot_set(rng, cube, SpotSetSettings(SCANNER, visible_rods=6, false_spots=10))
    first = register_spots(problem.spots_px, cube, SCALE)
    again = register_spots(problem.spots_px, cube, SCALE)
    shuffled = register_spots(problem.spots_px[rng.permutation(len(problem.spots_px))], cube, SCALE)
    assert first
    assert again
    assert shuffled
    np.testing.assert_array_equal(first.scanner_from_frame.rotation, again.scanner_from_frame.rotation)
    np.testing.assert_allclose(first.scanner_from_frame.translation, shuffled.scanner_from_frame.translation, atol=1e-5)
    assert first.estimate.log10_false_alarms == pytest.approx(shuffled.estimate.log10_false_alarms, abs=1e-6)


@pytest.mark.parametrize(
    ("visible", "false_spots", "noise_px", "least_accepted"),
    [(6, 0, 0.5, 0.99), (6, 8, 0.5, 0.99), (6, 24, 0.5, 0.98), (5, 8, 0.05, 0.97), (4, 8, 0.5, 0.0), (5, 24, 0.5, 0.0)],
)
def test_false_spots_and_missing_rods(cube, visible, false_spots, noise_px, least_accepted):
    rng = np.random.default_rng(100 * visible + false_spots)
    settings = SpotSetSettings(SCANNER, visible, false_spots, noise_px)
    trials, accepted = 50, 0
    for _ in range(trials):
        problem = random_spot_set(rng, cube, settings)
        result = register_spots(problem.spots_px, cube, SCALE, replace(PERFECT, spot_noise_px=0.3))
        if result:
            accepted += 1
            # The pose may be off by what its own covariance says, which few rods make large; not by more.
            found, estimate = result.scanner_from_frame, result.estimate
            offset = np.linalg.norm(found.translation - problem.slice_from_frame.translation)
            assert offset <= 5 * estimate.position_std_mm
            assert not is_wrong(found, problem.slice_from_frame, 2.0, 3.0)
    print(f"{accepted} of {trials} accepted")
    assert accepted >= least_accepted * trials


@pytest.mark.parametrize("name", ["cube6", "leksell_ct", "zframe"])
def test_clutter_alone_is_never_accepted(name):
    rng = np.random.default_rng(4)
    frame = load_frame(name)
    for _ in range(25):
        spots = rng.uniform(0, 512, (rng.integers(5, 31), 2))
        result = register_spots(spots, frame, SCALE)
        assert not result
        assert result.reason in ("no_consensus", "too_few_spots")


def test_any_orientation_without_prior(cube):
    """All around, not only within 20 degrees; the twin of a pose, where there is one, makes it ambiguous, not wrong."""
    rng = np.random.default_rng(5)
    outcomes = {"accepted": 0, "ambiguous": 0, "no_consensus": 0}
    while sum(outcomes.values()) < 60:
        rotation = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        truth = Pose(rotation, np.array([128.0, 128.0, 0.0]) + rng.uniform(-15, 15, 3))
        spots, cuts = project(cube, truth, SCALE)
        if cuts.inside.sum() < 6:
            continue
        result = register_spots(spots + rng.normal(0, 0.1, spots.shape), cube, SCALE)
        outcomes["accepted" if result else result.reason] += 1
        if result:
            assert not is_wrong(result.scanner_from_frame, truth)
    print(outcomes)
    assert outcomes["accepted"] >= 54


@pytest.mark.parametrize(
    ("name", "poses", "least_accepted"), [("leksell_ct", (4, 5, 6, 7, 8), 3), ("zframe", (2,), 10)]
)
def test_symmetric_frames_are_ambiguous_until_told_how_they_stand(name, poses, least_accepted):
    """Parallel rods, the slice nearly at right angles to them: the normal case of these frames.

    The Leksell box has but two directions of rods: the sign of a small tilt to the front is often not to be seen.
    """
    frame = load_frame(name)
    scanner = ScannerSettings(shape=(640, 640))
    rng = np.random.default_rng(6)
    # However weak the pose is.
    open_end = replace(PERFECT, max_target_error_mm=1000.0)
    accepted = 0
    for _ in range(10):
        truth = random_pose(rng, frame, scanner, max_tilt_deg=4.0, max_offset_mm=10.0, max_depth_mm=15.0)
        spots, _ = project(frame, truth, SCALE)
        spots = spots + rng.normal(0, 0.2, spots.shape)
        blind = register_spots(spots, frame, SCALE, open_end)
        assert not blind
        assert blind.reason == "ambiguous"
        assert len(blind.estimates) in poses
        told = register_spots(spots, frame, SCALE, replace(open_end, max_rotation_deg=40.0))
        if not told:
            assert told.reason == "ambiguous"
            assert len(told.estimates) == 2
            continue
        accepted += 1
        error = np.append(
            told.scanner_from_frame.translation - truth.translation,
            Rotation.from_matrix(told.scanner_from_frame.rotation @ truth.rotation.T).as_rotvec(),
        )
        # Weakly determined directions may be far off; by what the covariance says.
        assert error @ np.linalg.solve(told.covariance, error) < 40.0
    assert accepted >= least_accepted


def test_parallel_rods_among_false_spots():
    rng = np.random.default_rng(8)
    frame = load_frame("zframe")
    accepted = 0
    for _ in range(20):
        settings = SpotSetSettings(SCANNER, visible_rods=7, false_spots=12, noise_px=0.3, max_tilt_deg=6.0)
        problem = random_spot_set(rng, frame, settings)
        result = register_spots(problem.spots_px, frame, SCALE, RegistrationOptions(max_rotation_deg=40.0))
        if result:
            accepted += 1
            assert not is_wrong(result.scanner_from_frame, problem.slice_from_frame, 2.0, 5.0)
    assert accepted >= 19


def test_prior_is_about_the_scanner_not_the_slice(cube):
    """With an oblique slice, the nominal orientation is that of the frame in the scanner."""
    rng = np.random.default_rng(9)
    oblique = Pose(Rotation.from_euler("xyz", [30, -20, 60], degrees=True).as_matrix(), np.array([10.0, -40.0, 700.0]))
    truth = random_pose(rng, cube, SCANNER)
    spots, _ = project(cube, truth, SCALE)
    expected = oblique @ truth
    told = RegistrationOptions(nominal_orientation=tuple(expected.quaternion_xyzw), max_rotation_deg=5.0)
    result = register_spots(spots, cube, SCALE, told, scanner_from_slice=oblique)
    assert result
    np.testing.assert_allclose(result.scanner_from_frame.translation, expected.translation, atol=1e-5)
    np.testing.assert_allclose(result.scanner_from_frame.rotation, expected.rotation, atol=1e-7)
    in_slice = RegistrationOptions(nominal_orientation=tuple(truth.quaternion_xyzw), max_rotation_deg=5.0)
    assert not register_spots(spots, cube, SCALE, in_slice, scanner_from_slice=oblique)


def test_a_pose_is_within_the_angle_to_a_fraction_of_a_degree(cube):
    """Searches start from poses some degrees beyond it, which may be refined into it."""
    rng = np.random.default_rng(15)
    for _ in range(3):
        truth = random_pose(rng, cube, SCANNER, max_tilt_deg=15.0)
        spots, _ = project(cube, truth, SCALE)
        degrees = math.degrees(float(rotation_angle(truth.rotation)))
        assert degrees > 3.0
        assert register_spots(spots, cube, SCALE, RegistrationOptions(max_rotation_deg=degrees + 0.3))
        assert not register_spots(spots, cube, SCALE, RegistrationOptions(max_rotation_deg=degrees - 0.3))


def test_spots_beyond_a_rods_end_are_not_on_it(cube):
    truth = centred_pose(cube, SCANNER)
    far = Pose(truth.rotation, truth.translation + np.array([0.0, 0.0, 45.0]))  # the cube ends 15 mm before the slice
    spots, cuts = project(cube, far, SCALE)
    assert not cuts.inside.any()
    assert not register_spots(spots, cube, SCALE)


def test_anisotropic_pixels_and_shear(cube):
    scale = PixelScale(0.45, 0.6, 0.02)
    truth = random_pose(np.random.default_rng(10), cube, SCANNER)
    spots, _ = project(cube, truth, scale)
    result = register_spots(spots, cube, scale)
    assert result
    np.testing.assert_allclose(result.scanner_from_frame.translation, truth.translation, atol=1e-5)
    # The same spots with the axes of the scale exchanged are another shape: no pose may come of it.
    assert not register_spots(spots, cube, PixelScale(0.6, 0.45))


def test_wrong_scale_is_refused_not_absorbed(cube):
    rng = np.random.default_rng(11)
    for _ in range(20):
        truth = random_pose(rng, cube, SCANNER)
        spots, _ = project(cube, truth, SCALE)
        assert not register_spots(spots, cube, PixelScale(0.55, 0.55), RegistrationOptions(spot_noise_px=0.1))


class TestRefusals:
    def test_too_few_spots(self, cube):
        for spots in (np.empty((0, 2)), [], [[1.0, 2.0]], np.ones((3, 2))):
            result = register_spots(spots, cube, SCALE)
            assert not result
            assert result.reason == "too_few_spots"
            assert "4 are needed" in result.message

    def test_too_many_spots_are_refused_at_once(self, cube):
        spots = np.random.default_rng(0).uniform(0, 512, (MAX_SPOTS + 1, 2))
        result = register_spots(spots, cube, SCALE)
        assert not result
        assert result.reason == "no_consensus"
        assert str(MAX_SPOTS) in result.message

    def test_one_place_and_one_line(self, cube):
        for spots in (np.full((8, 2), 100.0), np.column_stack([np.linspace(0, 500, 8), np.full(8, 3.0)])):
            result = register_spots(spots, cube, SCALE)
            assert not result
            assert result.reason == "no_consensus"

    def test_inaccurate_by_its_residual(self, cube):
        """Told a noise far below the real one, the rods still match, but the residual cannot be believed."""
        rng = np.random.default_rng(12)
        reasons = []
        for _ in range(30):
            problem = random_spot_set(rng, cube, SpotSetSettings(SCANNER, 6, 0, 0.5))
            result = register_spots(problem.spots_px, cube, SCALE, replace(PERFECT, spot_noise_px=0.08))
            reasons.append("accepted" if result else result.reason)
            if result:
                assert not is_wrong(result.scanner_from_frame, problem.slice_from_frame, 2.0, 3.0)
        assert "inaccurate" in reasons

    def test_inaccurate_by_its_standard_deviation(self, cube):
        truth = random_pose(np.random.default_rng(13), cube, SCANNER)
        spots, _ = project(cube, truth, SCALE)
        result = register_spots(spots, cube, SCALE, RegistrationOptions(max_position_std_mm=0.01))
        assert not result
        assert result.reason == "inaccurate"
        assert "0.01 mm" in result.message

    def test_inaccurate_by_its_target_error(self, cube):
        """The same slice is good enough for a needle that is short, and not for one that is long."""
        truth = random_pose(np.random.default_rng(13), cube, SCANNER)
        spots, _ = project(cube, truth, SCALE)
        near = register_spots(spots, cube, SCALE, RegistrationOptions(max_target_error_mm=1.5))
        assert near
        told = RegistrationOptions(max_target_error_mm=1.5, target_in_frame_mm=(0.0, 30.0, -300.0))
        far = register_spots(spots, cube, SCALE, told)
        assert not far
        assert far.reason == "inaccurate"
        assert far.options is told
        error = far.estimates[0].target_error_95_mm(told.target_in_frame_mm)
        assert error > 1.5 > near.estimate.target_error_95_mm((0.0, 0.0, 0.0))
        assert f"(0, 30, -300) mm of the frame are within {error:.2f} mm, 1.5 mm are allowed" in far.message
        assert register_spots(spots, cube, SCALE, replace(told, max_target_error_mm=error + 1e-6))

    def test_what_may_be_two_millimetres_or_three_degrees_off_bears_a_caution(self):
        """Four standard deviations are the measure; upright rods leave the tilt open at some poses, not at all."""
        frame = load_frame("leksell_ct")
        options = replace(PERFECT, max_rotation_deg=40.0, spot_noise_px=0.3, max_target_error_mm=1000.0)
        rng = np.random.default_rng(5)
        seen = set()
        for _ in range(40):
            problem = random_spot_set(rng, frame, SpotSetSettings(ScannerSettings(shape=(640, 640)), 6, 0, 0.5))
            result = register_spots(problem.spots_px, frame, SCALE, options)
            if result:
                estimate = result.estimate
                weak = 4 * estimate.position_std_mm > 2.0 or 4 * estimate.rotation_std_deg > 3.0
                assert ("weakly determined" in result.caution) == weak
                seen.add(weak)
        assert seen == {True, False}

    def test_degenerate_names_the_direction(self):
        """At right angles to a Leksell box, the turn about the line across its plates is of second order."""
        frame = load_frame("leksell_ct")
        truth = centred_pose(frame, SCANNER)
        spots, _ = project(frame, truth, SCALE)
        options = RegistrationOptions(
            max_rotation_deg=30.0, spot_noise_px=3.0, max_position_std_mm=1000.0, max_target_error_mm=1000.0
        )
        result = register_spots(spots, frame, SCALE, options)
        assert not result
        assert result.reason == "degenerate"
        axis = np.array(re.findall(r"-?\d+\.\d*", result.message)[:3], dtype=float)
        assert abs(axis[0]) > 0.99, result.message

    def test_three_rods_can_never_be_verified(self):
        frame = Frame("three", tuple("abc"), np.eye(3) * 30, -np.eye(3)[::-1] * 30 + 5, np.ones(3))
        result = register_spots(np.random.default_rng(0).uniform(0, 100, (6, 2)), frame, SCALE)
        assert not result
        assert result.reason == "no_consensus"

    @pytest.mark.parametrize(
        ("spots", "message"),
        [
            (np.ones((4, 3)), r"shape \(4, 3\)"),
            (np.ones(8), r"shape \(8,\)"),
            (np.full((6, 2), np.nan), "finite"),
            ([[1.0, np.inf]] * 6, "finite"),
        ],
    )
    def test_wrong_arguments_are_exceptions(self, cube, spots, message):
        with pytest.raises(ValueError, match=message):
            register_spots(spots, cube, SCALE)


def test_as_many_rods_as_must_have_a_spot_are_enough(cube):
    truth = random_pose(np.random.default_rng(14), cube, SCANNER)
    spots, _ = project(cube, truth, SCALE)
    for least in (4, 5, 6):
        result = register_spots(spots, cube, SCALE, RegistrationOptions(min_inliers=least))
        assert result
        assert result.estimate.inliers == 6
    too_few = register_spots(spots[:5], cube, SCALE, RegistrationOptions(min_inliers=6))
    assert not too_few
    assert too_few.reason == "too_few_spots"


def test_empty_slice_is_refused(cube):
    result = register_slice(Slice(np.full((64, 64), -1000.0, dtype=np.float32), SCALE), cube)
    assert not result
    assert result.reason == "too_few_spots"


class TestPlausibility:
    """The stated noise is judged by the residual: its chi-square, both ways."""

    @staticmethod
    def outcomes(cube: Frame, told_px: float, trials: int = 80) -> list[str]:
        rng = np.random.default_rng(21)
        outcomes: list[str] = []
        for _ in range(trials):
            problem = random_spot_set(rng, cube, SpotSetSettings(SCANNER, 6, 0, 0.2, gaussian=True))
            result = register_spots(
                problem.spots_px, cube, SCALE, replace(PERFECT, spot_noise_px=told_px, max_rotation_deg=60.0)
            )
            if not result:
                outcomes.append("implausible" if "cannot come from" in result.message else result.reason)
            else:
                outcomes.append("doubtful" if "is large for" in result.caution else "plain")
        return outcomes

    @staticmethod
    def assert_share(found: list[str], outcome: str, expected: float) -> None:
        """Within four standard deviations of a binomial count."""
        mean = expected * len(found)
        assert found.count(outcome) == pytest.approx(mean, abs=4 * math.sqrt(mean * (1 - expected)) + 1), outcome

    def test_the_right_noise_is_believed(self, cube):
        """But for what is doubted or refused of the right noise itself."""
        found = self.outcomes(cube, 0.2)
        assert set(found) <= {"plain", "doubtful", "implausible"}
        self.assert_share(found, "implausible", IMPLAUSIBLE)
        self.assert_share(found, "doubtful", judgement._DOUBTFUL - IMPLAUSIBLE)

    def test_a_noise_told_too_large_is_no_reason_to_doubt(self, cube):
        assert set(self.outcomes(cube, 0.4)) == {"plain"}

    def test_a_noise_told_too_small_is_doubted_or_refused(self, cube):
        """Chi-square of 6 degrees of freedom is four times as large, so that more than half of all are refused."""
        found = self.outcomes(cube, 0.1)
        levels = (judgement._DOUBTFUL, IMPLAUSIBLE)
        doubtful, implausible = (float(chi2.sf(chi2.isf(level, 6) / 4, 6)) for level in levels)
        assert implausible > 0.5
        self.assert_share(found, "plain", 1 - doubtful)
        self.assert_share(found, "doubtful", doubtful - implausible)
        # Some of the rest have a spot so far off that it is not matched.
        assert found.count("implausible") > 0.7 * implausible * len(found)

    def test_chi_square_is_that_of_its_degrees_of_freedom(self, cube):
        rng = np.random.default_rng(22)
        values = []
        for _ in range(150):
            problem = random_spot_set(rng, cube, SpotSetSettings(SCANNER, 6, 0, 0.2, gaussian=True))
            result = register_spots(problem.spots_px, cube, SCALE, replace(PERFECT, spot_noise_px=0.2))
            # Some are refused for it.
            (estimate,) = [result.estimate] if result else result.estimates
            assert result or "cannot come from" in result.message
            assert estimate.degrees_of_freedom == 6
            values.append(estimate.chi_square)
        assert kstest(values, chi2(6).cdf).pvalue > 0.001


class TestRecognition:
    """What spots look most like, for those who test it in another way."""

    def test_of_a_slice_that_is_accepted_it_is_the_same_pose(self, cube):
        rng = np.random.default_rng(41)
        for _ in range(8):
            spots = random_spot_set(rng, cube, SpotSetSettings(SCANNER, 6, 9, 0.3, gaussian=True)).spots_px
            accepted, recognised = register_spots(spots, cube, SCALE), recognise(SliceSpots(spots, SCALE), cube)
            assert accepted
            assert recognised is not None
            pairs = [[(match.line, match.spot) for match in one.matches] for one in (accepted, recognised)]
            assert pairs[0] == pairs[1]
            found, expected = recognised.estimate.scanner_from_frame, accepted.scanner_from_frame
            np.testing.assert_allclose(found.translation, expected.translation, atol=1e-3)

    def test_what_would_be_refused_is_recognised_all_the_same(self, cube):
        rng = np.random.default_rng(42)
        spots = random_spot_set(rng, cube, SpotSetSettings(SCANNER, 6, 9, 0.3, gaussian=True)).spots_px
        strict = RegistrationOptions(max_target_error_mm=0.01)
        refused, recognised = (
            register_spots(spots, cube, SCALE, strict),
            recognise(SliceSpots(spots, SCALE), cube, strict),
        )
        assert not refused
        assert refused.reason == "inaccurate"
        assert recognised is not None
        assert len(recognised.matches) == 6

    def test_a_frame_that_asks_for_an_orientation_is_not_recognised_without(self, cube):
        asking = replace(cube, orientation_required=True)
        spots, _ = project(cube, random_pose(np.random.default_rng(43), cube, SCANNER), SCALE)
        assert recognise(SliceSpots(spots, SCALE), asking) is None
        assert recognise(SliceSpots(spots, SCALE), asking, RegistrationOptions(max_rotation_deg=90.0)) is not None

    def test_nothing_where_nothing_looks_like_the_frame(self, cube):
        assert recognise(SliceSpots(np.zeros((0, 2)), SCALE), cube) is None
        four = np.array([[10.0, 10.0], [60.0, 10.0], [300.0, 300.0], [310.0, 20.0]])
        assert recognise(SliceSpots(four, SCALE), cube) is None


class TestWhatTheCallerGave:
    """A result holds the caller's own options and frame, also where half of the false alarms are for a guess."""

    @pytest.mark.parametrize("has_guess", [False, True])
    @pytest.mark.parametrize("matcher", ["three_line", "maurin2009"])
    def test_is_in_every_result(self, cube, has_guess, matcher):
        truth = random_pose(np.random.default_rng(21), cube, SCANNER)
        spots, _ = project(cube, truth, SCALE)
        guess = truth if has_guess else None
        options = RegistrationOptions(max_log10_false_alarms=-4.0, matcher=matcher)
        again = load_frame("cube6")
        accepted = register_spots(spots, again, SCALE, options, previous=guess)
        too_few = register_spots(spots[:3], again, SCALE, options, previous=guess)
        too_weak = replace(options, max_target_error_mm=0.001)
        refused = register_spots(spots, again, SCALE, too_weak, previous=guess)
        assert accepted
        assert not too_few
        assert not refused
        assert refused.reason == "inaccurate"
        for result, given in ((accepted, options), (too_few, options), (refused, too_weak)):
            assert result.options is given
            assert result.options.max_log10_false_alarms == -4.0
            assert result.frame is again


class TestScaleCovariance:
    def test_adds_what_the_scale_makes_uncertain(self, cube):
        truth = random_pose(np.random.default_rng(23), cube, SCANNER)
        plane = Pose(Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix(), np.array([5.0, 6.0, 7.0]))
        spots, _ = project(cube, truth, SCALE)
        covariance = 1e-6 * np.array([[1.0, 0.3, 0.1], [0.3, 2.0, 0.0], [0.1, 0.0, 0.5]])
        plain = register_spots(spots, cube, SCALE, PERFECT, plane)
        wide = register_spots(spots, cube, SCALE, PERFECT, plane, scale_covariance=covariance)
        assert plain
        assert wide
        pose = wide.estimate.slice_from_frame
        jacobian = cut_jacobian(cut(cube, pose.rotation, pose.translation), pose.translation).reshape(-1, 6)
        # By how much the spots move that are shown at the wrong distance from the scanner's origin.
        off = np.linalg.solve(SCALE.matrix, (SCALE.to_mm(spots) - plane.inverse().translation[:2]).T).T
        moved = np.zeros((6, 2, 3))
        moved[:, 0, 0], moved[:, 1, 1], moved[:, 0, 2] = off[:, 0], off[:, 1], off[:, 1]
        by_scale = moved.reshape(-1, 3)
        # The spots are weighed by all that makes them uncertain, but for what moves them all alike.
        apart = (moved - moved.mean(axis=0)).reshape(-1, 3)
        weights = np.linalg.inv((0.3 * 0.5) ** 2 * np.eye(12) + apart @ covariance @ apart.T)
        follows = np.linalg.solve(jacobian.T @ weights @ jacobian, jacobian.T @ weights)
        expected = follows @ ((0.3 * 0.5) ** 2 * np.eye(12) + by_scale @ covariance @ by_scale.T) @ follows.T
        turned = np.kron(np.eye(2), plane.rotation)
        assert wide.estimate.position_std_mm > 1.2 * plain.estimate.position_std_mm
        np.testing.assert_allclose(wide.covariance, turned @ expected @ turned.T, rtol=1e-6, atol=1e-9)
        nothing = register_spots(spots, cube, SCALE, PERFECT, plane, scale_covariance=np.zeros((2, 2)))
        assert nothing
        np.testing.assert_allclose(nothing.covariance, plain.covariance, atol=1e-15)

    def test_counts_in_what_is_refused(self, cube):
        truth = random_pose(np.random.default_rng(24), cube, SCANNER)
        spots, _ = project(cube, truth, SCALE)
        options = replace(PERFECT, max_position_std_mm=1.0)
        assert register_spots(spots, cube, SCALE, options)
        result = register_spots(spots, cube, SCALE, options, scale_covariance=0.01**2 * np.eye(2))
        assert not result
        assert result.reason == "inaccurate"

    @pytest.mark.parametrize("given", [np.eye(4), [[1.0, 2.0], [0.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]]], ids=str)
    def test_what_is_none_is_named(self, cube, given):
        with pytest.raises(ValueError, match="scale_covariance"):
            register_spots(np.zeros((6, 2)), cube, SCALE, scale_covariance=given)
        with pytest.raises(ValueError, match="scale_covariance"):
            register_slice(Slice(np.zeros((32, 32), np.float32), SCALE), cube, scale_covariance=given)
