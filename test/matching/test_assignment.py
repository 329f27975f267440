"""Which spots rods are given at a pose: within reach of all that is uncertain, the nearest, and each only once."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching.consensus import GATE
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.settling import _assign
from stereoreg_ros.matching.spots import Spots, Streaks
from stereoreg_ros.matching.tolerances import Tolerances
from stereoreg_ros.matching.twin_starts import starts_along_valley
from stereoreg_ros.solvers.likelihood_valley import ARM_MM
from stereoreg_ros.solvers.maximum_likelihood import Refined

# Three upright rods, cut in their middle; the last leans by 45 degrees along x.
PLACES = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 40.0], [60.0, 60.0]])
LEAN = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 1], [1, 0, 1]])
MIDDLES = np.column_stack([PLACES, np.zeros(4)])
FRAME = Frame("four", tuple("abcd"), MIDDLES - 30 * LEAN, MIDDLES + 30 * LEAN, np.ones(4))
KNOWN = np.diag([1e5, 1e5, 1e5, 1e7, 1e7, 1e7])
ROUND = 0.04 * np.eye(2)
# Standard deviations of 0.5 mm along one diagonal and 0.1 mm along the other.
ALONG, ACROSS = np.array([1.0, 1.0]) / math.sqrt(2), np.array([1.0, -1.0]) / math.sqrt(2)
SLANTED = 0.25 * np.outer(ALONG, ALONG) + 0.01 * np.outer(ACROSS, ACROSS)


def assigned(
    points_mm: ArrayLike,
    covariances: Array | None = None,
    information: Array = KNOWN,
    rod_mm: float = 0.0,
    streaks: Streaks | None = None,
    frame: Frame = FRAME,
) -> NDArray[np.intp]:
    """Rows of the spots given to the rods, at the pose that the frame has by itself."""
    points = np.asarray(points_mm, dtype=np.float64)
    tolerances = Tolerances.none(frame)._replace(rod_mm=np.full(len(frame), rod_mm))
    given = np.tile(ROUND, (len(points), 1, 1)) if covariances is None else covariances
    rotations, translations = np.eye(3)[None], np.zeros((1, 3))
    cuts = cut(frame, rotations, translations)
    refined = Refined(rotations, translations, np.zeros(1), information[None], np.ones(1, dtype=bool), cuts)
    found: NDArray[np.intp] = _assign(Spots.of(points, given, None, tolerances, streaks), frame, refined)[0]
    return found


# Four standard deviations and a little: the gate is a chi-square of 18.4.
REACH = math.sqrt(GATE)


@pytest.mark.parametrize("direction", [[1.0, 0.0], [0.0, -1.0], [0.6, 0.8]])
def test_a_spot_is_within_reach_up_to_the_gate(direction: list[float]) -> None:
    near, far = (PLACES[1] + share * REACH * 0.2 * np.array(direction) for share in (0.99, 1.01))
    assert assigned([near])[1] == 0
    assert assigned([far])[1] == UNMATCHED


@pytest.mark.parametrize(("direction", "deviation"), [(ALONG, 0.5), (-ALONG, 0.5), (ACROSS, 0.1), (-ACROSS, 0.1)])
def test_along_its_own_axes_where_a_spot_is_known_unequally(direction: Array, deviation: float) -> None:
    for share, expected in ((0.99, 0), (1.01, UNMATCHED)):
        spot = PLACES[1] + share * REACH * deviation * direction
        assert assigned([spot], SLANTED[None])[1] == expected


def test_of_two_spots_the_likelier_is_the_nearer() -> None:
    """Not in millimetres: 0.9 mm along the one's long axis are less than 0.5 mm across it."""
    spots = np.array([PLACES[1] + 0.38 * ACROSS, PLACES[1] + 0.9 * ALONG])
    assert assigned(spots, np.array([SLANTED, SLANTED]))[1] == 1
    assert assigned(spots)[1] == 0


def test_of_two_rods_that_want_one_spot_the_nearer_has_it() -> None:
    middles = MIDDLES.copy()
    middles[1] = [1.0, 0.0, 0.0]
    frame = Frame("near", tuple("abcd"), middles - 30 * LEAN, middles + 30 * LEAN, np.ones(4))
    for x, expected in ((0.4, [0, UNMATCHED]), (0.6, [UNMATCHED, 0])):
        assert assigned([[x, 0.0]], frame=frame)[:2].tolist() == expected
    assert assigned([[0.4, 0.0], [0.7, 0.0]], frame=frame)[:2].tolist() == [0, 1]


def test_what_the_pose_is_uncertain_by_is_within_reach_too() -> None:
    """0.3 mm along x and 0.1 mm along y, and the noise of 0.2 mm."""
    information = KNOWN.copy()
    information[0, 0], information[1, 1] = 0.3**-2, 0.1**-2
    for axis, deviation in ((0, math.hypot(0.3, 0.2)), (1, math.hypot(0.1, 0.2))):
        for share, expected in ((0.99, 0), (1.01, UNMATCHED)):
            spot = PLACES[1].copy()
            spot[axis] += share * REACH * deviation
            assert assigned([spot], information=information)[1] == expected


def test_a_turn_reaches_farther_out_than_near_the_origin() -> None:
    """0.01 rad about z: 0.4 mm along y at 40 mm along x, nothing at the origin."""
    information = KNOWN.copy()
    information[5, 5] = 0.01**-2
    reach = 0.99 * REACH * math.hypot(0.4, 0.2)
    assert assigned([PLACES[1] + [0.0, reach]], information=information)[1] == 0
    assert assigned([PLACES[1] + [reach, 0.0]], information=information)[1] == UNMATCHED
    assert assigned([PLACES[0] + [0.0, reach]], information=information)[0] == UNMATCHED


