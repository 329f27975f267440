"""What RViz shows of one slice: the rods where they were found, the spots they rest on, the slice's plane."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import count
from typing import Final

import numpy as np
from geometry_msgs.msg import Vector3
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.nodes.conversions import MM_PER_M, point_to_message, pose_to_message
from stereoreg_ros.result import Refusal, Registration

_MATCHED: Final = (0.2, 0.8, 0.3, 1.0)
_MISSING: Final = (0.9, 0.3, 0.2, 1.0)
_SPOT: Final = (1.0, 0.8, 0.1, 1.0)
_PLANE: Final = (0.4, 0.6, 1.0, 1.0)
_SPOT_DIAMETER_MM: Final = 3.0
_PLANE_WIDTH_MM: Final = 0.5


def markers_of(ct_slice: Slice, result: Registration | Refusal, header: Header, fiducial_frame_id: str) -> MarkerArray:
    """Markers in scanner axes, which need no TF: rods (green: with a spot, red: without), spots and the slice's plane.

    A refused slice shows its plane only. Everything shown before is removed.
    """
    numbers = count()
    shown = [Marker(header=header, action=Marker.DELETEALL), _plane(ct_slice, header, next(numbers))]
    if result:
        matched = {match.line_index for match in result.matches}
        for line in range(len(result.frame)):
            colour = _MATCHED if line in matched else _MISSING
            shown.append(_rod(result, line, colour, header, next(numbers)))
        spots_px = np.array([match.spot_px for match in result.matches])
        shown.append(_spots(_in_scanner(ct_slice, spots_px), header, next(numbers)))
    for marker in shown:
        marker.ns = fiducial_frame_id
    return MarkerArray(markers=shown)


def _rod(
    result: Registration, line: int, colour: tuple[float, float, float, float], header: Header, number: int
) -> Marker:
    frame = result.frame
    middle, axis = 0.5 * (frame.starts[line] + frame.ends[line]), frame.directions[line]
    # RViz draws cylinders along z; of all turns of z onto the rod any does.
    side = np.cross(np.eye(3)[int(np.abs(axis).argmin())], axis)
    side /= np.linalg.norm(side)
    frame_from_rod = Pose(np.column_stack([side, np.cross(axis, side), axis]), middle)
    length = float(np.linalg.norm(frame.ends[line] - frame.starts[line]))
    diameter = float(frame.diameters[line])
    return Marker(
        header=header,
        id=number,
        type=Marker.CYLINDER,
        pose=pose_to_message(result.scanner_from_frame @ frame_from_rod),
        scale=_metres(diameter, diameter, length),
        color=_colour(colour),
    )


def _spots(points_mm: Array, header: Header, number: int) -> Marker:
    return Marker(
        header=header,
        id=number,
        type=Marker.SPHERE_LIST,
        pose=pose_to_message(Pose.identity()),
        scale=_metres(_SPOT_DIAMETER_MM, _SPOT_DIAMETER_MM, _SPOT_DIAMETER_MM),
        color=_colour(_SPOT),
        points=[point_to_message(point) for point in points_mm],
    )


def _plane(ct_slice: Slice, header: Header, number: int) -> Marker:
    rows, columns = ct_slice.hu.shape
    corners_px = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows], [0, 0]]) - 0.5
    return Marker(
        header=header,
        id=number,
        type=Marker.LINE_STRIP,
        pose=pose_to_message(Pose.identity()),
        scale=_metres(_PLANE_WIDTH_MM, 0.0, 0.0),
        color=_colour(_PLANE),
        points=[point_to_message(point) for point in _in_scanner(ct_slice, corners_px)],
    )


def _in_scanner(ct_slice: Slice, points_px: Array) -> Array:
    points_mm = np.zeros((len(points_px), 3))
    points_mm[:, :2] = ct_slice.scale.to_mm(points_px)
    return ct_slice.scanner_from_slice @ points_mm


def _metres(x_mm: float, y_mm: float, z_mm: float) -> Vector3:
    return Vector3(x=x_mm / MM_PER_M, y=y_mm / MM_PER_M, z=z_mm / MM_PER_M)


def _colour(rgba: Iterable[float]) -> ColorRGBA:
    r, g, b, a = rgba
    return ColorRGBA(r=r, g=g, b=b, a=a)
