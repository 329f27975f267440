"""In which order triples of rods are tried: well-conditioned ones first, and so that missing rods are soon covered."""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array

_PLANES = 400
# Below this share of the best triple's quality a triple determines no pose (coplanar or all parallel rods).
_LEAST_SIDE_MM = 1e-6
_USELESS = 1e-3
_MOST_SUBSETS = 50_000
_STEPS = 24


class RankedTriple(NamedTuple):
    """A triple of rods, and what has been covered once it and all before it were tried.

    complete_from: every set of at least that many rods that any triple can solve holds a triple tried by then.
    """

    lines: tuple[int, int, int]
    complete_from: int


@lru_cache(maxsize=64)
def triple_order(frame: Frame, min_inliers: int) -> tuple[RankedTriple, ...]:
    """Triples of the frame's rods in the order to try them, until sets of `min_inliers` rods are covered.

    After the first triple every slice with all rods is covered; greedily the fewest further triples are taken until
    every set of one rod less holds a triple, then of two less, and so on.
    """
    n = len(frame)
    usable = _usable(frame)
    masks = {t: sum(1 << line for line in t) for t in usable}
    left = sorted(usable, key=lambda t: -usable[t])
    order: list[RankedTriple] = []
    for size in range(n, min_inliers - 1, -1):
        if comb(n, size) > _MOST_SUBSETS:
            order += [RankedTriple(t, size + 1) for t in left[:-1]] + [RankedTriple(t, min_inliers) for t in left[-1:]]
            return tuple(order)
        subsets = np.array([sum(1 << line for line in subset) for subset in combinations(range(n), size)])
        taken = np.array([masks[entry.lines] for entry in order], dtype=np.int64)
        open_sets = subsets[~((subsets[:, None] & taken) == taken).any(axis=1)]
        while open_sets.size and left:
            covers = [int(((open_sets & masks[t]) == masks[t]).sum()) for t in left]
            best = max(range(len(left)), key=lambda i: (covers[i], usable[left[i]]))
            if covers[best] == 0:
                break  # What is left open, no usable triple can solve.
            chosen = left.pop(best)
            open_sets = open_sets[(open_sets & masks[chosen]) != masks[chosen]]
            order.append(RankedTriple(chosen, size + 1))
        if order:
            order[-1] = order[-1]._replace(complete_from=size)
    return tuple(order)


@lru_cache(maxsize=64)
def further_triples(frame: Frame, min_inliers: int, rods: int, looks: int) -> tuple[tuple[int, int, int], ...]:
    """Triples to try after those of `triple_order`, until every set of `rods` rods holds `looks` that were tried.

    Or all that it has. One triple misses poses in which its own spots lie in a line, or its equations have a double
    root; the rods' other triples seldom share that.
    """
    n = len(frame)
    usable = _usable(frame)
    if not usable or rods > n or comb(n, rods) > _MOST_SUBSETS:
        return ()
    masks = {t: sum(1 << line for line in t) for t in usable}
    order = triple_order(frame, min_inliers)
    last = next((row for row, entry in enumerate(order) if entry.complete_from <= rods), len(order) - 1)
    tried = {entry.lines for entry in order[: last + 1]}
    subsets = np.array([sum(1 << line for line in subset) for subset in combinations(range(n), rods)])
    holds = {t: (subsets & mask) == mask for t, mask in masks.items()}
    wanted = np.minimum(np.sum([*holds.values()], axis=0), looks) - np.sum([holds[t] for t in tried], axis=0)
    left = sorted(usable.keys() - tried, key=lambda t: -usable[t])
    chosen: list[tuple[int, int, int]] = []
    while (wanted > 0).any():
        covers = [int((holds[t] & (wanted > 0)).sum()) for t in left]
        best = left.pop(int(np.argmax(covers)))  # the first of the most: the one of the best quality
        wanted = wanted - holds[best]
        chosen.append(best)
    return tuple(chosen)


