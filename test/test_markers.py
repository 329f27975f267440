"""What RViz shows of a slice, by hand: in the scanner's axes, in metres, oblong as the slice is."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from stereoreg_ros import PixelScale, Pose, RegistrationOptions, load_frame
from stereoreg_ros.geometry.pose import Array, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.nodes.markers import markers_of
from stereoreg_ros.result import Match, PoseEstimate, Registration

ROWS, COLUMNS = 20, 30
SCALE = PixelScale(0.5, 2.0, 0.1)
# A quarter turn about x: the rows go upwards in the scanner.
PLANE = Pose(rotation_exp(np.array([math.pi / 2, 0.0, 0.0])), np.array([10.0, 20.0, 30.0]))
FRAME = load_frame("cube6")
SLICE_FROM_FRAME = Pose(rotation_exp(np.array([0.1, 0.2, 0.3])), np.array([40.0, 50.0, 2.0]))
VARIANCES = np.array([1.0, 4.0, 9.0, 0.0, 0.0, 0.0])


def shown() -> dict[str, list[Marker]]:
    """Markers by their namespaces, of a frame with spots of its first two rods."""
    predicted, _ = project(FRAME, SLICE_FROM_FRAME, SCALE)
    matches = tuple(Match(FRAME.line_names[k], k, k, predicted[k], predicted[k], 0.0) for k in (0, 1))
    estimate = PoseEstimate(SLICE_FROM_FRAME, PLANE @ SLICE_FROM_FRAME, np.diag(VARIANCES), matches, 1.0, -20.0)
    result = Registration(FRAME, SCALE, RegistrationOptions(), predicted, estimate)
    ct_slice = Slice(np.zeros((ROWS, COLUMNS), np.float32), SCALE, PLANE)
    named: dict[str, list[Marker]] = {}
    for marker in markers_of(ct_slice, [(result, "frame")], Header(frame_id="ct")).markers:
        named.setdefault(marker.ns, []).append(marker)
    return named


def points_mm(marker: Marker) -> Array:
    return 1e3 * np.array([[point.x, point.y, point.z] for point in marker.points])


def test_the_slices_outline_runs_around_its_pixels() -> None:
    (outline,) = shown()["slice"]
    assert outline.type == Marker.LINE_STRIP
    # Half a pixel beyond the centres of the outermost ones; y of the slice is z of the scanner.
    corners_px = np.array([[-0.5, -0.5], [29.5, -0.5], [29.5, 19.5], [-0.5, 19.5], [-0.5, -0.5]])
    x, y = 0.5 * corners_px[:, 0] + 0.1 * corners_px[:, 1], 2.0 * corners_px[:, 1]
    np.testing.assert_allclose(points_mm(outline), np.stack([x + 10, np.full(5, 20.0), y + 30], axis=-1), atol=1e-9)


def test_spots_and_rods_are_where_the_scanner_has_them() -> None:
    markers = shown()["frame"]
    rods = [marker for marker in markers if marker.type == Marker.CYLINDER]
    assert [rod.color.g > rod.color.r for rod in rods] == [True, True, False, False, False, False]
    scanner_from_frame = PLANE @ SLICE_FROM_FRAME
    for line, rod in enumerate(rods):
        middle = scanner_from_frame @ (0.5 * (FRAME.starts[line] + FRAME.ends[line]))
        at = rod.pose.position
        np.testing.assert_allclose(1e3 * np.array([at.x, at.y, at.z]), middle, atol=1e-9)
        assert 1e3 * rod.scale.z == pytest.approx(np.linalg.norm(FRAME.ends[line] - FRAME.starts[line]))
    (spots,) = (marker for marker in markers if marker.type == Marker.SPHERE_LIST)
    predicted, _ = project(FRAME, SLICE_FROM_FRAME, PixelScale(1.0, 1.0))
    in_slice = np.column_stack([predicted[:2], np.zeros(2)])
    np.testing.assert_allclose(points_mm(spots), PLANE @ in_slice, atol=1e-6)


def test_the_ellipsoid_has_the_diameters_that_hold_95_percent() -> None:
    (ellipsoid,) = (marker for marker in shown()["frame"] if marker.type == Marker.SPHERE)
    # The root of chi-square's 95 % for three numbers is 2.7955 standard deviations, to either side.
    diameters = 1e3 * np.array([ellipsoid.scale.x, ellipsoid.scale.y, ellipsoid.scale.z])
    np.testing.assert_allclose(np.sort(diameters), 2 * 2.7955 * np.array([1.0, 2.0, 3.0]), rtol=1e-4)
