"""Fig. 12: the rods of one cube predicted from the registration of the other, with boxes that bound the error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, skew
from stereoreg_ros.geometry.projection import project, projection_jacobian
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.reproduction import paper
from stereoreg_ros.reproduction.table import Cell, Comparison, Section, Table
from stereoreg_ros.reproduction.two_cubes import SECOND_IN_FIRST, SETTINGS, Rail, RailSlice
from stereoreg_ros.result import Registration

_BOTH_WAYS: Final = ((0, 1, SECOND_IN_FIRST), (1, 0, SECOND_IN_FIRST.inverse()))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Spots of one cube as the other one's registration has them, in one slice.

    line_names: of the predicted cube's rods (n,); predicted_px, spots_px: (n, 2); half_px: (n, 2), half sides of the
    boxes.
    """

    rail: str
    slice_number: int
    predicted_cube: str
    line_names: tuple[str, ...]
    predicted_px: Array
    spots_px: Array
    half_px: Array

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(n,): which spots lie inside their boxes."""
        off = np.abs(self.spots_px - self.predicted_px)
        return np.asarray((off <= self.half_px).all(axis=1))

    @property
    def half_mm(self) -> Array:
        """Half sides of the boxes (n, 2) mm."""
        half: Array = self.half_px * [SETTINGS.scale.sx, SETTINGS.scale.sy]
        return half


def predict(known: Registration, other: Frame, known_from_other: Pose) -> tuple[Array, Array]:
    """Spots (n, 2) in pixel of the other cube's rods, and half sides (n, 2) in pixel of their error boxes.

    The registration's spots are supposed to be off by at most 0.25 pixel in each coordinate. To first order the pose
    moves by (J'J)^-1 J' dE and a predicted coordinate by a row g of (its Jacobian times that); over the box of dE, its
    extremes are +- sum |g| * 0.25.
    """
    slice_from_known = known.estimate.slice_from_frame
    lines = np.array([match.line_index for match in known.matches])
    _, cuts = project(known.frame, slice_from_known, known.scale)
    jacobian = projection_jacobian(cuts, slice_from_known, known.scale)[0][lines].reshape(-1, 6)
    pose_by_spots = np.linalg.pinv(jacobian)
    slice_from_other = slice_from_known @ known_from_other
    # The known cube's perturbation (p, w) turns the other one about the known one's origin.
    carried = np.eye(6)
    carried[:3, 3:] = -skew(slice_from_other.translation - slice_from_known.translation)
    predicted_px, other_cuts = project(other, slice_from_other, known.scale)
    by_pose = projection_jacobian(other_cuts, slice_from_other, known.scale)[0]
    by_spots = by_pose @ carried @ pose_by_spots
    return predicted_px, np.abs(by_spots).sum(axis=-1) * paper.SPOT_ERROR_PX


def measure(rail: Rail, slices: list[RailSlice]) -> list[Prediction]:
    """Predict both ways in every slice in which both cubes are registered."""
    predictions = []
    for one in slices:
        for known, predicted, known_from_other in _BOTH_WAYS:
            by, of = one.results[known], one.results[predicted]
            if not by or not of:
                continue
            predicted_px, half_px = predict(by, of.frame, known_from_other)
            lines = [match.line_index for match in of.matches]
            predictions.append(
                Prediction(
                    rail.name,
                    one.number,
                    of.frame.name,
                    tuple(match.line for match in of.matches),
                    predicted_px[lines],
                    np.array([match.spot_px for match in of.matches]),
                    half_px[lines],
                )
            )
    return predictions


def section(by_rail: dict[str, list[Prediction]]) -> Section:
    """The part of the report. by_rail: the predictions, by the cubes' names."""
    rows: list[tuple[Cell, ...]] = []
    comparisons = []
    for name, predictions in by_rail.items():
        for one in predictions:
            for row, line in enumerate(one.line_names):
                u, v = map(float, one.predicted_px[row])
                spot_u, spot_v = map(float, one.spots_px[row])
                half_x, half_y = map(float, one.half_mm[row])
                rows.append(
                    (
                        one.rail,
                        one.slice_number,
                        one.predicted_cube,
                        line,
                        u,
                        v,
                        spot_u,
                        spot_v,
                        half_x,
                        half_y,
                        int(one.inside[row]),
                    )
                )
        inside = np.concatenate([one.inside for one in predictions])
        bounds = np.concatenate([one.half_mm.max(axis=1) for one in predictions])
        largest, typical = float(bounds.max()), float(np.median(bounds))
        off = np.concatenate([one.spots_px - one.predicted_px for one in predictions]) * SETTINGS.scale.sx
        comparisons.append(
            Comparison(
                f"{name}: predicted spots inside their boxes; largest bound (fig. 12)",
                f"all; {paper.BOX_MM:g} mm",
                f"{int(inside.sum())} of {len(inside)}; {largest:.2f} mm (median {typical:.2f} mm, "
                f"{int((bounds <= paper.BOX_MM).sum())} within {paper.BOX_MM:g} mm; largest true error "
                f"{float(np.linalg.norm(off, axis=1).max()):.2f} mm)",
                bool(inside.all() and largest <= paper.BOX_MM),
            )
        )
    table = Table(
        "figure_12_predicted_rods",
        (
            "cubes",
            "slice",
            "predicted cube",
            "rod",
            "predicted u / pixel",
            "predicted v / pixel",
            "u / pixel",
            "v / pixel",
            "half side x / mm",
            "half side y / mm",
            "inside",
        ),
        rows,
    )
    text = f"""The same slices with six rods. The registration of each cube and the known offset predict the spots
of the other. The boxes contain these spots if no spot of the registered cube is off by more than
{paper.SPOT_ERROR_PX:g} pixel in any coordinate (closed form over a box, through the sensitivity of the
maximum-likelihood pose). A bound is half the longer side of a box. The spots found in rendered slices are accurate
to about 0.02 pixel, so they lie well inside. A box assumes that all twelve coordinates are off by the maximum and
in the worst combination. Its size depends on the frame: the smaller the cube, the larger the box 118 mm away. The
paper does not say whether its 2 mm are half a side or a whole one."""
    return Section(
        "Rods of one cube predicted from the other: fig. 12",
        text,
        comparisons,
        (table,),
        figures=(
            ("figure_12_predicted_rods.png", "The middle slice: boxes predicted from the other cube, spots as crosses"),
        ),
    )


def pictured(slices: list[RailSlice], predictions: list[Prediction]) -> tuple[Slice, list[Prediction]]:
    """The slice nearest to the middle of the sequence that has predictions, and these."""
    numbers = sorted({one.slice_number for one in predictions}, key=lambda number: abs(2 * number - len(slices) + 1))
    chosen = next(one for one in slices if one.number == numbers[0])
    return chosen.ct_slice, [one for one in predictions if one.slice_number == chosen.number]
