"""How explanations are ranked, and which of them are one: by explanations made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoreg_ros.matching.consensus import MISSING_COST, distinct, evidence, score
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis

SIX = np.arange(6)
# Of six spots, no two alike, so that none can be taken for another.
GAINS = np.array([5.0, 5.5, 6.0, 6.5, 7.0, 7.5])
COVARIANCE = np.diag([0.04, 0.09, 0.16, 1e-4, 2e-4, 3e-4])


def explanation(
    offset: np.ndarray | None = None,
    chi_square: float = 4.0,
    spot_of_line: np.ndarray = SIX,
    covariance: np.ndarray = COVARIANCE,
    missing: int = 0,
) -> Hypothesis:
    """An explanation whose pose lies at an offset (6,), as of `Pose.perturbed`, from the identity."""
    offset = np.zeros(6) if offset is None else offset
    rotation = Rotation.from_rotvec(offset[3:]).as_matrix()
    return Hypothesis(rotation, offset[:3], spot_of_line, chi_square, np.linalg.inv(covariance), missing)


def covariance_of(one: Hypothesis) -> np.ndarray:
    return np.linalg.inv(one.information)


class TestScore:
    def test_is_what_the_matched_spots_gain_less_half_of_chi_square_and_the_cost_of_missing_rods(self) -> None:
        matched = np.array([4, UNMATCHED, 2, 0, UNMATCHED, 5])
        found = explanation(chi_square=3.0, spot_of_line=matched, missing=2)
        assert score(found, GAINS) == pytest.approx(7.0 + 6.0 + 5.0 + 7.5 - 1.5 - 2 * MISSING_COST)

    def test_of_two_that_differ_in_nothing_but_a_missing_rod_the_complete_one_is_first(self) -> None:
        far = np.array([40.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        five = np.array([0, 1, 2, 3, 4, UNMATCHED])
        lacking, complete = explanation(spot_of_line=five, missing=1), explanation(far, spot_of_line=five)
        assert distinct([lacking, complete], GAINS) == [complete, lacking]
        assert score(complete, GAINS) - score(lacking, GAINS) == pytest.approx(MISSING_COST)
        # What it costs is one in twenty.
        assert pytest.approx(math.log(20), abs=0.01) == MISSING_COST

    def test_evidence_prefers_the_pose_that_is_known_less_well(self) -> None:
        """Of two that fit as well, the one that leaves the pose more room is reached by more poses."""
        narrow, wide = explanation(), explanation(covariance=4 * COVARIANCE)
        assert evidence(wide, GAINS) - evidence(narrow, GAINS) == pytest.approx(0.5 * 6 * math.log(4))


class TestDistinct:
    def test_two_places_are_two_best_first(self) -> None:
        near = explanation(chi_square=6.0)
        far = explanation(np.array([30.0, 0, 0, 0, 0, 0]), chi_square=5.0)
        assert distinct([near, far], GAINS) == [far, near]

    def test_what_is_far_behind_is_forgotten(self) -> None:
        far = np.array([30.0, 0, 0, 0, 0, 0])
        best = explanation(chi_square=1.0)
        behind, too_far_behind = (explanation(far, chi_square=1.0 + 2 * by) for by in (29.9, 30.1))
        assert distinct([best, behind], GAINS) == [best, behind]
        assert distinct([best, too_far_behind], GAINS) == [best]

    def test_the_same_optimum_found_again_widens_nothing(self) -> None:
        best = explanation()
        again = explanation(1e-3 * np.array([1.0, -1.0, 1.0, 0.01, 0.01, -0.01]))
        (found,) = distinct([best, again], GAINS)
        assert found is best

    @pytest.mark.parametrize(("squared", "is_the_same"), [(0.09, True), (0.11, False)])
    def test_optima_are_the_same_within_a_third_of_a_standard_deviation(
        self, squared: float, is_the_same: bool
    ) -> None:
        offset = np.array([0.0, math.sqrt(squared * COVARIANCE[1, 1]), 0.0, 0.0, 0.0, 0.0])
        best = explanation()
        (found,) = distinct([best, explanation(offset)], GAINS)
        assert (found is best) is is_the_same
        assert found.is_widened is not is_the_same

    @pytest.mark.parametrize("behind", [0.0, 1.0, 3.0])
    def test_two_optima_of_one_valley_are_one_whose_covariance_holds_both(self, behind: float) -> None:
        """As a mixture of the two, each by its likelihood, varies about the better one."""
        offset = np.array([0.9, -1.2, 0.5, 0.02, 0.01, -0.03])
        best = explanation(chi_square=4.0)
        (found,) = distinct([best, explanation(offset, chi_square=4.0 + 2 * behind)], GAINS)
        share = math.exp(-behind) / (1 + math.exp(-behind))
        np.testing.assert_allclose(covariance_of(found), COVARIANCE + share * np.outer(offset, offset), rtol=1e-6)
        np.testing.assert_array_equal(found.translation, best.translation)
        assert found.chi_square == best.chi_square
        assert found.is_widened

    def test_of_a_third_optimum_the_valley_is_widened_too(self) -> None:
        offset = np.array([0.9, -1.2, 0.5, 0.02, 0.01, -0.03])
        alike = [explanation(sign * offset, chi_square=4.0) for sign in (0.0, 1.0, -1.0)]
        (two,), (three,) = distinct(alike[:2], GAINS), distinct(alike, GAINS)
        assert covariance_of(three)[1, 1] > 1.2 * covariance_of(two)[1, 1]

    def test_what_a_ridge_parts_is_two(self) -> None:
        """Two optima at a distance d, in standard deviations of either, are parted by a ridge of d^2/16."""
        direction = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        for ridge, count in ((3.9, 1), (4.1, 2)):
            offset = math.sqrt(16 * ridge * COVARIANCE[1, 1]) * direction
            assert len(distinct([explanation(), explanation(offset)], GAINS)) == count

    def test_the_narrower_of_two_decides_whether_they_are_one(self) -> None:
        offset = np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0])
        assert len(distinct([explanation(), explanation(offset)], GAINS)) == 1
        assert len(distinct([explanation(), explanation(offset, covariance=0.3 * COVARIANCE)], GAINS)) == 2

    def test_far_apart_in_orientation_is_never_one_valley(self) -> None:
        wide = np.diag([1e4, 1e4, 1e4, 10.0, 10.0, 10.0])
        for angle, count in ((0.49, 1), (0.51, 2)):
            offset = np.array([0, 0, 0, 0, angle, 0])
            assert len(distinct([explanation(covariance=wide), explanation(offset, covariance=wide)], GAINS)) == count


class TestOtherMatches:
    """Of one pose: where two rods meet and one does not show, either may have the spot."""

    OFFSET = np.array([0.3, -0.4, 0.2, 0.01, 0.005, -0.01])
    # The last rod takes the spot of the last but one.
    FIRST = np.array([0, 1, 2, 3, 4, UNMATCHED])
    OTHER = np.array([0, 1, 2, 3, UNMATCHED, 4])

    @pytest.mark.parametrize("behind", [0.0, 0.7, 2.5])
    def test_as_many_widen_by_their_evidence(self, behind: float) -> None:
        wide = COVARIANCE @ np.diag([1.0, 2.0, 4.0, 1.0, 9.0, 1.0])
        best = explanation(spot_of_line=self.FIRST)
        other = explanation(self.OFFSET, 4.0 + 2 * behind, self.OTHER, wide)
        (found,) = distinct([best, other], GAINS)
        # Evidence, not likelihood: what is known less well has more room, by the root of 2 * 4 * 9.
        odds = math.exp(-behind) * math.sqrt(72)
        share = odds / (1 + odds)
        expected = (1 - share) * COVARIANCE + share * (wide + np.outer(self.OFFSET, self.OFFSET))
        np.testing.assert_allclose(covariance_of(found), expected, rtol=1e-6, atol=1e-12)
        np.testing.assert_array_equal(found.spot_of_line, best.spot_of_line)
        assert found.is_widened

    def test_as_likely_they_widen_even_where_the_poses_are_the_same(self) -> None:
        wide = 4 * COVARIANCE
        best = explanation(spot_of_line=self.FIRST)
        (found,) = distinct([best, explanation(spot_of_line=self.OTHER, covariance=wide)], GAINS)
        assert found.is_widened
        assert covariance_of(found)[0, 0] > 3 * COVARIANCE[0, 0]

    def test_of_fewer_rods_only_the_place_counts(self) -> None:
        """All that five of six matches say less than six is known already: the sixth is a spot of the frame's."""
        best = explanation(spot_of_line=SIX)
        other = explanation(spot_of_line=np.array([0, 1, 2, 3, 4, UNMATCHED]), covariance=9 * COVARIANCE, chi_square=0)
        (found,) = distinct([best, other], GAINS)
        np.testing.assert_allclose(covariance_of(found), COVARIANCE)
        assert not found.is_widened

    def test_a_thousand_times_less_likely_widens_nothing(self) -> None:
        best = explanation(spot_of_line=self.FIRST)
        for behind, widened in ((6.8, True), (7.0, False)):
            other = explanation(self.OFFSET, 4.0 + 2 * behind, self.OTHER)
            (found,) = distinct([best, other], GAINS)
            assert found.is_widened is widened
            assert (found is best) is not widened
