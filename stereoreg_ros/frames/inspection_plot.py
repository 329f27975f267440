"""A frame's rods in 3-D and where its errors are, as a picture; needs matplotlib."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D

from stereoreg_ros.frames.expected_error import Imaging, expected, point_covariances, pooled_error_95
from stereoreg_ros.frames.inspection import Inspection
from stereoreg_ros.frames.layouts import Layouts
from stereoreg_ros.geometry.pose import Array

_GRID, _MAP_POSES = 25, 32


def draw_inspection(inspection: Inspection, path: Path) -> None:
    """Write a PNG: the rods, the target error over the place of the target, and over tilt and height of the slice."""
    figure = Figure(figsize=(14, 4.8), layout="constrained")
    rods = figure.add_subplot(1, 3, 1, projection="3d")
    assert isinstance(rods, Axes3D)
    _draw_rods(rods, inspection)
    _draw_places(figure, figure.add_subplot(1, 3, 2), inspection)
    _draw_slices(figure, figure.add_subplot(1, 3, 3), inspection)
    figure.savefig(path, dpi=100)


def _draw_rods(axes: Axes3D, inspection: Inspection) -> None:
    frame = inspection.frame
    shares = inspection.visible.mean(axis=0)
    for name, start, end, share in zip(frame.line_names, frame.starts, frame.ends, shares, strict=True):
        axes.plot(*np.column_stack([start, end]), linewidth=2, label=f"{name}: in {100 * share:.0f} % of the slices")
        axes.text(*end, name)
    axes.set(xlabel="x / mm", ylabel="y / mm", zlabel="z / mm", title=f"{frame.name}, {len(frame)} rods")
    axes.set_aspect("equal")
    axes.legend(fontsize="x-small", loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=2)


def _draw_places(figure: Figure, axes: Axes, inspection: Inspection) -> None:
    """The 95 % error of a target in the plane z = 0 of the frame, over poses that show the frame."""
    frame, options = inspection.frame, inspection.options
    imaging = Imaging.of(inspection.scale, options)
    poses = inspection.poses.take(slice(_MAP_POSES))
    covariances = expected(Layouts.of(frame), poses, imaging).covariances
    ends = np.concatenate([frame.starts, frame.ends])
    target = np.array(options.target_in_frame_mm)
    reach = 1.2 * max(float(np.abs(ends[:, :2]).max()), float(np.abs(target[:2]).max()), 50.0)
    places = np.linspace(-reach, reach, _GRID)
    errors = np.array([[_pooled(covariances, poses.rotations, np.array([x, y, 0.0])) for x in places] for y in places])
    drawn = axes.contourf(places, places, errors, levels=12, cmap="viridis")
    figure.colorbar(drawn, ax=axes, label="95 % target error / mm")
    for start, end in zip(frame.starts, frame.ends, strict=True):
        axes.plot([start[0], end[0]], [start[1], end[1]], color="white", linewidth=1)
    axes.plot(target[0], target[1], "r*", markersize=12, label=f"target (z = {target[2]:g})")
    axes.set(xlabel="x / mm", ylabel="y / mm", title="target in the plane z = 0, all slices", aspect="equal")
    axes.legend(fontsize="small")


def _pooled(covariances: Array, rotations: Array, place: Array) -> float:
    return float(pooled_error_95(point_covariances(covariances, rotations, place))[0])


def _draw_slices(figure: Figure, axes: Axes, inspection: Inspection) -> None:
    errors = inspection.error_target_mm
    poses = inspection.poses
    top = float(np.quantile(errors, 0.95))
    drawn = axes.scatter(
        poses.heights_mm, poses.tilts_deg, c=errors, vmin=float(errors.min()), vmax=top, cmap="viridis"
    )
    figure.colorbar(drawn, ax=axes, extend="max", label="95 % target error / mm")
    axes.set(xlabel="slice above the frame's middle / mm", ylabel="tilt / degrees", title="each slice")
    axes.grid(alpha=0.3)
