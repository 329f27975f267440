"""In which poses the spots of a frame could be explained by another pose too, and by which."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereoreg_ros.frames.slice_poses import SlicePoses
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, rotation_angle
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.registration import register_spots

_PIXELS = 512 * 512


@dataclass(frozen=True, eq=False)
class Trial:
    """What the registration made of the spots of one pose.

    left_out: row of the rod that was taken for missing, or None; reason: empty where accepted; right: whether the pose
    (accepted) or the best explanation (refused) has every spot on its rod; twins: each other explanation as
    (rods in the true order -> rods it puts there), with the angle in degrees and the distance in mm to the true pose.
    """

    left_out: int | None
    reason: str
    right: bool
    twins: tuple[tuple[str, float, float], ...]


def trials(
    frame: Frame,
    poses: SlicePoses,
    scale: PixelScale,
    options: RegistrationOptions,
    left_out: Sequence[int | None],
    rng: np.random.Generator,
) -> Iterator[Trial]:
    """Register the frame from the spots of each pose, with the stated noise, for each choice of a rod left out.

    In each pose the rods are another specimen's, within the tolerance, and the scale another scanner's. The spots are
    taken to be all that a slice of 512 x 512 pixels shows.
    """
    area_mm2 = _PIXELS * scale.sx * scale.sy
    tolerances_mm = frame.tolerances_or(options.frame_tolerance_mm)
    specimens = rng.spawn(1)[0]
    for row in range(len(poses)):
        slice_from_frame = poses.pose(row)
        built = _specimen(frame, tolerances_mm, specimens)
        stretch_x, stretch_y = 1 + options.scale_tolerance * specimens.standard_normal(2)
        taken = PixelScale(stretch_x * scale.sx, stretch_y * scale.sy, scale.shear)
        spots_px, cuts = project(built, slice_from_frame, taken)
        for out in left_out:
            lines = np.flatnonzero(cuts.inside & (np.arange(len(frame)) != (-1 if out is None else out)))
            noisy = spots_px[lines] + options.spot_noise_px * rng.standard_normal((len(lines), 2))
            result = register_spots(noisy, frame, scale, options, slice_area_mm2=area_mm2)
            estimates = (result.estimate,) if result else result.estimates
            by_spot = [sorted((match.spot, match.line_index) for match in one.matches) for one in estimates]
            spots = [[spot for spot, _ in pairs] for pairs in by_spot]
            explanations = [[line for _, line in pairs] for pairs in by_spot]
            right = bool(explanations) and list(lines[spots[0]]) == explanations[0]
            twins = []
            for estimate, put, on in zip(estimates, explanations, spots, strict=True):
                true = list(lines[on])
                if put != true:
                    names = [[frame.line_names[line] for line in chosen] for chosen in (true, put)]
                    away = estimate.slice_from_frame @ slice_from_frame.inverse()
                    moved = estimate.slice_from_frame.translation - slice_from_frame.translation
                    angle = math.degrees(float(rotation_angle(away.rotation)))
                    exchange = f"{','.join(names[0])} -> {','.join(names[1])}"
                    twins.append((exchange, angle, float(np.linalg.norm(moved))))
            yield Trial(out, "" if result else result.reason, right, tuple(twins))


def _specimen(frame: Frame, tolerances_mm: Array, rng: np.random.Generator) -> Frame:
    """The frame as it may have been built."""
    off = tolerances_mm[:, None] * rng.standard_normal((2, len(frame), 3))
    return replace(frame, starts=frame.starts + off[0], ends=frame.ends + off[1])


def reasons(made: Sequence[Trial]) -> Counter[str]:
    """How often which outcome; `accepted` for those that were."""
    return Counter(trial.reason or "accepted" for trial in made)
