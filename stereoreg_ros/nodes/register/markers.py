"""What RViz shows of one slice: its plane, the rods that were found, their spots, the error, the target."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import count
from typing import Final

import numpy as np
from geometry_msgs.msg import PointStamped, Vector3
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.nodes.common.conversions import MM_PER_M, point_from_message, point_to_message, pose_to_message
from stereoreg_ros.result import Refusal, Registration
from stereoreg_ros.uncertainty import point_covariance

_MATCHED: Final = (0.2, 0.8, 0.3, 1.0)
_MISSING: Final = (0.9, 0.3, 0.2, 1.0)
_SPOT: Final = (1.0, 0.8, 0.1, 1.0)
_PLANE: Final = (0.4, 0.6, 1.0, 1.0)
_TARGET: Final = (0.9, 0.2, 0.9, 1.0)
_ERROR: Final = (1.0, 0.6, 0.1, 0.4)
_SPOT_DIAMETER_MM: Final = 3.0
_TARGET_DIAMETER_MM: Final = 4.0
_THINNEST_MM: Final = 0.01
_CHI_SQUARE_3_AT_95: Final = 7.8147
_PLANE_WIDTH_MM: Final = 0.5


def markers_of(
    ct_slice: Slice,
    results: Sequence[tuple[Registration | Refusal, str]],
    header: Header,
    target: PointStamped | None = None,
) -> MarkerArray:
    """Markers in scanner axes, which need no TF, for each frame's result and the name of its axes.

    The slice's plane; of an accepted frame its rods (green: with a spot, red: without), the spots, and the ellipsoid
    that holds 95 % of the errors at `target_in_frame_mm`, in its true size; the target, in scanner axes. Everything
    shown before is removed.
    """
    shown = [Marker(header=header, action=Marker.DELETEALL), _named(_plane(ct_slice, header, 0), "slice")]
    if target is not None:
        shown.append(_named(_target(target, header), "target"))
    for result, name in results:
        if result:
            shown += [_named(marker, name) for marker in _frame(ct_slice, result, header)]
    return MarkerArray(markers=shown)


def _frame(ct_slice: Slice, result: Registration, header: Header) -> list[Marker]:
    numbers = count()
    matched = {match.line_index for match in result.matches}
    rods = [
        _rod(result, line, _MATCHED if line in matched else _MISSING, header, next(numbers))
        for line in range(len(result.frame))
    ]
    spots_px = np.array([match.spot_px for match in result.matches])
    spots = _spots(_in_scanner(ct_slice, spots_px), header, next(numbers))
    return [*rods, spots, _ellipsoid(result, header, next(numbers))]


def _named(marker: Marker, namespace: str) -> Marker:
    marker.ns = namespace
    return marker


def _target(target: PointStamped, header: Header) -> Marker:
    at = Pose(np.eye(3), point_from_message(target))
    return Marker(
        header=header,
        type=Marker.SPHERE,
        pose=pose_to_message(at),
        scale=_metres(_TARGET_DIAMETER_MM, _TARGET_DIAMETER_MM, _TARGET_DIAMETER_MM),
        color=_colour(_TARGET),
    )


def _ellipsoid(result: Registration, header: Header, number: int) -> Marker:
    """Where the point `target_in_frame_mm` is, with 95 % of its errors."""
    pose, point = result.scanner_from_frame, np.array(result.options.target_in_frame_mm)
    variances, axes = np.linalg.eigh(point_covariance(result.covariance, pose, point))
    axes = axes * np.sign(np.linalg.det(axes))
    diameters = 2 * np.sqrt(_CHI_SQUARE_3_AT_95 * np.maximum(variances, 0.0))
    return Marker(
        header=header,
        id=number,
        type=Marker.SPHERE,
        pose=pose_to_message(Pose(axes, pose @ point)),
        scale=_metres(*np.maximum(diameters, _THINNEST_MM)),
        color=_colour(_ERROR),
    )


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
