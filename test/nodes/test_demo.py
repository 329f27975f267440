"""The demonstration, as `make demo` runs it, and that it fails when a pose is wrong."""

from __future__ import annotations

import os
import subprocess

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from stereoreg_ros.geometry.pose import Pose, rotation_exp
from stereoreg_ros.nodes.demo.demo_report import _is_wrong, _SliceReport, _summary
from support.ros_process import ROS_ENVIRONMENT, command_of


def test_demo_registers_a_simulated_stream(tmp_path):
    picture = tmp_path / "demo.png"
    command = [*command_of("demo_report"), "--slices", "12", "--output", str(picture)]
    environment = {**os.environ, **ROS_ENVIRONMENT}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "12 of 12 slices answered" in done.stdout
    assert " 0 wrong" in done.stdout
    image = cv2.imread(str(picture))
    assert image is not None
    assert image.shape[1] >= 1024


def report(offset_mm: float) -> _SliceReport:
    values = {"outcome": "accepted", "inliers": "6", "spots": "6", "residual_rms_mm": "0.1", "duration_ms": "9"}
    return _SliceReport(Pose.identity(), Pose(np.eye(3), np.array([offset_mm, 0, 0])), values)


@pytest.mark.parametrize(
    ("reports", "count", "code", "complaint"),
    [
        ([report(0.1)], 1, 0, ""),
        ([report(0.1), report(1.6)], 2, 1, "1 wrong poses were published"),
        ([report(0.1)], 3, 1, "2 slices were not answered"),
        ([], 1, 1, "no slice was registered"),
    ],
)
def test_summary_fails_loudly(capsys, tmp_path, reports, count, code, complaint):
    assert _summary(reports, count, tmp_path / "x.png") == code
    assert complaint in capsys.readouterr().err


def test_errors_are_in_millimetres_and_degrees_and_either_makes_a_pose_wrong():
    truth = Pose(rotation_exp(np.array([0.3, 0.0, 0.0])), np.array([1.0, 2.0, 3.0]))
    for turn_deg, shift_mm, wrong in ((1.9, 1.4, False), (2.1, 0.0, True), (0.0, 1.6, True)):
        turn = rotation_exp(np.radians([0.0, turn_deg, 0.0]))
        seen = _SliceReport(truth, Pose(turn @ truth.rotation, truth.translation + np.array([0.0, 0.0, shift_mm])))
        assert seen.error == pytest.approx((shift_mm, turn_deg), abs=1e-6)
        assert _is_wrong(seen) is wrong


def test_a_slice_is_judged_when_its_truth_its_status_and_if_accepted_its_pose_have_come():
    truth = pose = Pose.identity()
    accepted, refused = {"outcome": "accepted"}, {"outcome": "refused"}
    assert _SliceReport(truth, pose, accepted).complete
    assert _SliceReport(truth, None, refused).complete
    assert not _SliceReport(truth, None, accepted).complete
    assert not _SliceReport(None, pose, accepted).complete
    assert not _SliceReport(truth, pose, {}).complete
