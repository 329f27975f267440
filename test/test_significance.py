"""How many matches chance brings, against chance itself."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
import pytest
from frames import random_frame, random_slice_from_frame

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import cut, cut_jacobian
from stereoreg_ros.matching.significance import clutter_area_mm2, log10_false_alarms, share_of


class TestAgainstChance:
    """Spots fall uniformly into a square; a seed of three rods predicts further ones. How often do they fit so well?"""

    SIGMA = 0.6
    SIDE = 80.0

    def predicted(self, further: int) -> tuple[Array, Array, Array]:
        """J'J (6, 6) of the seed and of the further rods, and the joint covariance of the misfit of these."""
        rng = np.random.default_rng(5)
        frame = random_frame(rng, 3 + further)
        pose = random_slice_from_frame(rng, frame)
        cuts = cut(frame, pose.rotation, pose.translation)
        jacobian = cut_jacobian(cuts, pose.translation)
        seed = jacobian[:3].reshape(6, 6)
        rest = jacobian[3:].reshape(2 * further, 6)
        seed_information = seed.T @ seed / self.SIGMA**2
        seed_information += np.diag([10.0**-2] * 3 + [0.1**-2] * 3)
        covariance = rest @ np.linalg.inv(seed_information) @ rest.T + self.SIGMA**2 * np.eye(2 * further)
        return seed_information, rest.T @ rest / self.SIGMA**2, covariance

    @pytest.mark.parametrize(
        ("further", "spots", "chi_square"), [(1, 4, 20.0), (1, 7, 20.0), (2, 5, 60.0), (2, 7, 60.0)]
    )
    def test_expected_number(self, further: int, spots: int, chi_square: float) -> None:
        seed_information, further_information, covariance = self.predicted(further)
        openness = np.diag([10.0**-2] * 3 + [0.1**-2] * 3)
        stated = 10 ** log10_false_alarms(
            inliers=3 + further,
            spots=spots,
            choices_of_rods=1,
            chi_square=chi_square,
            # The openness is added inside; here it is part of what the seed knows already.
            information=seed_information - openness + further_information,
            seed_information=seed_information - openness,
            spot_variance_mm2=self.SIGMA**2,
            area_mm2=self.SIDE**2,
            share=1.0,
        )
        rng = np.random.default_rng(6)
        trials = 400_000
        clutter = rng.uniform(-self.SIDE / 2, self.SIDE / 2, (trials, spots - 3, 2))
        precision = np.linalg.inv(covariance)
        count = 0
        for chosen in permutations(range(spots - 3), further):
            misfit = clutter[:, list(chosen)].reshape(trials, -1)
            count += int((np.einsum("mi,ij,mj->m", misfit, precision, misfit) <= chi_square).sum())
        assert count > 100
        # The ellipsoid must lie within the square for the volumes to be comparable.
        assert math.sqrt(chi_square * np.linalg.eigvalsh(covariance)[-1]) < self.SIDE / 2
        assert count / trials == pytest.approx(stated, rel=4.5 / math.sqrt(count))


def stated(**changes: float) -> float:
    usual = {
        "inliers": 6,
        "spots": 20,
        "choices_of_rods": 100,
        "chi_square": 5.0,
        "spot_variance_mm2": 0.02,
        "area_mm2": 40_000.0,
        "share": 0.5,
    }
    information = np.diag([100.0, 100, 50, 1e5, 1e5, 1e5])
    return log10_false_alarms(**{**usual, **changes}, information=3 * information, seed_information=information)  # type: ignore[arg-type]


