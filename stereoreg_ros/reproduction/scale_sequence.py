"""Fig. 10: the scale from each slice of a rendered sequence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from tqdm import tqdm

from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.registration import register_slice
from stereoreg_ros.reproduction import paper
from stereoreg_ros.reproduction.calibration_accuracy import METHODS
from stereoreg_ros.reproduction.effort import Effort
from stereoreg_ros.reproduction.exact_rods import exact_options
from stereoreg_ros.reproduction.rods import FIRST_CUBE
from stereoreg_ros.reproduction.table import Cell, Comparison, Section, Table
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, centred_pose, render_slice
from stereoreg_ros.solvers.arrangement import DegenerateArrangementError

# As in the paper's images: 0.475 mm/pixel, slices of 0.5 mm.
SETTINGS: Final = ScannerSettings(scale=PixelScale(0.475, 0.475), slice_thickness_mm=0.5)
TILT: Final = (0.09, -0.12, 0.05)
TRAVEL_MM: Final = 42.0
OPTIONS: Final = exact_options(spot_noise_px=0.1)


@dataclass(frozen=True, eq=False)
class ScaleSequence:
    """What fig. 10 shows.

    slices: how many were rendered; numbers: (k,), those registered with all their rods; scales: by method (k, 2),
    their (sx, sy) in mm/pixel.
    """

    slices: int
    numbers: Array
    scales: dict[str, Array]


def measure(effort: Effort, seed: int) -> ScaleSequence:
    """Render the cube on its way through the slice, find and match its spots, calibrate from each slice alone."""
    rng = np.random.default_rng([seed, 10])
    middle = centred_pose(FIRST_CUBE, SETTINGS, rotation=rotation_exp(np.array(TILT)))
    numbers: list[int] = []
    scales: dict[str, list[tuple[float, float]]] = {name: [] for name in METHODS}
    travel = np.linspace(-0.5 * TRAVEL_MM, 0.5 * TRAVEL_MM, effort.sequence_slices)
    for number, z in enumerate(tqdm(travel, desc="fig. 10: scale", disable=None, leave=False)):
        pose = Pose(middle.rotation, middle.translation + np.array([0.0, 0.0, z]))
        ct_slice = render_slice([PlacedFrame(FIRST_CUBE, pose)], SETTINGS, rng)
        result = register_slice(ct_slice, FIRST_CUBE, OPTIONS)
        if not result or len(result.matches) < len(FIRST_CUBE):
            continue
        lines = np.array([match.line_index for match in result.matches])
        spots_px = np.array([match.spot_px for match in result.matches])
        try:
            found = {name: method(FIRST_CUBE, lines, spots_px) for name, method in METHODS.items()}
        except DegenerateArrangementError:
            continue
        numbers.append(number)
        for name, solution in found.items():
            scales[name].append((solution.scale.sx, solution.scale.sy))
    return ScaleSequence(
        effort.sequence_slices,
        np.array(numbers, dtype=np.float64),
        {name: np.array(values).reshape(-1, 2) for name, values in scales.items()},
    )


def section(result: ScaleSequence) -> Section:
    """The part of the report."""
    true = np.array([SETTINGS.scale.sx, SETTINGS.scale.sy])
    rows: list[tuple[Cell, ...]] = [
        (int(number), name, float(sx), float(sy))
        for row, number in enumerate(result.numbers)
        for name in METHODS
        for sx, sy in result.scales[name][row : row + 1]
    ]
    table = Table("figure_10_scale", ("slice", "method", "sx / (mm/pixel)", "sy / (mm/pixel)"), rows)
    comparisons = []
    for name in METHODS:
        scales = result.scales[name]
        off = np.abs(scales / true - 1).mean(axis=0) * 100
        std = scales.std(axis=0, ddof=1)
        in_paper = "" if name != "ML" else " (LS, N-R)"
        comparisons += [
            Comparison(
                f"mean error of sx, sy, {name} (fig. 10)",
                f"< {paper.SEQUENCE_ERROR_PERCENT:g} %{in_paper}",
                f"{off[0]:.2f} %, {off[1]:.2f} %",
                bool((off < paper.SEQUENCE_ERROR_PERCENT).all()),
            ),
            Comparison(
                f"sigma(sx), sigma(sy), {name} (fig. 10)",
                f"<= {paper.SEQUENCE_STD[0]:.0e}, {paper.SEQUENCE_STD[1]:.0e} mm/pixel{in_paper}",
                f"{std[0]:.1e}, {std[1]:.1e} mm/pixel",
                bool((std <= paper.SEQUENCE_STD).all()),
            ),
        ]
    text = f"""{result.slices} rendered slices (`{FIRST_CUBE.name}`, six rods, in its block, with a patient; 512 x
512 pixels of {SETTINGS.scale.sx:g} mm, slices of {SETTINGS.slice_thickness_mm:g} mm, noise {SETTINGS.noise_hu:g}
HU); the cube is tilted by the rotation vector {TILT} rad and moves by {TRAVEL_MM:g} mm in all. Spots come from
`find_spots` and matches from `register_slice`; then the scale from each slice alone is compared with the spacing it
was rendered with. {len(result.numbers)} of {result.slices} slices gave all six rods. The paper's real slices have
what these lack: a rail and a table, a detector, rods that are straight to 10 um."""
    return Section(
        "Scale from a sequence: fig. 10",
        text,
        comparisons,
        (table,),
        figures=(("figure_10_scale.png", "Scale from each slice; the line is the spacing it was rendered with"),),
    )
