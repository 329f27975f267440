"""What a frame can do: which rods a slice shows, what error to expect, what is ambiguous, degenerate or weak."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.frames.ambiguity import Trial, reasons, trials
from stereoreg_ros.frames.expected_error import Expected, Imaging, expected, point_covariances, scale_information
from stereoreg_ros.frames.layouts import Layouts
from stereoreg_ros.frames.slice_poses import SlicePoses, slice_poses
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, rotation_from_quaternion
from stereoreg_ros.geometry.projection import Cuts
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.solvers.arrangement import (
    fewer_than_three_directions,
    three_collinear_spots,
    three_coplanar_lines,
)
from stereoreg_ros.uncertainty import error_ball_95

# Rods that fix the scale too (Maurin 2009, section 3), and with it need one more than the pose.
_RODS_FOR_SCALE = 5
HANDEDNESS: Final = (
    "axes must be right-handed: a mirrored image, or a frame file with left-handed axes, fits one slice exactly, and "
    "only a series of slices shows it"
)


@dataclass(frozen=True, eq=False)
class Inspection:
    """What `inspect` found out over p poses in which at least `min_inliers` rods show.

    tolerances_mm: (n,), assumed standard deviation per axis of the rods' ends, the frame's own or the option's; shown:
    share of all poses drawn in which they do; visible: (p, n); error_origin_mm, error_target_mm: (p,), radii of
    the 95 % error balls at the frame's origin and at the target; position_std_mm, rotation_std_deg: (3,), medians along
    and about the frame's axes; weakest_axis, weakest_rotation_axis: (3,), in the frame's axes, along and about which
    the pose is known worst on the whole; scale_std_percent: (p,) of the worse of sx and sy from one slice, infinite
    where it does not follow; singular: names of section 3.1 with the share of poses in which each was found;
    whole, one_missing: what the registration made of the spots, with all rods and with each one left out.
    """

    frame: Frame
    options: RegistrationOptions
    scale: PixelScale
    tolerances_mm: Array
    poses: SlicePoses
    shown: float
    visible: NDArray[np.bool_]
    error_origin_mm: Array
    error_target_mm: Array
    position_std_mm: Array
    rotation_std_deg: Array
    weakest_axis: Array
    weakest_rotation_axis: Array
    scale_std_percent: Array
    singular: dict[str, float]
    whole: tuple[Trial, ...]
    one_missing: tuple[Trial, ...]

    def record(self) -> dict[str, Any]:
        """Everything as plain values for JSON; a number that does not exist is None."""
        return {
            "frame": self.frame.name,
            "lines": len(self.frame),
            "orientation_required": self.frame.orientation_required,
            "spot_noise_px": self.options.spot_noise_px,
            "tolerances_mm": dict(zip(self.frame.line_names, self.tolerances_mm.tolist(), strict=True)),
            "scale_tolerance": self.options.scale_tolerance,
            "poses": len(self.poses),
            "share_of_poses_shown": self.shown,
            "visible_rods": {
                name: float(share) for name, share in zip(self.frame.line_names, self.visible.mean(axis=0), strict=True)
            },
            "rods_per_slice": {str(count): float(share) for count, share in _shares(self.visible.sum(axis=1)).items()},
            "error_origin_95_mm": _spread(self.error_origin_mm),
            "target_in_frame_mm": list(self.options.target_in_frame_mm),
            "error_target_95_mm": _spread(self.error_target_mm),
            "position_std_mm": self.position_std_mm.tolist(),
            "rotation_std_deg": self.rotation_std_deg.tolist(),
            "weakest_axis": self.weakest_axis.tolist(),
            "weakest_rotation_axis": self.weakest_rotation_axis.tolist(),
            "scale_std_percent": _spread(self.scale_std_percent),
            "singular_arrangements": self.singular,
            "outcomes": dict(reasons(self.whole)),
            "outcomes_one_rod_missing": dict(reasons(self.one_missing)),
            "wrong": sum(not trial.reason and not trial.right for trial in (*self.whole, *self.one_missing)),
            "twins": twins_of([*self.whole, *self.one_missing]),
            "cautions": [HANDEDNESS],
        }


def inspect_frame(
    frame: Frame,
    options: RegistrationOptions,
    scale: PixelScale,
    largest_tilt_deg: float = 30.0,
    count: int = 200,
    seed: int = 0,
    progress: Callable[[float], bool] | None = None,
) -> Inspection:
    """Look at the frame in `count` poses, evenly drawn over tilts, turns and heights, that show `min_inliers` rods.

    largest_tilt_deg: of the slice's normal against the frame's z axis as it nominally stands (`nominal_orientation`),
    within `max_rotation_deg`. A tenth of the poses are given to the registration itself, with one rod left out after
    the other. progress: called with the share done; where it returns False, these are cut short.
    Raises ValueError where no pose shows `min_inliers` rods, or the tilt is out of range.
    """
    if not 0 <= largest_tilt_deg <= 180:
        raise ValueError(f"tilt is {largest_tilt_deg!r}, expected from 0 to 180 degrees")
    drawn = _drawn(frame, options, largest_tilt_deg, 4 * count, seed)
    imaging = Imaging.of(scale, options)
    layout = Layouts.of(frame)
    shows = expected(layout, drawn, imaging).visible[0].sum(axis=-1) >= options.min_inliers
    if not shows.any():
        raise ValueError(
            f"frame '{frame.name}': no slice within {largest_tilt_deg:g} degrees shows {options.min_inliers} rods"
        )
    poses = drawn.take(np.flatnonzero(shows)[:count])
    bound = expected(layout, poses, imaging)
    covariances, rotations = bound.covariances[0], poses.rotations
    in_frame = _turned(covariances, rotations)
    mean = _median_of_known(in_frame)
    tried = _tried(frame, poses, scale, options, seed, progress)
    return Inspection(
        frame=frame,
        options=options,
        scale=scale,
        tolerances_mm=layout.tolerances_or(options.frame_tolerance_mm),
        poses=poses,
        shown=float(shows.mean()),
        visible=bound.visible[0],
        error_origin_mm=_balls(point_covariances(covariances, rotations, np.zeros(3))),
        error_target_mm=_balls(point_covariances(covariances, rotations, np.array(options.target_in_frame_mm))),
        position_std_mm=np.sqrt(np.median(np.einsum("pii->pi", in_frame[:, :3, :3]), axis=0)),
        rotation_std_deg=np.degrees(np.sqrt(np.median(np.einsum("pii->pi", in_frame[:, 3:, 3:]), axis=0))),
        weakest_axis=_upright(np.linalg.eigh(mean[:3, :3])[1][:, -1]),
        weakest_rotation_axis=_upright(np.linalg.eigh(mean[3:, 3:])[1][:, -1]),
        scale_std_percent=_scale_std_percent(bound),
        singular=_singular(frame, bound.cuts, bound.visible[0]),
        whole=tuple(trial for trial in tried if trial.left_out is None),
        one_missing=tuple(trial for trial in tried if trial.left_out is not None),
    )


def twins_of(tried: list[Trial]) -> list[dict[str, Any]]:
    """The wrong explanations, the most frequent first: which rods stand for which, how often, how far off."""
    found: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for trial in tried:
        for exchange, angle, distance in trial.twins:
            found[exchange].append((angle, distance))
    return [
        {
            "rods": exchange,
            "times": len(where),
            "angle_deg": float(np.median([angle for angle, _ in where])),
            "distance_mm": float(np.median([distance for _, distance in where])),
        }
        for exchange, where in sorted(found.items(), key=lambda item: -len(item[1]))
    ]


def _drawn(frame: Frame, options: RegistrationOptions, tilt_deg: float, count: int, seed: int) -> SlicePoses:
    ends = np.concatenate([frame.starts, frame.ends])
    middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
    reach = float(np.linalg.norm(ends - middle, axis=1).max())
    nominal = rotation_from_quaternion(options.nominal_orientation)
    heights = np.array([-reach, reach])
    return slice_poses(count, seed, middle, heights, tilt_deg, nominal, options.max_rotation_deg)


def _tried(
    frame: Frame,
    poses: SlicePoses,
    scale: PixelScale,
    options: RegistrationOptions,
    seed: int,
    progress: Callable[[float], bool] | None,
) -> list[Trial]:
    """All rods in every pose; one left out, in turn, in as many poses as take that long again."""
    rng = np.random.default_rng(seed)
    n = len(frame)
    few = poses.take(np.arange(0, len(poses), n))
    total = len(poses) + n * len(few)
    made: list[Trial] = []
    for part, left_out in ((poses, [None]), (few, list(range(n)))):
        for trial in trials(frame, part, scale, options, left_out, rng):
            made.append(trial)
            if progress is not None and not progress(len(made) / total):
                return made
    return made


def _turned(covariances: Array, rotations: Array) -> Array:
    """Covariances (p, 6, 6) from slice axes to the frame's."""
    turn = np.zeros((len(rotations), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(rotations, 1, 2)
    turned: Array = turn @ covariances @ np.swapaxes(turn, 1, 2)
    return turned


def _median_of_known(covariances: Array) -> Array:
    """The mean of the better half, so that a few poses which determine nothing do not drown the others."""
    traces = np.einsum("pii->p", covariances)
    return np.asarray(covariances[traces <= np.median(traces)].mean(axis=0))


def _balls(covariances: Array) -> Array:
    return np.array([error_ball_95(covariance) for covariance in covariances])


def _upright(axis: Array) -> Array:
    """Of the two senses of an axis, the one whose largest component is positive."""
    upright: Array = axis * np.sign(axis[np.abs(axis).argmax()])
    return upright


def _scale_std_percent(bound: Expected) -> Array:
    """Of the worse of sx and sy, from one slice whose pose is unknown."""
    values, vectors = np.linalg.eigh(scale_information(bound)[0])
    variances = np.einsum("pik,pk->pi", vectors**2, 1 / np.maximum(values, 1e-12))
    with_pose_known = np.einsum("pii->p", bound.information[0, :, 6:, 6:])
    found = (bound.visible[0].sum(axis=1) >= _RODS_FOR_SCALE) & (values[:, 0] > 1e-6 * with_pose_known)
    return np.where(found, 100 * np.sqrt(variances.max(axis=1)), np.inf)


def _singular(frame: Frame, cuts: Cuts, visible: NDArray[np.bool_]) -> dict[str, float]:
    """Arrangements of Maurin 2009, section 3.1, and the share of poses in which each is met."""
    met: Counter[str] = Counter()
    for points, shown in zip(cuts.points_mm[0], visible, strict=True):
        lines = np.flatnonzero(shown)
        found = [
            *three_coplanar_lines(frame, lines),
            *three_collinear_spots(points[lines]),
            *fewer_than_three_directions(frame, lines),
        ]
        met.update({one.name for one in found})
    return {name: times / len(visible) for name, times in met.most_common()}


def _shares(counts: NDArray[np.intp]) -> dict[int, float]:
    values, times = np.unique(counts, return_counts=True)
    return {int(value): float(many) / len(counts) for value, many in zip(values, times, strict=True)}


def _spread(values: Array) -> dict[str, float | None]:
    """Median, 95 % quantile and worst; None for what is infinite or as good as that."""
    figures = {
        "median": np.median(values),
        "95_percent": np.quantile(values, 0.95, method="higher"),
        "worst": values.max(),
    }
    return {name: float(value) if value < 1e5 else None for name, value in figures.items()}
