"""How many matches chance brings, against chance itself."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from frames import random_slice_from_frame
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Array, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import cut, cut_jacobian
from stereoreg_ros.matching.pose_volume import low_stretch, plane_sample, pose_volume, stretch
from stereoreg_ros.matching.prior import Near, Prior
from stereoreg_ros.matching.significance import (
    Chance,
    area_of_uniform_mm2,
    log10_expected,
    lucky_chi_square,
    share_of,
)
from stereoreg_ros.matching.visibility import END_SLACK_MM, LEAST_COSINE

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
