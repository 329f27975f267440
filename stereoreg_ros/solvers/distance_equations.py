"""The three distances between points of three rods: how they depend on the positions along the rods."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from stereoreg_ros.geometry.pose import Array

# Pairs of the three rods, in the order of all arrays of three distances.
PAIRS: Final = ((0, 1), (0, 2), (1, 2))
# Damping of the steps, in units of squared cosines: reached only where a double root is near.
_DAMPING: Final = 1e-5


class Misfits(NamedTuple):
    """Errors of the three distances, each (c,) mm, and the derivatives of each by the positions on its two rods."""

    error: list[Array]
    slope: list[tuple[Array, Array]]

    @property
    def largest(self) -> Array:
        """(c,), mm."""
        largest: Array = np.maximum.reduce([np.abs(error) for error in self.error])
        return largest

    def step(self) -> tuple[Array, Array, Array]:
        """The damped Newton step (J'J + mu)^-1 J' e, to be subtracted from the positions."""
        (a0, b0), (a1, c1), (b2, c2) = self.slope
        e0, e1, e2 = self.error
        (cxx, cyy, czz, cxy, cxz, cyz), determinant = self._inverse_normal(_DAMPING)
        right_x, right_y, right_z = a0 * e0 + a1 * e1, b0 * e0 + b2 * e2, c1 * e1 + c2 * e2
        inverse = 1.0 / determinant
        return (
            (cxx * right_x + cxy * right_y + cxz * right_z) * inverse,
            (cxy * right_x + cyy * right_y + cyz * right_z) * inverse,
            (cxz * right_x + cyz * right_y + czz * right_z) * inverse,
        )

    def covariance(self, sigma_mm: float, longest: Array) -> Array:
        """Covariance (c, 3, 3) mm^2 of the positions, for distances known to sigma_mm.

        At a double root the distance changes only with the square of the position, x^2 / 2D: there a position is known
        to sqrt(2 D sigma), not to infinity. longest: (c,), of the three distances D.
        """
        inverse, determinant = self._inverse_normal(sigma_mm / (2 * longest))
        xx, yy, zz, xy, xz, yz = (part * (sigma_mm**2 / determinant) for part in inverse)
        return np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).reshape(3, 3, -1).transpose(2, 0, 1)

    def _inverse_normal(self, damping: Array | float) -> tuple[tuple[Array, ...], Array]:
        """Adjugate (xx, yy, zz, xy, xz, yz) and determinant of J'J + damping, in elements: LAPACK takes far longer."""
        (a0, b0), (a1, c1), (b2, c2) = self.slope
        xx, yy, zz = a0 * a0 + a1 * a1 + damping, b0 * b0 + b2 * b2 + damping, c1 * c1 + c2 * c2 + damping
        xy, xz, yz = a0 * b0, a1 * c1, b2 * c2
        cxx, cyy, czz = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
        cxy, cxz, cyz = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
        return (cxx, cyy, czz, cxy, cxz, cyz), xx * cxx + xy * cxy + xz * cxz


class DistanceEquations:
    """d^2 = la^2 + lb^2 - 2 cosine la lb + 2 at_a la + 2 at_b lb + constant, for each pair of three rods."""

    def __init__(self, origins: Array, directions: Array) -> None:
        """origins (3, 3) mm and directions (3, 3) of the rods, as in `Frame`."""
        self._quadratics = []
        for a, b in PAIRS:
            between = origins[a] - origins[b]
            self._quadratics.append(
                (
                    float(directions[a] @ directions[b]),
                    float(directions[a] @ between),
                    float(-directions[b] @ between),
                    float(between @ between),
                )
            )

    def misfits(self, lambdas: list[Array], distances: list[Array]) -> Misfits:
        """(d^2 - D^2) / 2D for each pair: the distance's error to first order, and smooth where rods meet.

        lambdas: positions along the rods, three times (c,) mm; distances: D of the pairs, three times (c,) mm.
        """
        errors, slopes = [], []
        for (a, b), (cosine, at_a, at_b, constant), known in zip(PAIRS, self._quadratics, distances, strict=True):
            first, second = lambdas[a], lambdas[b]
            slope_a = first - cosine * second + at_a
            slope_b = second - cosine * first + at_b
            squared = first * (slope_a + at_a) + second * (slope_b + at_b) + constant
            inverse = 1.0 / known
            errors.append(0.5 * (squared * inverse - known))
            slopes.append((slope_a * inverse, slope_b * inverse))
        return Misfits(errors, slopes)
