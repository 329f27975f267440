"""What `/diagnostics` says of a slice, by results made by hand: no two numbers are alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from diagnostic_msgs.msg import DiagnosticStatus

from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.nodes.common.diagnostic_status import NAME
from stereoreg_ros.nodes.register.scale_keeper import ScaleInUse
from stereoreg_ros.nodes.register.slice_registration import Unusable
from stereoreg_ros.nodes.register.slice_status import status_of, status_of_unusable
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.result import Match, PoseEstimate, Refusal, Registration
from support.contract import DIAGNOSTIC_KEYS

FRAME = load_frame("cube6")
SCALE = PixelScale(0.4, 0.7)
POSE = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
MATCHES = tuple(Match(FRAME.line_names[row], row, row, np.zeros(2), np.zeros(2), 0.25) for row in range(5))
ESTIMATE = PoseEstimate(POSE, POSE, np.diag([0.01, 0.04, 0.09, 1e-6, 1e-6, 1e-6]), MATCHES, 3.0, -9.5)
SPOTS = np.zeros((9, 2))


def values_of(status: DiagnosticStatus) -> dict[str, Any]:
    assert (status.name, status.hardware_id) == (NAME, "ct")
    return {entry.key: entry.value for entry in status.values}


def test_an_accepted_slice_is_ok_and_one_with_a_caution_a_warning() -> None:
    for caution, level, more in (("", DiagnosticStatus.OK, ""), ("look twice", DiagnosticStatus.WARN, "; look twice")):
        result = Registration(FRAME, SliceSpots(SPOTS, SCALE), RegistrationOptions(), ESTIMATE, caution)
        status = status_of(result, "measured", 0.0125, "ct")
        assert status.level == level
        assert status.message == f"registered 5 of 6 rods, residual 0.25 mm{more}"
        values = values_of(status)
        assert (values["outcome"], values["reason"], values["calibration"]) == ("accepted", "", "measured")
        assert (values["spots"], values["lines"], values["inliers"]) == ("9", "6", "5")
        assert (values["duration_ms"], values["residual_rms_mm"], values["position_std_mm"]) == ("12.5", "0.25", "0.3")
        assert (values["pixel_spacing_x_mm"], values["pixel_spacing_y_mm"]) == ("0.4", "0.7")


def test_a_refused_slice_is_an_error_with_its_sentence() -> None:
    result = Refusal(FRAME, SliceSpots(SPOTS, SCALE), "no_consensus", "nothing fits")
    status = status_of(result, "configured", 0.5, "ct")
    assert (status.level, status.message) == (DiagnosticStatus.ERROR, "nothing fits")
    values = values_of(status)
    assert (values["outcome"], values["reason"]) == ("refused", "no_consensus")
    assert values["residual_rms_mm"] == "nan"


def test_an_image_that_never_came_to_registration_has_the_same_keys_and_nothing_found() -> None:
    status = status_of_unusable(Unusable("bad_image", "no image", 0.0125), "cube6", 6, ScaleInUse(SCALE), "ct")
    assert (status.level, status.message) == (DiagnosticStatus.ERROR, "no image")
    values = values_of(status)
    assert list(values) == list(DIAGNOSTIC_KEYS)
    assert list(values) == [
        entry.key
        for entry in status_of(Refusal(FRAME, SliceSpots(SPOTS, SCALE), "bad_image", ""), "", 0.0, "ct").values
    ]
    known = {
        "outcome": "refused",
        "reason": "bad_image",
        "frame": "cube6",
        "spots": "0",
        "lines": "6",
        "inliers": "0",
        "ambiguous_poses": "0",
        "pixel_spacing_x_mm": "0.4",
        "pixel_spacing_y_mm": "0.7",
        "calibration": "configured",
        "duration_ms": "12.5",
    }
    # What was not found is no number, least of all a good one.
    assert values == dict.fromkeys(DIAGNOSTIC_KEYS, "nan") | known
