"""How many matches as good as this one chance alone would bring.

A contrario (Desolneux, Moisan, Morel; Moisan and Stival 2004). Under chance, spots are independent and uniform around
the frame, as dense as they are found to be there. A hypothesis is a pose through three rods and three spots, and a
choice of further rods and spots. Given the three, the further spots lie where the pose predicts them, with a joint
covariance that holds both their own noise and that of the pose. A fit with residual chi-square q means that they fell
into the ellipsoid of that q; its volume over the area's power is the chance of that, the area being that over which so
many spots would be spread at this density. The expected number of hypotheses as good is that chance times the number of
hypotheses tried.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array

# A seed does not leave a direction of the pose wholly open: the squares of distances bound it (see
# `ThreeLineSolver._covariance`). Stated as standard deviations: of a rotation in rad, of a position in mm.
_OPEN_ROTATION = 0.1
_OPEN_POSITION = 10.0
# Chi-square of a perfect fit, to rounding; exact data must not make the number of false alarms vanish.
_LEAST_CHI_SQUARE = 1e-6


def clutter_area_mm2(spots_mm: Array, matched: NDArray[np.intp]) -> float:
    """Area in mm^2 over which the spots (s, 2) mm would be spread if they were everywhere as dense as around the frame.

    matched: rows of the k spots given to rods. Around the frame is half again as far as the matched spots reach. Spots
    counted there are the unmatched ones, all but three of the matched ones, as under chance they are clutter like the
    others, and one more, as none seen does not mean that there are none.
    """
    centre = spots_mm[matched].mean(axis=0)
    radius = 1.5 * float(np.linalg.norm(spots_mm[matched] - centre, axis=1).max())
    nearby = int((np.linalg.norm(spots_mm - centre, axis=1) <= radius).sum())
    return len(spots_mm) * math.pi * radius**2 / (nearby - 3 + 1)


def log10_false_alarms(
    inliers: int,
    spots: int,
    choices_of_rods: int,
    chi_square: float,
    information: Array,
    seed_information: Array,
    spot_variance_mm2: float,
    area_mm2: float,
    sizes_tried: int,
) -> float:
    """log10 of the expected number of matches by chance of `inliers` rods with a chi-square this low.

    spots: how many there are; choices_of_rods: over all poses of three rods and three spots that were looked at, the
    number of ways to choose the further rods among those that the pose has the slice cut; information,
    seed_information (6, 6): J'J of all matches, and of three of them; spot_variance_mm2: product of a spot's standard
    deviations in x and y; area_mm2: over which spots fall; sizes_tried: how many numbers of inliers would have been
    accepted.
    """
    further = inliers - 3
    openness = np.diag([_OPEN_POSITION**-2] * 3 + [_OPEN_ROTATION**-2] * 3)
    _, log_det = np.linalg.slogdet(information + openness)
    _, log_det_seed = np.linalg.slogdet(seed_information + openness)
    log_volume = (
        further * math.log(math.pi)
        - math.lgamma(further + 1)
        + further * math.log(max(chi_square, _LEAST_CHI_SQUARE))
        + 0.5 * (log_det - log_det_seed)
        + further * math.log(spot_variance_mm2)
    )
    log_chance = min(0.0, log_volume - further * math.log(area_mm2))
    log_choices = (
        math.log(max(choices_of_rods, 1))
        + math.lgamma(spots - 3 + 1)
        - math.lgamma(spots - inliers + 1)
        + math.log(sizes_tried)
    )
    return float((log_chance + log_choices) / math.log(10.0))
