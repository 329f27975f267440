"""Results: truth values, figures, and the keys of the contract."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.result import REASONS, Match, PoseEstimate, Refusal, Registration, diagnostics
from stereoreg_ros.uncertainty import error_ball_95
from support.contract import DIAGNOSTIC_KEYS
from support.contract import REASONS as CONTRACT_REASONS

FRAME = load_frame("cube6")
SCALE = PixelScale(0.5, 0.8)
SPOTS = np.arange(14.0).reshape(7, 2)
COVARIANCE = np.diag([0.01, 0.04, 0.09, 1e-4, 4e-4, 1e-6])


def estimate() -> PoseEstimate:
    matches = tuple(
        Match(FRAME.line_names[k], k, k + 1, SPOTS[k + 1], SPOTS[k + 1] + [0.3 * k, 0.4 * k], 0.1 * k) for k in range(5)
    )
    pose = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
    return PoseEstimate(pose, pose, COVARIANCE, matches, 4.5, -12.5)


@pytest.fixture
def accepted() -> Registration:
    return Registration(FRAME, SliceSpots(SPOTS, SCALE), RegistrationOptions(), estimate())


def refused(estimates: tuple[PoseEstimate, ...] = ()) -> Refusal:
    return Refusal(FRAME, SliceSpots(SPOTS, SCALE), "no_consensus", "nothing found", estimates)


class TestTruth:
    def test_an_accepted_slice_is_true_and_a_refusal_is_false(self, accepted: Registration) -> None:
        assert accepted
        assert bool(accepted) is True
        assert not refused()
        assert bool(refused((estimate(),))) is False

    def test_the_reasons_of_the_contract(self) -> None:
        assert sorted(REASONS) == sorted(CONTRACT_REASONS)
        assert len(set(REASONS)) == len(REASONS)


class TestFigures:
    def test_of_an_estimate(self) -> None:
        best = estimate()
        assert best.inliers == 5
        assert best.degrees_of_freedom == 4
        assert best.residual_rms_mm == pytest.approx(0.1 * math.sqrt(30 / 5))
        assert best.residual_rms_px == pytest.approx(0.5 * math.sqrt(30 / 5))
        assert [match.residual_px for match in best.matches] == pytest.approx([0, 0.5, 1, 1.5, 2])

    def test_deviations_are_along_the_worst_axis(self) -> None:
        turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
        whole = np.kron(np.eye(2), turn)
        best = replace(estimate(), covariance=whole @ COVARIANCE @ whole.T)
        assert best.position_std_mm == pytest.approx(0.3)
        assert best.rotation_std_deg == pytest.approx(math.degrees(0.02))

    def test_the_error_at_a_target_is_by_how_the_frame_stands_in_the_scanner(self) -> None:
        """A quarter turn about z there: 100 mm along the frame's x are along y, where turning about x moves it along z.

        That adds (0.01 rad * 100 mm)^2 along z, and the turn about z (0.001 rad * 100 mm)^2 along x.
        """
        quarter = Pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([5.0, 6.0, 7.0]))
        best = replace(estimate(), scanner_from_frame=quarter)
        expected = error_ball_95(np.diag([0.01 + 0.01, 0.04, 0.09 + 1.0]))
        assert best.target_error_95_mm((100.0, 0.0, 0.0)) == pytest.approx(expected)

    def test_no_deviation_is_below_zero(self) -> None:
        best = replace(estimate(), covariance=-1e-18 * np.eye(6))
        assert best.position_std_mm == best.rotation_std_deg == 0.0

    def test_an_accepted_slice_passes_on_its_estimate(self, accepted: Registration) -> None:
        assert accepted.scanner_from_frame is accepted.estimate.scanner_from_frame
        assert accepted.covariance is accepted.estimate.covariance
        assert accepted.matches is accepted.estimate.matches


class TestDiagnostics:
    def test_keys_are_those_of_the_contract_in_its_order(self, accepted: Registration) -> None:
        for result in (accepted, refused(), refused((estimate(), estimate()))):
            assert list(diagnostics(result, "configured", 0.1)) == DIAGNOSTIC_KEYS

    def test_of_an_accepted_slice(self, accepted: Registration) -> None:
        told = diagnostics(accepted, "measured", 0.0125)
        assert told["outcome"] == "accepted"
        assert told["reason"] == ""
        assert told["frame"] == "cube6"
        assert (told["spots"], told["lines"], told["inliers"], told["ambiguous_poses"]) == (7, 6, 5, 1)
        assert told["residual_rms_mm"] == accepted.estimate.residual_rms_mm
        assert told["residual_rms_px"] == accepted.estimate.residual_rms_px
        assert told["log10_false_alarms"] == -12.5
        assert told["position_std_mm"] == pytest.approx(0.3)
        assert told["rotation_std_deg"] == pytest.approx(math.degrees(0.02))
        assert told["target_error_95_mm"] == error_ball_95(COVARIANCE[:3, :3])
        assert (told["pixel_spacing_x_mm"], told["pixel_spacing_y_mm"]) == (0.5, 0.8)
        assert told["calibration"] == "measured"
        assert told["duration_ms"] == pytest.approx(12.5)

    def test_target_error_is_that_of_the_target_told(self, accepted: Registration) -> None:
        """100 mm along x the rotations about y and z add 0.02 and 0.001 rad times 100 mm across."""
        told = replace(accepted, options=RegistrationOptions(target_in_frame_mm=(100.0, 0.0, 0.0)))
        expected = error_ball_95(np.diag([0.01, 0.04 + 0.01, 0.09 + 4.0]))
        assert diagnostics(told, "configured", 0.1)["target_error_95_mm"] == pytest.approx(expected)
        failed = replace(refused((estimate(),)), options=told.options)
        assert diagnostics(failed, "configured", 0.1)["target_error_95_mm"] == pytest.approx(expected)

    def test_what_a_refusal_does_not_have_is_nan(self) -> None:
        told = diagnostics(refused(), "configured", 0.1)
        assert (told["outcome"], told["reason"]) == ("refused", "no_consensus")
        assert (told["spots"], told["lines"], told["inliers"], told["ambiguous_poses"]) == (7, 6, 0, 0)
        nans = {key for key, value in told.items() if isinstance(value, float) and math.isnan(value)}
        assert nans == {
            "residual_rms_mm",
            "residual_rms_px",
            "log10_false_alarms",
            "position_std_mm",
            "rotation_std_deg",
            "target_error_95_mm",
        }

    def test_a_refusal_tells_of_its_best_explanation(self) -> None:
        best = estimate()
        told = diagnostics(refused((best, replace(best, log10_false_alarms=-3.0))), "configured", 0.1)
        assert told["outcome"] == "refused"
        assert (told["inliers"], told["ambiguous_poses"]) == (5, 2)
        assert told["log10_false_alarms"] == -12.5
        assert told["residual_rms_mm"] == best.residual_rms_mm
