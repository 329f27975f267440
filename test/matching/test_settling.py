"""From a start to a settled match: with the rods matched anew, and with the matches as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros import Pose, load_frame
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching.hypothesis import UNMATCHED
from stereoreg_ros.matching.seeds import Starts
from stereoreg_ros.matching.settling import settle, settle_as_matched
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.matching.tolerances import Tolerances
from stereoreg_ros.simulation import ScannerSettings, random_pose

CUBE = load_frame("cube6")
ROWS = np.arange(6)


def spots_of(points_mm: NDArray[np.float64], frame: Frame = CUBE) -> Spots:
    """Spots at these points, known to 0.2 mm."""
    covariances = np.tile(0.04 * np.eye(2), (len(points_mm), 1, 1))
    return Spots.of(points_mm, covariances, None, Tolerances.none(frame))


def start_at(pose: Pose, spot_of_line: NDArray[np.intp]) -> Starts:
    return Starts(pose.rotation[None], pose.translation[None], spot_of_line[None], np.zeros(1, dtype=np.intp))


def slices(count: int) -> list[tuple[Pose, NDArray[np.float64]]]:
    """Poses, and where their slices cut the rods (6, 2) mm."""
    rng = np.random.default_rng(7)
    poses = [random_pose(rng, CUBE, ScannerSettings()) for _ in range(count)]
    return [(pose, cut(CUBE, pose.rotation, pose.translation).points_mm) for pose in poses]


def test_both_return_to_the_pose_from_beside_it() -> None:
    for pose, points_mm in slices(5):
        beside = pose.perturbed(np.array([0.8, -0.5, 0.4]), np.array([0.01, 0.02, -0.01]))
        spots, order = spots_of(points_mm[::-1]), ROWS[::-1]
        for found in (
            settle(spots, CUBE, start_at(beside, order), 4),
            settle_as_matched(spots, CUBE, start_at(beside, order)),
        ):
            (one,) = found
            np.testing.assert_allclose(one.translation, pose.translation, atol=1e-5)
            np.testing.assert_allclose(one.rotation, pose.rotation, atol=1e-6)
            np.testing.assert_array_equal(one.spot_of_line, order)
            assert one.chi_square < 1e-6
            assert one.missing == 0


def test_a_start_that_lacks_a_match_finds_it_unless_it_is_to_stay_as_it_is() -> None:
    five = np.array([0, 1, 2, 3, 4, UNMATCHED])
    for pose, points_mm in slices(5):
        spots = spots_of(points_mm)
        (settled,) = settle(spots, CUBE, start_at(pose, five), 4)
        (as_matched,) = settle_as_matched(spots, CUBE, start_at(pose, five))
        np.testing.assert_array_equal(settled.spot_of_line, ROWS)
        np.testing.assert_array_equal(as_matched.spot_of_line, five)
        assert as_matched.missing == 1


def test_a_spot_given_to_another_rod_returns_unless_it_is_to_stay_there() -> None:
    """Five spots; the last rod has that of the last but one, which is without."""
    exchanged = np.array([0, 1, 2, 3, UNMATCHED, 4])
    stayed = 0
    for pose, points_mm in slices(5):
        spots = spots_of(points_mm[:5])
        for one in settle(spots, CUBE, start_at(pose, exchanged), 4):
            assert one.spot_of_line[5] == UNMATCHED
        for one in settle_as_matched(spots, CUBE, start_at(pose, exchanged)):
            np.testing.assert_array_equal(one.spot_of_line, exchanged)
            moved_mm = np.linalg.norm(cut(CUBE, one.rotation, one.translation).points_mm[5] - points_mm[5])
            assert moved_mm > 1.0
            stayed += 1
    assert stayed


def test_a_rod_that_the_pose_does_not_show_keeps_no_spot() -> None:
    """A rod that ends 5 mm above the slice has no spot there, whatever lies on its line."""
    for pose, points_mm in slices(5):
        at = cut(CUBE, pose.rotation, pose.translation).lambdas[0]
        # Its length is measured from the point that is nearest to the frame's origin.
        unit = (CUBE.ends[0] - CUBE.starts[0]) / np.linalg.norm(CUBE.ends[0] - CUBE.starts[0])
        ends = CUBE.ends.copy()
        ends[0] = CUBE.starts[0] + (at - CUBE.lambda_min[0] - 5.0) * unit
        short = replace(CUBE, ends=ends)
        spots = spots_of(points_mm, short)
        assert settle_as_matched(spots, short, start_at(pose, ROWS)) == []
        (one,) = settle(spots, short, start_at(pose, ROWS), 4)
        np.testing.assert_array_equal(one.spot_of_line, [UNMATCHED, 1, 2, 3, 4, 5])
        assert one.missing == 0


def test_too_few_rods_are_no_explanation() -> None:
    (pose, points_mm), *_ = slices(1)
    spots = spots_of(points_mm[:4])
    four = np.array([0, 1, 2, 3, UNMATCHED, UNMATCHED])
    assert len(settle(spots, CUBE, start_at(pose, four), 4)) == 1
    assert settle(spots, CUBE, start_at(pose, four), 5) == []
