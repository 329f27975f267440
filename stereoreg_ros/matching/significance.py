"""How many matches as good as this one chance alone would bring.

A contrario (Desolneux, Moisan, Morel; Moisan and Stival 2004). Under chance, spots are independent and uniform over an
area. A hypothesis is a seed, a pose through three rods and three spots, and a choice of further rods that the pose has
the slice cut, with a spot for each. Given the seed, the further spots lie where it predicts them, with a joint
covariance that holds both their own noise and that of the seed. A fit with residual chi-square q means that they fell
into the ellipsoid of that q; its volume over the area's power is the chance of that. The expected number of hypotheses
as good is that chance times the number of hypotheses there are: the seeds that were found, each with its choices.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc, gammaincinv

from stereoreg_ros.geometry.pose import Array

# A rod that leaves the slice at less than 11.5 degrees (sine 0.2) has a streak for a spot: neither sought nor counted.
LEAST_COSINE = 0.2
# A seed does not leave a direction of the pose wholly open: the squares of distances bound it (see
# `ThreeLineSolver._covariance`). Stated as standard deviations: of a rotation in rad, of a position in mm.
_OPEN_ROTATION = 0.1
_OPEN_POSITION = 10.0
# Chi-square of a perfect fit, to rounding; exact data must not make the number of false alarms vanish.
_LEAST_CHI_SQUARE = 1e-6
_LEAST_AREA_MM2 = 100.0
# Clutter around the frame that uniform clutter would bring less often than this is taken to be denser there.
_CROWDED = 0.01
_FEWEST, _SHARE_OF_FEWEST, _SHARE_OF_MORE = 4, 0.01, 0.125
# How seldom a true match has a residual as small as that by which a search for one is held to be hopeless.
_LUCK = 0.01


def log10_false_alarms(
    inliers: int,
    spots: int,
    choices_of_rods: int,
    chi_square: float,
    information: Array,
    seed_information: Array,
    spot_variance_mm2: float,
    area_mm2: float,
    share: float,
) -> float:
    """log10 of the expected number of matches by chance of `inliers` rods with a chi-square this low.

    spots: how many there are; choices_of_rods: over all seeds, the number of ways to choose the further rods among
    those that the seed has the slice cut; information, seed_information (6, 6): J'J of all matches, and of three of
    them; spot_variance_mm2: product of a spot's standard deviations in x and y; area_mm2: over which spots fall;
    share: of all false alarms that are allowed, those for this number of inliers.
    """
    openness = np.diag([_OPEN_POSITION**-2] * 3 + [_OPEN_ROTATION**-2] * 3)
    _, (log_det, log_det_seed) = np.linalg.slogdet(np.stack([information, seed_information]) + openness)
    log_stretch = 0.5 * (log_det - log_det_seed)
    return _log10_expected(inliers, spots, choices_of_rods, chi_square, log_stretch, spot_variance_mm2, area_mm2, share)


def _log10_expected(
    inliers: int,
    spots: int,
    choices_of_rods: int,
    chi_square: float,
    log_stretch: float,
    spot_variance_mm2: float,
    area_mm2: float,
    share: float,
) -> float:
    """As `log10_false_alarms`; log_stretch: log of how many times larger than by the spots' own noise the ellipsoid is
    in which the further spots are expected, by the noise of the seed.
    """
    further = inliers - 3
    log_volume = (
        further * math.log(math.pi * max(chi_square, _LEAST_CHI_SQUARE) * spot_variance_mm2)
        - math.lgamma(further + 1)
        + log_stretch
    )
    log_chance = min(0.0, log_volume - further * math.log(area_mm2))
    log_choices = (
        math.log(max(choices_of_rods, 1))
        + math.lgamma(spots - 3 + 1)
        - math.lgamma(spots - inliers + 1)
        - math.log(share)
    )
    return float((log_chance + log_choices) / math.log(10.0))


def least_log10_false_alarms(
    inliers: int, lines: int, spots: int, seeds_by_visible: NDArray[np.int64], variance_mm2: float, area_mm2: float
) -> float:
    """What log10_false_alarms of a true match of so many rods is hardly ever below: once in a hundred.

    seeds_by_visible: of the seeds found so far; lines: of the frame; the others as in `log10_false_alarms`.
    """
    return _log10_expected(
        inliers=inliers,
        spots=spots,
        choices_of_rods=choices_of_rods(seeds_by_visible, inliers),
        chi_square=2 * float(gammaincinv(inliers - 3, _LUCK)),
        log_stretch=0.0,
        spot_variance_mm2=variance_mm2,
        area_mm2=area_mm2,
        share=share_of(inliers, lines),
    )


def choices_of_rods(seeds_by_visible: NDArray[np.int64], inliers: int) -> int:
    """Over all seeds, the number of ways to choose the further rods of a match of so many.

    seeds_by_visible: at v, how many seeds have the slice cut v rods besides their own three.
    """
    return sum(int(seeds) * math.comb(visible, inliers - 3) for visible, seeds in enumerate(seeds_by_visible))


def area_of_uniform_mm2(spots_mm: Array, slice_area_mm2: float | None) -> float:
    """Area in mm^2 over which uniform spots (s, 2) mm fall: the slice's.

    Where that is not known, spots uniform in a rectangle leave a margin of it empty, on average 1 / (s + 1) of each
    side: it is taken to be that much larger than the box around them.
    """
    count = len(spots_mm)
    width, height = np.ptp(spots_mm, axis=0)
    box = float(width * height) * ((count + 1) / (count - 1)) ** 2
    return max(slice_area_mm2 or box, _LEAST_AREA_MM2)


def clutter_area_mm2(spots_mm: Array, matched: NDArray[np.intp], slice_area_mm2: float | None) -> float:
    """Area in mm^2 over which the spots (s, 2) mm would be spread if they were everywhere as dense as around the frame.

    matched: rows of the k spots given to rods; slice_area_mm2: see `area_of_uniform_mm2`.
    Around the frame (half again as far as the matched spots reach) clutter can be denser than elsewhere: where
    there are more unmatched spots than uniform ones would be once in a hundred slices, their density is taken.
    """
    count = len(spots_mm)
    everywhere = area_of_uniform_mm2(spots_mm, slice_area_mm2)
    centre = spots_mm[matched].mean(axis=0)
    radius = 1.5 * float(np.linalg.norm(spots_mm[matched] - centre, axis=1).max())
    nearby = int((np.linalg.norm(spots_mm - centre, axis=1) <= radius).sum()) - len(matched)
    around = min(math.pi * radius**2, everywhere)
    expected = (count - len(matched)) * around / everywhere
    # Probability of `nearby` or more by a Poisson law of that mean.
    if nearby > 0 and gammainc(nearby, expected) < _CROWDED:
        return min(everywhere, count * around / nearby)
    return everywhere


def share_of(inliers: int, lines: int) -> float:
    """Share of the allowed false alarms that matches of so many of the frame's rods get; all shares sum to one.

    From five rods on each number gets an eighth of the one below: each rod more makes chance matches a thousand times
    rarer, so that less of the allowance is needed. Four rods have but one to confirm them and can hardly ever be told
    from chance: they get a hundredth.
    """
    if inliers == _FEWEST:
        return 1.0 if lines == _FEWEST else _SHARE_OF_FEWEST
    total = sum(_SHARE_OF_MORE**step for step in range(lines - _FEWEST))
    return (1.0 - _SHARE_OF_FEWEST) * _SHARE_OF_MORE ** (inliers - _FEWEST - 1) / total
