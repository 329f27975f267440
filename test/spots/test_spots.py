"""Spots in drawn images whose centres are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.spots import find_spots

SCALE = PixelScale(0.5, 0.5)
OPTIONS = RegistrationOptions(threshold=2000.0)


def drawn(centres: Array, shape: tuple[int, int] = (60, 80), peak: float = 20_000.0, sigma: float = 1.0) -> Array:
    """Gaussian blobs over 40 HU."""
    v, u = np.indices(shape)
    image = np.full(shape, 40.0)
    for x, y in centres:
        image += peak * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2))
    return image


def blank(shape: tuple[int, int] = (60, 80)) -> Array:
    return np.zeros(shape)


def spots_of(image: Array, options: RegistrationOptions = OPTIONS, scale: PixelScale = SCALE) -> Array:
    return find_spots(Slice(image.astype(np.float32), scale), options).centres_px


class TestCentre:
    @pytest.mark.parametrize("sigma", [0.8, 1.0, 1.5])
    def test_of_a_gaussian_blob_is_found_within_a_twentieth_of_a_pixel(self, sigma: float) -> None:
        rng = np.random.default_rng(1)
        for _ in range(50):
            centre = np.array([40.0, 30.0]) + rng.uniform(-0.5, 0.5, 2)
            spots = spots_of(drawn(centre[None], sigma=sigma))
            assert spots.shape == (1, 2)
            np.testing.assert_allclose(spots[0], centre, atol=0.05)

    def test_is_column_first(self) -> None:
        np.testing.assert_allclose(spots_of(drawn(np.array([[62.0, 11.0]]))), [[62.0, 11.0]], atol=1e-3)

    def test_does_not_depend_on_the_level_of_the_surroundings(self) -> None:
        image = drawn(np.array([[40.3, 30.2]]))
        options = RegistrationOptions(threshold=3000.0)
        np.testing.assert_allclose(spots_of(image + 1000, options), spots_of(image), atol=1e-3)

    def test_far_more_spots_than_one(self) -> None:
        centres = np.array([[u + 0.01 * v, v + 0.02 * u] for v in range(10, 55, 10) for u in range(10, 75, 10)])
        spots = spots_of(drawn(centres))
        assert spots.shape == centres.shape
        for centre in centres:
            assert np.linalg.norm(spots - centre, axis=1).min() < 0.05

    def test_from_top_to_bottom(self) -> None:
        spots = spots_of(drawn(np.array([[20.0, 50.0], [60.0, 10.0], [40.0, 30.0]])))
        np.testing.assert_allclose(spots, [[60, 10], [40, 30], [20, 50]], atol=0.05)
        # Whatever their sizes.
        large_one_above = drawn(np.array([[60.0, 14.0]]), sigma=3.0) + drawn(np.array([[20.0, 50.0], [40.0, 36.0]]))
        np.testing.assert_allclose(spots_of(large_one_above), [[60, 14], [40, 36], [20, 50]], atol=0.05)


class TestWhatIsASpot:
    @pytest.mark.parametrize("shape", [(60, 80), (1, 1), (1, 50), (50, 1), (2, 2), (3, 3)])
    def test_none_in_an_empty_image(self, shape: tuple[int, int]) -> None:
        spots = spots_of(blank(shape))
        assert spots.shape == (0, 2)
        assert spots.dtype == np.float64

    @pytest.mark.parametrize("shape", [(1, 1), (1, 50), (2, 2), (60, 80)])
    def test_none_where_all_is_bright(self, shape: tuple[int, int]) -> None:
        assert spots_of(np.full(shape, 3000.0)).shape == (0, 2)

    def test_size_limits_are_areas_in_mm2(self) -> None:
        image = blank()
        image[10:12, 10:13] = 5000  # 6 pixels
        image[30:34, 40:44] = 5000  # 16 pixels
        scale = PixelScale(0.5, 0.4)

        def found(low: float, high: float) -> list[list[float]]:
            options = replace(OPTIONS, min_spot_area_mm2=low, max_spot_area_mm2=high)
            rounded: list[list[float]] = np.round(spots_of(image, options, scale), 6).tolist()
            return rounded

        small, large = [11.0, 10.5], [41.5, 31.5]
        assert found(1.19, 3.21) == [small, large]
        assert found(1.21, 3.21) == [large]
        assert found(1.19, 3.19) == [small]
        assert found(1.21, 3.19) == []
        # Areas of 1.5 and 4 mm^2 to the last bit: the limits themselves are allowed.
        scale = PixelScale(0.5, 0.5)
        assert found(1.5, 4.0) == [small, large]

    def test_threshold_is_exclusive(self) -> None:
        image = blank()
        image[20:24, 20:24] = 2000
        assert len(spots_of(image)) == 0
        image[20:24, 20:24] = 2001
        assert len(spots_of(image)) == 1

    @pytest.mark.parametrize("negative", [-2000.0, -500.0])
    def test_threshold_may_be_below_zero(self, negative: float) -> None:
        image = np.full((40, 40), negative - 500)
        image[20:23, 10:13] = negative + 500
        np.testing.assert_allclose(spots_of(image, RegistrationOptions(threshold=negative)), [[11, 21]], atol=1e-9)

    @pytest.mark.parametrize(
        "place",
        [np.s_[0:3, 20:23], np.s_[-3:, 20:23], np.s_[20:23, 0:3], np.s_[20:23, -3:], np.s_[0:3, 0:3], np.s_[-3:, -3:]],
        ids=["top", "bottom", "left", "right", "first corner", "last corner"],
    )
    def test_one_that_touches_the_edge_is_dropped(self, place: tuple[slice, slice]) -> None:
        image = blank()
        image[place] = 5000
        assert spots_of(image).shape == (0, 2)

    @pytest.mark.parametrize("v", [1, 56])
    @pytest.mark.parametrize("u", [1, 76])
    def test_one_beside_the_edge_is_kept(self, u: int, v: int) -> None:
        image = blank()
        image[v : v + 3, u : u + 3] = 5000
        np.testing.assert_allclose(spots_of(image), [[u + 1, v + 1]], atol=0.5)

    def test_corners_connect(self) -> None:
        image = blank()
        image[20:22, 20:22] = 5000
        image[22:24, 22:24] = 5000
        np.testing.assert_allclose(spots_of(image), [[21.5, 21.5]], atol=1e-6)

    def test_a_gap_of_one_pixel_parts(self) -> None:
        image = blank()
        image[20:23, 20:23] = 5000
        image[20:23, 24:27] = 5000
        assert len(spots_of(image)) == 2

    def test_neighbours_do_not_pull_at_each_other(self) -> None:
        image = blank()
        image[20:23, 20:23] = 5000
        image[20:23, 25:28] = 9000
        np.testing.assert_allclose(spots_of(image), [[21, 21], [26, 21]], atol=0.05)

    def test_nor_do_they_make_each_other_longer(self) -> None:
        """A square of three pixels has second moments of two thirds, however near the next one is."""
        image = blank()
        image[20:23, 20:23] = 5000
        image[20:23, 24:27] = 9000
        found = find_spots(Slice(image.astype(np.float32), SCALE), OPTIONS)
        np.testing.assert_allclose(found.extents_px2, np.tile(2 / 3 * np.eye(2), (2, 1, 1)), atol=0.01)

    def test_what_is_around_a_spot_is_no_other_things_brightness(self) -> None:
        """A bright wall around three quarters of it: the level is that of the rest, of 40 HU.

        Above a third of its height the spot has 3307 HU in its middle then, and 1807 HU in the eight pixels around it.
        """
        image = blank()
        image[22:39, 32:49] = 3000
        image[27:34, 37:44] = 40
        image[31:39, 41:49] = 40
        image[29:32, 39:42] = 3500
        image[30, 40] = 5000
        options = RegistrationOptions(threshold=2000.0, max_spot_area_mm2=5.0)
        found = find_spots(Slice(image.astype(np.float32), SCALE), options)
        np.testing.assert_allclose(found.centres_px, [[40, 30]], atol=0.01)
        np.testing.assert_allclose(found.extents_px2, [6 * 1807 / (3307 + 8 * 1807) * np.eye(2)], atol=1e-3)


class TestLimitOfTheError:
    @pytest.mark.parametrize("along_columns", [False, True])
    @pytest.mark.parametrize(("tail", "is_a_spot"), [(16.0, True), (23.0, False)])
    def test_what_has_no_centre_to_four_fifths_of_a_pixel_is_none(
        self, tail: float, is_a_spot: bool, along_columns: bool
    ) -> None:
        """A comet: the longer its tail, the less it is known where its middle is; 0.71 and 0.81 pixel."""
        v, u = np.indices((60, 120))
        along = u - 30.0
        profile = np.where(along < 0, np.exp(-((along / 0.8) ** 2) / 2), np.exp(-along / tail))
        image = 40.0 + 3000.0 * profile * np.exp(-(((v - 30.0) / 1.2) ** 2) / 2)
        found = find_spots(
            Slice((image.T if along_columns else image).astype(np.float32), SCALE), replace(OPTIONS, threshold=800.0)
        )
        assert len(found) == is_a_spot
        stds = np.sqrt(np.linalg.eigvalsh(found.covariances_px2))
        assert stds[:, 1] == pytest.approx([0.706] * is_a_spot, abs=0.02)


class TestHostileImages:
    @pytest.mark.parametrize("value", [3.4e8, -3.4e8, 1e9, 65535.0, 1e-30])
    @pytest.mark.parametrize("threshold", [2000.0, 0.0, -500.0, "auto"])
    def test_pixels_without_sense_are_spots_or_none(self, value: float, threshold: float | str) -> None:
        options = RegistrationOptions(threshold=threshold)
        # The first five have a spot of which nothing is known in one direction, to the last bit.
        for seed in (58, 184, 194, 208, 19, *range(20)):
            rng = np.random.default_rng(seed)
            image = np.full((24, 24), -1000.0)
            image[rng.integers(0, 24, 30), rng.integers(0, 24, 30)] = value
            found = find_spots(Slice(image.astype(np.float32), PixelScale(1.0, 1.0)), options)
            assert np.isfinite(found.centres_px).all()
            assert np.linalg.eigvalsh(found.covariances_px2).min(initial=0.0) > -1e-9

    def test_slopes_in_one_direction_only(self) -> None:
        """The information about such a spot's centre has no inverse, to the last bit where it is large."""
        v, u = np.indices((24, 24))
        for scale in (1.0, 1e3, 1e5):
            image = np.where(np.abs(u - v) < 2, scale * 3000.0, 0.0)
            image[:3] = image[-3:] = 0
            spots_of(image, RegistrationOptions(threshold=1000.0, max_spot_area_mm2=1000.0))
