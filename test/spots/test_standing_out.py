"""What stands out of a slice, step by step: how far, of how much noise, and in how many parts."""

from __future__ import annotations

import numpy as np
import pytest

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.spots import contrast
from stereoreg_ros.spots.contrast import _Candidate, _Prominent, _regions, regions_by_contrast
from stereoreg_ros.spots.finding import _surroundings
from stereoreg_ros.spots.peaks import Peaks, find_peaks
from stereoreg_ros.spots.prominence import Prominence, SmoothSlice, _noise, least_height, prominences
from stereoreg_ros.spots.regions import Regions, parted, regions_above

MARGIN = 12


def peak_at(u: int, v: int, top: float, rough_height: float) -> Peaks:
    return Peaks(np.array([u]), np.array([v]), np.array([top], np.float32), np.array([rough_height], np.float32))


def test_least_height_is_six_times_the_noise_and_no_less_than_a_unit() -> None:
    assert least_height(2.0) == pytest.approx(12.0)
    assert least_height(0.1) == 1.0


def test_the_surroundings_of_a_spot_are_described_by_their_median_and_by_how_far_most_are_from_it() -> None:
    """Around the first one 10 to 18 HU, and 1000 HU once; around the second nothing."""
    patches = np.full((2, 5, 5), 7.0, np.float32)
    patches[0, 0], patches[0, 1, 0] = [18.0, 10.0, 14.0, 16.0, 12.0], 1000.0
    patches[1, 2, 2] = -3.0
    ring = np.zeros((2, 5, 5), dtype=bool)
    ring[0, 0] = ring[0, 1, 0] = True
    level, noise_hu2 = _surroundings(patches, ring)
    # The lower of the two in the middle.
    assert level.tolist() == [14.0, -3.0]
    assert noise_hu2 == pytest.approx([(2 / 0.6745) ** 2, 0.0])


class TestPeaks:
    @staticmethod
    def found(hu: Array) -> Peaks:
        wide = np.zeros((40 + 2 * MARGIN, 40 + 2 * MARGIN), np.float32)
        wide[MARGIN:-MARGIN, MARGIN:-MARGIN] = hu
        return find_peaks(wide, MARGIN, 8, 1.0, 50)

    def test_of_a_plateau_there_is_one_in_its_middle(self) -> None:
        hu = np.zeros((40, 40))
        hu[19:22, 9:14] = 100.0
        peaks = self.found(hu)
        assert (peaks.u.tolist(), peaks.v.tolist()) == ([11], [20])
        assert (peaks.top.tolist(), peaks.rough_height.tolist()) == ([100.0], [100.0])

    def test_a_rough_height_is_that_above_the_darker_of_two_sides(self) -> None:
        """At 4 and at 8 pixels, 50 HU on the left and 10 HU on the right."""
        hu = np.zeros((40, 40))
        hu[20, 20], hu[20, [12, 16]], hu[20, [24, 28]] = 100.0, 50.0, 10.0
        peaks = self.found(hu)
        assert peaks.rough_height[peaks.u == 20].tolist() == [90.0]


@pytest.mark.parametrize(
    ("by_column", "by_row", "least"), [(1.0, 20.0, 3.0), (20.0, 1.0, 3.0), (10.0, 7.0, 6.0), (10.0, -7.0, 6.0)]
)
def test_noise_is_what_pixels_differ_by_in_the_direction_in_which_they_do_least(
    by_column: float, by_row: float, least: float
) -> None:
    """Of a slope: three pixels apart along a row or a column, two by two along either diagonal."""
    v, u = np.indices((21, 21))
    square = (by_column * u + by_row * v).astype(np.float32)
    assert _noise(square[None]) == pytest.approx([least / 0.954])


class TestProminence:
    """A ridge of three pixels in a slice that is flat: 50, 30 and 100 HU."""

    @staticmethod
    def of(u: int, noise: float = 0.0, top: float = 50.0) -> Prominence:
        hu = np.zeros((40 + 2 * MARGIN, 40 + 2 * MARGIN), np.float32)
        hu[20 + MARGIN, 18 + MARGIN : 21 + MARGIN] = [50.0, 30.0, 100.0]
        return prominences(SmoothSlice(hu, MARGIN, noise), peak_at(u, 20, top, top), 8, 60.0)

    def test_reaches_down_to_where_something_higher_is_joined(self) -> None:
        assert self.of(18).height[0] == pytest.approx(20.0, rel=0.1)

    def test_of_the_highest_reaches_down_to_what_is_around(self) -> None:
        assert self.of(20, top=100.0).height[0] == pytest.approx(100.0, rel=0.1)

    def test_noise_is_no_less_than_is_usual_in_the_slice(self) -> None:
        found = self.of(20, noise=2.0, top=100.0)
        assert found.noise[0] == 2.0
        assert found.height[0] > 90.0

    @pytest.mark.parametrize(("noise", "stands_out"), [(3.2, True), (3.4, False)])
    def test_of_less_than_six_times_the_noise_there_is_none(self, noise: float, stands_out: bool) -> None:
        assert bool(self.of(18, noise=noise).height[0] > 0) is stands_out


