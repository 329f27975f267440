"""Several slices of one pixel scale whose spots are known to be which rods: what a scale is measured from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, rotation_exp
from stereoreg_ros.geometry.projection import Cuts, cut, cut_jacobian, scale_jacobian
from stereoreg_ros.geometry.slice import PixelScale


class IdentifiedSpots(NamedTuple):
    """The spots of n rods in m slices.

    spots_px: (m, n, 2), of each rod; covariances_px2: (m, n, 2, 2), of their centres; anything where used (m, n) is
    false.
    """

    spots_px: Array
    used: NDArray[np.bool_]
    covariances_px2: Array

    def whitening(self) -> Array:
        """(m, n, 2, 2) 1/pixel, what turns a residual in pixels into one of unit variance."""
        known = np.where(self.used[..., None, None], self.covariances_px2, np.eye(2))
        return np.asarray(np.linalg.inv(np.linalg.cholesky(known)), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class ScaleAndPoses:
    """A pixel scale, mm/pixel, and poses slice_from_frame of m slices: rotations (m, 3, 3), translations (m, 3) mm."""

    scale: PixelScale
    rotations: Array
    translations: Array

    def moved(self, by_scale: Array, by_pose: Array) -> ScaleAndPoses | None:
        """After steps (3,) of (sx, sy, shear) and (m, 6) of the poses; None where that is no scale any more."""
        sx, sy, shear = np.array([self.scale.sx, self.scale.sy, self.scale.shear]) + by_scale
        if not (min(sx, sy) > 0 and np.isfinite([sx, sy, shear]).all()):
            return None
        return replace(
            self,
            scale=PixelScale(float(sx), float(sy), float(shear)),
            rotations=rotation_exp(by_pose[:, 3:]) @ self.rotations,
            translations=self.translations + by_pose[:, :3],
        )


class Linearised(NamedTuple):
    """The residuals of all spots at a scale and poses, and what they change by.

    cuts: of the poses; residuals_px: (m, n, 2), spot less prediction, zero where a rod has no spot. In standard
    deviations of the spots: white (m, 2n, 1), the residuals; by_scale (m, n, 2, 3), their slope by (sx, sy, shear);
    by_pose (m, 2n, 6).
    """

    cuts: Cuts
    residuals_px: Array
    white: Array
    by_scale: Array
    by_pose: Array


def linearised(frame: Frame, at: ScaleAndPoses, identified: IdentifiedSpots, whitening: Array) -> Linearised:
    """The residuals and their slopes; whitening: see `IdentifiedSpots.whitening`."""
    m, n = identified.used.shape
    cuts = cut(frame, at.rotations, at.translations)
    predicted = at.scale.to_px(cuts.points_mm)
    mask = identified.used[..., None]
    residual = np.where(mask, np.where(mask, identified.spots_px, 0.0) - predicted, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_pose = at.scale.inverse_matrix @ cut_jacobian(cuts, at.translations)
    return Linearised(
        cuts,
        residual,
        (whitening @ residual[..., None]).reshape(m, 2 * n, 1),
        np.where(mask[..., None], whitening @ scale_jacobian(predicted, at.scale), 0.0),
        np.where(mask[..., None], whitening @ by_pose, 0.0).reshape(m, 2 * n, 6),
    )
