"""How many matches chance brings, against chance itself."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Array, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import Cuts, cut, cut_jacobian
from stereoreg_ros.geometry.visibility import END_SLACK_MM, LEAST_COSINE
from stereoreg_ros.matching.consensus import least_log10_false_alarms, log10_by_chance, log10_false_alarms
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.pose_volume import low_stretch, plane_sample, pose_volume, stretch
from stereoreg_ros.matching.prior import Near, Prior
from stereoreg_ros.matching.significance import (
    Chance,
    area_of_uniform_mm2,
    log10_expected,
    lucky_chi_square,
    share_of,
)
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.matching.tolerances import Tolerances
from support.frames import random_slice_from_frame

OPEN = Prior(np.eye(3), np.pi)


def visible(frame: Frame, rotations: Array, translations: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which rods (p, n) each pose has the slice cut, and where (p, n, 2) mm."""
    cuts = cut(frame, rotations, translations)
    with np.errstate(invalid="ignore"):
        low, high = frame.lambda_min - END_SLACK_MM, frame.lambda_max + END_SLACK_MM
        seen = (cuts.lambdas >= low) & (cuts.lambdas <= high) & (np.abs(cuts.directions[..., 2]) >= LEAST_COSINE)
    return seen, cuts.points_mm


class TestExpectedNumber:
    def test_scales_as_the_chance_does(self) -> None:
        usual = Chance(spots=20, area_mm2=4e4, variance_mm2=0.02, measure_mm6=1e10)
        value = log10_expected(6, 5.0, usual)
        assert log10_expected(6, 50.0, usual) - value == pytest.approx(3)
        assert log10_expected(6, 5.0, Chance(20, 4e5, 0.02, 1e10)) - value == pytest.approx(-6)
        assert log10_expected(6, 5.0, Chance(20, 4e4, 0.2, 1e10)) - value == pytest.approx(3)
        assert log10_expected(6, 5.0, Chance(20, 4e4, 0.02, 1e12)) - value == pytest.approx(2)
        more = log10_expected(6, 5.0, Chance(40, 4e4, 0.02, 1e10)) - value
        assert more == pytest.approx(math.log10(math.perm(40, 6) / math.perm(20, 6)))

    def test_more_rods_are_less_by_chance(self) -> None:
        usual = Chance(spots=20, area_mm2=4e4, variance_mm2=0.02, measure_mm6=1e10)
        values = [log10_expected(inliers, 5.0, usual) for inliers in (4, 5, 6, 7)]
        assert values == sorted(values, reverse=True)

    def test_exact_data_and_no_poses_stay_numbers(self) -> None:
        assert math.isfinite(log10_expected(5, 0.0, Chance(9, 4e4, 0.02, 1e10)))
        assert log10_expected(5, 1.0, Chance(9, 4e4, 0.02, 0.0)) == -math.inf
        assert log10_expected(6, 1.0, Chance(5, 4e4, 0.02, 1e10)) == -math.inf

    def test_luck_is_one_in_a_hundred(self) -> None:
        rng = np.random.default_rng(3)
        for inliers in (4, 5, 6):
            drawn = rng.chisquare(2 * inliers - 6, 200_000)
            assert np.mean(drawn < lucky_chi_square(inliers)) == pytest.approx(0.01, rel=0.1)

    @pytest.mark.parametrize(
        ("inliers", "ball_mm4"),
        [(4, math.pi * 0.06), (5, math.pi**2 / 2 * 0.06**2), (6, math.pi**3 / 6 * 0.06**3)],
        ids=["a disc", "a ball in four dimensions", "a ball in six"],
    )
    def test_by_hand(self, inliers: int, ball_mm4: float) -> None:
        """Twelve spots in 100 mm by 90 mm: the orders of so many of them, times the share of the room that is near."""
        orders = {4: 12 * 11 * 10 * 9, 5: 12 * 11 * 10 * 9 * 8, 6: 12 * 11 * 10 * 9 * 8 * 7}[inliers]
        expected = orders * 5e7 * ball_mm4 / 9000.0**inliers
        # Chi-square 3 and a variance of 0.02 mm^2: a squared radius of 0.06 mm^2.
        assert log10_expected(inliers, 3.0, Chance(12, 9000.0, 0.02, 5e7)) == pytest.approx(math.log10(expected))

    def test_by_chance_itself(self) -> None:
        """Uniform points in the space of four spots' coordinates: how many lie near a flat surface of poses."""
        rng = np.random.default_rng(8)
        jacobian = np.concatenate([np.diag([1.0, 2.0, 1.0, 3.0, 1.0, 2.0]), rng.uniform(-1, 1, (2, 6))])
        reach = np.abs(jacobian).sum(axis=1) * 0.5
        radius = 0.6
        # Uniform in a box that holds all that is near the surface: its area takes the place of the slice's.
        half = reach + radius
        count = 400_000
        points = rng.uniform(-1, 1, (count, 8)) * half
        poses = points @ np.linalg.pinv(jacobian).T
        near = np.linalg.norm(points - poses @ jacobian.T, axis=1) <= radius
        found = int((near & (np.abs(poses) <= 0.5).all(axis=1)).sum())
        measure = 1.0 * math.sqrt(np.linalg.det(jacobian.T @ jacobian))
        area = float(np.prod(2 * half)) ** (1 / 4)
        # Of one of the 24 orders in which four spots can be given to four rods.
        expected = count * 10 ** log10_expected(4, 2.0, Chance(4, area, radius**2 / 2, measure)) / 24
        assert expected > 400
        assert found == pytest.approx(expected, abs=3 * math.sqrt(expected))


