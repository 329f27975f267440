"""How dense false spots are where the matched ones lie, of clutter that has order.

The chance model has clutter uniform over the slice. Fragments of a rod's spot crowd around it, a needle's spots lie on
a line, the holes of a template on a lattice: where such order is significant among the unmatched spots, a matched spot
that shares it is reckoned to be as likely as its order makes it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, gammainc

from stereoreg_ros.geometry.pose import Array

# More unmatched spots in a region than uniform clutter would bring so seldom are significant.
_CROWDED: Final = 0.01
# Fewer unmatched spots make no order.
_FEWEST: Final = 3
# Radius about a matched spot within which fragments of the rod's spot lie, and half the width of a line, mm.
_CLUMP_MM: Final = 6.0
_HALF_LINE_MM: Final = 0.75
# Pitches of a square lattice that are looked for, mm; a finer one is not told from none.
_FINEST_MM, _COARSEST_MM = 2.5, 25.0
# Steps of wave number, as phases over the spots' extent; how far, as a share of the pitch, a spot may be off a hole.
_PHASE_STEP, _OFF_HOLE = 0.25, 0.12
# Expected number of lattices as marked among so many wave numbers in uniform spots, below which there is one.
_LATTICE_BY_CHANCE: Final = 0.05
# So many spots nearest to the matched ones are looked at for a lattice.
_MOST_FOR_LATTICE: Final = 80


def matched_densities(spots_mm: Array, matched: NDArray[np.intp], area_mm2: float, in_order: bool = True) -> Array:
    """Density (k,) per mm^2 that false spots have where each of the matched spots lies.

    spots_mm: (s, 2); matched: (k,), rows of the spots given to rods; area_mm2: over which all are spread, if uniformly.
    At least the uniform density of all spots; more where unmatched spots crowd around the frame and, if `in_order`,
    around the matched spots, or lie with these on a line or on a lattice, where uniform clutter would do so less often
    than once in a hundred slices.
    """
    others = np.delete(spots_mm, matched, axis=0)
    own = spots_mm[matched]
    densities = np.full(len(own), len(spots_mm) / area_mm2)
    if len(others):
        for region in (_around_frame, _clumps, _lines, _lattice) if in_order else (_around_frame,):
            densities = np.maximum(densities, region(own, others, area_mm2))
    return densities


def _around_frame(own: Array, others: Array, area_mm2: float) -> Array:
    """Half again as far as the matched spots reach."""
    centre = own.mean(axis=0)
    radius = 1.5 * float(np.linalg.norm(own - centre, axis=1).max())
    nearby = int((np.linalg.norm(others - centre, axis=1) <= radius).sum())
    around = min(math.pi * radius**2, area_mm2)
    if _is_crowded(nearby, len(others) * around / area_mm2):
        return np.full(len(own), nearby / around)
    return np.zeros(len(own))


def _clumps(own: Array, others: Array, area_mm2: float) -> Array:
    """Around the matched spots themselves."""
    distance = np.linalg.norm(others[:, None] - own, axis=2)
    nearby = int((distance.min(axis=1) <= _CLUMP_MM).sum())
    around = len(own) * math.pi * _CLUMP_MM**2
    if nearby >= _FEWEST and _is_crowded(nearby, len(others) * min(around / area_mm2, 1.0)):
        return np.full(len(own), nearby / around)
    return np.zeros(len(own))


def _lines(own: Array, others: Array, area_mm2: float) -> Array:
    """On lines through two of the matched spots."""
    densities = np.zeros(len(own))
    first, second = np.triu_indices(len(own), 1)
    along = own[second] - own[first]
    length = np.linalg.norm(along, axis=1)
    apart = length > 2 * _CLUMP_MM
    if not apart.any():
        return densities
    first, along = first[apart], along[apart] / length[apart][:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)

    def is_on(points: Array) -> NDArray[np.bool_]:
        off = points[:, None] - own[first]
        return np.asarray(np.abs((off * across).sum(axis=2)) <= _HALF_LINE_MM)

    count = is_on(others).sum(axis=0)
    # As far as spots could lie.
    strip_mm2 = 2 * _HALF_LINE_MM * math.sqrt(area_mm2)
    expected = len(others) * strip_mm2 / area_mm2
    crowded = (count >= _FEWEST) & (gammainc(np.maximum(count, 1), expected) * len(count) < _CROWDED)
    if crowded.any():
        with_them = is_on(own)[:, crowded] * (count[crowded] / strip_mm2)
        densities = with_them.max(axis=1)
    return np.asarray(densities, dtype=np.float64)


def _lattice(own: Array, others: Array, area_mm2: float) -> Array:
    """On the holes of a square lattice."""
    none = np.zeros(len(own))
    if len(others) < _FEWEST:
        return none
    centre = own.mean(axis=0)
    nearest = np.argsort(np.linalg.norm(others - centre, axis=1), kind="stable")[:_MOST_FOR_LATTICE]
    others = others[nearest]
    points = np.concatenate([own, others]) - centre
    strongest = _strongest_wave(points)
    if strongest is None:
        return none
    wave = strongest
    count = len(points)
    pitch_mm = 1.0 / float(np.linalg.norm(wave))
    phases = points @ np.stack([wave, _turned(wave)], axis=1)
    origin = np.angle(np.exp(2j * np.pi * phases).sum(axis=0)) / (2 * np.pi)
    off = np.abs((phases - origin + 0.5) % 1.0 - 0.5)
    is_on = (off <= _OFF_HOLE).all(axis=1)
    share = (2 * _OFF_HOLE) ** 2
    on_holes = int(is_on[len(own) :].sum())
    if on_holes < _FEWEST or bdtrc(on_holes - 1, count - len(own), share) > _CROWDED:
        return none
    extent = np.maximum(np.ptp(points, axis=0) + pitch_mm, pitch_mm)
    holes_mm2 = share * float(extent.prod())
    return np.asarray(np.where(is_on[: len(own)], on_holes / holes_mm2, 0.0))


def _strongest_wave(points: Array) -> Array | None:
    """Wave number (2,) 1/mm of the square lattice that points (s, 2) mm follow best; None where that may be by chance.

    A lattice is followed as far as the phases of the points along its two axes agree. Of uniform points the squared
    sums of phases over the number of points are distributed exponentially, those of two axes by a Gamma law.
    """
    step = _PHASE_STEP / max(float(np.ptp(points, axis=0).max()), _FINEST_MM)
    ticks = step * np.arange(int(1.0 / _FINEST_MM / step) + 1)
    along_x, along_y = (np.exp(2j * np.pi * np.outer(ticks, points[:, axis])) for axis in (0, 1))
    # At (a, b) of the ticks the wave, and at right angles to it (-b, a).
    strength = np.abs(along_x @ along_y.T) ** 2 + np.abs(along_x.conj() @ along_y.T).T ** 2
    strength /= len(points)
    size = np.hypot(ticks[:, None], ticks)
    tried = (size <= 1.0 / _FINEST_MM) & (size >= 1.0 / _COARSEST_MM) & (ticks > 0)[:, None]
    strength[~tried] = 0.0
    row, column = np.unravel_index(int(strength.argmax()), strength.shape)
    most = float(strength[row, column])
    if tried.sum() * (1.0 + most) * math.exp(-most) > _LATTICE_BY_CHANCE:
        return None
    # Between the steps.
    offsets = step * np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 9)] * 2), axis=-1).reshape(-1, 2)
    fine = np.array([ticks[row], ticks[column]]) + offsets
    sums = sum(
        np.abs(np.exp(2j * np.pi * (waves @ points.T)).sum(axis=1)) ** 2
        for waves in (fine, np.stack([-fine[:, 1], fine[:, 0]], axis=1))
    )
    return np.asarray(fine[int(np.argmax(sums))])


def _turned(wave: Array) -> Array:
    return np.array([-wave[1], wave[0]])


def _is_crowded(count: int, expected: float) -> bool:
    """Whether so many are significantly more than expected, by a Poisson law."""
    return bool(count > 0 and gammainc(count, expected) < _CROWDED)