@lru_cache(maxsize=64)
def _usable(frame: Frame) -> dict[tuple[int, int, int], float]:
    """The triples that determine a pose, with their quality."""
    quality = _qualities(frame)
    return {t: q for t, q in quality.items() if q > _USELESS * max(quality.values())}


def _qualities(frame: Frame) -> dict[tuple[int, int, int], float]:
    """How well each triple of rods fixes the pose, over slices that may meet the frame, for the work it takes.

    For one slice: the smallest singular value of the distances' derivatives by the positions along the rods, times
    how far the three cuts are from collinear; nothing where a rod is not cut. The mean over slices, divided by the area
    (squared) within which two spots can lie beside a third one: triples of false spots are as many.
    """
    rng = np.random.default_rng(0)  # a fixed sample: the order must not change from run to run
    points = np.concatenate([frame.starts, frame.ends])
    low, high = points.min(axis=0), points.max(axis=0)
    normals = rng.normal(size=(_PLANES, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    through = low + (high - low) * rng.random((_PLANES, 3))
    along = normals @ frame.directions.T
    along = np.where(np.abs(along) < 1e-9, 1e-9, along)
    lambdas = (np.einsum("pi,pi->p", normals, through)[:, None] - normals @ frame.origins.T) / along
    inside = (lambdas >= frame.lambda_min) & (lambdas <= frame.lambda_max)
    cuts = frame.origins + lambdas[..., None] * frame.directions
    return {t: _quality(cuts, inside, frame.directions, t) for t in combinations(range(len(frame)), 3)}


def _quality(cuts: Array, inside: Array, directions: Array, triple: tuple[int, int, int]) -> float:
    pairs = ((0, 1), (0, 2), (1, 2))
    points = cuts[:, triple]
    sides = [np.linalg.norm(points[:, a] - points[:, b], axis=1) for a, b in pairs]
    # Rods that meet, or lie within each other, have one spot there.
    visible = inside[:, triple].all(axis=1) & (np.min(sides, axis=0) > _LEAST_SIDE_MM)
    if not visible.any():
        return 0.0
    points, sides = points[visible], [length[visible] for length in sides]
    jacobian = np.zeros((len(points), 3, 3))
    for row, ((a, b), length) in enumerate(zip(pairs, sides, strict=True)):
        difference = points[:, a] - points[:, b]
        jacobian[:, row, a] = difference @ directions[triple[a]] / length
        jacobian[:, row, b] = -difference @ directions[triple[b]] / length
    weakest = np.linalg.svd(jacobian, compute_uv=False)[:, 2]
    twice_area = np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1)
    flatness = twice_area / np.max(sides, axis=0) ** 2
    return float((weakest * flatness).sum() / len(cuts)) / _extent(np.array(sides))


def _extent(sides: Array) -> float:
    """Area, squared, mm^4, over which two spots can lie beside a third; sides (3, p) mm, distances 01, 02, 12."""
    low, high = sides.min(axis=1), sides.max(axis=1)
    # On a grid of polar coordinates about the first spot, the second one's direction being the first axis.
    first = np.linspace(low[0], high[0], _STEPS + 1)[:-1] + (high[0] - low[0]) / _STEPS / 2
    second = np.linspace(low[1], high[1], _STEPS + 1)[:-1] + (high[1] - low[1]) / _STEPS / 2
    angle = (np.arange(_STEPS) + 0.5) * np.pi / _STEPS
    third = np.sqrt(
        first[:, None, None] ** 2 + second[:, None] ** 2 - 2 * first[:, None, None] * second[:, None] * np.cos(angle)
    )
    possible = (third >= low[2]) & (third <= high[2])
    measure = first[:, None, None] * second[:, None] * possible
    cell = (high[0] - low[0]) * (high[1] - low[1]) / _STEPS**2 * 2 * np.pi / _STEPS
    return float(2 * np.pi * measure.sum() * cell) + 1.0
