"""An inspection in words and figures, for the shell and for a report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereoreg_ros.frames.ambiguity import Trial, reasons
from stereoreg_ros.frames.inspection import HANDEDNESS, Inspection, twins_of
from stereoreg_ros.geometry.pose import Array

_MOST_TWINS = 5


def table_of(inspection: Inspection) -> list[str]:
    """The lines of a table."""
    frame, options = inspection.frame, inspection.options
    rods = inspection.visible.sum(axis=1)
    target = ", ".join(f"{value:g}" for value in options.target_in_frame_mm)
    lines = [
        f"{frame.name}: {len(frame)} rods; {len(inspection.poses)} slices that show {options.min_inliers} or more, "
        f"{100 * inspection.shown:.0f} % of those that meet its sphere",
        f"assumed: spots to {options.spot_noise_px:g} pixel of {inspection.scale.sx:g} x {inspection.scale.sy:g} mm, "
        f"slices of {options.slice_thickness_mm:g} mm, {_tolerances(inspection)}, scale to "
        f"{100 * options.scale_tolerance:g} % (standard deviations)",
        "",
        "rods in a slice       " + ", ".join(f"{n}: {100 * np.mean(rods == n):.0f} %" for n in np.unique(rods)),
        "each rod is in        "
        + ", ".join(
            f"{name}: {100 * share:.0f} %"
            for name, share in zip(frame.line_names, inspection.visible.mean(axis=0), strict=True)
        ),
        "",
        "95 % error ball / mm           median    95 %   worst",
        f"  at the frame's origin      {_quantiles(inspection.error_origin_mm)}",
        f"  at the target ({target})".ljust(29) + _quantiles(inspection.error_target_mm),
        f"one slice's scale / %        {_quantiles(inspection.scale_std_percent)}   (standard deviation of sx or sy)",
        "",
        f"position, standard deviation along x, y, z of the frame: {_three(inspection.position_std_mm)} mm (median); "
        f"worst along {_three(inspection.weakest_axis)}",
        f"rotation, standard deviation about x, y, z of the frame: {_three(inspection.rotation_std_deg)} degrees "
        f"(median); worst about {_three(inspection.weakest_rotation_axis)}",
        "",
        "singular arrangements (Maurin 2009, section 3.1): "
        + (", ".join(f"{name} in {100 * share:.0f} %" for name, share in inspection.singular.items()) or "none"),
        f"registered, all rods there:   {_outcomes(inspection.whole)}",
        f"registered, one rod missing:  {_outcomes(inspection.one_missing)}",
    ]
    twins = twins_of([*inspection.whole, *inspection.one_missing])
    for twin in twins[:_MOST_TWINS]:
        lines.append(
            f"  twin, {twin['times']} times: {twin['rods']} ({twin['angle_deg']:.1f} degrees, "
            f"{twin['distance_mm']:.1f} mm away)"
        )
    if len(twins) > _MOST_TWINS:
        lines.append(f"  and {len(twins) - _MOST_TWINS} more twins")
    if frame.orientation_required:
        lines.append("orientation required: without a nominal orientation the frame is refused")
    lines.append(HANDEDNESS)
    return lines


def _tolerances(inspection: Inspection) -> str:
    """What the rods' ends were taken to be known to, and whether the frame file or the option says so."""
    names, tolerances = inspection.frame.line_names, inspection.tolerances_mm
    if (tolerances == tolerances[0]).all():
        listed = f"{tolerances[0]:g} mm"
    else:
        listed = ", ".join(f"{name} {one:g}" for name, one in zip(names, tolerances, strict=True)) + " mm"
    own = ~np.isnan(inspection.frame.tolerances_or(np.nan))
    source = "frame file" if own.all() else "frame_tolerance_mm" if not own.any() else "frame file, frame_tolerance_mm"
    return f"rods' ends to {listed} per axis ({source})"


def _quantiles(values: Array) -> str:
    three = (np.median(values), np.quantile(values, 0.95, method="higher"), values.max())
    return "  ".join(f"{value:6.2f}" if value < 1e4 else "  none" for value in three)


def _three(values: Array) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def _outcomes(made: Sequence[Trial]) -> str:
    if not made:
        return "not tried"
    counts = reasons(made)
    wrong = sum(not trial.reason and not trial.right for trial in made)
    listed = ", ".join(f"{100 * times / len(made):.1f} % {word}" for word, times in counts.most_common())
    return f"{listed}; {wrong} of {len(made)} accepted with a wrong rod"
