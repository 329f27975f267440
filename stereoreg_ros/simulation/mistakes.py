"""Scenes with the mistakes that operators make, and with clutter that has order, as sets of spots with a known answer.

Every scene holds what the registration is given (spots, frame, pixel scale, options, previous pose) and what is true.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.simulation.motion import centred_pose, random_pose
from stereoreg_ros.simulation.scene import ScannerSettings

NO_ROD = -1
NOISE_PX = 0.3  # standard deviation per axis of a spot's centre; the default of `spot_noise_px`

_TILT_DEG, _OFFSET_MM = 20.0, 20.0
# A pose may lie this much inside the prior at most, so that noise does not carry it across.
_PRIOR_MARGIN_DEG = 1.0
_TRIES = 500
# Horizontal distance in mm between a rod's ends from which it counts as leaning.
_LEANING_MM = 15.0

TEMPLATE_HOLES, TEMPLATE_PITCH_MM = 13, 5.0
HELICAL_SLOPE = 0.02


@dataclass(frozen=True)
class Surroundings:
    """What scenes are drawn in.

    scanner: size of the image and the true pixel scale; max_rotation_deg: the configured prior about the identity, in
    which all poses lie, except those that contradict it; 180: no prior.
    """

    scanner: ScannerSettings = field(default_factory=ScannerSettings)
    max_rotation_deg: float = 180.0


@dataclass(frozen=True, eq=False)
class Scene:
    """One slice as a set of spots, what is configured, and the truth.

    spots_px: (s, 2) pixel, in random order; rods: (s,), the row in `frame` of the rod that made each spot, NO_ROD for
    all others; frame, scale, options, previous: as configured, options by the names of the registration's; previous is
    scanner_from_frame, None where there is none. slice_area_mm2: area of the image at the configured scale.
    truth: scanner_from_frame; true_frame: the frame as it truly is; both None where the frame is not in the slice.
    """

    spots_px: Array
    rods: NDArray[np.intp]
    frame: Frame
    scale: PixelScale
    options: dict[str, float]
    slice_area_mm2: float
    previous: Pose | None
    truth: Pose | None
    true_frame: Frame | None


SceneGenerator = Callable[[np.random.Generator, Frame, Surroundings], Scene]


def true_scene(
    rng: np.random.Generator,
    frame: Frame,
    around: Surroundings,
    *,
    missing: int = 0,
    most_false: int = 15,
    rod_ends_mm: float = 0.0,
    noise_px: float = NOISE_PX,
    stated_mm: float | None = None,
    stated_scale: float | None = None,
) -> Scene:
    """No mistake, or a small one: the frame within the prior, 0 to `most_false` spots uniform over the image.

    missing: rods without a spot; rod_ends_mm: standard deviation per axis by which the rods' ends differ from the
    file. stated_mm, stated_scale: tolerances of the rods' ends and of the scale as configured; None: not stated.
    """
    true_frame = with_rod_ends_off(rng, frame, rod_ends_mm) if rod_ends_mm else frame
    pose = _pose_within_prior(rng, frame, around)
    spots, rods = _spots(rng, true_frame, pose, around.scanner.scale, noise_px)
    kept = rng.permutation(len(spots))[missing:]
    false = _uniform(rng, int(rng.integers(most_false + 1)), around.scanner)
    configured = frame if stated_mm is None else with_tolerance(frame, stated_mm)
    options = {} if stated_scale is None else {"scale_tolerance": stated_scale}
    drawn = _Drawn(spots[kept], rods[kept], false)
    return _scene(rng, drawn, _Configured(configured, options=options), around, _Truth(pose, true_frame))


def contradicted_prior(rng: np.random.Generator, frame: Frame, around: Surroundings, *, turn_deg: float) -> Scene:
    """The frame turned about the slice's normal by `turn_deg`, while the identity within 30 degrees is configured.

    Half a turn is a patient written as prone, or as feet first. All rods show and there are no false spots.
    """
    rotation = rotation_exp(np.array([0.0, 0.0, math.radians(turn_deg)]))
    nominal = centred_pose(frame, around.scanner, rotation=rotation)
    pose = _random_pose(rng, frame, around.scanner, nominal)
    spots, rods = _spots(rng, frame, pose, around.scanner.scale)
    with_prior = replace(around, max_rotation_deg=30.0)
    return _scene(rng, _Drawn(spots, rods), _Configured(frame), with_prior, _Truth(pose, frame))


def wrong_spacing(
    rng: np.random.Generator,
    frame: Frame,
    around: Surroundings,
    *,
    share: float = 0.05,
) -> Scene:
    """The pixel spacing along one axis is configured too large or too small by `share` of it.

    The true position is given at the configured scale: the middle of the frame is where the image shows it.
    """
    factors = np.ones(2)
    factors[rng.integers(2)] += share * rng.choice([-1, 1])
    true_scale = around.scanner.scale
    scale = replace(true_scale, sx=true_scale.sx * factors[0], sy=true_scale.sy * factors[1])
    pose = _pose_within_prior(rng, frame, around)
    spots, rods = _spots(rng, frame, pose, true_scale)
    middle_mm = pose @ _middle(frame)
    shift = np.append(scale.to_mm(true_scale.to_px(middle_mm[:2])) - middle_mm[:2], 0.0)
    seen = Pose(pose.rotation, pose.translation + shift)
    return _scene(rng, _Drawn(spots, rods), _Configured(frame, scale), around, _Truth(seen, frame))


def scale_within_tolerance(
    rng: np.random.Generator, frame: Frame, around: Surroundings, *, std: float = 0.002, rod_ends_mm: float = 0.0
) -> Scene:
    """Both pixel spacings off by independent normal errors of `std` of them, and both tolerances stated as they are.

    The truth is in true mm from the centre of pixel (0, 0): the position is off by as much as the scale makes it.
    """
    factors = 1 + rng.normal(0.0, std, 2)
    true_scale = around.scanner.scale
    scale = replace(true_scale, sx=true_scale.sx * factors[0], sy=true_scale.sy * factors[1])
    pose = _pose_within_prior(rng, frame, around)
    true_frame = with_rod_ends_off(rng, frame, rod_ends_mm) if rod_ends_mm else frame
    spots, rods = _spots(rng, true_frame, pose, true_scale)
    configured, options = with_tolerance(frame, rod_ends_mm), {"scale_tolerance": std}
    return _scene(rng, _Drawn(spots, rods), _Configured(configured, scale, options), around, _Truth(pose, true_frame))


def mirrored_rod(rng: np.random.Generator, frame: Frame, around: Surroundings) -> Scene:
    """One leaning rod leans the other way in the file; see `with_rod_mirrored`."""
    lean = np.abs(frame.ends - frame.starts)[:, :2].max(axis=1)
    rod = int(rng.choice(np.flatnonzero(lean >= min(_LEANING_MM, lean.max()))))
    pose = _pose_within_prior(rng, frame, around)
    spots, rods = _spots(rng, frame, pose, around.scanner.scale)
    mirrored = _Configured(with_rod_mirrored(frame, rod))
    return _scene(rng, _Drawn(spots, rods), mirrored, around, _Truth(pose, frame))


def helical(rng: np.random.Generator, frame: Frame, around: Surroundings) -> Scene:
    """The table moves while the slice is taken: row y shows the plane z = HELICAL_SLOPE (y - y of the image's middle).

    That is a slice tilted by 1.15 degrees, stretched by 0.02 %: no single slice can tell it from a tilted frame.
    """
    pose = _pose_within_prior(rng, frame, around)
    half = 0.5 * around.scanner.size_mm[1]
    # A point p is seen at p where its z is on the sloping plane: shear z away, then cut by z = 0.
    sheared = _sheared(frame, pose, HELICAL_SLOPE, half)
    spots, rods = _spots(rng, sheared, Pose.identity(), around.scanner.scale)
    return _scene(rng, _Drawn(spots, rods), _Configured(frame), around, _Truth(pose, frame))


def template(rng: np.random.Generator, frame: Frame, around: Surroundings) -> Scene:
    """The frame is absent; holes of a needle template instead: of 13 x 13, 5 mm apart, the corners and 6 to 24 others.

    The template stands within 10 degrees of the image's rows and near the image's centre.
    """
    steps = (np.arange(TEMPLATE_HOLES) - (TEMPLATE_HOLES - 1) / 2) * TEMPLATE_PITCH_MM
    holes = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    at_corner = (np.abs(holes) == steps[-1]).all(axis=1)
    others = rng.permutation(np.flatnonzero(~at_corner))[: rng.integers(6, 25)]
    chosen = np.concatenate([holes[at_corner], holes[others]])
    turn = math.radians(rng.uniform(-10, 10))
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    middle = 0.5 * around.scanner.size_mm + rng.uniform(-_OFFSET_MM, _OFFSET_MM, 2)
    spots = around.scanner.scale.to_px(chosen @ rotation.T + middle) + rng.normal(0.0, NOISE_PX, chosen.shape)
    return _scene(rng, _Drawn(false=spots), _Configured(frame), around, None)


def sister(rng: np.random.Generator, frame: Frame, around: Surroundings, *, missing: int = 0) -> Scene:
    """Two frames of the same kind beside each other, the one asked for without `missing` of its rods' spots.

    Nothing says which of the two is asked for: where both may be accepted, the slice is ambiguous. The image is as wide
    as both need.
    """
    scanner = around.scanner
    width = 1.3 * float(np.linalg.norm(np.ptp(np.concatenate([frame.starts, frame.ends]), axis=0)[:2]))
    if 2 * width > scanner.size_mm[0]:
        scanner = replace(scanner, shape=(scanner.shape[0], math.ceil(2 * width / scanner.scale.sx)))
    wide = replace(around, scanner=scanner)
    sides = (0.25, 0.75) if rng.integers(2) else (0.75, 0.25)
    for _ in range(_TRIES):
        pose, other = (
            _pose_within_prior(rng, frame, wide, centred_pose(frame, scanner, (share, 0.5)), offset_mm=8.0)
            for share in sides
        )
        spots, rods = _spots(rng, frame, pose, scanner.scale)
        others, _ = _spots(rng, frame, other, scanner.scale)
        left, right = (spots, others) if sides[0] < sides[1] else (others, spots)
        if left[:, 0].max() + 10 < right[:, 0].min():
            kept = rng.permutation(len(spots))[missing:]
            return _scene(rng, _Drawn(spots[kept], rods[kept], others), _Configured(frame), wide, _Truth(pose, frame))
    raise ValueError(f"frame '{frame.name}': no two poses found that do not overlap")


def fragments(
    rng: np.random.Generator,
    frame: Frame,
    around: Surroundings,
    *,
    pieces: tuple[int, int] = (3, 6),
    radius_mm: tuple[float, float] = (1.0, 3.0),
    with_previous: bool = True,
) -> Scene:
    """Each rod's spot broken into pieces, uniform in a disc about the rod, the same number and radius for all rods.

    with_previous: the pose before is given, 1 to 2 mm and 1 degree off.
    """
    pose = _pose_within_prior(rng, frame, around)
    centres, rods = _spots(rng, frame, pose, around.scanner.scale, 0.0)
    count, radius = int(rng.integers(pieces[0], pieces[1] + 1)), rng.uniform(*radius_mm)
    angle = rng.uniform(0, 2 * np.pi, (len(centres), count))
    distance = radius * np.sqrt(rng.uniform(0, 1, angle.shape))
    offset = around.scanner.scale.to_px(np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1))
    spots = (centres[:, None] + offset).reshape(-1, 2)
    spots += rng.normal(0.0, NOISE_PX, spots.shape)
    previous = _near(rng, pose, frame, rng.uniform(1.0, 2.0), 1.0) if with_previous else None
    configured = _Configured(frame, previous=previous)
    return _scene(rng, _Drawn(spots, np.repeat(rods, count)), configured, around, _Truth(pose, frame))


def collinear(rng: np.random.Generator, frame: Frame, around: Surroundings, *, missing: int = 0) -> Scene:
    """One to three needles or streaks of 4 to 8 false spots each, evenly spaced along lines through rods' spots.

    missing: rods without a spot, though a line may run through where it would be.
    """
    scanner = around.scanner
    pose = _pose_within_prior(rng, frame, around)
    spots, rods = _spots(rng, frame, pose, scanner.scale)
    lines = [_streak(rng, scanner.scale.to_mm(spots)) for _ in range(rng.integers(1, 4))]
    clutter = scanner.scale.to_px(np.concatenate(lines))
    clutter = clutter[((clutter >= 0) & (clutter < scanner.shape[::-1])).all(axis=1)]
    clutter += rng.normal(0.0, NOISE_PX, clutter.shape)
    kept = rng.permutation(len(spots))[missing:]
    return _scene(rng, _Drawn(spots[kept], rods[kept], clutter), _Configured(frame), around, _Truth(pose, frame))


def with_rod_ends_off(rng: np.random.Generator, frame: Frame, std_mm: float) -> Frame:
    """The frame with normal errors of `std_mm` per axis at both ends of every rod."""
    errors = rng.normal(0.0, std_mm, (2, len(frame), 3))
    return replace(frame, starts=frame.starts + errors[0], ends=frame.ends + errors[1])


def with_tolerance(frame: Frame, tolerance_mm: float) -> Frame:
    """The frame with this tolerance of all its rods."""
    return replace(frame, tolerances_mm=np.full(len(frame), tolerance_mm))


def with_rod_mirrored(frame: Frame, rod: int) -> Frame:
    """The frame with a rod (row) that leans the other way: its ends change places along x or y, not in height.

    It is the axis along which they are farther apart.
    """
    starts, ends = frame.starts.copy(), frame.ends.copy()
    axis = int(np.abs(frame.ends - frame.starts)[rod, :2].argmax())
    starts[rod, axis], ends[rod, axis] = frame.ends[rod, axis], frame.starts[rod, axis]
    return replace(frame, name=f"{frame.name}, {frame.line_names[rod]} mirrored", starts=starts, ends=ends)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Spots (s, 2) in pixel, the rods (s,) that made them, and false spots (k, 2)."""

    spots: Array = field(default_factory=lambda: np.empty((0, 2)))
    rods: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    false: Array = field(default_factory=lambda: np.empty((0, 2)))


@dataclass(frozen=True, eq=False)
class _Configured:
    """What is configured besides the prior; see Scene. scale: None where it is the true one."""

    frame: Frame
    scale: PixelScale | None = None
    options: dict[str, float] = field(default_factory=dict)
    previous: Pose | None = None


@dataclass(frozen=True, eq=False)
class _Truth:
    """scanner_from_frame, and the frame as it truly is."""

    pose: Pose
    frame: Frame


def _scene(
    rng: np.random.Generator, drawn: _Drawn, configured: _Configured, around: Surroundings, truth: _Truth | None
) -> Scene:
    scale = configured.scale or around.scanner.scale
    spots = np.concatenate([drawn.spots, drawn.false])
    rods = np.concatenate([drawn.rods, np.full(len(drawn.false), NO_ROD)])
    order = rng.permutation(len(spots))
    return Scene(
        spots_px=spots[order],
        rods=rods[order],
        frame=configured.frame,
        scale=scale,
        options={"max_rotation_deg": around.max_rotation_deg, **configured.options},
        slice_area_mm2=float(np.prod(around.scanner.shape)) * scale.sx * scale.sy,
        previous=configured.previous,
        truth=truth.pose if truth is not None else None,
        true_frame=truth.frame if truth is not None else None,
    )


def _uniform(rng: np.random.Generator, count: int, scanner: ScannerSettings) -> Array:
    spots: Array = rng.uniform(0, scanner.shape[::-1], (count, 2))
    return spots


def _spots(
    rng: np.random.Generator, frame: Frame, pose: Pose, scale: PixelScale, noise_px: float = NOISE_PX
) -> tuple[Array, NDArray[np.intp]]:
    """Spots (k, 2) of the rods that the slice cuts, with their noise, and the rods' rows (k,)."""
    predicted, cuts = project(frame, pose, scale)
    rods = np.flatnonzero(cuts.inside)
    return predicted[rods] + rng.normal(0.0, noise_px, (len(rods), 2)), rods


def _middle(frame: Frame) -> Array:
    """Middle (3,) of the box about the rods, mm, in the frame's axes."""
    ends = np.concatenate([frame.starts, frame.ends])
    middle: Array = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
    return middle


def _random_pose(
    rng: np.random.Generator,
    frame: Frame,
    scanner: ScannerSettings,
    nominal: Pose | None = None,
    offset_mm: float = _OFFSET_MM,
) -> Pose:
    """A pose with which the slice cuts every rod, at any height within the middle third of the frame's."""
    height = float(np.ptp(np.concatenate([frame.starts, frame.ends])[:, 2]))
    thin = replace(scanner, slice_thickness_mm=0.05)
    return random_pose(
        rng,
        frame,
        thin,
        max_tilt_deg=_TILT_DEG,
        max_offset_mm=offset_mm,
        max_depth_mm=height / 6,
        nominal=nominal,
    )


def _pose_within_prior(
    rng: np.random.Generator,
    frame: Frame,
    around: Surroundings,
    nominal: Pose | None = None,
    offset_mm: float = _OFFSET_MM,
) -> Pose:
    for _ in range(_TRIES):
        pose = _random_pose(rng, frame, around.scanner, nominal, offset_mm)
        if math.degrees(float(rotation_angle(pose.rotation))) <= around.max_rotation_deg - _PRIOR_MARGIN_DEG:
            return pose
    raise ValueError(f"frame '{frame.name}': no pose found within {around.max_rotation_deg:g} degrees")


def _near(rng: np.random.Generator, pose: Pose, frame: Frame, distance_mm: float, angle_deg: float) -> Pose:
    """The pose with the frame's middle moved and the frame turned about it, in directions drawn at random."""
    step, axis = rng.normal(size=(2, 3))
    turned = rotation_exp(math.radians(angle_deg) * axis / np.linalg.norm(axis)) @ pose.rotation
    middle = pose @ _middle(frame) + distance_mm * step / np.linalg.norm(step)
    return Pose(turned, middle - turned @ _middle(frame))


def _sheared(frame: Frame, pose: Pose, slope: float, half_mm: float) -> Frame:
    """The frame in slice axes, with z taken from the plane that rises by `slope` along y through y = half_mm."""
    starts, ends = pose @ frame.starts, pose @ frame.ends
    for points in (starts, ends):
        points[:, 2] -= slope * (points[:, 1] - half_mm)
    return replace(frame, starts=starts, ends=ends)


def _streak(rng: np.random.Generator, rods_mm: Array) -> Array:
    """Points (k, 2) mm, a step apart, on a line through one or two of the rods' spots, but not at the first."""
    first, second = rng.permutation(len(rods_mm))[:2]
    if rng.integers(2):
        angle = rng.uniform(0, np.pi)
        direction = np.array([math.cos(angle), math.sin(angle)])
    else:
        direction = rods_mm[second] - rods_mm[first]
        direction /= np.linalg.norm(direction)
    count, step = int(rng.integers(4, 9)), rng.uniform(3.0, 8.0)
    places = np.arange(-count, count + 1)
    start = int(rng.integers(count + 1))
    chosen = places[places != 0][start : start + count]
    points: Array = rods_mm[first] + step * chosen[:, None] * direction
    return points
