"""The spots of a slice: what is checked, what is known by default, and what goes with some of them or another scale."""

from __future__ import annotations

import numpy as np
import pytest

from stereoreg_ros.geometry.pose import Pose, rotation_exp
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots

SCALE = PixelScale(0.5, 0.6, 0.1)
PLANE = Pose(rotation_exp(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
CENTRES = np.array([[1.0, 2.0], [30.0, 40.0], [500.0, 60.0]])
COVARIANCES = np.arange(1.0, 4.0)[:, None, None] * np.array([[0.04, 0.01], [0.01, 0.09]])
WHOLE = SliceSpots(
    CENTRES,
    SCALE,
    COVARIANCES,
    extents_px2=2 * COVARIANCES,
    cut_short=np.array([True, False, True]),
    scanner_from_slice=PLANE,
    area_mm2=900.0,
    scale_covariance=np.diag([1e-6, 2e-6, 0.0]),
    stated_scale=PixelScale(0.51, 0.61),
)


def test_nothing_is_known_by_default() -> None:
    spots = SliceSpots(CENTRES, SCALE)
    assert len(spots) == 3
    np.testing.assert_array_equal(spots.covariances_px2, np.zeros((3, 2, 2)))
    assert np.isnan(spots.extents_px2).all()
    assert spots.cut_short.tolist() == [False, False, False]
    np.testing.assert_array_equal(spots.scanner_from_slice.rotation, np.eye(3))
    assert (spots.area_mm2, spots.scale_covariance, spots.stated_scale) == (None, None, None)


def test_none_at_all() -> None:
    spots = SliceSpots(np.array([]), SCALE)
    assert len(spots) == 0
    assert spots.centres_mm.shape == (0, 2)
    assert spots.noise_px2(0.3).shape == (0, 2, 2)


def test_some_of_them_are_of_the_same_slice() -> None:
    some = WHOLE.take(np.array([2, 0]))
    np.testing.assert_array_equal(some.centres_px, CENTRES[[2, 0]])
    np.testing.assert_array_equal(some.covariances_px2, COVARIANCES[[2, 0]])
    np.testing.assert_array_equal(some.extents_px2, 2 * COVARIANCES[[2, 0]])
    assert some.cut_short.tolist() == [True, True]
    assert some.scanner_from_slice is PLANE
    assert (some.area_mm2, some.scale, some.stated_scale) == (900.0, SCALE, WHOLE.stated_scale)
    assert some.scale_covariance is WHOLE.scale_covariance


def test_with_another_scale_the_slice_is_as_many_pixels() -> None:
    other = WHOLE.with_scale(PixelScale(1.0, 0.3))
    assert other.area_mm2 == pytest.approx(900.0)
    assert WHOLE.with_scale(PixelScale(0.25, 0.6)).area_mm2 == pytest.approx(450.0)
    assert WHOLE.with_scale(SCALE).area_mm2 == 900.0
    np.testing.assert_allclose(other.centres_mm, CENTRES * [1.0, 0.3])
    # Of the other scale no errors are known; what the slice itself came with stays.
    assert other.scale_covariance is None
    assert other.stated_scale == WHOLE.stated_scale
    np.testing.assert_array_equal(other.extents_px2, WHOLE.extents_px2)
    assert SliceSpots(CENTRES, SCALE).with_scale(PixelScale(1.0, 1.0)).area_mm2 is None


def test_centres_in_mm_by_scale_and_shear() -> None:
    np.testing.assert_allclose(WHOLE.centres_mm[0], [0.5 * 1 + 0.1 * 2, 0.6 * 2])


def test_noise_is_raised_along_the_axes_that_are_known_better() -> None:
    spots = SliceSpots(CENTRES[:2], SCALE, np.array([np.diag([0.01, 0.25]), np.diag([1.0, 0.0])]))
    np.testing.assert_allclose(spots.noise_px2(0.3), [np.diag([0.09, 0.25]), np.diag([1.0, 0.09])], atol=1e-12)
    np.testing.assert_allclose(SliceSpots(CENTRES[:1], SCALE).noise_px2(0.3), [0.09 * np.eye(2)])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"centres_px": np.zeros(3)}, r"spots_px has shape \(3,\), expected \(n, 2\)"),
        ({"centres_px": np.array([[0.0, np.nan]])}, "spots_px must be finite"),
        ({"covariances_px2": np.zeros((2, 2, 2))}, r"covariances_px2 has shape \(2, 2, 2\), expected \(3, 2, 2\)"),
        ({"covariances_px2": np.full((3, 2, 2), np.nan)}, "covariances_px2 must be finite and symmetric"),
        ({"covariances_px2": np.tile([[1.0, 0.5], [0.0, 1.0]], (3, 1, 1))}, "must be finite and symmetric"),
        ({"covariances_px2": np.tile(np.diag([1.0, -0.1]), (3, 1, 1))}, "matrix with a negative variance"),
        ({"extents_px2": np.zeros((3, 2))}, r"extents_px2 has shape \(3, 2\), expected \(3, 2, 2\)"),
        ({"cut_short": np.zeros(2, dtype=bool)}, r"cut_short has shape \(2,\), expected \(3,\)"),
    ],
)
def test_what_cannot_be_is_refused(fields: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SliceSpots(**{"centres_px": CENTRES, "scale": SCALE, **fields})  # type: ignore[arg-type]
