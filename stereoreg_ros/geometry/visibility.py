"""Which rods a slice may show."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.projection import Cuts

# A rod that leaves the slice at less than 11.5 degrees (sine 0.2) has a streak for a spot: neither sought nor counted.
LEAST_COSINE: Final = 0.2
# How far beyond its end a rod may be cut: the noise apart, partial volume makes its end unsharp.
END_SLACK_MM: Final = 1.0
# A rod is surely cut only so far from its ends.
SURE_MM: Final = 2.0


def may_show(frame: Frame, cuts: Cuts, slack_mm: float = END_SLACK_MM) -> NDArray[np.bool_]:
    """Whether a slice may show each rod (..., n): between its ends or up to slack_mm beyond, and not along the rod."""
    with np.errstate(invalid="ignore"):
        may = (cuts.lambdas >= frame.lambda_min - slack_mm) & (cuts.lambdas <= frame.lambda_max + slack_mm)
        return np.asarray(may & (np.abs(cuts.directions[..., 2]) >= LEAST_COSINE))


def must_show(frame: Frame, cuts: Cuts) -> NDArray[np.bool_]:
    """Whether a slice must show each rod (..., n) that is in view: well between its ends, and not along the rod."""
    return may_show(frame, cuts, -SURE_MM)