class TestOfAnExplanation:
    """What chance brings as good as an explanation: by its residuals, as its spots' covariances measure them."""

    FRAME = load_frame("cube6")
    POSE = random_slice_from_frame(np.random.default_rng(4), FRAME)
    AREA_MM2 = 200.0 * 180.0

    def spots(self) -> Spots:
        """Those of the six rods and two more, in another order, no two known alike."""
        rng = np.random.default_rng(5)
        mm = np.concatenate([[[3.0, 4.0], [190.0, 170.0]], self.cuts.points_mm[::-1]])
        root = 0.1 * rng.normal(size=(8, 2, 2))
        covariances = root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(2)
        return Spots.of(mm, covariances, self.AREA_MM2, Tolerances.none(self.FRAME))

    @property
    def cuts(self) -> Cuts:
        return cut(self.FRAME, self.POSE.rotation, self.POSE.translation)

    def explanation(self, spot_of_line: list[int], chi_square: float = 2.5) -> Hypothesis:
        rows = np.array(spot_of_line)
        return Hypothesis(self.POSE.rotation, self.POSE.translation, rows, chi_square, np.eye(6), 0)

    @pytest.mark.parametrize("spot_of_line", [[7, 6, 5, 4, 3, 2], [7, UNMATCHED, 5, 4, 3, 2]], ids=["six", "five"])
    def test_by_hand(self, spot_of_line: list[int]) -> None:
        """In units of standard deviations the spots have a room of their own, and the surface of the poses another."""
        spots, rods = self.spots(), np.flatnonzero(np.array(spot_of_line) != UNMATCHED)
        k = len(rods)
        covariances = spots.covariances_mm2[np.array(spot_of_line)[rods]]
        jacobian = cut_jacobian(self.cuts, self.POSE.translation)[rods]
        information = np.einsum("nij,nik,nkl->jl", jacobian, np.linalg.inv(covariances), jacobian)
        # No direction of the pose is taken to be open for more than 10 mm and 0.1 rad.
        information += np.diag([10.0**-2] * 3 + [0.1**-2] * 3)
        surface = math.sqrt(np.linalg.det(information)) * pose_volume(self.FRAME, k, OPEN, self.AREA_MM2)
        ball = math.pi ** (k - 3) / math.factorial(k - 3) * 2.5 ** (k - 3)
        room = np.prod(self.AREA_MM2 / np.sqrt(np.linalg.det(covariances)))
        expected = math.perm(8, k) * surface * ball / room
        share = {6: 0.99 / 9, 5: 0.99 / 9 * 8}[k]
        found = log10_false_alarms(self.explanation(spot_of_line), spots, self.FRAME, OPEN)
        assert found == pytest.approx(math.log10(expected / share), abs=1e-6)

    def test_errors_that_spots_share_are_room_too(self) -> None:
        """The covariance of all coordinates together decides, errors of the scale among them."""
        spots = self.spots()._replace(tolerances=Tolerances.none(self.FRAME).with_scale_known_to(0.01))
        order = [7, 6, 5, 4, 3, 2]
        own = spots.covariances_mm2[order]
        common = spots.tolerances.common(self.FRAME, self.cuts, spots.mm[order], np.ones(6, dtype=bool)).reshape(12, -1)
        whole = common @ common.T
        for k in range(6):
            whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += own[k]
        jacobian = cut_jacobian(self.cuts, self.POSE.translation).reshape(12, 6)
        surface = math.sqrt(np.linalg.det(jacobian.T @ np.linalg.solve(whole, jacobian)))
        surface *= pose_volume(self.FRAME, 6, OPEN, self.AREA_MM2)
        ball = math.pi**3 / 6 * 2.5**3
        expected = math.perm(8, 6) * surface * ball * math.sqrt(np.linalg.det(whole)) / self.AREA_MM2**6
        found = log10_false_alarms(self.explanation(order), spots, self.FRAME, OPEN)
        assert found == pytest.approx(math.log10(expected / (0.99 / 9)), abs=2e-3)
        alone = log10_false_alarms(self.explanation(order), self.spots(), self.FRAME, OPEN)
        assert found > alone + 0.5

    def test_before_one_is_found_the_best_spots_the_lowest_stretch_and_luck_are_reckoned_with(self) -> None:
        spots = self.spots()
        variances = np.sort(np.sqrt(np.linalg.det(spots.covariances_mm2)))
        variance = float(np.exp(np.log(variances[:5]).mean()))
        measure = low_stretch(self.FRAME, 5, variance) * pose_volume(self.FRAME, 5, OPEN, self.AREA_MM2)
        lucky = log10_expected(5, lucky_chi_square(5), Chance(8, self.AREA_MM2, variance, measure))
        found = least_log10_false_alarms(5, spots, self.FRAME, OPEN)
        # The variance is rounded down, in steps of one in fifty, of which the number goes by the fifth power.
        assert 0 <= lucky - math.log10(0.99 / 9 * 8) - found <= 5 * math.log10(1.02)
        mean = plane_sample(self.FRAME, 5).mean_ratio * pose_volume(self.FRAME, 5, OPEN, self.AREA_MM2)
        worst = float(np.exp(np.log(variances[-5:]).mean()))
        by_chance = log10_expected(5, 7.0, Chance(8, self.AREA_MM2, worst, mean))
        assert log10_by_chance(5, 7.0, spots, self.FRAME, OPEN) == pytest.approx(by_chance)

    def test_the_mean_and_the_low_stretch_are_those_of_slices_at_random(self) -> None:
        rotations = Rotation.random(20_000, random_state=6).as_matrix()
        translations = np.random.default_rng(6).uniform(-53, 53, (20_000, 3)) * [0, 0, 1]
        seen, _ = visible(self.FRAME, rotations, translations)
        chosen = seen.all(axis=1)
        cuts = cut(self.FRAME, rotations[chosen], translations[chosen])
        jacobian = cut_jacobian(cuts, translations[chosen]).reshape(-1, 12, 6)
        squares = np.swapaxes(jacobian, 1, 2) @ jacobian
        ratios = np.sqrt(np.linalg.det(squares))
        assert plane_sample(self.FRAME, 6).mean_ratio == pytest.approx(ratios.mean(), rel=0.1)
        low = float(np.percentile(stretch(squares / 0.02, 0.02), 2.0))
        assert low_stretch(self.FRAME, 6, 0.02) == pytest.approx(low, rel=0.25)

    def test_where_nothing_fixes_the_pose_ten_millimetres_and_a_tenth_of_a_radian_do(self) -> None:
        assert stretch(np.zeros((6, 6)), 0.02) == pytest.approx(0.1**3 * 10**3 * 0.02**3)