class TestLikeARod:
    """A disc of 29 pixels, 95 HU high, and a pixel in its middle of 100 HU."""

    @staticmethod
    def regions(height: float, most: float, rough_height: float = 100.0, top: float = 100.0) -> int:
        v, u = np.indices((20 + 2 * MARGIN, 20 + 2 * MARGIN)) - 10 - MARGIN
        wide = np.where(u**2 + v**2 < 9.5, 95.0, 0.0).astype(np.float32)
        wide[10 + MARGIN, 10 + MARGIN] = 100.0
        assert (wide > 0).sum() == 29
        prominent = _Prominent(peak_at(10, 10, top, rough_height), np.array([height], np.float32), np.zeros(1))
        return len(_regions(wide, MARGIN, prominent, 8, (2.0, most)))

    def test_the_top_of_something_larger_is_none(self) -> None:
        """Down to half of 32 HU it has 29 pixels, which are many where 100 are the most."""
        assert self.regions(32.0, most=100.0) == 0
        assert self.regions(34.0, most=100.0) == 1, "more than a third of its rough height"
        assert self.regions(32.0, most=120.0) == 1, "less than a quarter of the largest"

    def test_what_is_larger_or_smaller_than_a_spot_is_none(self) -> None:
        assert self.regions(100.0, most=29.0) == 1
        assert self.regions(100.0, most=28.0) == 0
        assert self.regions(8.0, most=28.0) == 0, "half of 8 HU leave one pixel, and two are the fewest"

    def test_a_pixel_that_smoothing_takes_most_of_is_none(self) -> None:
        """Of a height of 20 HU in the smoothed slice, 46 more would have to be its own."""
        assert self.regions(20.0, most=200.0, rough_height=20.0, top=54.0) == 1
        assert self.regions(20.0, most=200.0, rough_height=20.0, top=53.0) == 0


def test_of_regions_that_overlap_the_higher_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    lower = _Candidate(50.0, 1.0, 20.0, (np.array([10, 10]), np.array([10, 11])))
    higher = _Candidate(100.0, 2.0, 60.0, (np.array([10, 10, 11]), np.array([11, 12, 12])))
    apart = _Candidate(30.0, 3.0, 10.0, (np.array([20]), np.array([5])))
    monkeypatch.setattr(contrast, "_candidates", lambda *_: ([lower, apart, higher], np.zeros(0, dtype=bool)))
    regions, height, noise = regions_by_contrast(np.zeros((30, 30), np.float32), 1.0, 20.0)
    assert (height.tolist(), noise.tolist()) == ([100.0, 30.0], [2.0, 3.0])
    assert regions.first.tolist() == [[11, 10], [5, 20]]
    assert regions.extent.tolist() == [[2, 2], [1, 1]]
    assert regions.labels[[10, 10, 20], [10, 12, 5]].tolist() == [0, *regions.label]


class TestParted:
    """A region at 2100 HU with two peaks of 2250 HU: 250 above the threshold, 125 above the half of that."""

    @staticmethod
    def picture() -> Array:
        hu = np.zeros((40, 60))
        hu[20:23, 20:30] = 2100.0
        hu[20:22, 21:23] = hu[21:23, 27:29] = 2250.0
        return hu

    def parts(self, noise: float) -> int:
        hu = self.picture().astype(np.float32)
        labels = (hu > 2000).astype(np.int32)
        given = Regions(labels, np.array([1]), np.array([[20, 20]]), np.array([[10, 3]]))
        found, whose = parted(hu, np.array([2000.0]), np.array([noise]), 2.0, given)
        assert whose.tolist() == len(found.label) * [0]
        return len(found.label)

    @pytest.mark.parametrize(("noise", "parts"), [(0.0, 2), (15.0, 2), (16.0, 1)])
    def test_parts_stand_out_of_the_noise_around_them_by_eight_times_that(self, noise: float, parts: int) -> None:
        assert self.parts(noise) == parts

    @pytest.mark.parametrize(("step", "parts"), [(14.0, 2), (16.0, 1)])
    def test_or_of_what_is_usual_in_the_slice(self, step: float, parts: int) -> None:
        """Columns that differ by so much are as noise of 1.05 times that."""
        hu = self.picture()
        hu[:, ::2] += step
        hu[20:23, 20:30] = self.picture()[20:23, 20:30]
        found = regions_above(hu.astype(np.float32), 2000.0, 2.0, 100.0)
        assert len(found.label) == parts
        if parts == 2:
            assert found.first.tolist() == [[21, 20], [27, 21]]
            assert found.extent.tolist() == [[2, 2], [2, 2]]
