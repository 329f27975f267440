"""A real MR volume of a Z-frame: tubes without CT numbers, two poses by symmetry, slices 2.4 mm apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from real_images import ZFRAME_OPTIONS, height, zframe

from stereoreg_ros import load_frame, register_slice
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.spots import find_spots

FULL = range(6, 12)  # the slices that show all seven tubes


@pytest.fixture(scope="module")
def volume():
    return zframe()


@pytest.fixture(scope="module")
def frame():
    return load_frame("zframe")


THRESHOLDS = pytest.mark.parametrize("threshold", [200.0, "auto"])


@THRESHOLDS
def test_without_prior_is_honestly_ambiguous(volume, frame, threshold):
    for number in FULL:
        options = replace(ZFRAME_OPTIONS, threshold=threshold, max_rotation_deg=180.0)
        result = register_slice(volume[number].ct_slice, frame, options)
        assert not result
        assert result.reason == "ambiguous"
        assert len(result.estimates) == 2


@THRESHOLDS
def test_with_prior_is_accepted_and_steps_with_the_table(volume, frame, threshold):
    options = replace(ZFRAME_OPTIONS, threshold=threshold)
    heights = []
    for number in FULL:
        one = volume[number].ct_slice
        result = register_slice(replace(one, scanner_from_slice=Pose.identity()), frame, options)
        assert result, f"slice {number}: {result.message}"
        assert result.estimate.inliers == 7
        assert result.estimate.residual_rms_mm <= 0.4
        heights.append(-result.scanner_from_frame.translation[2])
    np.testing.assert_allclose(np.diff([height(volume[number]) for number in FULL]), 2.4, atol=1e-4)
    steps = np.diff(heights)
    print(f"steps {np.round(steps, 3).tolist()} mm: mean {steps.mean():.3f}, standard deviation {steps.std():.3f}")
    # Air bubbles in the tubes of slices 6 and 11 shift single spots: each step has the spread, their mean has not.
    assert abs(steps.mean() - 2.4) <= 0.05
    assert np.sqrt(np.mean((steps - 2.4) ** 2)) <= 0.3


def test_auto_offers_the_seven_tubes_and_hardly_more(volume):
    for number in FULL:
        found = find_spots(volume[number].ct_slice, replace(ZFRAME_OPTIONS, threshold="auto"))
        assert 7 <= len(found) <= 9, number


@THRESHOLDS
def test_slices_without_the_frame_are_refused(volume, frame, threshold):
    for number, one in enumerate(volume):
        if number not in range(5, 12):
            result = register_slice(one.ct_slice, frame, replace(ZFRAME_OPTIONS, threshold=threshold))
            assert not result