class TestBehaviour:
    def test_more_rods_are_less_by_chance(self) -> None:
        assert stated(inliers=4) > stated(inliers=5) > stated(inliers=6) > stated(inliers=7)

    def test_scales_as_the_chance_does(self) -> None:
        assert stated(chi_square=50.0) - stated() == pytest.approx(3)
        assert stated(area_mm2=4e5) - stated() == pytest.approx(-3)
        assert stated(spot_variance_mm2=0.2) - stated() == pytest.approx(3)
        assert stated(choices_of_rods=10_000) - stated() == pytest.approx(2)
        assert stated(share=0.05) - stated() == pytest.approx(1)
        assert stated(spots=40) - stated() == pytest.approx(math.log10(37 * 36 * 35 / (17 * 16 * 15)))

    def test_a_chance_is_at_most_one(self) -> None:
        hopeless = stated(chi_square=1e9, choices_of_rods=1, share=1.0)
        assert hopeless == pytest.approx(math.log10(17 * 16 * 15))

    def test_exact_data_and_no_choices_stay_finite(self) -> None:
        assert math.isfinite(stated(chi_square=0.0))
        assert stated(choices_of_rods=0) == stated(choices_of_rods=1)

    def test_a_seed_that_leaves_the_pose_open(self) -> None:
        value = log10_false_alarms(4, 10, 5, 1.0, np.zeros((6, 6)), np.zeros((6, 6)), 0.02, 4e4, 1.0)
        assert math.isfinite(value)


class TestClutterArea:
    def test_uniform_clutter_has_its_own_area(self) -> None:
        rng = np.random.default_rng(7)
        spots = rng.uniform(0, 200, (4000, 2))
        # As the matched spots of a frame: some of those there, not all.
        matched = np.flatnonzero(np.linalg.norm(spots - 100, axis=1) < 40)[::50]
        assert clutter_area_mm2(spots, matched, None) == pytest.approx(200**2, rel=0.1)
        assert clutter_area_mm2(spots, matched, 200.0**2) == pytest.approx(200**2, rel=0.1)

    def test_box_around_few_spots_is_made_up_for(self) -> None:
        rng = np.random.default_rng(10)
        areas = [clutter_area_mm2(spots, np.arange(4), None) for spots in rng.uniform(0, 100, (4000, 12, 2))]
        # Where clutter happens to be dense around the four it is less; that is rare.
        assert 0.9 * 100**2 < np.mean(areas) < 1.05 * 100**2

    def test_by_hand(self) -> None:
        # Four at 10 mm around (50, 50), six unmatched among them, five far off: radius 15 mm, six unmatched there where
        # 11 * 707 / 10000 = 0.8 are expected.
        among = [[52, 51], [48, 49], [51, 47], [53, 53], [47, 52], [49, 54]]
        spots = np.array([[40, 50], [60, 50], [50, 40], [50, 60], *among, *[[200 + i, 0] for i in range(5)]], float)
        assert clutter_area_mm2(spots, np.arange(4), 1e4) == pytest.approx(15 * math.pi * 15**2 / 6)
        # One or two there are nothing unusual.
        assert clutter_area_mm2(np.delete(spots, range(5, 10), axis=0), np.arange(4), 1e4) == 1e4

    def test_never_more_than_the_slice(self) -> None:
        spots = np.random.default_rng(11).uniform(0, 100, (8, 2))
        assert clutter_area_mm2(spots, np.arange(4), 3000.0) <= 3000.0

    def test_denser_clutter_nearby_shrinks_it(self) -> None:
        rng = np.random.default_rng(8)
        matched = np.array([[40, 50], [60, 50], [50, 40], [50, 60]], dtype=float)
        near, far = rng.uniform(42, 58, (20, 2)), rng.uniform(300, 400, (20, 2))
        crowded = clutter_area_mm2(np.concatenate([matched, near]), np.arange(4), 1e5)
        sparse = clutter_area_mm2(np.concatenate([matched, far]), np.arange(4), 1e5)
        assert crowded < 0.3 * sparse

    def test_does_not_depend_on_place_or_order(self) -> None:
        spots = np.random.default_rng(9).uniform(0, 200, (30, 2))
        area = clutter_area_mm2(spots, np.array([3, 8, 11, 20]), None)
        assert clutter_area_mm2(spots - 500, np.array([20, 3, 8, 11]), None) == pytest.approx(area)


@pytest.mark.parametrize("lines", [4, 5, 6, 7, 12])
def test_shares_sum_to_one(lines: int) -> None:
    assert sum(share_of(inliers, lines) for inliers in range(4, lines + 1)) == pytest.approx(1)
