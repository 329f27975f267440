"""What Maurin 2009 measured (section 6), for putting beside ours."""

from __future__ import annotations

from typing import Final, NamedTuple

# Level in pixel at which the text gives figures for the pose, and the figures, mm and degrees.
NOISE_PX: Final = 0.5
POSE_CLOSED_FORM: Final = {4: (1.0, 3.0), 8: (0.35, 0.8)}
POSE_NEWTON_RAPHSON: Final = {4: (0.5, 1.5), 8: (0.2, 0.3)}
# Order of magnitude of fig. 7, mm/pixel.
SCALE_ERROR: Final = 1e-3

# Fig. 10: largest mean error, percent; largest standard deviations of sx, sy, mm/pixel.
SEQUENCE_ERROR_PERCENT: Final = 5.0
SEQUENCE_STD: Final = (4e-3, 2e-3)

# The second cube's origin in the first one's axes, mm.
RAIL_OFFSET_MM: Final = (0.0, -118.290, 0.0)


class RailErrors(NamedTuple):
    """A line of table 1: mean errors and standard deviations (x, y, z), mm."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]


# By number of lines and method.
RAIL: Final = {
    (6, "LS"): RailErrors((0.88, 1.04, 0.98), (0.99, 0.68, 2.81)),
    (5, "LS"): RailErrors((0.77, 0.75, 4.86), (1.03, 0.93, 3.03)),
    (6, "N-R"): RailErrors((0.15, 0.79, 0.74), (0.91, 0.35, 2.32)),
    (5, "N-R"): RailErrors((0.26, 1.11, 2.18), (0.97, 0.52, 4.64)),
}

# Fig. 12.
BOX_MM: Final = 2.0
SPOT_ERROR_PX: Final = 0.25

# Table 2: by number of false spots, seconds without collinearity test, with s_c = sin 10, with s_c = sin 20 degrees.
MATCHING_S: Final = {
    0: ("0.38", "0.17-0.33", "0.05-0.16"),
    1: ("0.85", "0.29-0.68", "0.12-0.42"),
    4: ("5.1", "1.3-3.2", "0.5-2.4"),
    8: ("24.2", "5.7-13.2", "3.7-9.5"),
    24: ("645", "365", "171"),
}
