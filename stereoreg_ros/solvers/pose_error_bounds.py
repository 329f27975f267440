"""How far errors of the spots can carry the maximum-likelihood pose: bounds that no error within a box exceeds.

To first order the pose moves by d = G S dE: the polytope of Maurin 2009, section 3.2, for the pose instead of the
linear calibration. What is left out is bounded and added. With the cuts c(d), their Jacobian J, the residual r in mm
and the spots' inverse covariance W, the solution has J'W r = 0, so that

    d = G (S dE - rho) + H^-1 (J - J_0)'W r,    rho = c(d) - c(0) - J_0 d,   H = J_0'W J_0,   G = H^-1 J_0'W.

rho and J - J_0 are of second order where d is small. A set of poses that this equation maps into itself holds its
solution (Brouwer), and the solution, which moves without a jump as the errors grow from nothing, does not leave it.
Such a set is found by starting from the first order, and adding what is missing until nothing is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, skew
from stereoreg_ros.geometry.projection import cut, cut_jacobian
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.error_bounds import LinearErrorModel

_ROUNDS = 200
# Each round is tried with this share more than was missing, so that the rounds come to an end.
_MARGIN = 1e-3
_ROTATION = np.hstack([np.zeros((3, 3)), np.eye(3)])


class PoseErrorModel(LinearErrorModel):
    """Errors (6,) of the maximum-likelihood pose slice_from_frame, as in `Pose.perturbed`: mm, then rad, slice axes.

    sensitivity: (6, 2n), in mm and rad per pixel.
    """

    def __init__(
        self,
        frame: Frame,
        lines: NDArray[np.intp],
        slice_from_frame: Pose,
        spots_px: Array,
        covariances_px2: Array,
        scale: PixelScale,
    ) -> None:
        """Linearise at the pose of the spots (n, 2) of the rods (n,), weighted by covariances_px2 (n, 2, 2)."""
        cuts = cut(frame, slice_from_frame.rotation, slice_from_frame.translation)
        jacobian = cut_jacobian(cuts, slice_from_frame.translation)[lines]
        self._rotation = slice_from_frame.rotation
        self._directions = cuts.directions[lines]
        self._arms = np.column_stack([cuts.points_mm[lines], np.zeros(len(lines))]) - slice_from_frame.translation
        self._weights = np.linalg.inv(scale.matrix @ covariances_px2 @ scale.matrix.T)
        weighted = np.swapaxes(jacobian, 1, 2) @ self._weights
        self._inverse = np.linalg.pinv((weighted @ jacobian).sum(axis=0), hermitian=True)
        # (n, 6, 2): how the pose follows each spot, mm and rad per mm.
        self._gain = self._inverse @ weighted
        self._jacobian = jacobian
        by_pixel = self._gain @ scale.matrix
        super().__init__(np.concatenate([by_pixel[:, :, 0], by_pixel[:, :, 1]]).T)
        self._root = np.swapaxes(np.linalg.cholesky(self._weights), 1, 2)
        self._scale = scale.matrix
        self._residuals = scale.to_mm(np.asarray(spots_px, dtype=np.float64)) - cuts.points_mm[lines]

    def displacement(self, point_in_frame: ArrayLike) -> Array:
        """(3, 6): how a point (3,) mm of the frame moves in the slice's axes with the pose, to first order."""
        return np.hstack([np.eye(3), -skew(self._rotation @ np.asarray(point_in_frame, dtype=np.float64))])

    def first_order(self, functional: ArrayLike, max_error_px: float) -> float:
        """The greatest |functional @ error| to first order, functional (6,) or (3, 6), over the box of `bounds_box`."""
        rows = np.atleast_2d(np.asarray(functional, dtype=np.float64))
        part = LinearErrorModel(rows @ self.sensitivity)
        return float(part.bounds_box(max_error_px)[1][0]) if len(rows) == 1 else part.greatest_length(max_error_px)[0]

    def worst_corner(self, functional: ArrayLike, max_error_px: float) -> Array:
        """The errors (2n,) within the box that make |functional @ error| greatest, to first order."""
        rows = np.atleast_2d(np.asarray(functional, dtype=np.float64)) @ self.sensitivity
        if len(rows) == 3:
            return LinearErrorModel(rows).greatest_length(max_error_px)[1]
        corner: Array = np.where(rows[0] < 0, -1.0, 1.0) * max_error_px
        return corner

    def reach(self, max_error_px: float) -> Reach | None:
        """Bounds where no coordinate of a spot is off by more than `max_error_px`; None where none can be proven.

        Raises ValueError where max_error_px is negative or not finite.
        """
        if not (max_error_px >= 0 and math.isfinite(max_error_px)):
            raise ValueError(f"max_error_px is {max_error_px!r}, expected a finite number that is not negative")
        first = self._first_orders(max_error_px)
        nothing = np.zeros(len(self._arms))
        beyond = _Beyond(nothing, nothing, nothing)
        for _ in range(_ROUNDS):
            reach = Reach(self, max_error_px, _Beyond(*((1 + _MARGIN) * part for part in beyond)))
            needed = self._needed(reach, first)
            if needed is None:
                return None
            if all((new <= old).all() for new, old in zip(needed, reach.beyond, strict=True)):
                return reach
            beyond = needed
        return None

    def _first_orders(self, max_error_px: float) -> _FirstOrders:
        n = len(self._arms)
        zero = np.zeros(n)
        rises = np.column_stack([zero, zero, zero + 1.0, self._arms[:, 1], -self._arms[:, 0], zero])
        arm_changes = np.zeros((n, 3, 6))
        arm_changes[:, :2] = self._jacobian
        arm_changes[:, :, :3] -= np.eye(3)
        swings = np.concatenate([np.zeros((n, 3, 3)), -skew(self._arms)], axis=2)
        # d_xy - slope d_z of what a turn adds to a rod's direction d, over d_z, is the change of its slope.
        turned = np.concatenate([np.zeros((n, 3, 3)), -skew(self._directions)], axis=2)
        leans = turned.copy()
        leans[:, :2] -= (self._directions[:, :2] / self._directions[:, 2:])[:, :, None] * turned[:, 2:]
        leans[:, 2] = 0.0
        of = _Functionals(_ROTATION, rises, arm_changes, swings, leans, turned[:, 2])
        own = np.einsum("ni,nij,nj->", self._residuals, self._weights, self._residuals)
        shifts = np.linalg.norm(self._root @ self._scale, ord=2, axis=(1, 2)) * math.sqrt(2) * max_error_px
        return _FirstOrders(
            of,
            _Functionals(
                np.array(self.first_order(of.rotation, max_error_px)),
                *(np.array([self.first_order(row, max_error_px) for row in part]) for part in of[1:]),
            ),
            math.sqrt(float(own)),
            shifts,
        )

    def _needed(self, reach: Reach, first: _FirstOrders) -> _Beyond | None:
        """What poses within the reach have beyond the first order; None where a rod may come to lie in the slice."""
        most = _Functionals(
            *(
                size + np.array([reach.beyond_first_order(row) for row in np.reshape(part, (-1, *part.shape[-rank:]))])
                for part, size, rank in zip(first.functionals, first.sizes, (2, 1, 2, 2, 2, 1), strict=True)
            )
        )
        turn = float(most.rotation[0])
        second = turn**2 / 2
        cosine = np.abs(self._directions[:, 2])
        least_cosine = cosine - most.dip - second
        if not (turn < math.pi / 2 and (least_cosine > 0).all()):
            return None
        slope_change = (most.lean + second / cosine) / least_cosine
        stretch = np.sqrt(1 + (np.linalg.norm(self._directions[:, :2], axis=1) / cosine + slope_change) ** 2)
        # The point of the rod at which the slice cuts it rises out of the slice, where the slope's change counts, and
        # it is moved by the second order of the turn, which the slope stretches.
        remainder = stretch * _second_order(turn, most.swing) + most.rise * slope_change
        arm_change = most.arm_change + remainder
        # 1 - J_0 G is a projection where lengths are measured by W: no shift of the spots leaves more than itself.
        root = np.linalg.norm(self._root, ord=2, axis=(1, 2))
        carried = root * [reach.forced(rows) for rows in self._jacobian]
        moved = np.linalg.norm(first.shifts + root * reach.beyond.remainder)
        tension = first.tension + float(moved) + float(np.linalg.norm(carried))
        return _Beyond(remainder, slope_change * root * tension, arm_change * stretch * root * tension)

    def follows(self, functional: Array, by_spot: Array) -> float:
        """A bound of |functional @ G p| for shifts p of the spots of lengths by_spot (n,) mm."""
        return float(np.linalg.norm(functional @ self._gain, ord=2, axis=(1, 2)) @ by_spot)

    def bound_by_residuals(self, functional: Array, by_slope: Array, by_arm: Array) -> float:
        """A bound of |functional @ H^-1 (J - J_0)'W r|: J_i'f is the force F = (f, -slope f) and the moment arm x F."""
        by_force = functional @ self._inverse
        lift = (by_force[:, :3] + by_force[:, 3:] @ skew(self._arms))[..., 2]
        # by_slope and by_arm are for all of the residual on one spot; spread over several, it does no more than this.
        each = np.linalg.norm(lift, axis=1) * by_slope + np.linalg.norm(by_force[:, 3:], ord=2) * by_arm
        return float(np.linalg.norm(each))


