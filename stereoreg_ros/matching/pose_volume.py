"""How many poses a frame may have: their volume, and how large a part of it one arrangement of spots takes up.

The poses that have the slice cut certain rods fill a volume of three millimetres and three radians. A small piece of it
is moved to a larger or smaller piece of the surface that the poses make in the space of all spot coordinates; the ratio
of the two is sqrt det J'J, J being the spots' derivative by the pose (see `matching.significance`).

What a slice shows does not change, but for its place and turn in the image, when it is shifted in its plane and turned
about its normal: only planes have to be drawn, their normals and their heights.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import cut, cut_jacobian
from stereoreg_ros.geometry.visibility import END_SLACK_MM, may_show
from stereoreg_ros.matching.prior import Near, Prior

_LOG2_PLANES = 14
# Of more sets of rods than this, only this many are drawn.
_MOST_SETS = 64
# For how many planes J'J is kept; and the percentage of them whose stretch is lower than the low one.
_FEW, _LOW = 400, 2.0
# Stated as standard deviations: how far a position, in mm, or a rotation, in rad, is left open at most.
_OPEN_POSITION_MM, _OPEN_ROTATION = 10.0, 0.1
# Over how many turns of a quarter circle boxes are averaged.
_TURNS = 6
# Near a pose, spots within reach leave the slice's height this many times the reach.
_NEAR_HEIGHTS = 4.0


def pose_volume(frame: Frame, rods: int, prior: Prior, area_mm2: float) -> float:
    """Volume, mm^3 rad^3, of the poses within the prior that have the slice cut `rods` rods, over all sets of these.

    area_mm2: of the slice, in which all the spots lie.
    """
    if prior.near is not None:
        return _volume_near(frame, rods, prior, prior.near)
    sample = plane_sample(frame, rods)
    # The wider a set of spots is, the less room it has in the slice, which is taken to be a square.
    room = sample.sets * area_mm2 - sample.widths_mm * math.sqrt(area_mm2) + sample.boxes_mm2
    room = np.maximum(room, 0.0)
    return sample.weight * float((prior.turns(sample.normals) * room).sum())


class PlaneSample(NamedTuple):
    """Planes (p) in which a slice cuts a given number of rods.

    normals: (p, 3); sets: (p,), how many sets of that many rods each cuts; widths_mm, boxes_mm2: (p,), sums over these
    sets of width and height together, and of width times height, of the box around the spots, averaged over turns;
    weight: volume that a plane stands for, mm rad^2 of the height and the normal. mean_ratio: of sqrt det J'J over
    planes and sets; squares: (m, 6, 6), J'J of some of them; J in mm per mm and per rad.
    """

    normals: Array
    sets: Array
    widths_mm: Array
    boxes_mm2: Array
    weight: float
    mean_ratio: float
    squares: Array


@lru_cache(maxsize=64)
def plane_sample(frame: Frame, rods: int) -> PlaneSample:
    """Planes with normals evenly over the sphere and heights evenly over the frame; drawn once."""
    rotations, translations, normals, radius = _planes(frame)
    cuts = cut(frame, rotations, translations)
    visible = may_show(frame, cuts)
    chosen = np.flatnonzero(visible.sum(axis=1) >= rods)
    visible, points = visible[chosen], cuts.points_mm[chosen]
    jacobians = cut_jacobian(cuts.take(chosen), translations[chosen])
    squares = [np.zeros((0, 6, 6))]
    ratios = [np.zeros(0)]
    sets, widths, boxes = (np.zeros(len(chosen)) for _ in range(3))
    turned = np.pi / 2 * np.arange(2 * _TURNS) / _TURNS
    along = points @ np.stack([np.cos(turned), np.sin(turned)])  # (planes, rods, turns)
    chosen_sets, share = _sets_of(len(frame), rods)
    for one in chosen_sets:
        rows = np.flatnonzero(visible[:, one].all(axis=1))
        jacobian = jacobians[rows][:, one].reshape(len(rows), 2 * rods, 6)
        square = np.swapaxes(jacobian, 1, 2) @ jacobian
        ratios.append(np.sqrt(np.maximum(np.linalg.det(square), 0.0)))
        squares.append(square[:: max(1, len(square) * len(chosen_sets) // _FEW)])
        extent = np.ptp(along[rows][:, one], axis=1)
        width, height = extent[:, :_TURNS], extent[:, _TURNS:]
        sets[rows] += share
        widths[rows] += share * (width + height).mean(axis=1)
        boxes[rows] += share * (width * height).mean(axis=1)
    weight = 4 * np.pi * 2 * radius / len(normals)
    mean_ratio = float(np.concatenate(ratios).mean()) if sets.any() else 0.0
    return PlaneSample(normals[chosen], sets, widths, boxes, weight, mean_ratio, np.concatenate(squares))


def typical_slices(frame: Frame, rods: int, most: int) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Up to `most` poses slice_from_frame (m, 3, 3), (m, 3) mm in which a slice cuts `rods` rods or more; which (m,
    n)."""
    rotations, translations, _, _ = _planes(frame)
    visible = may_show(frame, cut(frame, rotations, translations))
    chosen = np.flatnonzero(visible.sum(axis=1) >= rods)[:most]
    return rotations[chosen], translations[chosen], visible[chosen]


