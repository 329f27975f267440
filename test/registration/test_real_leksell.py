"""One real CT slice of a Leksell frame: ambiguous by its symmetry, certain once told how it stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, load_frame, register_slice
from stereoreg_ros.geometry.pose import rotation_angle
from stereoreg_ros.spots import find_spots
from support.real_images import LEKSELL_OPTIONS, leksell

# Where the six rods are to be seen, pixel (u, v), by the data's own description.
RODS_PX = np.array([[105.5, 162.3], [108.3, 246.9], [111.4, 354.3], [408.9, 153.1], [411.5, 232.9], [414.5, 345.0]])


@pytest.fixture(scope="module")
def ct_slice():
    return leksell().ct_slice


@pytest.fixture(scope="module")
def frame():
    return load_frame("leksell_ct")


@pytest.mark.parametrize("threshold", [800.0, 900.0, 1000.0, 1200.0, "auto"])
def test_without_prior_is_ambiguous_and_lists_the_four_poses(ct_slice, frame, threshold):
    result = register_slice(ct_slice, frame, replace(LEKSELL_OPTIONS, threshold=threshold, max_rotation_deg=180.0))
    assert not result
    assert result.reason == "ambiguous"
    assert len(result.estimates) == 4
    assert all(estimate.inliers == 6 and estimate.residual_rms_mm <= 0.3 for estimate in result.estimates)
    rotations = [estimate.scanner_from_frame.rotation for estimate in result.estimates]
    apart = [rotation_angle(a @ b.T) for i, a in enumerate(rotations) for b in rotations[:i]]
    assert min(apart) > np.pi / 2
    for estimate in result.estimates:
        x, y, z = estimate.scanner_from_frame.translation
        assert f"({x:.1f}, {y:.1f}, {z:.1f})" in result.message


@pytest.mark.parametrize("threshold", [800.0, 900.0, 1000.0, 1200.0, "auto"])
def test_with_prior_is_accepted(ct_slice, frame, threshold):
    result = register_slice(ct_slice, frame, replace(LEKSELL_OPTIONS, threshold=threshold))
    assert result, result.message
    assert result.estimate.inliers == 6
    assert result.estimate.residual_rms_mm <= 0.3
    found = np.array(sorted((match.spot_px for match in result.matches), key=lambda p: (p[0] > 256, p[1])))
    np.testing.assert_allclose(found, RODS_PX, atol=0.5)
    # The slice is nearly at right angles to the upright rods: the tilt is known only weakly, and that is said.
    assert result.estimate.rotation_std_deg >= 0.5


def test_a_tilt_this_weak_is_refused_by_default_and_the_sentence_says_how_to_allow_it(ct_slice, frame):
    allowed = RegistrationOptions().max_target_error_mm
    result = register_slice(ct_slice, frame, replace(LEKSELL_OPTIONS, max_target_error_mm=allowed))
    assert not result
    assert result.reason == "inaccurate"
    assert result.estimates[0].inliers == 6
    stated = result.estimates[0].target_error_95_mm([0.0, 0.0, 0.0])
    assert stated > allowed
    assert f"{stated:.2f} mm" in result.message
    assert "raise max_target_error_mm" in result.message


def test_auto_offers_the_six_rods_and_hardly_more(ct_slice):
    found = find_spots(ct_slice, replace(LEKSELL_OPTIONS, threshold="auto")).centres_px
    for rod in RODS_PX:
        assert np.linalg.norm(found - rod, axis=1).min() < 1.0
    print(f"{len(found) - 6} besides the six rods")
    assert len(found) <= 9


def test_each_of_the_four_poses_is_accepted_when_the_prior_names_it(ct_slice, frame):
    refusal = register_slice(ct_slice, frame, replace(LEKSELL_OPTIONS, max_rotation_deg=180.0))
    assert not refusal
    for estimate in refusal.estimates:
        told = tuple(estimate.scanner_from_frame.quaternion_xyzw)
        result = register_slice(ct_slice, frame, replace(LEKSELL_OPTIONS, nominal_orientation=told))
        assert result
        np.testing.assert_allclose(
            result.scanner_from_frame.translation, estimate.scanner_from_frame.translation, atol=0.05
        )


def test_wrong_frames_are_refused(ct_slice):
    for name in ("cube6", "zframe", "catphan_ctp404"):
        result = register_slice(ct_slice, load_frame(name), replace(LEKSELL_OPTIONS, max_rotation_deg=180.0))
        assert not result
        assert result.reason == "no_consensus"
