"""The figures as PNG. The only module that needs matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.reproduction import calibration_accuracy, paper, pose_accuracy, scale_sequence, two_cubes
from stereoreg_ros.reproduction.calibration_accuracy import CalibrationAccuracy
from stereoreg_ros.reproduction.matching_time import MatchingTime
from stereoreg_ros.reproduction.pose_accuracy import PoseAccuracy
from stereoreg_ros.reproduction.predicted_rods import Prediction
from stereoreg_ros.reproduction.scale_sequence import ScaleSequence
from stereoreg_ros.reproduction.two_cubes import SECOND_IN_FIRST, RailOffsets

_DPI: Final = 100
_STYLES: Final = {
    "LS": ("tab:orange", "s"),
    "LS-SVD": ("tab:orange", "s"),
    "LS-SVD (DR)": ("tab:red", "v"),
    "LS-TZ": ("tab:purple", "^"),
    "N-R": ("tab:blue", "o"),
    "ML": ("tab:green", "x"),
}
_NOISE: Final = "amplitude of the uniform noise / pixel"


def draw_calibration(result: CalibrationAccuracy, path: Path) -> None:
    """Figs 6 and 7: four errors against the noise."""
    figure = Figure(figsize=(9, 7), layout="constrained")
    for column, (axes, error) in enumerate(zip(figure.subplots(2, 2).flat, calibration_accuracy.ERRORS, strict=True)):
        for name in calibration_accuracy.METHODS:
            _curve(axes, result.levels_px, result.mean[name][:, column], name)
        if column < 3:
            axes.plot(result.levels_px, result.bound[:, column], "k--", label="Cramer-Rao bound")
        _label(axes, _NOISE, f"mean error: {error}")
    _save(figure, f"Calibration, 8 lines, {result.poses} poses per level", path)


def draw_pose(result: PoseAccuracy, path: Path) -> None:
    """Fig. 8 or 9: three errors against the noise."""
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    for column, (axes, error) in enumerate(zip(figure.subplots(1, 3).flat, pose_accuracy.ERRORS, strict=True)):
        for name in pose_accuracy.METHODS:
            _curve(axes, result.levels_px, result.mean[name][:, column], name)
        highest = float(max(result.mean["N-R"][:, column].max(), result.mean["LS-SVD"][:, column].max()))
        if column < 2:
            axes.plot(result.levels_px, result.bound[:, column], "k--", label="Cramer-Rao bound")
            highest = max(highest, float(result.bound[:, column].max()))
            of_paper = (paper.POSE_CLOSED_FORM, paper.POSE_NEWTON_RAPHSON)
            for values, name in zip(of_paper, ("LS-SVD", "N-R"), strict=True):
                value = values[result.lines][column]
                axes.plot(paper.NOISE_PX, value, "*", color=_STYLES[name][0], markersize=13, markeredgecolor="k")
            axes.plot([], [], "*", color="w", markersize=13, markeredgecolor="k", label="the paper's text")
        # A single wrong root can carry a mean of LS-SVD (DR) away; the curves of the others shall stay readable.
        top = min(axes.get_ylim()[1], 1.5 * highest)
        axes.set_ylim(-0.02 * top, top)
        _label(axes, _NOISE, f"mean error: {error}")
    _save(figure, f"Pose, {result.lines} lines, {result.poses} poses per level", path)


def draw_scale(result: ScaleSequence, path: Path) -> None:
    """Fig. 10: sx and sy of each slice."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    true = (scale_sequence.SETTINGS.scale.sx, scale_sequence.SETTINGS.scale.sy)
    for column, (axes, axis) in enumerate(zip(figure.subplots(2, 1).flat, "xy", strict=True)):
        axes.axhline(true[column], color="k", linewidth=1, label="true")
        for name in calibration_accuracy.METHODS:
            _curve(axes, result.numbers, result.scales[name][:, column], name)
        axes.ticklabel_format(useOffset=False)
        _label(axes, "slice", f"s{axis} / (mm/pixel)")
    _save(figure, "Scale from each slice of a sequence", path)


def draw_offsets(results: list[RailOffsets], path: Path) -> None:
    """Fig. 13: the second cube's y in the first one's axes, slice by slice, for every rail."""
    figure = Figure(figsize=(12, 7), layout="constrained")
    for result, axes in zip(results, figure.subplots(2, (len(results) + 1) // 2).flat, strict=False):
        axes.axhline(SECOND_IN_FIRST.translation[1], color="k", linestyle=":", label="true")
        for name in two_cubes.METHODS:
            _curve(axes, result.numbers, result.offsets[name][:, 1], name)
        axes.ticklabel_format(useOffset=False)
        axes.set_title(f"{result.rail.name}, {result.rail.lines} lines")
        _label(axes, "slice", "relative position y / mm")
    _save(figure, "The second cube in the first one's axes", path)


def draw_predictions(ct_slice: Slice, predictions: list[Prediction], path: Path) -> None:
    """Fig. 12: boxes and spots over the slice, and each cube closer."""
    figure = Figure(figsize=(13, 5), layout="constrained")
    panels = figure.subplots(1, 1 + len(predictions))
    for number, axes in enumerate(np.atleast_1d(panels)):
        axes.imshow(ct_slice.hu, cmap="gray", vmin=-1000, vmax=3000)
        for one in predictions:
            for predicted, half in zip(one.predicted_px, one.half_px, strict=True):
                corner = predicted - half
                axes.add_patch(Rectangle(tuple(corner), *(2 * half), fill=False, edgecolor="yellow", linewidth=1))
            axes.plot(*one.spots_px.T, "r+", markersize=5)
        axes.set(xlabel="u / pixel", ylabel="v / pixel")
        if number:
            one = predictions[number - 1]
            low, high = one.spots_px.min(axis=0) - 12, one.spots_px.max(axis=0) + 12
            axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), title=f"{one.predicted_cube}, predicted")
    figure.suptitle(f"Error boxes for {paper.SPOT_ERROR_PX:g} pixel")
    figure.savefig(path, dpi=_DPI)


def draw_matching(results: list[MatchingTime], path: Path) -> None:
    """Table 2 as curves: seconds against the number of spots."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    for name in dict.fromkeys(one.method for one in results):
        chosen = [one for one in results if one.method == name]
        (line,) = axes.semilogy([one.spots for one in chosen], [one.median_s for one in chosen], "o-", label=name)
        guessed = [one for one in chosen if one.extrapolated]
        axes.semilogy(
            [one.spots for one in guessed],
            [one.median_s for one in guessed],
            "o",
            color=line.get_color(),
            markerfacecolor="w",
            markersize=9,
        )
    axes.semilogy([], [], "o", color="k", markerfacecolor="w", markersize=9, label="extrapolated")
    axes.set_xscale("log")
    spots = sorted({one.spots for one in results})
    axes.set_xticks(spots, [str(number) for number in spots], minor=False)
    axes.set_xticks([], minor=True)
    _label(axes, "spots, six of them true", "median time / s")
    _save(figure, "Time of the automatic matching", path, columns=3)


def _curve(axes: Axes, x: np.ndarray, y: np.ndarray, method: str) -> None:
    colour, marker = _STYLES[method]
    axes.plot(x, y, color=colour, marker=marker, markersize=5, linewidth=1, label=method)


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)


def _save(figure: Figure, title: str, path: Path, columns: int = 8) -> None:
    figure.suptitle(title)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(columns, len(labels)))
    figure.savefig(path, dpi=_DPI)
