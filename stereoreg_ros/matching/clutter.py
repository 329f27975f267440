"""How dense false spots are where the matched ones lie, of clutter that has order.

The chance model has clutter uniform over the slice. Fragments of a rod's spot crowd around it, a needle's spots lie on
a line, the holes of a template on a lattice: where such order is significant among the unmatched spots, a matched spot
that shares it is reckoned to be as likely as its order makes it.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
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
# How far the pieces of a spot lie from each other, mm per axis; shares of the unmatched spots that may be pieces.
_PIECE_MM: Final = 2.0
_PIECE_SHARES: Final = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
# Pitches of a square lattice that are looked for, mm; a finer one cannot be distinguished from uniform clutter.
_FINEST_MM, _COARSEST_MM = 2.5, 25.0
# Steps of wave number, as phases over the spots' extent; how far, as a share of the pitch, a spot may be off a hole.
_PHASE_STEP, _OFF_HOLE = 0.4, 0.12
# Expected number of lattices as marked among all wave numbers tried in uniform spots, below which there is one.
_LATTICE_BY_CHANCE: Final = 0.05
# Of lattices followed by this share of the best one's strength, the coarsest is meant.
_AS_WELL: Final = 0.7
_COMPLEX: Final = np.array([1.0, 1.0j])
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


def likeness_to_pieces(spots_mm: Array, matched: NDArray[np.intp], area_mm2: float) -> float:
    """By how much (log-likelihood) unmatched spots look like pieces of the matched ones, over lying anywhere.

    Some share of them are pieces, whichever, or none. A spot that has fallen to pieces has its centre at none of them.
    Arguments: see `matched_densities`.
    """
    others = np.delete(spots_mm, matched, axis=0)
    squared = ((others[:, None] - spots_mm[matched]) ** 2).sum(axis=2)
    # Student's distribution of two degrees of freedom, in the plane.
    beside = ((1.0 + squared / (2 * _PIECE_MM**2)) ** -2 / (2 * math.pi * _PIECE_MM**2)).mean(axis=1)
    # Uniform over the area, whatever their number.
    of_shares = np.log1p(_PIECE_SHARES[:, None] * (beside * area_mm2 - 1.0)).sum(axis=1)
    return float(np.logaddexp.reduce(of_shares) - math.log(len(of_shares)))


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

    def off_lines(points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """How far along each line points (p, 2) lie, and whether they are on it: (p, lines) each."""
        off = points[:, None] - own[first]
        return (off * along).sum(axis=2), np.abs((off * across).sum(axis=2)) <= _HALF_LINE_MM

    place, is_on = off_lines(others)
    count = is_on.sum(axis=0)
    # As far as spots could lie.
    strip_mm2 = 2 * _HALF_LINE_MM * math.sqrt(area_mm2)
    expected = len(others) * strip_mm2 / area_mm2
    crowded = (count >= _FEWEST) & (gammainc(np.maximum(count, 1), expected) * len(count) < _CROWDED)
    if not crowded.any():
        return densities
    count, is_on, place = count[crowded], is_on[:, crowded], place[:, crowded]
    # The row ends somewhere: as far beyond its last spots as these are apart, there may be one more.
    low, high = np.where(is_on, place, np.inf).min(axis=0), np.where(is_on, place, -np.inf).max(axis=0)
    apart_mm = (high - low) / (count - 1)
    own_place, own_on = (part[:, crowded] for part in off_lines(own))
    within = (own_place >= low - apart_mm - _HALF_LINE_MM) & (own_place <= high + apart_mm + _HALF_LINE_MM)
    of_row = count / (2 * _HALF_LINE_MM * (high - low + 2 * apart_mm + 2 * _HALF_LINE_MM))
    with_them = np.where(own_on, np.where(within, np.maximum(of_row, count / strip_mm2), count / strip_mm2), 0.0)
    return np.asarray(with_them.max(axis=1), dtype=np.float64)


def _lattice(own: Array, others: Array, area_mm2: float) -> Array:
    """On the holes of a square lattice, as a template's: the matched spots may be some of these, and count as spots."""
    none = np.zeros(len(own))
    centre = own.mean(axis=0)
    nearest = np.argsort(np.linalg.norm(others - centre, axis=1), kind="stable")[:_MOST_FOR_LATTICE]
    points = np.concatenate([own, others[nearest]]) - centre
    wave = _strongest_wave(points)
    if wave is None:
        return none
    # Places as complex numbers: a lattice's rows and columns are those, turned, scaled and shifted.
    places, turned = points @ _COMPLEX, complex(wave[0], -wave[1])
    shift = _common_phase(turned * places)
    is_on = _is_on_hole(turned * places - shift)
    if is_on.sum() < _FEWEST:
        return none
    # Spots off the lattice have pulled at it.
    turned, shift = _fitted(places[is_on], _nearest_hole((turned * places - shift)[is_on]))
    is_on = _is_on_hole(turned * places - shift)
    share = (2 * _OFF_HOLE) ** 2
    on_holes = int(is_on[len(own) :].sum())
    if on_holes < _FEWEST or bdtrc(on_holes - 1, len(nearest), share) > _CROWDED:
        return none
    holes = _nearest_hole((turned * places - shift)[len(own) :][is_on[len(own) :]])
    if min(len(np.unique(holes.real)), len(np.unique(holes.imag))) < _FEWEST:
        return none  # spots along a line mark no rows beside it
    extent = np.ptp(points, axis=0) + 1.0 / abs(turned)
    density = on_holes / (share * float(extent.prod()))
    return np.asarray(np.where(is_on[: len(own)], density, 0.0))


