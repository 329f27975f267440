"""How many matches as good as this one chance alone would bring.

A contrario (Desolneux, Moisan, Morel; Moisan and Stival 2004). Under chance, spots are independent and uniform over an
area A. A match of k rods with a chi-square q means that k of the n spots, in an order, lie near the surface that the
poses make in the space of 2k coordinates: within the ball across it, of 2k - 6 dimensions and of radius sqrt(q) sigma.
The allowed false alarms are spread evenly over the poses' volume V (see `matching.pose_volume`), of which a piece is
moved to a piece of the surface sqrt det J'J times as large. So chance brings

    n! / (n - k)!  A^-k  V sqrt det J'J  pi^(k - 3) / (k - 3)!  (q sigma^2)^(k - 3)

matches that are as good: see docs/matching.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from stereoreg_ros.geometry.pose import Array

# Chi-square of a perfect fit, to rounding; exact data must not make the number of false alarms vanish.
_LEAST_CHI_SQUARE = 1e-6
_LEAST_AREA_MM2 = 100.0
_FEWEST, _SHARE_OF_FEWEST, _SHARE_OF_MORE = 4, 0.01, 0.125
# How seldom a true match has a residual as small as that by which a search for one is held to be hopeless.
_LUCK = 0.01


@dataclass(frozen=True)
class Chance:
    """What decides how much chance brings.

    spots: how many there are; area_mm2: over which they fall; variance_mm2: product of a spot's standard deviations in
    x and y; measure_mm6: V sqrt det J'J, what the surface of the poses measures if it is everywhere as stretched.
    """

    spots: int
    area_mm2: float
    variance_mm2: float
    measure_mm6: float


def log10_expected(inliers: int, chi_square: float, chance: Chance) -> float:
    """log10 of the expected number of matches of `inliers` rods by chance, with a chi-square this low."""
    further = inliers - 3
    if inliers > chance.spots or chance.measure_mm6 <= 0:
        return -math.inf
    log_volume = (
        math.log(chance.measure_mm6)
        + further * math.log(math.pi * max(chi_square, _LEAST_CHI_SQUARE) * chance.variance_mm2)
        - math.lgamma(further + 1)
    )
    log_probability = log_volume - inliers * math.log(chance.area_mm2)
    log_orders = math.lgamma(chance.spots + 1) - math.lgamma(chance.spots - inliers + 1)
    return (log_probability + log_orders) / math.log(10.0)


def lucky_chi_square(inliers: int) -> float:
    """Chi-square that a true match of `inliers` rods is hardly ever below: once in a hundred."""
    return 2 * float(gammaincinv(inliers - 3, _LUCK))


def most_chi_square_of(inliers: int, decades: float) -> float:
    """The chi-square at which matches by chance are 10^decades times as frequent as at `lucky_chi_square`.

    They grow as the power inliers - 3 of chi-square, see `log10_expected`.
    """
    return lucky_chi_square(inliers) * float(10.0 ** (decades / (inliers - 3)))


def area_of_uniform_mm2(spots_mm: Array, slice_area_mm2: float | None) -> float:
    """Area in mm^2 over which uniform spots (s, 2) mm fall: the slice's.

    Where that is not known, spots uniform in a rectangle leave a margin of it empty, on average 1 / (s + 1) of each
    side: it is taken to be that much larger than the box around them.
    """
    count = len(spots_mm)
    width, height = np.ptp(spots_mm, axis=0)
    box = float(width * height) * ((count + 1) / (count - 1)) ** 2
    return max(slice_area_mm2 or box, _LEAST_AREA_MM2)


def share_of(inliers: int, lines: int) -> float:
    """Share of the allowed false alarms that matches of `inliers` of the frame's rods get; all shares sum to one.

    From five rods on each number gets an eighth of the one below: each rod more makes chance matches a thousand times
    rarer, so that less of the allowance is needed. Four rods have but one to confirm them and can hardly ever be told
    from chance: they get a hundredth.
    """
    if inliers == _FEWEST:
        return 1.0 if lines == _FEWEST else _SHARE_OF_FEWEST
    total = sum(_SHARE_OF_MORE**step for step in range(lines - _FEWEST))
    return (1.0 - _SHARE_OF_FEWEST) * _SHARE_OF_MORE ** (inliers - _FEWEST - 1) / total
