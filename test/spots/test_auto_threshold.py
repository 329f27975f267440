"""The threshold `auto` loses no rods that a fixed one finds, whatever else is bright, and offers few other spots."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame
from stereoreg_ros.dicom import DicomSlice, read_series
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.simulation import Cylinder, add_metal
from stereoreg_ros.spots import find_spots
from stereoreg_ros.spots.choice import worth_matching
from stereoreg_ros.spots.peaks import find_peaks
from support.artefacts import measure as measure_scanned
from support.beside_bright_things import BESIDE, Beside, compare
from support.dicom_files import SHARED_DATA, real
from support.real_images import catphan, height, leksell, shows_module, zframe

AUTO = RegistrationOptions(threshold="auto")
SCALE = PixelScale(0.5, 0.5)
SAME_PX = 1.5


def found_in(image: Array, options: RegistrationOptions = AUTO, scale: PixelScale = SCALE) -> SliceSpots:
    return find_spots(Slice(image.astype(np.float32), scale), options)


def near(places: Array, spots: Array, reach_px: float = SAME_PX) -> NDArray[np.bool_]:
    """Which of the places (n, 2) have a spot."""
    return np.asarray((np.linalg.norm(places[:, None] - spots, axis=-1) < reach_px).any(axis=1))


class TestBesideBrightThings:
    @pytest.mark.parametrize("beside", BESIDE, ids=[beside.name for beside in BESIDE])
    def test_rods_are_found_and_little_else(self, beside: Beside) -> None:
        found = compare(beside, slices=6)
        print(found)
        assert found.fixed >= 0.8 * found.rods, "the fixed threshold is to show the rods"
        assert found.auto == found.rods
        assert found.others_auto <= found.others_fixed + 3 * 6

    def test_thin_rods_are_found_in_a_scan_beside_posts(self) -> None:
        """Beams of several energies through steel, filtered back-projection: the posts' streaks are as they come."""
        found, there, rms_px, _ = measure_scanned(slices=1, rods=6, diameter_mm=0.5, threshold="auto", posts=2)
        print(f"{found} of {there}: RMS {rms_px:.3f} pixel")
        assert found == there
        assert rms_px <= 0.2

    def test_a_faint_rod_is_found_near_the_corner_of_its_block(self) -> None:
        rng = np.random.default_rng(1)
        v, u = np.indices((90, 90))
        for _ in range(20):
            at = 30 + rng.uniform(5, 12, 2)
            image = np.where((u > 30) & (v > 30), 100.0, -1000.0)
            image += 500 * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 3.0) + rng.normal(0, 20.0, u.shape)
            assert near(at[None], found_in(image).centres_px).all()

    @pytest.mark.parametrize("apart_px", [6.0, 8.0, 12.0])
    def test_a_faint_one_is_found_beside_a_bright_one(self, apart_px: float) -> None:
        rng = np.random.default_rng(2)
        v, u = np.indices((80, 80))
        for turn in rng.uniform(0, 2 * math.pi, 10):
            at = 40 + apart_px * np.array([[0.0, 0.0], [math.cos(turn), math.sin(turn)]])
            image = rng.normal(0, 5.0, u.shape)
            for (x, y), height_hu in zip(at, (3000.0, 300.0), strict=True):
                image += height_hu * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 2.5)
            assert near(at, found_in(image).centres_px).all()

    def test_what_has_no_centre_does_not_make_others_uncertain(self) -> None:
        """Bumps along an edge: what is around them varies by hundreds of HU. Around the rods there is noise only."""
        rng = np.random.default_rng(3)
        v, u = np.indices((160, 160))
        image = np.where(u > 80, 60.0, -1000.0) + rng.normal(0, 10.0, u.shape)
        rods = np.array([[110.2, 30.4], [130.6, 70.1], [115.3, 120.8]])
        bumps = np.array([[83.0, y] for y in range(12, 150, 12)])
        for x, y in np.concatenate([rods, bumps]):
            image += 400 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 2.5)
        found = found_in(image, RegistrationOptions(threshold=250.0))
        away = np.linalg.norm(found.centres_px - rods[:, None], axis=-1)
        assert (away.min(axis=1) < 0.3).all()
        std_px = np.sqrt(np.linalg.eigvalsh(found.covariances_px2[away.argmin(axis=1)])[:, -1])
        assert (std_px < 0.1).all(), std_px