def test_shares_are_an_eighth_of_those_of_a_rod_less_and_a_hundredth_for_four() -> None:
    """By hand, of a frame of seven rods: 512 + 64 + 8 + 1 = 585 parts of 0.99, without the last three of a rod more."""
    assert share_of(4, 7) == 0.01
    assert [share_of(inliers, 7) for inliers in (5, 6, 7)] == pytest.approx([0.99 * part / 73 for part in (64, 8, 1)])
    assert share_of(5, 5) == pytest.approx(0.99)
    assert share_of(4, 4) == 1.0


class TestNearAGuess:
    """The room of poses near a guess: by hand."""

    # Upright rods, which the guess cuts at their middle; the last two end 21.5 mm and 20.5 mm below the slice.
    ENDS_MM = np.array([30.0, 30.0, 30.0, 30.0, -21.5, -20.5])
    STARTS = np.array(
        [[0, 0, -60], [20, 0, -60], [0, 20, -60], [20, 25, -60], [40, 5, -60], [45, 40, -60]], dtype=float
    )
    FRAME = Frame("pins", tuple("abcdef"), STARTS, STARTS * [1, 1, 0] + ENDS_MM[:, None] * [0, 0, 1], np.ones(6))

    def volume(self, rods: int, reach_mm: float = 10.0) -> float:
        near = Near(np.array([50.0, 60.0, 0.0]), reach_mm, np.ones((6, 9), dtype=bool))
        return pose_volume(self.FRAME, rods, Prior(np.eye(3), 0.1, near), 256.0**2)

    # Within 10 mm along the slice, 40 mm across it, and 0.1 rad of every axis.
    ROOM = math.pi * 10**2 * 40 * 4 / 3 * math.pi * 0.1**3

    def test_of_five_rods_of_six_any_five_may_be_the_ones(self) -> None:
        """A rod that ends as far from the slice as the slice may rise, and a millimetre, may be cut."""
        assert self.volume(5) == pytest.approx(self.ROOM)
        assert self.volume(4) == pytest.approx(5 * self.ROOM)
        assert self.volume(3) == pytest.approx(10 * self.ROOM)
        assert self.volume(6) == 0.0

    def test_half_the_reach_is_an_eighth_of_the_room_and_leaves_out_a_rod(self) -> None:
        assert self.volume(4, 5.0) == pytest.approx(self.ROOM / 8)
        assert self.volume(5, 5.0) == 0.0

    def test_a_rod_that_lies_along_the_slice_is_none_of_them(self) -> None:
        ends = self.FRAME.ends.copy()
        ends[0] = self.STARTS[0] + [300.0, 0.0, 55.0]  # at 10.4 degrees
        frame = Frame("leaning", tuple("abcdef"), self.STARTS, ends, np.ones(6))
        # The slice cuts the lower half of the others.
        near = Near(np.array([50.0, 60.0, 30.0]), 10.0, np.ones((6, 9), dtype=bool))
        prior = Prior(np.eye(3), 0.1, near)
        assert pose_volume(frame, 3, prior, 256.0**2) == pytest.approx(self.ROOM * 10)


