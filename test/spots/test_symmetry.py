"""The centre of a spot's symmetry in patches drawn by hand: what counts, what does not, and where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.spots.symmetry import _moderated, centres_of_symmetry

SIDE = 15
V, U = np.indices((SIDE, SIDE))
ROUND = 1000.0 * np.exp(-((U - 7.0) ** 2 + (V - 7.0) ** 2) / 4.5)
# Steep on one side, with a tail on the other.
COMET = 1000.0 * np.where(U < 6, np.exp(-((U - 6.0) ** 2)), np.exp(-(U - 6) / 2.5)) * np.exp(-((V - 7.0) ** 2) / 3)
NONE = np.zeros((SIDE, SIDE), dtype=bool)


def centre(
    patch: Array,
    rough: tuple[float, float],
    shut: NDArray[np.bool_] = NONE,
    clipped: NDArray[np.bool_] = NONE,
    noise_hu2: float = 1.0,
) -> tuple[Array, Array]:
    centres, covariances = centres_of_symmetry(
        patch[None], np.array([rough]), 2.0 * np.eye(2)[None], shut[None], clipped[None], np.array([noise_hu2])
    )
    return centres[0], covariances[0]


def one_pixel(u: int, v: int) -> NDArray[np.bool_]:
    return np.asarray((u == U) & (v == V))


def test_a_rough_centre_is_made_better() -> None:
    found, covariance = centre(ROUND, (7.6, 6.7))
    np.testing.assert_allclose(found, [7.0, 7.0], atol=1e-3)
    assert np.sqrt(np.diag(covariance)).max() < 0.02


@pytest.mark.parametrize("is_clipped", [False, True])
def test_neither_a_shut_or_clipped_pixel_nor_its_mirror_image_counts(is_clipped: bool) -> None:
    masked = one_pixel(9, 6)
    patch = np.where(masked, ROUND + 500.0, ROUND)
    aside, _ = centre(patch, (7.1, 7.0))
    assert np.linalg.norm(aside - 7.0) > 0.02, "where it does count it pulls"
    found, _ = centre(patch, (7.1, 7.0), NONE if is_clipped else masked, masked if is_clipped else NONE)
    np.testing.assert_allclose(found, [7.0, 7.0], atol=2e-3)


def test_clipped_pixels_are_compared_where_little_else_is_left() -> None:
    found, covariance = centre(ROUND, (7.3, 7.0), clipped=(U - 7) ** 2 + (V - 7) ** 2 < 20)
    np.testing.assert_allclose(found, [7.0, 7.0], atol=1e-3)
    assert np.sqrt(np.diag(covariance)).max() < 0.02


def test_where_there_is_no_symmetry_the_centroid_is_taken_with_the_difference_as_an_error() -> None:
    rough = (7.4, 7.0)
    symmetric, _ = centre(COMET, rough, noise_hu2=1e6)
    off = symmetric - rough
    assert np.linalg.norm(off) > 0.1
    found, covariance = centre(COMET, rough)
    np.testing.assert_array_equal(found, rough)
    along = off / np.linalg.norm(off)
    assert along @ covariance @ along > off @ off


@pytest.mark.parametrize(("u", "is_lost"), [(7.9, False), (8.4, True)])
def test_a_centre_a_pixel_off_its_centroid_is_none(u: float, is_lost: bool) -> None:
    found, covariance = centre(ROUND, (u, 7.0), noise_hu2=1e6)  # whatever it differs by may be noise
    if is_lost:
        np.testing.assert_array_equal(found, [u, 7.0])
        np.testing.assert_array_equal(covariance, np.eye(2))
    else:
        np.testing.assert_allclose(found, [7.0, 7.0], atol=1e-3)


class TestModerated:
    """Variances of five spots of 1000 HU in noise of 4 HU^2."""

    @staticmethod
    def of(variance: list[float], lame: list[bool]) -> list[float]:
        noise, height = np.full(5, 4.0), np.full(5, 1000.0)
        found: list[float] = _moderated(np.array(variance), noise, height, np.array(lame)).tolist()
        return found

    def test_spots_alike_have_what_is_usual(self) -> None:
        """The noise, and what the one in the middle has beyond it."""
        assert self.of([3.0, 5.0, 6.0, 9.0, 59.9], 5 * [False]) == pytest.approx([6.0] * 5)

    def test_one_that_differs_by_ten_times_that_keeps_its_own(self) -> None:
        assert self.of([3.0, 5.0, 6.0, 9.0, 60.1], 5 * [False]) == pytest.approx([6.0, 6.0, 6.0, 6.0, 60.1])

    def test_those_without_a_centre_say_nothing_of_the_others(self) -> None:
        lame = [False, False, True, True, True]
        assert self.of([5.0, 7.0, 500.0, 600.0, 700.0], lame) == pytest.approx([6.0, 6.0, 500.0, 600.0, 700.0])
        assert self.of([500.0, 600.0, 700.0, 800.0, 900.0], 5 * [True]) == pytest.approx([700.0] * 5)
