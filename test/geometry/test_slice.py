"""The pixel scale and the slice."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice

SEEDED = settings(derandomize=True, deadline=None)

spacings = st.floats(0.05, 5.0)
scales = st.builds(PixelScale, spacings, spacings, st.floats(-0.5, 0.5))


class TestPixelScale:
    def test_x_goes_with_columns_and_the_shear_with_rows(self) -> None:
        scale = PixelScale(0.5, 0.8, 0.1)
        np.testing.assert_allclose(scale.to_mm(np.array([1.0, 0.0])), [0.5, 0.0])
        np.testing.assert_allclose(scale.to_mm(np.array([0.0, 1.0])), [0.1, 0.8])
        np.testing.assert_array_equal(scale.matrix, [[0.5, 0.1], [0.0, 0.8]])

    @SEEDED
    @given(scales, arrays(np.float64, (3, 2, 2), elements=st.floats(-1000, 1000)))
    def test_round_trip(self, scale: PixelScale, points: Array) -> None:
        np.testing.assert_allclose(scale.to_px(scale.to_mm(points)), points, atol=1e-7)
        np.testing.assert_allclose(scale.to_mm(scale.to_px(points)), points, atol=1e-7)

    @SEEDED
    @given(scales)
    def test_inverse_matrix(self, scale: PixelScale) -> None:
        np.testing.assert_allclose(scale.inverse_matrix, np.linalg.inv(scale.matrix), rtol=1e-9, atol=1e-12)

    def test_no_points(self) -> None:
        assert PixelScale(0.5, 0.8).to_mm(np.empty((0, 2))).shape == (0, 2)

    @pytest.mark.parametrize("bad", [0.0, -0.5, np.nan, np.inf])
    @pytest.mark.parametrize("name", ["sx", "sy"])
    def test_spacing_must_be_positive_and_finite(self, name: str, bad: float) -> None:
        with pytest.raises(ValueError, match=f"pixel spacing {name} is {bad}, expected a positive number"):
            PixelScale(**{"sx": 0.5, "sy": 0.5, name: bad})

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_shear_must_be_finite(self, bad: float) -> None:
        with pytest.raises(ValueError, match=f"pixel shear is {bad}, expected a finite number"):
            PixelScale(0.5, 0.5, bad)


class TestSlice:
    @pytest.mark.parametrize("dtype", [np.int16, np.uint16, np.float64, np.float32])
    @pytest.mark.parametrize("order", ["C", "F"])
    def test_becomes_contiguous_float32(self, dtype: Any, order: Any) -> None:
        image = np.array([[1, 2, 3], [4, 5, 6]], dtype=dtype, order=order)
        ct_slice = Slice(image, PixelScale(0.5, 0.5))
        assert ct_slice.hu.dtype == np.float32
        assert ct_slice.hu.flags.c_contiguous
        np.testing.assert_array_equal(ct_slice.hu, [[1, 2, 3], [4, 5, 6]])

    def test_nested_lists_and_views(self) -> None:
        assert Slice([[1, 2]], PixelScale(1, 1)).hu.shape == (1, 2)  # type: ignore[arg-type]
        mirrored = Slice(np.arange(6.0, dtype=np.float32).reshape(2, 3)[:, ::-1], PixelScale(1, 1))
        np.testing.assert_array_equal(mirrored.hu, [[2, 1, 0], [5, 4, 3]])

    def test_the_scanner_is_the_slice_unless_told(self) -> None:
        pose = Slice(np.zeros((2, 2), np.float32), PixelScale(1, 1)).scanner_from_slice
        np.testing.assert_array_equal(pose.rotation, np.eye(3))
        np.testing.assert_array_equal(pose.translation, 0)
        told = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
        assert Slice(np.zeros((2, 2), np.float32), PixelScale(1, 1), told).scanner_from_slice is told

    @pytest.mark.parametrize(
        ("image", "told"),
        [
            (np.zeros(4), r"image has shape \(4,\), expected \(rows, columns\)"),
            (np.zeros((4, 4, 3)), r"image has shape \(4, 4, 3\), expected \(rows, columns\)"),
            (np.zeros((0, 4)), "image is empty: 0 rows, 4 columns"),
            (np.zeros((4, 0)), "image is empty: 4 rows, 0 columns"),
            (np.array([[0, np.nan], [0, 0]]), "image holds 1 pixels that are not finite"),
            (np.array([[0, np.inf], [np.nan, 0]]), "image holds 2 pixels that are not finite"),
            (np.array([[np.inf, -np.inf], [np.nan, 0]]), "image holds 3 pixels that are not finite"),
            (np.array([[1e300, 0], [0, 0]]), "image holds 1 pixels that are not finite"),
            (np.array([[2e9, 0], [0, -1]]), r"image holds values from -1 to 2e\+09, expected at most 1e\+09 HU"),
            (np.array([[2, 0], [0, -3e38]]), r"image holds values from -3e\+38 to 2, expected at most 1e\+09 HU"),
        ],
    )
    def test_what_is_no_slice(self, image: Array, told: str) -> None:
        with pytest.raises(ValueError, match=told):
            Slice(image, PixelScale(1, 1))  # type: ignore[arg-type]