class TestPoseVolume:
    """Against poses drawn at random from the whole of a box of positions and of all rotations."""

    COUNT = 300_000
    SIDE = 200.0
    HEIGHT = 60.0

    def drawn(self, frame: Frame, seed: int) -> tuple[Array, NDArray[np.bool_], float]:
        rng = np.random.default_rng(seed)
        rotations = Rotation.random(self.COUNT, random_state=seed).as_matrix()
        low, high = np.zeros(3), np.array([self.SIDE, self.SIDE, self.HEIGHT])
        translations = rng.uniform(low, high, (self.COUNT, 3)) - [0, 0, self.HEIGHT / 2]
        seen, points = visible(frame, rotations, translations)
        inside = ((points >= 0) & (points <= self.SIDE)).all(axis=2)
        volume = 8 * np.pi**2 * self.SIDE**2 * self.HEIGHT
        return rotations, seen & inside, volume / self.COUNT

    @pytest.mark.parametrize("rods", [4, 5, 6])
    def test_of_all_poses(self, rods: int) -> None:
        frame = load_frame("cube6")
        # The farthest rod's end is 52 mm from the centre: 60 mm would cut off heights that rods still reach.
        self.HEIGHT = 106.0
        _, seen, weight = self.drawn(frame, 1)
        sets = sum(seen[:, list(one)].all(axis=1).sum() for one in combinations(range(6), rods))
        stated = pose_volume(frame, rods, OPEN, self.SIDE**2)
        assert stated == pytest.approx(weight * sets, rel=0.05)

    def test_within_an_angle(self) -> None:
        frame = load_frame("cube6")
        self.HEIGHT = 106.0
        rotations, seen, weight = self.drawn(frame, 2)
        nominal = rotation_exp(np.array([0.3, -0.2, 1.0]))
        for degrees in (40.0, 90.0, 150.0):
            prior = Prior(nominal, np.radians(degrees))
            near = prior.angles(rotations) <= prior.max_rotation
            sets = sum((near & seen[:, list(one)].all(axis=1)).sum() for one in combinations(range(6), 5))
            stated = pose_volume(frame, 5, prior, self.SIDE**2)
            assert stated == pytest.approx(weight * sets, rel=0.12), degrees

    def test_near_a_pose_is_less(self) -> None:
        frame = load_frame("cube6")
        pose = random_slice_from_frame(np.random.default_rng(4), frame)
        near = Prior(pose.rotation, np.radians(5.0), Near(pose.translation, 10.0, np.ones((6, 9), dtype=bool)))
        wide = Prior(pose.rotation, np.radians(5.0))
        assert 0 < pose_volume(frame, 6, near, 256.0**2) < 0.1 * pose_volume(frame, 6, wide, 256.0**2)

    def test_more_rods_than_any_slice_cuts(self) -> None:
        starts = np.array([[0, 0, -30], [20, 0, -30], [0, 20, -30], [0, 0, 60], [20, 0, 60], [0, 20, 60]], dtype=float)
        ends = starts + np.array([3.0, 5.0, 30.0]) + np.eye(3)[[0, 1, 2, 1, 2, 0]] * 4
        frame = Frame("two floors", tuple("abcdef"), starts, ends, np.ones(6))
        steep = Prior(np.eye(3), np.radians(10.0))
        assert pose_volume(frame, 3, steep, 256.0**2) > 0
        assert pose_volume(frame, 6, steep, 256.0**2) == 0

    def test_the_turns_within_an_angle(self) -> None:
        rng = np.random.default_rng(6)
        nominal = rotation_exp(np.array([0.5, 0.2, -0.4]))
        prior = Prior(nominal, np.radians(50.0))
        for tilt_deg in (0.0, 20.0, 49.0, 51.0):
            axis = np.append(rng.normal(size=2), 0.0)
            tilted = rotation_exp(np.radians(tilt_deg) * axis / np.linalg.norm(axis)) @ nominal
            psi = np.linspace(-np.pi, np.pi, 20_001)
            about = rotation_exp(np.column_stack([0 * psi, 0 * psi, psi])) @ tilted
            share = np.mean(rotation_angle(about @ nominal.T) <= prior.max_rotation)
            assert prior.turns(tilted[2:3])[0] == pytest.approx(2 * np.pi * share, abs=2e-3)

    def test_stretch_is_bounded_where_the_pose_is_open(self) -> None:
        frame = load_frame("leksell_ct")
        cuts = cut(frame, np.eye(3), np.array([0.0, 0.0, 60.0]))
        jacobian = cut_jacobian(cuts, np.array([0.0, 0.0, 60.0])).reshape(-1, 6)
        square = jacobian.T @ jacobian
        assert np.linalg.det(square) < 1e-3
        assert stretch(square / 0.02, 0.02) > 1e3
        assert low_stretch(frame, 6, 0.02) > 0
        regular = np.diag([6.0, 6, 2, 5e3, 5e3, 5e3])
        assert stretch(regular / 0.02, 0.02) == pytest.approx(math.sqrt(np.linalg.det(regular)), rel=0.01)

    def test_is_drawn_once(self) -> None:
        frame = load_frame("zframe")
        assert plane_sample(frame, 5) is plane_sample(frame, 5)
        np.testing.assert_allclose(np.linalg.norm(plane_sample(frame, 5).normals, axis=1), 1)


def test_area_of_uniform_spots_is_the_slices_where_known() -> None:
    spots = np.random.default_rng(12).uniform(0, 100, (9, 2))
    assert area_of_uniform_mm2(spots, 5e4) == 5e4
    assert area_of_uniform_mm2(spots, None) == pytest.approx(float(np.prod(np.ptp(spots, axis=0))) * (10 / 8) ** 2)


@pytest.mark.parametrize("lines", [4, 5, 6, 7, 12])
def test_shares_sum_to_one(lines: int) -> None:
    assert sum(share_of(inliers, lines) for inliers in range(4, lines + 1)) == pytest.approx(1)