def _planes(frame: Frame) -> tuple[Array, Array, Array, float]:
    """Poses slice_from_frame (p, 3, 3), (p, 3) mm with normals (p, 3) evenly over the sphere and heights evenly over
    the frame, and the frame's radius in mm.
    """
    ends = np.concatenate([frame.starts, frame.ends])
    centre = (ends.min(axis=0) + ends.max(axis=0)) / 2
    radius = float(np.linalg.norm(ends - centre, axis=1).max()) + END_SLACK_MM
    from scipy.stats import qmc  # takes 0.4 s, which whoever asks for help need not wait

    drawn = qmc.Sobol(3, scramble=True, seed=0).random_base2(_LOG2_PLANES)
    z, turn = 2 * drawn[:, 0] - 1, 2 * np.pi * drawn[:, 1]
    across = np.sqrt(1 - z**2)
    normals = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
    rotations = _any_rotations(normals)
    # The frame's middle is at the slice's origin, but for its height.
    translations = -(rotations @ centre)
    translations[:, 2] += radius * (2 * drawn[:, 2] - 1)
    return rotations, translations, normals, radius


def stretch(information: Array, variance_mm2: float) -> Array:
    """sqrt det J'J (...) in mm^6, for spots of that variance, mm^2; information: (..., 6, 6), J'J over the variance.

    Spots do not leave a direction of the pose wholly open: where they do so to first order, the second bounds it.
    """
    openness = np.diag([_OPEN_POSITION_MM**-2] * 3 + [_OPEN_ROTATION**-2] * 3)
    determinant = np.linalg.det(information + openness)
    ratio: Array = np.sqrt(np.maximum(determinant, 0.0)) * variance_mm2**3
    return ratio


@lru_cache(maxsize=256)
def low_stretch(frame: Frame, rods: int, variance_mm2: float) -> float:
    """What few poses' stretch is below."""
    ratios = stretch(plane_sample(frame, rods).squares / variance_mm2, variance_mm2)
    return float(np.percentile(ratios, _LOW)) if ratios.size else 0.0


def _sets_of(lines: int, rods: int) -> tuple[list[NDArray[np.intp]], float]:
    """Sets of `rods` of the lines, and how many sets each stands for."""
    if comb(lines, rods) <= _MOST_SETS:
        return [np.array(one) for one in combinations(range(lines), rods)], 1.0
    rng = np.random.default_rng(0)
    return [rng.permutation(lines)[:rods] for _ in range(_MOST_SETS)], comb(lines, rods) / _MOST_SETS


def _any_rotations(normals: Array) -> Array:
    """Rotations (p, 3, 3), slice_from_frame, with the slice's normal at `normals` (p, 3) in the frame."""
    aside = np.where(np.abs(normals[:, :1]) < 0.7, np.eye(3)[0], np.eye(3)[1])
    first = np.cross(aside, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    rotations: Array = np.stack([first, np.cross(normals, first), normals], axis=1)
    return rotations


def _volume_near(frame: Frame, rods: int, prior: Prior, near: Near) -> float:
    cuts = cut(frame, prior.rotation, near.translation)
    visible = may_show(frame, cuts, END_SLACK_MM + _NEAR_HEIGHTS * near.reach_mm / 2)
    room = math.pi * near.reach_mm**2 * _NEAR_HEIGHTS * near.reach_mm
    return comb(int(visible.sum()), rods) * room * 4 / 3 * math.pi * prior.max_rotation**3
