"""A real CT scan of a CatPhan: thin inclined wires, determined on some slices and judged on the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from stereoreg_ros import load_frame, register_slice
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.spots import find_spots
from support.real_images import CATPHAN_OPTIONS, catphan, height, row_of, shows_module

# Heights of the slices from which config/frames/catphan_ctp404.yaml was determined, and its origin in the scanner, mm.
TRAINING_MM = (-6.31, -1.31, 3.69)
ORIGIN_MM = np.array([-124.35, -125.7, 0.0])
# Slices just outside the module may show the ends of its wires and may go either way.
CATPHAN_MARGIN = (-14.0, 11.5)
# Where each line lies in the slice z = 0, roughly, and how far from there its spots may be found over the module.
PLACES = {
    "wire_top": (0.0, -38.0, 30.0, 2.0),
    "wire_right": (38.0, 0.0, 2.0, 30.0),
    "wire_bottom": (0.0, 38.0, 30.0, 2.0),
    "wire_left": (-38.0, 0.0, 2.0, 30.0),
    "rod": (25.0, -25.0, 3.0, 3.0),
}


@pytest.fixture(scope="module")
def scan():
    return catphan()


@pytest.fixture(scope="module")
def frame():
    return load_frame("catphan_ctp404")


def is_training(one):
    return any(abs(height(one) - z) < 0.1 for z in TRAINING_MM)


def test_shipped_wires_are_those_of_the_training_slices(scan, frame):
    training = [one.ct_slice for one in scan if is_training(one)]
    assert len(training) == len(TRAINING_MM)
    points = []
    for ct_slice in training:
        mm = ct_slice.scale.to_mm(find_spots(ct_slice, CATPHAN_OPTIONS).centres_px)
        points.append(ct_slice.scanner_from_slice @ np.column_stack([mm, np.zeros(len(mm))]) - ORIGIN_MM)
    for name, (x, y, far_x, far_y) in PLACES.items():
        near = [p[(np.abs(p[:, 0] - x) < far_x) & (np.abs(p[:, 1] - y) < far_y)] for p in points]
        assert [len(p) for p in near] == [1] * len(training), name
        on_line = np.concatenate(near)
        centre = on_line.mean(axis=0)
        direction = np.linalg.svd(on_line - centre)[2][0]
        line = frame.line_names.index(name)
        for end in (frame.starts[line], frame.ends[line]):
            fitted = centre + direction * (end[2] - centre[2]) / direction[2]
            np.testing.assert_allclose(fitted, end, atol=0.02, err_msg=name)


def test_centres_of_each_wire_lie_on_a_straight_line(scan):
    """In the slices through which the wires run from one side to the other: all but the first and the last."""
    inner = [one.ct_slice for one in scan if shows_module(one)][1:-1]
    points: dict[str, list[np.ndarray]] = {name: [] for name in PLACES}
    for ct_slice in inner:
        mm = ct_slice.scale.to_mm(find_spots(ct_slice, CATPHAN_OPTIONS).centres_px)
        placed = ct_slice.scanner_from_slice @ np.column_stack([mm, np.zeros(len(mm))]) - ORIGIN_MM
        for name, (x, y, far_x, far_y) in PLACES.items():
            near = (np.abs(placed[:, 0] - x) < far_x) & (np.abs(placed[:, 1] - y) < far_y)
            points[name].extend(placed[near])
    for name, on_line in points.items():
        assert len(on_line) == len(inner), name
        off = np.array(on_line) - np.mean(on_line, axis=0)
        direction = np.linalg.svd(off)[2][0]
        rms = np.sqrt((np.linalg.norm(off - np.outer(off @ direction, direction), axis=1) ** 2).mean())
        print(f"{name}: {rms:.3f} mm RMS from a straight line over {len(on_line)} slices")
        assert rms <= 0.10


def inner_slices(scan):
    """The slices through which the wires run from side to side: all that show the module but the first and the last."""
    return [one for one in scan if shows_module(one)][1:-1]


def test_slices_that_show_the_module_are_accepted_and_step_with_the_table(scan, frame):
    found = {}
    for one in inner_slices(scan):
        result = register_slice(replace(one.ct_slice, scanner_from_slice=Pose.identity()), frame, CATPHAN_OPTIONS)
        assert result, f"z = {height(one):.1f}: {result.message}"
        assert result.estimate.inliers == 5
        found[height(one)] = (-result.scanner_from_frame.translation[2], is_training(one))
    assert len(found) == 7
    table = np.array(sorted(found))
    recovered = np.array([found[z][0] for z in table])
    judged = np.array([not found[z][1] for z in table])
    steps = np.diff(recovered)
    off = (recovered - table)[judged]
    print(f"steps {np.round(steps, 3).tolist()}: mean {steps.mean():.3f}, spread {steps.std():.3f} mm")
    print(f"table position on the {len(off)} slices not used for the wires: spread {off.std():.3f} mm")
    assert judged.sum() == 4
    assert abs(steps.mean() - 2.5) <= 0.05
    assert steps.std() <= 0.15
    assert off.std() <= 0.15


def heights_chi_square(scan, frame, options):
    """Chi-square of the inner slices' heights less the table's, by their stated variances; its degrees of freedom."""
    off, variances = [], []
    for one in inner_slices(scan):
        result = register_slice(replace(one.ct_slice, scanner_from_slice=Pose.identity()), frame, options)
        assert result
        off.append(-result.scanner_from_frame.translation[2] - height(one))
        variances.append(result.covariance[2, 2])
    away = np.array(off) - np.average(off, weights=1 / np.array(variances))
    chi_square = float((away**2 / variances).sum())
    print(f"chi-square {chi_square:.2f} of {len(off) - 1} degrees of freedom")
    return chi_square, len(off) - 1


def test_heights_spread_as_stated(scan, frame):
    """Between the 1 and 99 % points, where frame and scale are taken to be exact: they were measured on this scan."""
    exact = replace(frame, tolerances_mm=np.zeros(len(frame)))
    chi_square, freedom = heights_chi_square(scan, exact, replace(CATPHAN_OPTIONS, scale_tolerance=0.0))
    low, high = chi2.ppf([0.01, 0.99], freedom)
    assert low < chi_square < high


def test_heights_spread_no_more_than_stated_with_the_shipped_tolerance(scan, frame):
    chi_square, freedom = heights_chi_square(scan, frame, CATPHAN_OPTIONS)
    assert chi_square < chi2.ppf(0.99, freedom)


@pytest.mark.parametrize("threshold", ["300", "auto"])
def test_end_slices_are_within_their_stated_errors_or_refused(scan, threshold):
    """There the wires end within the slice's thickness, which makes their spots a millimetre off."""
    figures = row_of(f"catphan pylinac/{threshold}/prior/end")
    assert len(figures.attempts) == 2
    assert not figures.missed


@pytest.mark.parametrize("threshold", ["300", "auto"])
def test_without_prior_none_is_wrong(scan, threshold):
    figures = row_of(f"catphan pylinac/{threshold}/no prior/module")
    assert not figures.missed


def test_slices_without_the_module_are_refused(scan, frame):
    others = [one for one in scan if not CATPHAN_MARGIN[0] < height(one) < CATPHAN_MARGIN[1]]
    assert len(others) >= 52
    for one in others:
        result = register_slice(one.ct_slice, frame, CATPHAN_OPTIONS)
        assert not result, f"z = {height(one):.1f}"
        assert result.reason in ("too_few_spots", "no_consensus")
