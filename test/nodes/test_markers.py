"""What RViz shows: each rod, spot, plane, error and target where it is, in metres and in scanner axes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from geometry_msgs.msg import Point, PointStamped, PoseStamped, Vector3
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from stereoreg_ros import RegistrationOptions
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.nodes.common.conversions import pose_from_message
from stereoreg_ros.nodes.register.markers import markers_of
from stereoreg_ros.result import Match, PoseEstimate, Refusal, Registration

HEADER = Header(frame_id="scanner")
STARTS = np.array([[0.0, 0, -30], [40, 0, -30], [0, 50, -30]])
ENDS = np.array([[0.0, 0, 30], [50, 20, 30], [10, 50, 40]])
FRAME = Frame("three", ("a", "b", "c"), STARTS, ENDS, np.array([1.0, 2.0, 3.0]))
# A quarter turn about z: x of the slice is y of the scanner.
SLICE = Slice(
    np.zeros((30, 20), np.float32),
    PixelScale(0.5, 2.0, 0.1),
    Pose(Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.array([100.0, 200.0, 300.0])),
)
POSE = Pose(Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), np.array([12.0, -30.0, 500.0]))
COVARIANCE = np.diag([0.04, 0.25, 1.0, 0.0, 0.0, 0.0])
TARGET = (10.0, 20.0, 30.0)


def registration(covariance: Array = COVARIANCE) -> Registration:
    """Of which the first and the last rod have a spot."""
    matches = tuple(
        Match(FRAME.line_names[line], line, spot, np.array(spot_px), np.array(spot_px), 0.1)
        for line, spot, spot_px in ((0, 1, [4.0, 10.0]), (2, 0, [0.0, 20.0]))
    )
    estimate = PoseEstimate(SLICE.scanner_from_slice.inverse() @ POSE, POSE, covariance, matches, 1.0, -9.0)
    spots_px = np.array([[0.0, 20.0], [4.0, 10.0], [1.0, 1.0]])
    return Registration(
        FRAME, SliceSpots(spots_px, SLICE.scale), RegistrationOptions(target_in_frame_mm=TARGET), estimate
    )


def shown(kind: int, covariance: Array = COVARIANCE) -> list[Marker]:
    found = markers_of(SLICE, [(registration(covariance), "three")], HEADER).markers
    return [one for one in found if one.type == kind and one.action == Marker.ADD]


def metres(at: Point | Vector3) -> Array:
    return np.array([at.x, at.y, at.z])


def assert_points(found: list[Point], expected_mm: ArrayLike) -> None:
    np.testing.assert_allclose([metres(one) for one in found], np.array(expected_mm) / 1000, atol=1e-12)


def test_everything_shown_before_goes_first_and_nothing_has_the_name_and_number_of_another() -> None:
    found = markers_of(SLICE, [(registration(), "one"), (registration(), "other")], HEADER, PointStamped()).markers
    assert [one.action for one in found] == [Marker.DELETEALL] + [Marker.ADD] * (len(found) - 1)
    keys = [(one.ns, one.id) for one in found[1:]]
    assert len(set(keys)) == len(keys)
    assert {one.ns for one in found[1:]} == {"slice", "target", "one", "other"}
    assert {one.header.frame_id for one in found} == {"scanner"}


def test_of_a_refused_frame_nothing_is_shown_but_the_slice() -> None:
    refusal = Refusal(FRAME, SliceSpots(np.zeros((0, 2)), SLICE.scale), "no_consensus", "", ())
    found = markers_of(SLICE, [(refusal, "three")], HEADER).markers
    assert [(one.action, one.ns) for one in found] == [(Marker.DELETEALL, ""), (Marker.ADD, "slice")]


def test_the_plane_goes_around_the_pixels_from_their_outer_edges() -> None:
    """20 columns of 0.5 mm along y of the scanner, 30 rows of 2 mm against its x, each 0.1 mm aside of the last."""
    (plane,) = shown(Marker.LINE_STRIP)
    left, top, right, bottom = -0.5, -0.5, 19.5, 29.5
    corners_px = [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]
    corners = [(0.5 * u + 0.1 * v, 2.0 * v) for u, v in corners_px]
    assert_points(plane.points, [[100 - y, 200 + x, 300.0] for x, y in corners])


def test_rods_stand_where_the_pose_has_them_as_long_and_thick_as_they_are() -> None:
    rods = shown(Marker.CYLINDER)
    assert len(rods) == 3
    for line, rod in enumerate(rods):
        pose = pose_from_message(PoseStamped(pose=rod.pose))
        np.testing.assert_allclose(pose.translation, POSE @ ((STARTS[line] + ENDS[line]) / 2), atol=1e-9)
        along = POSE.rotation @ (ENDS[line] - STARTS[line])
        length = float(np.linalg.norm(along))
        np.testing.assert_allclose(pose.rotation[:, 2], along / length, atol=1e-9)
        np.testing.assert_allclose(metres(rod.scale), np.array([line + 1.0, line + 1.0, length]) / 1000)


def test_only_a_rod_without_a_spot_is_red() -> None:
    assert ["red" if one.color.r > one.color.g else "green" for one in shown(Marker.CYLINDER)] == [
        "green",
        "red",
        "green",
    ]


def test_only_the_spots_of_rods_are_shown_where_they_lie_in_the_scanner() -> None:
    (spots,) = shown(Marker.SPHERE_LIST)
    # (4, 10) pixel are 2 mm and the tenth row's 1 mm along x of the slice, and 20 mm along its y.
    assert_points(spots.points, [[100 - 20, 200 + 3, 300.0], [100 - 40, 202.0, 300.0]])


@pytest.mark.parametrize("turn", range(8))
def test_the_ellipsoid_holds_95_percent_of_the_errors_at_the_point_that_counts(turn: int) -> None:
    """Standard deviations of 0.2, 0.5 and 1 mm along axes at right angles: 2.796 of each to either side."""
    axes = Rotation.from_rotvec(np.random.default_rng(turn).normal(size=3)).as_matrix()
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = axes @ np.diag([0.04, 0.25, 1.0]) @ axes.T
    (error,) = shown(Marker.SPHERE, covariance)
    pose = pose_from_message(PoseStamped(pose=error.pose))
    np.testing.assert_allclose(pose.translation, POSE @ np.array(TARGET), atol=1e-9)
    shape = pose.rotation @ np.diag(metres(error.scale) ** 2) @ pose.rotation.T
    expected = (2 * 2.7955 / 1000) ** 2 * covariance[:3, :3]
    np.testing.assert_allclose(shape, expected, rtol=1e-4, atol=1e-10)


def test_the_ellipsoid_of_a_turn_is_across_the_line_to_the_frames_origin() -> None:
    """An error of the rotation about z alone moves the point along z x arm, by the arm's length across z."""
    (error,) = shown(Marker.SPHERE, np.diag([0, 0, 0, 0, 0, 0.01**2]))
    pose = pose_from_message(PoseStamped(pose=error.pose))
    arm = POSE.rotation @ np.array(TARGET)
    way = np.cross([0.0, 0.0, 1.0], arm)
    size = metres(error.scale)
    longest = int(size.argmax())
    assert size[longest] == pytest.approx(2 * 2.7955 * 0.01 * np.linalg.norm(way) / 1000, rel=1e-4)
    assert abs(pose.rotation[:, longest] @ way) == pytest.approx(float(np.linalg.norm(way)), rel=1e-6)


def test_the_target_is_in_scanner_axes_as_it_came() -> None:
    target = PointStamped(point=Point(x=0.01, y=-0.02, z=0.3))
    found = markers_of(SLICE, [], HEADER, target).markers
    (sphere,) = (one for one in found if one.ns == "target")
    np.testing.assert_allclose(metres(sphere.pose.position), [0.01, -0.02, 0.3])
