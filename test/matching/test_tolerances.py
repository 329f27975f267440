"""How the frame and the scale may be off: against clipped rods, wrong scales, and the errors of poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import cut, cut_jacobian, project
from stereoreg_ros.matching.tolerances import Tolerances
from stereoreg_ros.result import Refusal, Registration
from stereoreg_ros.simulation import ScannerSettings, random_pose
from support.frames import random_frame
from support.pose_statistics import PoseStatistics, pose_error

SCANNER = ScannerSettings()
SCALE = SCANNER.scale
SHEARED = PixelScale(0.45, 0.6, 0.02)
Outcome = Registration | Refusal
MEASURED = 1e-6 * np.array([[1.0, 0.3, 0.1], [0.3, 2.0, 0.0], [0.1, 0.0, 0.5]])


def tolerances(frame: Frame, rod_mm: float = 0.0, scale: PixelScale = SCALE, thickness_mm: float = 0.0) -> Tolerances:
    return Tolerances.of(frame, np.full(len(frame), rod_mm), scale, 0.0, None, thickness_mm)


class TestScale:
    @pytest.mark.parametrize("scale", [SCALE, SHEARED], ids=str)
    @pytest.mark.parametrize("measured", [None, MEASURED], ids=["stated", "measured"])
    @pytest.mark.parametrize("share", [0.0, 0.003])
    def test_stretches_are_the_scales_covariance(self, scale: PixelScale, measured: Array | None, share: float) -> None:
        """A point that pixel (u, v) shows moves by (dsx u + dshear v, dsy v)."""
        frame = load_frame("cube6")
        found = Tolerances.of(frame, np.zeros(6), scale, share, measured, 1.0).stretches
        covariance = np.diag([(share * scale.sx) ** 2, (share * scale.sy) ** 2, 0.0])
        covariance += 0.0 if measured is None else measured
        assert len(found) == np.linalg.matrix_rank(covariance, tol=1e-20)
        u, v = 130.0, -57.0
        point = scale.to_mm(np.array([u, v]))
        by_scale = np.array([[u, 0.0, v], [0.0, v, 0.0]])
        moved = found @ point
        np.testing.assert_allclose(moved.T @ moved, by_scale @ covariance @ by_scale.T, rtol=1e-9, atol=1e-15)

    def test_moves_spots_away_from_the_middle_of_those_used(self) -> None:
        frame = load_frame("cube6")
        given = Tolerances.of(frame, np.zeros(6), SHEARED, 0.002, MEASURED, 1.0)
        pose = Pose(np.eye(3), np.array([70.0, 80.0, 0.0]))
        cuts = cut(frame, pose.rotation, pose.translation)
        used = np.array([True, True, False, True, True, True])
        spots = np.where(used[:, None], cuts.points_mm, np.nan)
        shared = given.common(frame, cuts, spots, used)
        assert shared.shape == (6, 2, 4)
        assert np.isfinite(shared).all()
        assert not shared[2, :, :3].any()
        np.testing.assert_allclose(shared[used, :, :3].sum(axis=0), 0.0, atol=1e-12)
        off = cuts.points_mm[1] - cuts.points_mm[used].mean(axis=0)
        for mode, stretch in enumerate(given.stretches):
            np.testing.assert_allclose(shared[1, :, mode], stretch @ off, rtol=1e-9)

    def test_many_poses_are_as_one_by_one(self) -> None:
        rng = np.random.default_rng(1)
        frame = random_frame(rng, 5)
        given = Tolerances.of(frame, np.full(5, 0.2), SCALE, 0.002, None, 40.0)
        rotations, translations = rotation_exp(rng.normal(0, 0.2, (4, 3))), rng.normal(0, 15, (4, 3))
        spots, used = rng.normal(0, 30, (4, 5, 2)), rng.random((4, 5)) < 0.7
        cuts = cut(frame, rotations, translations)
        together = given.common(frame, cuts, spots, used), given.rod_covariances(frame, cuts)
        for row in range(4):
            alone = cut(frame, rotations[row], translations[row])
            np.testing.assert_allclose(together[0][row], given.common(frame, alone, spots[row], used[row]), atol=1e-12)
            np.testing.assert_allclose(together[1][row], given.rod_covariances(frame, alone), rtol=1e-9)


class TestRods:
    def test_a_perfect_frame_has_none(self) -> None:
        frame = load_frame("cube6")
        cuts = cut(frame, np.eye(3), np.zeros(3))
        none = Tolerances.none(frame)
        assert none.extent_mm == none.half_slice_mm == 0.0
        assert not none.rod_covariances(frame, cuts).any()
        assert not none.common(frame, cuts, cuts.points_mm, np.ones(6, dtype=bool)).any()

    def test_a_rod_within_the_slice_has_none_and_gives_no_warning(self) -> None:
        starts = np.array([[5.0, 7, -10], [-10, 0, -10], [-20, 4, 0]])
        ends = np.array([[5.0, 7, 10], [10, 0, 10], [20, 4, 0]])
        frame = Frame("lying", ("z", "leaning", "within"), starts, ends, np.ones(3))
        cuts = cut(frame, np.eye(3), np.zeros(3))
        given = tolerances(frame, 0.3)
        covariances = given.rod_covariances(frame, cuts)
        np.testing.assert_allclose(covariances[0], 0.5 * 0.3**2 * np.eye(2))
        # It leans by 45 degrees along x.
        np.testing.assert_allclose(covariances[1], 0.5 * 0.3**2 * np.diag([2.0, 1.0]))
        assert not covariances[2].any()
        assert not given.end_shifts(frame, cuts)[2].any()

    def test_the_extent_is_the_rms_over_a_rods_length(self) -> None:
        """The error at a share a of the length is (1 - a) e + a f of the errors e and f of its ends."""
        along = np.linspace(0.0, 1.0, 100_001)
        expected = 0.3 * np.sqrt(((1 - along) ** 2 + along**2).mean())
        assert tolerances(load_frame("cube6"), 0.3).extent_mm == pytest.approx(expected, rel=1e-4)


def clipped_shifts(frame: Frame, pose: Pose, half_mm: float) -> Array:
    """From where a rod's axis meets the slice's middle plane to the middle of what a slab of the slice has of it."""
    starts, ends = pose @ frame.starts, pose @ frame.ends
    shifts = []
    for start, end in zip(starts, ends, strict=True):
        share = np.sort((np.array([-half_mm, half_mm]) - start[2]) / (end[2] - start[2]))
        low, high = max(share[0], 0.0), min(share[1], 1.0)
        assert low < high, "the slab does not meet the rod"
        middle = start + (low + high) / 2 * (end - start)
        on_axis = start - start[2] / (end[2] - start[2]) * (end - start)
        shifts.append((middle - on_axis)[:2])
    return np.array(shifts)


class TestEndShifts:
    # Two rods from below up and one from above down, all leaning; in mm.
    FRAME = Frame(
        "ends",
        ("up", "steep", "down"),
        np.array([[0.0, 0, -10], [20, 0, -10], [-20, 5, 10]]),
        np.array([[15.0, -8, 10], [22, 1, 10], [0, 30, -10]]),
        np.ones(3),
    )

    @pytest.mark.parametrize("upside_down", [False, True])
    @pytest.mark.parametrize("height_mm", [-10.9, -9.6, -8.1, -6.5, 0.0, 7.8, 8.3, 9.9, 10.7])
    def test_are_those_of_a_clipped_rod(self, height_mm: float, upside_down: bool) -> None:
        turn = rotation_exp(np.array([np.pi if upside_down else 0.0, 0.0, 0.0]))
        pose = Pose(rotation_exp(np.array([0.02, -0.03, 0.4])) @ turn, np.zeros(3))
        # The heights are those of the slice in the frame.
        pose = Pose(pose.rotation, -(pose.rotation @ np.array([0.0, 0.0, height_mm])))
        given = tolerances(self.FRAME, thickness_mm=5.0)
        cuts = cut(self.FRAME, pose.rotation, pose.translation)
        expected = clipped_shifts(self.FRAME, pose, 2.5)
        np.testing.assert_allclose(given.end_shifts(self.FRAME, cuts), expected, atol=1e-12)
        assert (np.abs(expected).max() > 0.01) == (abs(height_mm) > 7.0)

    def test_of_a_rod_shorter_than_the_slice_is_thick(self) -> None:
        short = replace(self.FRAME, starts=0.1 * self.FRAME.starts, ends=0.15 * self.FRAME.ends)
        pose = Pose(np.eye(3), np.array([0.0, 0.0, 0.1]))
        given = tolerances(short, thickness_mm=4.0)
        cuts = cut(short, pose.rotation, pose.translation)
        expected = clipped_shifts(short, pose, 2.0)
        np.testing.assert_allclose(given.end_shifts(short, cuts), expected, atol=1e-12)
        assert np.linalg.norm(expected, axis=1).min() > 0.01

    def test_are_the_last_of_the_shared_errors(self) -> None:
        cuts = cut(self.FRAME, np.eye(3), np.array([0.0, 0.0, -9.0]))
        given = tolerances(self.FRAME, thickness_mm=5.0)
        shared = given.common(self.FRAME, cuts, cuts.points_mm, np.ones(3, dtype=bool))
        np.testing.assert_array_equal(shared[..., -1], given.end_shifts(self.FRAME, cuts))
        assert shared[..., -1].any()

    def test_where_the_thickness_is_not_known_it_may_be_two_and_a_half_millimetres(self) -> None:
        cuts = cut(self.FRAME, np.eye(3), np.array([0.0, 0.0, -9.0]))
        known, unknown = tolerances(self.FRAME, thickness_mm=2.5), tolerances(self.FRAME)
        np.testing.assert_array_equal(known.end_shifts(self.FRAME, cuts), unknown.end_shifts(self.FRAME, cuts))

    def test_beyond_the_end_it_is_no_more_than_half_the_slice(self) -> None:
        given = tolerances(self.FRAME, thickness_mm=5.0)
        cuts = cut(self.FRAME, np.eye(3), np.array([0.0, 0.0, -40.0]))
        slope = np.linalg.norm(cuts.directions[:, :2] / cuts.directions[:, 2:], axis=1)
        np.testing.assert_allclose(np.linalg.norm(given.end_shifts(self.FRAME, cuts), axis=1), 2.5 * slope)


@dataclass(frozen=True)
class Errors:
    """What is off, all of it stated.

    ends_mm: rod ends, standard deviation per axis; share: of the scale; measured: whether the scale has a measured
    covariance instead; plane: whether the slice's pose in the scanner is given, so that a wrong scale stretches the
    image about the scanner's origin and not about pixel (0, 0); unequal: each spot has a covariance of its own.
    """

    ends_mm: float = 0.25
    share: float = 0.002
    measured: bool = False
    plane: bool = False
    unequal: bool = False
    missing: int = 0


def registered(rng: np.random.Generator, frame: Frame, errors: Errors, stated: Errors) -> tuple[Outcome, Pose]:
    """Register one set of spots in random order that has some errors, and others stated; and the true pose."""
    n = len(frame)
    pose = random_pose(rng, frame, SCANNER)
    off = rng.normal(0.0, errors.ends_mm, (2, n, 3))
    true_frame = replace(frame, starts=frame.starts + off[0], ends=frame.ends + off[1])
    points_mm = cut(true_frame, pose.rotation, pose.translation).points_mm
    if errors.measured:
        told = PixelScale(*(np.array([SCALE.sx, SCALE.sy, 0.0]) + rng.multivariate_normal(np.zeros(3), MEASURED)))
    else:
        factors = 1 + rng.normal(0.0, errors.share, 2)
        told = PixelScale(SCALE.sx * factors[0], SCALE.sy * factors[1])
    scanner_from_slice, anchor_mm = Pose.identity(), np.zeros(2)
    if errors.plane:
        away = np.append(rng.uniform(-200, 0, 2), rng.uniform(-300, 300))
        scanner_from_slice = Pose(rotation_exp(rng.normal(0, 0.3, 3)), away)
        anchor_mm = scanner_from_slice.inverse().translation[:2]
    shown_mm = anchor_mm + (points_mm - anchor_mm) @ (told.matrix @ SCALE.inverse_matrix).T
    covariances = np.tile(0.1**2 * np.eye(2), (n, 1, 1))
    if errors.unequal:
        root = rng.uniform(-0.2, 0.2, (n, 2, 2))
        covariances = root @ np.swapaxes(root, 1, 2) + 0.05**2 * np.eye(2)
    noise = (np.linalg.cholesky(covariances) @ rng.standard_normal((n, 2, 1)))[..., 0]
    order = rng.permutation(n)[errors.missing :]
    result = register_spots(
        (told.to_px(shown_mm) + noise)[order],
        frame,
        told,
        RegistrationOptions(
            spot_noise_px=0.05 if errors.unequal else 0.1,
            frame_tolerance_mm=stated.ends_mm,
            scale_tolerance=0.0 if stated.measured else stated.share,
            # No rod ends within so thin a slice.
            slice_thickness_mm=0.01,
            max_log10_false_alarms=-4.0,
            max_target_error_mm=1000.0,
            nominal_orientation=tuple(scanner_from_slice.quaternion_xyzw),
            max_rotation_deg=40.0,
        ),
        scanner_from_slice,
        float(np.prod(SCANNER.size_mm)),
        covariances_px2=covariances[order],
        scale_covariance=MEASURED if stated.measured else None,
    )
    return result, scanner_from_slice @ pose


def statistics(frame: Frame, errors: Errors, sets: int, stated: Errors | None = None) -> PoseStatistics:
    """The errors of so many poses; stated: what is stated where that is not what is true."""
    rng, found = np.random.default_rng(1), PoseStatistics()
    for _ in range(sets):
        found.add(*registered(rng, frame, errors, stated or errors))
    return found


def frame_of(name: str) -> Frame:
    return random_frame(np.random.default_rng(3), 7) if name == "random" else load_frame(name)


class TestErrorsOfPoses:
    """Squared errors in terms of the stated covariance are 6 in the mean, and the 95 % ball holds 95 % of them."""

    SETS = 80

    @pytest.mark.parametrize(
        ("name", "errors"),
        [
            ("cube6", Errors()),
            ("cube8", Errors(unequal=True, missing=1)),
            ("cube8", Errors(measured=True)),
            ("random", Errors(measured=True, plane=True, missing=1)),
        ],
        ids=str,
    )
    def test_are_as_stated(self, name: str, errors: Errors) -> None:
        found = statistics(frame_of(name), errors, self.SETS)
        print(f"NEES {found.nees:.2f}, held {np.round(found.coverage, 2).tolist()}, refused {dict(found.refused)}")
        # A residual or a scale as unlikely as that is refused once in two hundred each, a weak pose or a twin now and
        # then.
        assert found.accepted >= 0.93 * self.SETS
        assert abs(found.nees - 6) < 4.5 * np.sqrt(12 / found.accepted)
        assert 5.0 < found.nees < 8.0
        assert (np.abs(found.coverage - 0.95) < 4 * np.sqrt(0.95 * 0.05 / found.accepted)).all()

    def test_are_noticed_where_the_scales_are_not_stated(self) -> None:
        """Or the test above would hold whatever is stated."""
        found = statistics(load_frame("cube6"), Errors(), 40, Errors(share=0.0))
        assert found.accepted > 5
        assert found.nees > 12

    def test_rods_that_are_farther_off_than_stated_are_refused(self) -> None:
        found = statistics(load_frame("cube6"), Errors(), 30, Errors(ends_mm=0.0))
        assert found.accepted <= 3
        assert found.refused["inaccurate"] + found.refused["contradicted"] > 20


class TestChiSquare:
    @pytest.mark.parametrize(("name", "errors"), [("cube6", Errors()), ("random", Errors(measured=True))], ids=str)
    def test_has_its_degrees_of_freedom(self, name: str, errors: Errors) -> None:
        """Of the residual and of what a free scale takes from it, with frames and scales off as stated."""
        frame, sets = frame_of(name), 60
        residuals, misfits = [], []
        rng = np.random.default_rng(3)
        for _ in range(sets):
            result, _ = registered(rng, frame, errors, errors)
            estimates = [result.estimate] if result else result.estimates
            if len(estimates) == 1 and estimates[0].inliers == len(frame):
                residuals.append(estimates[0].chi_square)
                misfits.append(estimates[0].scale_misfit.fall)
                assert estimates[0].scale_misfit.degrees_of_freedom == (3 if errors.measured else 2)
        assert len(residuals) > 0.95 * sets
        freedom, modes = 2 * len(frame) - 6, 3 if errors.measured else 2
        for values, mean in ((residuals, freedom), (misfits, modes)):
            assert np.mean(values) == pytest.approx(mean, abs=4 * np.sqrt(2 * mean / len(values)))
            assert np.mean(np.array(values) > chi2.isf(0.05, mean)) < 0.05 + 4 * np.sqrt(0.05 * 0.95 / len(values))


def plain_estimate(
    frame: Frame, lines: NDArray[np.intp], pose: Pose, spots_mm: Array, variances: Array
) -> tuple[Pose, Array, float]:
    """Gauss-Newton on the residuals alone: pose, covariance (6, 6) and chi-square."""
    weights = np.repeat(1.0 / variances, 2)
    for _ in range(50):
        cuts = cut(frame, pose.rotation, pose.translation)
        jacobian = cut_jacobian(cuts, pose.translation)[lines].reshape(-1, 6)
        residual = (spots_mm - cuts.points_mm[lines]).ravel()
        covariance = np.asarray(np.linalg.inv(jacobian.T @ (weights[:, None] * jacobian)), dtype=np.float64)
        step = covariance @ jacobian.T @ (weights * residual)
        pose = pose.perturbed(step[:3], step[3:])
    return pose, covariance, float(weights @ residual**2)


@pytest.mark.parametrize("missing", [0, 1])
def test_of_a_perfect_frame_all_is_as_least_squares_alone_has_it(missing: int) -> None:
    frame, rng = load_frame("cube8"), np.random.default_rng(4)
    options = RegistrationOptions(
        spot_noise_px=0.1, frame_tolerance_mm=0.0, scale_tolerance=0.0, slice_thickness_mm=0.01, max_rotation_deg=60.0
    )
    for _ in range(8):
        pose = random_pose(rng, frame, SCANNER)
        spots_px = project(frame, pose, SCALE)[0] + rng.normal(0.0, 0.15, (8, 2))
        covariances = rng.uniform(0.1, 0.3, 8)[:, None, None] ** 2 * np.eye(2)
        order = rng.permutation(8)[missing:]
        result = register_spots(spots_px[order], frame, SCALE, options, covariances_px2=covariances[order])
        assert result
        lines = np.sort(order)
        variances = np.asarray(covariances[lines, 0, 0] * SCALE.sx**2, dtype=np.float64)
        found, covariance, residual = plain_estimate(frame, lines, pose, SCALE.to_mm(spots_px[lines]), variances)
        assert result.estimate.chi_square == pytest.approx(residual, rel=1e-9)
        # Both stop where a step no longer matters, and the curvature changes a little on the way there.
        size = np.sqrt(np.diag(covariance))
        apart = pose_error(result.scanner_from_frame, found)
        assert np.abs(apart / size).max() < 1e-4
        at_result = np.linalg.inv(information(frame, lines, result.scanner_from_frame, variances))
        np.testing.assert_allclose(
            result.covariance / np.outer(size, size), at_result / np.outer(size, size), atol=1e-9
        )
        np.testing.assert_allclose(at_result / np.outer(size, size), covariance / np.outer(size, size), atol=1e-4)


def information(frame: Frame, lines: NDArray[np.intp], pose: Pose, variances: Array) -> Array:
    jacobian = cut_jacobian(cut(frame, pose.rotation, pose.translation), pose.translation)[lines].reshape(-1, 6)
    square: Array = jacobian.T @ (np.repeat(1.0 / variances, 2)[:, None] * jacobian)
    return square
