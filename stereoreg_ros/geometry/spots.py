"""The bright spots of one slice: what goes from spot finding to matching, calibration and drawing."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import PixelScale

# By how much rounding may make a variance negative.
_ROUNDING_PX2: Final = 1e-9


@dataclass(frozen=True, eq=False)
class SliceSpots:
    """The spots of a slice, n of them, and what is known of the slice they were found in.

    centres_px: (n, 2), pixel (u, v). scale: mm/pixel. covariances_px2: (n, 2, 2) of the centres, as the image shows
    them; by default zero, where nothing is known of that. extents_px2: (n, 2, 2), second moments of each spot's
    brightness, its size and elongation; by default NaN, where they were not measured. cut_short: (n,), whether the spot
    may be larger than `extents_px2` has it; by default false. scanner_from_slice: the slice's plane; by default the
    scanner is the slice. area_mm2: of the slice, over which spots could have been found; None where it is not known.
    scale_covariance: (3, 3) of (sx, sy, shear), mm^2/pixel^2, where `scale` was measured. stated_scale: the scale that
    came with the slice itself, which a measured one may have replaced; None where somebody typed the scale in.

    Raises ValueError where the shapes do not fit, a number is not finite, or a covariance is not symmetric or has a
    negative variance.
    """

    centres_px: Array
    scale: PixelScale
    covariances_px2: Array = None  # type: ignore[assignment]
    extents_px2: Array = None  # type: ignore[assignment]
    cut_short: NDArray[np.bool_] = None  # type: ignore[assignment]
    scanner_from_slice: Pose = field(default_factory=Pose.identity)
    area_mm2: float | None = None
    scale_covariance: Array | None = None
    stated_scale: PixelScale | None = None

    def __post_init__(self) -> None:
        centres = np.asarray(self.centres_px, dtype=np.float64)
        if centres.size == 0:
            centres = centres.reshape(0, 2)
        if centres.ndim != 2 or centres.shape[1] != 2:
            raise ValueError(f"spots_px has shape {centres.shape}, expected (n, 2)")
        if not np.isfinite(centres).all():
            raise ValueError("spots_px must be finite")
        count = len(centres)
        known = self.covariances_px2 is not None
        covariances = _checked_covariances(self.covariances_px2, count) if known else np.zeros((count, 2, 2))
        extents = np.full((count, 2, 2), np.nan) if self.extents_px2 is None else np.asarray(self.extents_px2)
        if extents.shape != (count, 2, 2):
            raise ValueError(f"extents_px2 has shape {extents.shape}, expected ({count}, 2, 2)")
        cut_short = np.zeros(count, dtype=bool) if self.cut_short is None else np.asarray(self.cut_short, dtype=bool)
        if cut_short.shape != (count,):
            raise ValueError(f"cut_short has shape {cut_short.shape}, expected ({count},)")
        for name, value in (
            ("centres_px", centres),
            ("covariances_px2", covariances),
            ("extents_px2", extents),
            ("cut_short", cut_short),
        ):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.centres_px)

    @property
    def centres_mm(self) -> Array:
        """The centres (n, 2) in the slice, mm."""
        return self.scale.to_mm(self.centres_px)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> SliceSpots:
        """Only the given spots, of the same slice."""
        return replace(
            self,
            centres_px=self.centres_px[rows],
            covariances_px2=self.covariances_px2[rows],
            extents_px2=self.extents_px2[rows],
            cut_short=self.cut_short[rows],
        )

    def with_scale(self, scale: PixelScale) -> SliceSpots:
        """The same pixels with another scale, mm/pixel, whose errors are not known: the slice's area follows it."""
        area_mm2 = self.area_mm2
        if area_mm2 is not None:
            area_mm2 *= (scale.sx * scale.sy) / (self.scale.sx * self.scale.sy)
        return replace(self, scale=scale, area_mm2=area_mm2, scale_covariance=None)

    def noise_px2(self, least_std_px: float) -> Array:
        """Covariances (n, 2, 2), pixel^2, without a direction of a smaller standard deviation than least_std_px."""
        if not self.covariances_px2.any():
            return np.tile(least_std_px**2 * np.eye(2), (len(self), 1, 1))
        values, vectors = np.linalg.eigh(self.covariances_px2)
        raised: Array = (vectors * np.maximum(values, least_std_px**2)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
        return raised


def _checked_covariances(covariances_px2: Array, count: int) -> Array:
    covariances = np.asarray(covariances_px2, dtype=np.float64)
    if covariances.shape != (count, 2, 2):
        raise ValueError(f"covariances_px2 has shape {covariances.shape}, expected ({count}, 2, 2)")
    turned = np.swapaxes(covariances, 1, 2)
    if not np.isfinite(covariances).all() or not np.allclose(covariances, turned, rtol=1e-6, atol=1e-12):
        raise ValueError("covariances_px2 must be finite and symmetric")
    covariances = 0.5 * (covariances + turned)
    if count and np.linalg.eigvalsh(covariances).min() < -_ROUNDING_PX2:
        raise ValueError("covariances_px2 holds a matrix with a negative variance")
    return np.asarray(covariances)