def test_a_rods_own_tolerance_is_within_reach_too() -> None:
    """Of ends known to 0.5 mm the middle is known to 0.354 mm, along a lean of 45 degrees to 0.5 mm."""
    for rod, axis, deviation in ((1, 0, 0.5 * math.sqrt(0.5)), (3, 1, 0.5 * math.sqrt(0.5)), (3, 0, 0.5)):
        for share, expected in ((0.99, 0), (1.01, UNMATCHED)):
            spot = PLACES[rod].copy()
            spot[axis] += share * REACH * math.hypot(deviation, 0.2)
            assert assigned([spot], rod_mm=0.5)[rod] == expected


def test_a_spot_that_is_too_short_for_a_leaning_rod_is_none_of_its() -> None:
    """In a slice of 5 mm the last rod leaves a streak of 5 mm along x, the others a dot."""
    along = np.array([[0.3, 0.0], [5.0, 0.0]])
    streaks = Streaks(along, np.zeros(2, dtype=bool), 5.0)
    spots = np.array([PLACES[3], PLACES[3] + [0.3, 0.0]])
    assert assigned(spots, streaks=streaks)[3] == 1
    assert assigned(spots)[3] == 0
    upright = np.array([PLACES[1], PLACES[1] + [0.3, 0.0]])
    assert assigned(upright, streaks=streaks)[1] == 0
    assert assigned(upright, streaks=Streaks(along[::-1], np.zeros(2, dtype=bool), 5.0))[1] == 1


class TestSpots:
    """Of spots with covariances of their own, and rods of 0.3 mm."""

    COVARIANCES = np.array([[[0.04, 0.01], [0.01, 0.09]], [[0.01, 0.0], [0.0, 0.25]]])

    def spots(self) -> Spots:
        tolerances = Tolerances.none(FRAME)._replace(rod_mm=np.full(4, 0.3), extent_mm=0.7)
        streaks = Streaks(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([True, False]), 2.5)
        return Spots.of(PLACES[:2], self.COVARIANCES, 1e4, tolerances, streaks)

    def test_variances_are_with_a_rods_error_where_that_is_least(self) -> None:
        found = self.spots().variances_mm2
        assert found == pytest.approx([math.sqrt(0.085 * 0.135 - 0.01**2), math.sqrt(0.055 * 0.295)])

    def test_the_largest_deviation_is_of_the_worst_spot_and_all_that_is_off(self) -> None:
        assert self.spots().sigma_mm == pytest.approx(math.hypot(0.5, 0.7))

    def test_some_of_them_keep_all_that_is_theirs(self) -> None:
        part = self.spots().only(np.array([1]))
        np.testing.assert_array_equal(part.mm, PLACES[1:2])
        np.testing.assert_array_equal(part.covariances_mm2, self.COVARIANCES[1:])
        assert part.variances_mm2 == pytest.approx(self.spots().variances_mm2[1:])
        assert part.slice_area_mm2 == 1e4
        assert part.streaks is not None
        assert part.streaks.along_mm.tolist() == [[3.0, 4.0]]
        assert part.streaks.cut_short.tolist() == [False]


class TestStartsAlongAValley:
    """Poses to start from along the directions that are hardly known: 8 to 48 mm to both sides."""

    @staticmethod
    def starts(deviations: list[float]) -> tuple[Array, Array]:
        """For standard deviations in mm, a turn being what it moves at 50 mm: shifts (m, 3) mm, and turns (m, 3)."""
        units = np.array([1.0, 1.0, 1.0, ARM_MM, ARM_MM, ARM_MM])
        information = np.diag(units**2 / np.square(deviations))
        pose = Hypothesis(np.eye(3), np.array([5.0, 6.0, 7.0]), np.arange(4), 1.0, information, 0)
        found = starts_along_valley(pose)
        assert (found.spot_of_line == np.arange(4)).all()
        odd = (found.rotations - np.swapaxes(found.rotations, 1, 2)) / 2
        turns = np.stack([odd[:, 2, 1], odd[:, 0, 2], odd[:, 1, 0]], axis=1)
        return found.translations - [5.0, 6.0, 7.0], turns

    def test_of_a_pose_that_is_known_well_there_are_none(self) -> None:
        assert len(self.starts([0.1, 0.2, 0.3, 0.4, 0.49, 0.1])[0]) == 0

    def test_of_a_height_that_is_hardly_known(self) -> None:
        shifts, turns = self.starts([0.1, 0.1, 0.51, 0.1, 0.1, 0.1])
        assert sorted(shifts[:, 2]) == pytest.approx([*range(-48, 0, 8), *range(8, 56, 8)])
        np.testing.assert_allclose(shifts[:, :2], 0.0, atol=1e-9)
        np.testing.assert_allclose(turns, 0.0, atol=1e-12)

    def test_of_a_turn_that_is_hardly_known(self) -> None:
        shifts, turns = self.starts([0.1, 0.1, 0.1, 0.1, 3.0, 0.1])
        np.testing.assert_allclose(shifts, 0.0, atol=1e-9)
        assert sorted(turns[:, 1]) == pytest.approx(np.sin([one / 50 for one in (*range(-48, 0, 8), *range(8, 56, 8))]))

    def test_of_the_two_weakest_directions_each(self) -> None:
        shifts, turns = self.starts([2.0, 0.6, 0.1, 0.1, 0.1, 3.0])
        assert len(shifts) == 24
        assert int((np.abs(shifts[:, 0]) > 1).sum()) == 12
        assert int((np.abs(turns[:, 2]) > 0.01).sum()) == 12
        assert not np.abs(shifts[:, 1]).max() > 1
