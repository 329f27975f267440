"""The frames of the reproduction. The paper's layouts are not published: these were chosen, openly, in their place."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame

_DIAMETER_MM: Final = 1.0


def _frame(name: str, ends_mm: ArrayLike) -> Frame:
    """Rods from[x, y, z], to[x, y, z], (n, 6), named a, b, c, ..."""
    ends = np.asarray(ends_mm, dtype=np.float64)
    names = tuple("abcdefgh"[: len(ends)])
    return Frame(name, names, ends[:, :3], ends[:, 3:], np.full(len(ends), _DIAMETER_MM))


# Between the lower and the upper face of a cube of 60 mm, the lower one at z = 0, since the paper's slices lie at
# z = 30 +- 10. Figures with n lines use the first n. Selected, as the report says: a to d by a search for a small
# Cramer-Rao bound; e to h among random ones for a small bound, Newton-Raphson below the paper's figures and closed
# forms near them. The layouts drawn without selection did worse.
EIGHT_RODS: Final = _frame(
    "eight rods",
    [
        [30, -26, 0, 30, 24, 60],
        [-26, 30, 0, 22, 30, 60],
        [-30, 26, 0, -30, -24, 60],
        [24, -30, 0, -26, -30, 60],
        [-30, -2, 0, 27, -30, 60],
        [29, -11, 0, -7, 14, 60],
        [20, 10, 0, 30, -25, 60],
        [23, 25, 0, 20, -6, 60],
    ],
)

# The two cubes on the rail, their origins in their middles; the first is the shipped one. The second was drawn at
# random over even mm: rods 9 mm or more apart, no three in one plane, and of those found the most accurate.
FIRST_CUBE: Final = load_frame("cube6")
SECOND_CUBE: Final = _frame(
    "second cube",
    [
        [30, -12, -30, -8, -22, 30],
        [-2, 8, -30, -30, -30, 30],
        [4, -30, -30, -16, -2, 30],
        [26, 12, -30, -4, 4, 30],
        [14, 28, -30, 28, 12, 30],
        [-28, 30, -30, -8, 20, 30],
    ],
)


def first_rods(frame: Frame, count: int) -> Frame:
    """The frame of the first `count` rods."""
    return Frame(
        frame.name, frame.line_names[:count], frame.starts[:count], frame.ends[:count], frame.diameters[:count]
    )


def shrunk(frame: Frame, share: float) -> Frame:
    """The frame with all coordinates multiplied by `share`; the rods stay as thick as they are."""
    return Frame(
        f"{frame.name}, scaled by {share:g}",
        frame.line_names,
        share * frame.starts,
        share * frame.ends,
        frame.diameters,
    )