class TestLongStreaks:
    @pytest.mark.parametrize(("thickness_mm", "tilt_deg"), [(5.0, 60.0), (5.0, 70.0), (8.0, 60.0), (3.0, 78.0)])
    def test_of_leaning_rods_are_found_whole(self, thickness_mm: float, tilt_deg: float) -> None:
        rng = np.random.default_rng(4)
        tilt = math.radians(tilt_deg)
        for turn in rng.uniform(0, 2 * math.pi, 20):
            at = 60 + rng.uniform(-0.5, 0.5, 2)
            along = np.array([math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), math.cos(tilt)])
            middle = np.array([*SCALE.to_mm(at), 0.0])
            image = np.full((120, 120), 40.0)
            rod = Cylinder(middle - 60 * along, middle + 60 * along, 1.0)
            add_metal(image, rod, SCALE, thickness_mm, 0.45, 8000.0)
            found = found_in(image + rng.normal(0, 20.0, image.shape))
            assert len(found) == 1
            assert near(at[None], found.centres_px, 0.3).all()


class TestWhereThereIsNoFrame:
    @pytest.mark.parametrize("grain_px", [0.0, 1.0, 2.5])
    def test_noise_has_no_spots(self, grain_px: float) -> None:
        rng = np.random.default_rng(5)
        image = rng.standard_normal((512, 512))
        if grain_px:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), grain_px), dtype=np.float64)
        assert len(found_in(np.rint(100 * image / image.std()))) <= 2

    def test_a_line_thinner_than_a_point_spread_is_no_row_of_spots(self) -> None:
        """As at the edge of the circle in which a slice was reconstructed: nothing beside it, and jagged."""
        image = np.full((512, 512), -1000.0)
        v, u = np.indices(image.shape)
        off = np.hypot(u - 255.5, v - 255.5) - 250.0
        image[(off >= 0) & (off < 0.8)] = (-1000 + 750 * off[(off >= 0) & (off < 0.8)]).astype(int)
        assert len(found_in(image)) <= 8

    @pytest.mark.parametrize("share", [0.0, 0.0003, 0.02])
    def test_a_large_slice_does_not_take_long(self, share: float) -> None:
        rng = np.random.default_rng(6)
        pins = np.where(rng.random((2048, 2048)) < share, 100_000.0, 0.0)
        image = np.asarray(cv2.GaussianBlur(pins, (0, 0), 4.0)) + 20 * rng.standard_normal(pins.shape)
        start = time.process_time()
        found = found_in(image, scale=PixelScale(0.125, 0.125))
        took_s = time.process_time() - start
        print(f"{len(found)} spots in {took_s:.2f} s")
        assert took_s < 5.0
        assert len(found) <= 300

    def test_no_more_peaks_are_looked_at_than_asked_for(self) -> None:
        rng = np.random.default_rng(7)
        pins = np.where(rng.random((300, 300)) < 0.02, 9000.0, 0.0).astype(np.float32)
        smooth = np.asarray(cv2.GaussianBlur(pins, (0, 0), 1.0), dtype=np.float32)
        peaks = find_peaks(smooth, 20, 14, 1.0, 50)
        assert len(peaks.u) == 50
        everything = find_peaks(smooth, 20, 14, 1.0, 10_000)
        assert len(everything.u) > 200
        assert np.sort(peaks.rough_height)[0] >= np.sort(everything.rough_height)[-50]


class TestPlateaus:
    @pytest.mark.parametrize("diameter_mm", [2.0, 5.0, 9.0])
    def test_a_rod_that_is_clipped_is_one_spot(self, diameter_mm: float) -> None:
        rng = np.random.default_rng(8)
        for _ in range(5):
            at = 40 + rng.uniform(-0.5, 0.5, 2)
            image = np.full((80, 80), 40.0)
            start, end = (np.array([*SCALE.to_mm(at), z]) for z in (-50.0, 50.0))
            rod = Cylinder(start, end, diameter_mm)
            add_metal(image, rod, SCALE, 1.0, 0.45, 8000.0)
            found = found_in(np.clip(np.rint(image + rng.normal(0, 20.0, image.shape)), -1024, 3071))
            assert len(found) == 1
            assert near(at[None], found.centres_px, 0.2).all()


