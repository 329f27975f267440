"""The centre of a spot as the point about which it is symmetric.

A straight rod through a slab leaves a spot that is the same when turned by half a turn, be it round or a streak, thin
or clipped. Of a spot of unknown shape the centre can be told as well as if the shape were known: shapes that are even
about the centre and shifts of it, which are odd, do not mix. So the spot is compared with its own mirror image; no
threshold and no model of the spot pulls at the centre.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array

_STEPS: Final = 3
# The window in which a spot is compared: flat, and falling off at this many times the spot's second moments; what is
# added to these, pixel^2, stands for the width of a pixel and of its neighbours.
_WINDOW, _LEAST_EXTENT_PX2 = 10.0, 0.3
# Least share of the information that must be left where clipped pixels are not compared; else they are.
_LEAST_LEFT: Final = 0.25
# So far from its centroid a symmetric spot's centre does not lie.
_FARTHEST_PX: Final = 1.0
# Squared differences between a spot and its mirror image no larger than this, of the noise's variance, are noise; and
# no matter, where the differences are smaller than this share of the spot's height.
_MOST_NOISE, _MOST_ODD = 2.0, 0.03
# So many times what is usual among the spots of a slice.
_MUCH_MORE: Final = 10.0
# Variance of whole HU.
_ROUNDING_HU2: Final = 1 / 12


def centres_of_symmetry(
    patches: Array,
    rough: Array,
    extents: Array,
    shut: NDArray[np.bool_],
    clipped: NDArray[np.bool_],
    noise_hu2: Array,
) -> tuple[Array, Array]:
    """Centres (n, 2) and their covariances (n, 2, 2), pixel and pixel^2, of one spot in each patch (n, p, p) of HU.

    patches: above their surroundings; rough: (n, 2), the centroids, (u, v) within the patch; extents: (n, 2, 2)
    pixel^2, second moments; shut: pixels that belong to something else; clipped: at the end of the image's range;
    noise_hu2: (n,), variance of a pixel's noise, as it is around the spot. The covariance follows from how far the spot
    is from being symmetric; where that is not by noise, the rough centre is kept, and what the two differ by is added.
    Where there is no centre near the rough one, that is returned with a standard deviation of `_FARTHEST_PX`.
    """
    window = _inverse(_WINDOW * (extents + _LEAST_EXTENT_PX2 * np.eye(2)))
    left = _share_left(patches, shut, clipped)
    shut = np.where((left >= _LEAST_LEFT)[:, None, None], shut | clipped, shut)
    centres = rough.copy()
    for _ in range(_STEPS):
        compared = _compared(patches, centres, window, shut)
        centres = centres + np.clip(compared.step, -0.5, 0.5)
    inverse = _inverse(_regular(compared.information))
    height = np.abs(patches).max(axis=(1, 2))
    variance = _variance(compared)
    # Where more than noise disturbs the symmetry, as the end of a rod within the slice or a bubble in a tube, there is
    # no centre of symmetry: the centroid is taken, and what the two differ by is an error.
    lame = (variance > _MOST_NOISE * noise_hu2) & (variance > (_MOST_ODD * height) ** 2)
    moderated = _moderated(variance, noise_hu2, height, lame)
    covariances = moderated[:, None, None] * (inverse @ _by_noise(compared) @ inverse)
    differs = np.where(lame[:, None], centres - rough, 0.0)
    covariances += differs[:, :, None] * differs[:, None, :]
    centres = np.where(lame[:, None], rough, centres)
    lost = ~(np.linalg.norm(centres - rough, axis=1) <= _FARTHEST_PX) | ~np.isfinite(covariances).all(axis=(1, 2))
    centres[lost], covariances[lost] = rough[lost], _FARTHEST_PX**2 * np.eye(2)
    return centres, 0.5 * (covariances + np.swapaxes(covariances, 1, 2))


def _moderated(variance: Array, noise_hu2: Array, height: Array, lame: NDArray[np.bool_]) -> Array:
    """Variances (n,) HU^2 of what spots differ by from their mirror images, taken together; lame: those (n,) without a
    centre of symmetry, which say nothing of the others where there are others.

    Each by itself comes from a few dozen pixels. What is more than the noise comes of the pixels' size and grows with
    the spot's height; for spots alike it is the same but for where between the pixels their centres lie. A spot that
    differs by much more than the others has its own reason to, and keeps its own variance.
    """
    fit = lame if lame.all() else ~lame
    # Beside an edge the surroundings vary by more than noise: that is no other spot's.
    noise = np.minimum(noise_hu2, np.median(noise_hu2[fit]))
    odd = np.median((np.maximum(variance - noise, 0.0) / np.maximum(height, 1.0) ** 2)[fit])
    usual = noise + odd * height**2
    return np.asarray(np.where(variance < _MUCH_MORE * usual, usual, variance), dtype=np.float64)


def _share_left(patches: Array, shut: NDArray[np.bool_], clipped: NDArray[np.bool_]) -> Array:
    """Share (n,) of the squared slopes of patches that is not on clipped pixels or beside them."""
    if not clipped.any():
        return np.ones(len(patches))
    slope_u, slope_v = np.zeros_like(patches), np.zeros_like(patches)
    slope_u[:, :, 1:-1], slope_v[:, 1:-1] = patches[:, :, 2:] - patches[:, :, :-2], patches[:, 2:] - patches[:, :-2]
    squared = np.where(shut, 0.0, slope_u**2 + slope_v**2)
    beside = clipped.copy()
    beside[:, 1:] |= clipped[:, :-1]
    beside[:, :-1] |= clipped[:, 1:]
    beside[:, :, 1:] |= clipped[:, :, :-1]
    beside[:, :, :-1] |= clipped[:, :, 1:]
    share: Array = np.where(beside, 0.0, squared).sum(axis=(1, 2)) / np.maximum(squared.sum(axis=(1, 2)), 1e-9)
    return share


class _Compared(NamedTuple):
    """Spots (n, p, p) and their mirror images: odd, HU, what they differ by; weight of each pixel; slopes, HU/pixel,
    along u and v, weighted; mirrors (n, p, p), the matrices of `_mirror` along u and v; information (n, 2, 2) HU^2 per
    pixel^2; step (n, 2) pixel to a better centre.
    """

    odd: Array
    weight: Array
    slopes: tuple[Array, Array]
    mirrors: tuple[Array, Array]
    information: Array
    step: Array


def _compared(patches: Array, centres: Array, window: Array, shut: NDArray[np.bool_]) -> _Compared:
    side = patches.shape[1]
    place = np.arange(side)
    (mirror_u, mirror_v), (near_u, near_v) = _mirror(centres.T, side)
    mirrored = mirror_v @ patches @ np.swapaxes(mirror_u, 1, 2)
    off_u, off_v = place - centres[:, 0, None], place - centres[:, 1, None]
    distance = (window[:, 0, 0, None] * off_u**2)[:, None, :] + (window[:, 1, 1, None] * off_v**2)[:, :, None]
    distance += (2 * window[:, 0, 1, None] * off_v)[:, :, None] * off_u[:, None, :]
    weight = np.exp(-0.5 * distance**2)
    # What lies on a shut pixel, or has its mirror image near one, or beyond the patch, is not compared.
    weight *= near_v.any(axis=2)[:, :, None] & near_u.any(axis=2)[:, None, :]
    if shut.any():
        blocked = shut.astype(np.float64)
        blocked += near_v @ blocked @ np.swapaxes(near_u, 1, 2)
        weight *= blocked == 0
    even, odd = 0.5 * (patches + mirrored), patches - mirrored
    slope_u, slope_v = np.zeros_like(even), np.zeros_like(even)
    slope_u[:, :, 2:-2] = (8 * (even[:, :, 3:-1] - even[:, :, 1:-3]) - (even[:, :, 4:] - even[:, :, :-4])) / 12
    slope_v[:, 2:-2] = (8 * (even[:, 3:-1] - even[:, 1:-3]) - (even[:, 4:] - even[:, :-4])) / 12
    weighted_u, weighted_v = weight * slope_u, weight * slope_v
    information = np.empty((len(patches), 2, 2))
    information[:, 0, 0] = np.einsum("nij,nij->n", weighted_u, slope_u)
    information[:, 1, 1] = np.einsum("nij,nij->n", weighted_v, slope_v)
    information[:, 0, 1] = information[:, 1, 0] = np.einsum("nij,nij->n", weighted_u, slope_v)
    pull = np.stack([np.einsum("nij,nij->n", part, odd) for part in (weighted_u, weighted_v)], axis=-1)
    step = -0.5 * np.linalg.solve(_regular(information), pull[..., None])[..., 0]
    return _Compared(odd, weight, (weighted_u, weighted_v), (mirror_u, mirror_v), information, step)


def _variance(compared: _Compared) -> Array:
    """Variance (n,) HU^2 of a pixel, by how a spot and its mirror image differ."""
    mirror_u, mirror_v = compared.mirrors
    weight, odd = compared.weight, compared.odd
    # Between pixels the noise of the mirror image is less than a pixel's. Each pair of pixels counts twice, and the
    # centre takes two pairs' worth.
    noise = 1.0 + (mirror_v**2).sum(axis=2)[:, :, None] * (mirror_u**2).sum(axis=2)[:, None, :]
    pairs = 0.5 * weight.sum(axis=(1, 2))
    variance: Array = np.einsum("nij,nij,nij->n", weight, odd, odd)
    variance /= np.maximum(np.einsum("nij,nij->n", weight, noise), 1e-9)
    variance *= np.maximum(pairs, 1.0) / np.maximum(pairs - 2.0, 1.0)
    return variance + _ROUNDING_HU2


def _by_noise(compared: _Compared) -> Array:
    """Covariance (n, 2, 2) HU^2 per pixel^2 of information times step, for a unit of noise in each pixel."""
    mirror_u, mirror_v = compared.mirrors
    # A pixel's noise pulls at the centre by itself and by what it is of the mirror image.
    pulls = np.stack([part - np.swapaxes(mirror_v, 1, 2) @ part @ mirror_u for part in compared.slopes], axis=1)
    return np.asarray(0.25 * np.einsum("naij,nbij->nab", pulls, pulls), dtype=np.float64)


def _mirror(centres: Array, side: int) -> tuple[Array, Array]:
    """Matrices (..., side, side) that take the values of pixels to those at 2 centre - pixel, by cubic splines, for
    centres (...) along one axis; and such that are 1 at the pixels next to that place, else 0.
    """
    place = np.arange(side)
    away = np.abs((2 * centres[..., None] - place)[..., None] - place)
    near = away < 1
    rest = np.maximum(2 - away, 0.0)
    basis = np.where(near, 2 / 3 - away * away * (1 - 0.5 * away), rest * rest * rest / 6)
    return basis @ _spline_coefficients(side), near.astype(np.float64)


@lru_cache(maxsize=16)
def _spline_coefficients(side: int) -> Array:
    """Matrix (side, side) from values at whole places to the coefficients of the cubic spline through them."""
    basis = 2 / 3 * np.eye(side) + 1 / 6 * (np.eye(side, k=1) + np.eye(side, k=-1))
    basis[0, 1] = basis[-1, -2] = 1 / 3  # mirrored at both ends
    return _inverse(basis)


def _regular(information: Array) -> Array:
    """Information (n, 2, 2) that can be inverted where a spot has slopes in one direction only, or none."""
    least = 1e-12 * np.trace(information, axis1=1, axis2=2) + 1e-12
    regular: Array = information + least[:, None, None] * np.eye(2)
    return regular


def _inverse(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