def _second_order(turn: float, swing: Array) -> Array:
    """Bound of |R a - a - w x a|, R turning by w of length `turn`, for |w x a| = swing: two parts at right angles."""
    bound: Array = swing * turn / 2 * math.sqrt(1 + turn**2 / 9)
    return bound


class _Functionals(NamedTuple):
    """Of the pose's error, for each of n rods, or their bounds: rotation (3, 6), rad; rise (n, 6) of the cut's point of
    the rod out of the slice, mm; arm_change (n, 3, 6), of the cut as seen from the frame's origin, mm; swing (n, 3, 6),
    of that point by the turn, mm; lean (n, 3, 6) and dip (n, 6), of the rod's direction, along the slice and in z.
    """

    rotation: Array
    rise: Array
    arm_change: Array
    swing: Array
    lean: Array
    dip: Array


class _FirstOrders(NamedTuple):
    """Functionals and their bounds over the box to first order; tension: length of the residual, shifts (n,): of what
    the errors move the spots by, both in standard deviations.
    """

    functionals: _Functionals
    sizes: _Functionals
    tension: float
    shifts: Array


class _Beyond(NamedTuple):
    """Bounds of what the first order leaves out, of each spot (n,): rho, mm; and, were all of the residual its own,
    what its force W r does by the change of the rod's slope, 1/mm, and by that of the cut's arm about the origin.
    """

    remainder: Array
    by_slope: Array
    by_arm: Array