class TestWorthMatching:
    """By heights and noise alone; four rods at least are sought."""

    @staticmethod
    def chosen(height_hu: list[float], noise_hu: float = 1.0) -> list[float]:
        heights = np.array(height_hu)
        return sorted(heights[worth_matching(heights, np.full(len(heights), noise_hu), 4)].tolist(), reverse=True)

    def test_none_of_none(self) -> None:
        assert self.chosen([]) == []

    def test_few_are_kept_that_are_sure_however_bright_others_are(self) -> None:
        heights = [3000.0] * 10 + [100.0] * 5
        assert self.chosen(heights) == heights

    def test_of_those_that_are_not_sure_the_bright_ones_are_kept(self) -> None:
        assert self.chosen([100.0, 90.0, 80.0, 70.0, 30.0, 10.0], noise_hu=10.0) == [100.0, 90.0, 80.0, 70.0, 30.0]

    def test_one_that_is_far_brighter_makes_no_others_faint(self) -> None:
        """As bright as the fourth brightest is meant, where four rods are sought."""
        heights = [1000.0, 100.0, 90.0, 80.0, 70.0, 25.0]
        assert self.chosen([*heights, 23.0], noise_hu=10.0) == heights

    def test_the_order_does_not_matter(self) -> None:
        heights = [70.0, 10.0, 90.0, 30.0, 100.0, 80.0]
        assert self.chosen(heights, noise_hu=10.0) == [100.0, 90.0, 80.0, 70.0, 30.0]

    def test_of_many_whole_kinds_are_kept(self) -> None:
        rods, balls = [1600.0, 1500.0, 1400.0, 1200.0, 1200.0, 1100.0], np.linspace(600, 100, 90).tolist()
        assert self.chosen(rods + balls) == rods
        pins = [3000.0] * 8
        assert self.chosen(pins + rods + balls) == pins + rods

    def test_thirty_two_are_few(self) -> None:
        """Of more, what is not sure is left out."""
        sure, others = [160.0] * 4, [100.0] * 28
        assert self.chosen(sure + others, noise_hu=10.0) == sure + others
        assert self.chosen([*sure, *others, 100.0], noise_hu=10.0) == sure

    def test_each_is_sure_by_the_noise_around_itself(self) -> None:
        heights, noise = np.array([20.0, 100.0, 100.0, 100.0, 100.0, 21.0]), np.array([1.0, 10, 10, 10, 10, 10])
        assert worth_matching(heights, noise, 4).tolist() == [True, True, True, True, True, False]

    def test_many_of_one_kind_are_kept_all(self) -> None:
        many = np.linspace(3000, 1500, 200).tolist()
        assert self.chosen(many) == many
        faint = np.linspace(1400, 300, 60).tolist()
        assert self.chosen(many + faint)[-1] >= 0.3 * many[3]

    def test_of_many_that_are_not_sure_few_are_kept(self) -> None:
        assert len(self.chosen([100.0] * 80, noise_hu=10.0)) <= 32
        assert self.chosen([1000.0] * 5 + [900.0] * 0 + [120.0] * 80, noise_hu=10.0) == [1000.0] * 5


# Real images: what shows where the rods are. A fixed threshold shows them, among other things.


def placed_px(starts: Array, ends: Array, ct_slice: Slice) -> tuple[Array, Array]:
    """Where lines (n, 3) in the scanner's axes, mm, cross a slice: pixel (n, 2), and how far from their ends, mm."""
    slice_from_scanner = ct_slice.scanner_from_slice.inverse()
    start, end = slice_from_scanner @ starts, slice_from_scanner @ ends
    share = -start[:, 2] / (end[:, 2] - start[:, 2])
    crossed = start + share[:, None] * (end - start)
    inside = np.minimum(share, 1 - share) * np.abs(end[:, 2] - start[:, 2])
    return ct_slice.scale.to_px(crossed[:, :2]), inside


def placed_frame(name: str, scanner_from_frame: Pose, slices: list[DicomSlice]) -> Iterator[tuple[DicomSlice, Array]]:
    """The slices, and the places (n, 2) of those rods that cross them, pixel."""
    frame = load_frame(name)
    for one in slices:
        px, inside_mm = placed_px(scanner_from_frame @ frame.starts, scanner_from_frame @ frame.ends, one.ct_slice)
        yield one, px[inside_mm > 0]


