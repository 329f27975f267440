"""A real MR volume of a Z-frame: tubes without CT numbers, two poses by symmetry, slices 2.4 mm apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stereoreg_ros import load_frame, register_slice
from stereoreg_ros.geometry.pose import Pose, rotation_from_quaternion
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.spots import find_spots
from support.real_images import ZFRAME_OPTIONS, height, row_of, zframe
from support.real_scenes import SHARED_DATA, ZFRAME_THICKNESS_MM, erased, turned_orientations, zframe_rest

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


@THRESHOLDS
def test_heights_spread_as_stated(volume, frame, threshold):
    """Chi-square of the heights less the table's, in terms of their stated variances, between its 1 and 99 % points."""
    off, variances = [], []
    for number in FULL:
        one = volume[number].ct_slice
        options = replace(ZFRAME_OPTIONS, threshold=threshold)
        result = register_slice(replace(one, scanner_from_slice=Pose.identity()), frame, options)
        assert result
        off.append(-result.scanner_from_frame.translation[2] - height(volume[number]))
        variances.append(result.covariance[2, 2])
    away = np.array(off) - np.average(off, weights=1 / np.array(variances))
    chi_square = float((away**2 / variances).sum())
    print(f"chi-square {chi_square:.2f} of {len(off) - 1} degrees of freedom")
    low, high = chi2.ppf([0.01, 0.99], len(off) - 1)
    assert low < chi_square < high


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


@THRESHOLDS
def test_with_the_thickness_given_it_is_as_good_as_without(threshold):
    """The tubes are 7.5 mm thick: what a leaning one shows is longer than the slice's thickness has it."""
    named = f"{threshold:g}" if isinstance(threshold, float) else threshold
    without, given = (row_of(f"zframe/{named}/full{what}") for what in ("", ", thickness given"))
    assert not without.missed
    assert not given.missed
    assert [one.rods for one in given.attempts] == [7] * len(FULL)
    np.testing.assert_allclose(
        [one.error_mm for one in given.attempts], [one.error_mm for one in without.attempts], atol=0.15
    )


@pytest.mark.parametrize("given", ["", ", thickness given"])
def test_slices_beside_the_whole_frame_are_within_their_stated_errors_or_refused(given):
    """In slice 5 diagonal tubes end."""
    figures = row_of(f"zframe/200/partly{given}")
    assert len(figures.attempts) == 2
    assert not figures.missed


def test_erased_tubes_leave_no_spot_and_the_others_as_they_were(volume, frame):
    rest = zframe_rest(SHARED_DATA / "zframe_mr")
    for number in FULL:
        ct_slice = volume[number].ct_slice
        slice_from_frame = ct_slice.scanner_from_slice.inverse() @ rest
        places = project(frame, slice_from_frame, ct_slice.scale)[0]
        before = find_spots(ct_slice, ZFRAME_OPTIONS).centres_px
        for line in range(len(frame)):
            one = erased(ct_slice, frame, slice_from_frame, [line], ZFRAME_THICKNESS_MM)
            after = find_spots(one, ZFRAME_OPTIONS).centres_px
            assert np.linalg.norm(before - places[line], axis=1).min() < 2.0
            assert np.linalg.norm(after - places[line], axis=1).min() > 10.0
            assert len(after) == len(before) - 1


@pytest.mark.parametrize("threshold", ["200", "auto"])
@pytest.mark.parametrize(("count", "most"), [("1", 6), ("2", 6)])
def test_with_tubes_erased_none_is_wrong(threshold, count, most):
    figures = row_of(f"zframe/{threshold}/{count} erased", most)
    assert len(figures.attempts) == most
    assert not figures.missed


def test_turned_orientations_are_far_from_how_it_stands(volume):
    turns = turned_orientations()
    assert len(turns) == 9
    upright = zframe_rest(SHARED_DATA / "zframe_mr").rotation
    for name, quaternion in turns.items():
        turned = rotation_from_quaternion(quaternion)
        angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(turned @ upright.T) - 1), -1, 1)))
        assert angle > 80.0, name


@pytest.mark.parametrize("threshold", ["200", "auto"])
def test_told_a_wrong_orientation_none_is_wrong(threshold):
    figures = row_of(f"zframe/{threshold}/turned", 5)
    assert not figures.missed