class Reach:
    """How far the pose can be carried by errors within the box that `PoseErrorModel.reach` was given."""

    def __init__(self, model: PoseErrorModel, max_error_px: float, beyond: _Beyond) -> None:
        self._model, self._max_error_px, self.beyond = model, max_error_px, beyond

    def bound(self, functional: ArrayLike) -> float:
        """A bound of |functional @ error|, functional (6,) or (3, 6): the error as in `Pose.perturbed`, slice axes."""
        return self._model.first_order(functional, self._max_error_px) + self.beyond_first_order(functional)

    def point_mm(self, point_in_frame: ArrayLike) -> float:
        """A bound of how far a point (3,) mm of the frame is from where the pose puts it, mm."""
        moved = self._model.displacement(point_in_frame)
        swing = np.array(self.bound(np.hstack([np.zeros((3, 3)), moved[:, 3:]])))
        return self.bound(moved) + float(_second_order(self.bound(_ROTATION), swing))

    def beyond_first_order(self, functional: ArrayLike) -> float:
        """What of the bound is not of first order."""
        rows = np.atleast_2d(np.asarray(functional, dtype=np.float64))
        return self._model.follows(rows, self.beyond.remainder) + self.forced(rows)

    def forced(self, functional: Array) -> float:
        """What of the bound comes from the Jacobian's change under the residuals."""
        return self._model.bound_by_residuals(functional, self.beyond.by_slope, self.beyond.by_arm)