def judge(
    slices: Iterator[tuple[DicomSlice, Array]], threshold: float, reach_px: float
) -> tuple[int, list[str], list[tuple[int, int]]]:
    """How many rods the threshold finds within reach of their places; which of them `auto` does not find; and how many
    other spots both find, slice by slice.
    """
    rods, lost, others = 0, [], []
    for one, places in slices:
        fixed = find_spots(one.ct_slice, RegistrationOptions(threshold=threshold)).centres_px
        auto = find_spots(one.ct_slice, AUTO).centres_px
        away = np.linalg.norm(fixed - places[:, None], axis=-1) if len(fixed) else np.full((len(places), 1), np.inf)
        shown = fixed[away.argmin(axis=1)[away.min(axis=1) < reach_px]] if len(fixed) else np.empty((0, 2))
        rods += len(shown)
        lost += [f"{height(one):.1f} mm: ({u:.0f}, {v:.0f})" for u, v in shown[~near(shown, auto)]]
        others.append((len(fixed) - len(shown), len(auto) - int(near(shown, auto).sum())))
    return rods, lost, others


def upright_leksell() -> Iterator[tuple[DicomSlice, Array]]:
    """The Leksell frame with three plates, as one pose for all slices has it (README of the data)."""
    rotation = rotation_exp(np.radians([-0.18, 1.51, 0.38]))
    pose = Pose(rotation, np.array([3.05, -0.65, -6.68]) - rotation @ np.array([95.0, -60.0, -60.0]))
    slices = [one for one in read_series(real(SHARED_DATA / "leksell9_ct")) if -50.5 < height(one) < 50.0]
    return placed_frame("leksell_ct9", pose, slices)


def second_catphan() -> Iterator[tuple[DicomSlice, Array]]:
    slices = list(read_series(real(SHARED_DATA / "catphan_second")))
    return placed_frame("catphan_ctp404", Pose(np.eye(3), np.array([0.7, 0.8, 30.5])), slices)


def first_catphan() -> Iterator[tuple[DicomSlice, Array]]:
    slices = [one for one in catphan() if shows_module(one)]
    return placed_frame("catphan_ctp404", Pose(np.eye(3), np.array([-124.35, -125.7, 0.0])), slices)


def tubes() -> Iterator[tuple[DicomSlice, Array]]:
    """Masked to the frame: what a threshold shows are its tubes."""
    for one in zframe():
        yield one, find_spots(one.ct_slice, RegistrationOptions(threshold=200.0)).centres_px


def head_phantom() -> Iterator[tuple[DicomSlice, Array]]:
    places = [[105.5, 162.3], [108.3, 246.9], [111.4, 354.3], [408.9, 153.1], [411.5, 232.9], [414.5, 345.0]]
    yield leksell(), np.array(places)


@pytest.mark.parametrize(
    ("slices", "threshold", "reach_px", "least_rods", "most_others"),
    [
        (upright_leksell, 1000.0, 3.0, 360, 15),
        (second_catphan, 300.0, 4.0, 54, 5),
        (first_catphan, 300.0, 4.0, 45, 3),
        (tubes, 200.0, 1.0, 49, 2),
        (head_phantom, 1000.0, 2.0, 6, 3),
    ],
    ids=["Leksell, three plates", "CatPhan, cone beam", "CatPhan", "Z-frame, MR", "Leksell, two plates"],
)
def test_loses_no_rod_of_a_real_series(
    slices: Callable[[], Iterator[tuple[DicomSlice, Array]]],
    threshold: float,
    reach_px: float,
    least_rods: int,
    most_others: int,
) -> None:
    rods, lost, others = judge(slices(), threshold, reach_px)
    print(f"{rods} rods; other spots: {sum(one for one, _ in others)} by {threshold:g} HU", end=", ")
    print(f"{sum(one for _, one in others)} by auto")
    assert rods >= least_rods
    assert not lost
    assert max(one for _, one in others) <= most_others


def test_offers_few_spots_where_the_catphan_shows_no_frame() -> None:
    counts = [len(find_spots(one.ct_slice, AUTO)) for one in catphan() if not shows_module(one)]
    print(f"{len(counts)} slices: median {np.median(counts):.0f}, most {max(counts)}")
    assert np.median(counts) <= 3
    assert max(counts) <= 60  # the line pairs: 27 bars, and where they run together
