"""The scale slice by slice as a picture; needs matplotlib."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from stereoreg_ros.calibration.series import SeriesScale


def draw_series_scale(series: SeriesScale, path: Path) -> None:
    """Write a PNG: sx and sy from each slice with their standard errors, from all together, and as the files say."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    for axes, name in zip(figure.subplots(2, 1, sharex=True), ("sx", "sy"), strict=True):
        column = 0 if name == "sx" else 1
        number = range(1, len(series.slices) + 1)
        axes.errorbar(
            number,
            [getattr(one.newton_raphson, name) for one in series.slices],
            [one.standard_errors[column] for one in series.slices],
            fmt="o",
            color="tab:blue",
            capsize=3,
            label="each slice alone, Newton-Raphson",
        )
        linear = [getattr(one.linear, name) for one in series.slices]
        axes.plot(number, linear, "s", color="tab:orange", markersize=4, label="each slice alone, linear")
        axes.axhline(getattr(series.given, name), color="black", linestyle=":", label="as the files say")
        if series.outcome:
            joint, error = getattr(series.outcome.scale, name), series.outcome.standard_errors[column]
            axes.axhline(joint, color="tab:green", label="all slices together")
            axes.axhspan(joint - error, joint + error, color="tab:green", alpha=0.2)
        axes.set_ylabel(f"{name} / (mm/pixel)")
        axes.grid(alpha=0.3)
    figure.axes[0].legend(fontsize="small")
    figure.axes[1].set_xlabel("slice")
    figure.savefig(path, dpi=100)