def _nearest_hole(places: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Row and column of the hole nearest to places (n,), in units of the pitch."""
    return np.asarray(np.rint(places.real) + 1j * np.rint(places.imag))


def _is_on_hole(places: NDArray[np.complex128]) -> NDArray[np.bool_]:
    """Which places (n,), in units of the pitch, are near a hole."""
    off = places - _nearest_hole(places)
    return np.asarray((np.abs(off.real) <= _OFF_HOLE) & (np.abs(off.imag) <= _OFF_HOLE))


def _common_phase(places: NDArray[np.complex128]) -> complex:
    """By how much most places (n,) are off the whole numbers, in both directions."""
    along, across = (np.angle(np.exp(2j * np.pi * part).sum()) / (2 * np.pi) for part in (places.real, places.imag))
    return complex(along, across)


def _fitted(places: NDArray[np.complex128], holes: NDArray[np.complex128]) -> tuple[complex, complex]:
    """The turn and shift by which turned * places - shift comes closest to the holes (n,), by least squares."""
    off = places - places.mean()
    turned = complex(np.vdot(off, holes) / np.vdot(off, off))
    return turned, complex(turned * places.mean() - holes.mean())


def _strongest_wave(points: Array) -> Array | None:
    """Wave number (2,) 1/mm of the square lattice that points (s, 2) mm follow; None where that may be by chance.

    A lattice is followed as far as the phases of the points along its two axes agree. Of uniform points the squared
    sums of phases over the number of points are distributed exponentially, those of two axes by a Gamma law. What lies
    on a lattice lies on finer ones too: of those followed about as well the coarsest is meant.
    """
    step = _PHASE_STEP / max(float(np.ptp(points, axis=0).max()), _FINEST_MM)
    ticks = step * np.arange(int(1.0 / _FINEST_MM / step) + 1)
    # Both axes together make at most twice as much as there are points.
    tried = 0.25 * math.pi * len(ticks) ** 2
    if tried * _by_chance(2.0 * len(points)) > _LATTICE_BY_CHANCE:
        return None
    phase_x, phase_y = (2 * np.pi * np.outer(ticks, points[:, axis]).astype(np.float32) for axis in (0, 1))
    cos_x, sin_x, cos_y, sin_y = np.cos(phase_x), np.sin(phase_x), np.cos(phase_y).T, np.sin(phase_y).T
    # At (a, b) of the ticks the wave, and at right angles to it (-b, a).
    both_cos, both_sin, sin_cos, cos_sin = cos_x @ cos_y, sin_x @ sin_y, sin_x @ cos_y, cos_x @ sin_y
    strength = (both_cos - both_sin) ** 2 + (sin_cos + cos_sin) ** 2
    strength += ((both_cos + both_sin) ** 2 + (sin_cos - cos_sin) ** 2).T
    strength /= len(points)
    size = ticks[:, None] ** 2 + ticks**2
    strength[(size > _FINEST_MM**-2) | (size < _COARSEST_MM**-2) | (ticks <= 0)[:, None]] = 0.0
    most = float(strength.max())
    if tried * _by_chance(most) > _LATTICE_BY_CHANCE:
        return None
    highest = (strength >= _AS_WELL * most) & (strength == cv2.dilate(strength, np.ones((5, 5), np.uint8)))
    peaks = np.argwhere(highest)
    row, column = peaks[size[highest].argmin()]
    # Between the steps.
    offsets = step * np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 9)] * 2), axis=-1).reshape(-1, 2)
    fine = np.array([ticks[row], ticks[column]]) + offsets
    sums = sum(
        np.abs(np.exp(2j * np.pi * (waves @ points.T)).sum(axis=1)) ** 2
        for waves in (fine, np.stack([-fine[:, 1], fine[:, 0]], axis=1))
    )
    return np.asarray(fine[int(np.argmax(sums))])


def _by_chance(strength: float) -> float:
    """Probability that uniform points follow a given lattice so well or better."""
    return (1.0 + strength) * math.exp(-strength)


def _is_crowded(count: int, expected: float) -> bool:
    """Whether `count` is significantly more than expected, by a Poisson law."""
    return bool(count > 0 and gammainc(count, expected) < _CROWDED)
