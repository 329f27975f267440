"""`stereoreg reproduce`: every experiment of section 6, its plots and tables, the report. The file to read first."""

from __future__ import annotations

import time
from pathlib import Path

from stereoreg_ros.reproduction import (
    calibration_accuracy,
    efficiency,
    matching_time,
    plots,
    pose_accuracy,
    predicted_rods,
    scale_sequence,
    two_cubes,
)
from stereoreg_ros.reproduction.effort import Effort
from stereoreg_ros.reproduction.report import comparison_table, report
from stereoreg_ros.reproduction.table import Section


def reproduce(folder: Path, effort: Effort, seed: int) -> Path:
    """Write the report with its plots (PNG) and data (CSV) to an existing folder; returns the report's path.

    The same seed gives the same figures, times apart.
    """
    start = time.perf_counter()
    sections = [
        _calibration(folder, effort, seed),
        _pose(folder, effort, seed),
        _efficiency(effort, seed),
        _scale(folder, effort, seed),
        *_two_cubes(folder, effort, seed),
        _matching(folder, effort, seed),
    ]
    for section in sections:
        for table in section.tables:
            table.write(folder)
    comparison_table(sections).write(folder)
    path = folder / "report.md"
    minutes = (time.perf_counter() - start) / 60
    path.write_text(report(sections, effort, seed, minutes), encoding="utf-8")
    return path


def _calibration(folder: Path, effort: Effort, seed: int) -> Section:
    """Figs 6 and 7."""
    result = calibration_accuracy.measure(effort, seed)
    section = calibration_accuracy.section(result)
    plots.draw_calibration(result, folder / section.figures[0][0])
    return section


def _pose(folder: Path, effort: Effort, seed: int) -> Section:
    """Figs 8 and 9."""
    results = [pose_accuracy.measure(effort, seed, lines) for lines in (4, 8)]
    section = pose_accuracy.section(results)
    for result, (name, _) in zip(results, section.figures, strict=True):
        plots.draw_pose(result, folder / name)
    return section


def _efficiency(effort: Effort, seed: int) -> Section:
    results = [one for lines in efficiency.LINES for one in efficiency.measure(effort, seed, lines)]
    return efficiency.section(results, effort.efficiency_poses)


def _scale(folder: Path, effort: Effort, seed: int) -> Section:
    """Fig. 10."""
    result = scale_sequence.measure(effort, seed)
    section = scale_sequence.section(result)
    plots.draw_scale(result, folder / section.figures[0][0])
    return section


def _two_cubes(folder: Path, effort: Effort, seed: int) -> tuple[Section, Section]:
    """Table 1 with fig. 13, and fig. 12 from the slices with six lines."""
    offsets = []
    predictions = {}
    picture = None
    for rail in two_cubes.RAILS:
        slices = list(two_cubes.slices_of(rail, effort, seed))
        offsets.append(two_cubes.measure(rail, slices))
        if not rail.hidden:
            predictions[rail.name] = predicted_rods.measure(rail, slices)
            picture = picture or predicted_rods.pictured(slices, predictions[rail.name])
    section, predicted = two_cubes.section(offsets), predicted_rods.section(predictions)
    plots.draw_offsets(offsets, folder / section.figures[0][0])
    if picture is not None:
        plots.draw_predictions(*picture, folder / predicted.figures[0][0])
    return section, predicted


def _matching(folder: Path, effort: Effort, seed: int) -> Section:
    """Table 2."""
    results = matching_time.measure(effort, seed)
    section = matching_time.section(results)
    plots.draw_matching(results, folder / section.figures[0][0])
    return section
