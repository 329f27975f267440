"""Scenes of `benchmarks.real_frames`: slices of real frames as they are, with rods taken away and false spots added.

Each scene says where the frame truly is: by all slices of its series together, so that a slice is judged by the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame, register_slice
from stereoreg_ros.dicom import read_series
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.registration import register_slice_spots
from stereoreg_ros.result import Refusal, Registration
from stereoreg_ros.simulation import Cylinder, PlacedFrame, ScannerSettings, render_slice
from stereoreg_ros.spots import find_spots

ROOT: Final = Path(__file__).resolve().parents[2]
SHARED_DATA: Final = ROOT.parent / "shared" / "data"
PRIOR_DEG: Final = 30.0

# One pose fitted to all slices of leksell9_ct (README of the data): where a point of the frame lies, and the rotation.
LEKSELL_POINT_MM: Final = np.array([95.0, -60.0, -60.0])
_LEKSELL_ROTATION: Final = rotation_exp(np.radians([-0.18, 1.51, 0.38]))
LEKSELL_POSE: Final = Pose(_LEKSELL_ROTATION, np.array([3.05, -0.65, -6.68]) - _LEKSELL_ROTATION @ LEKSELL_POINT_MM)
# Heights, mm, between which all nine rods are visible.
LEKSELL_HEIGHTS: Final = (-50.0, 52.0)
# A spot this near to where the reference puts a rod, mm, is that rod's: rods are off by up to 0.8 mm.
_SAME_ROD_MM: Final = 3.0

# Slices of the Z-frame that show all seven tubes, and those around them that show some.
ZFRAME_FULL: Final = range(6, 12)
ZFRAME_PARTLY: Final = range(5, 13)
ZFRAME_THICKNESS_MM: Final = 2.4
# Half a turn about y maps the Z-frame onto itself.
ZFRAME_SYMMETRY: Final = "y180"
# Around a tube that is erased, mm: beyond its outline, and the ring that says what is behind it.
_ERASED_MM, _RING_MM = 2.5, 2.0


class AbsentError(Exception):
    """Images that a row needs are not on this machine."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A slice to register, and the truth.

    scanner_from_frame: the true pose; point_mm: (3,) of the frame, at which errors count; largest_mm, largest_deg: what
    an accepted pose may be off by, whatever it states. table_mm: the slice's table position. register: does it.
    """

    name: str
    scanner_from_frame: Pose
    point_mm: Array
    largest_mm: float
    largest_deg: float
    table_mm: float
    register: Callable[[], Registration | Refusal]


@dataclass(frozen=True)
class Target:
    """What a row has to reach besides no wrong pose.

    accepted, most_accepted: least and largest share of the scenes; inside: whether 93 to 97 % of the errors are to be
    within the stated 95 % radius; all_inside: whether each of them is. steps: whether the recovered plane is to step
    with the table. may_be_wrong: where no slice can show it.
    """

    accepted: float = 0.0
    most_accepted: float = 1.0
    inside: bool = False
    all_inside: bool = False
    steps: bool = False
    may_be_wrong: bool = False


@dataclass(frozen=True, eq=False)
class Row:
    """Scenes of one kind, listed when they are wanted, as that may take images. quick: one for a first look."""

    name: str
    scenes: Callable[[], Iterator[Scene]] = field(repr=False)
    target: Target = field(default_factory=Target)
    quick: bool = True


def series_at(folder: Path) -> tuple[tuple[str, Slice], ...]:
    """Slices of a folder in table order, by name; AbsentError where it is not there."""
    if not folder.is_dir():
        raise AbsentError(f"{folder} is not there")
    return _read(folder)


@lru_cache(maxsize=4)
def _read(folder: Path) -> tuple[tuple[str, Slice], ...]:
    return tuple((one.header.path.stem, one.ct_slice) for one in read_series(folder))


def height_mm(ct_slice: Slice) -> float:
    """Table position of a slice, mm."""
    return float(ct_slice.scanner_from_slice.translation[2])


@lru_cache(maxsize=1024)
def _spots_of(ct_slice: Slice, options: RegistrationOptions) -> SliceSpots:
    return find_spots(ct_slice, options)


# Leksell


@dataclass(frozen=True)
class Change:
    """What is done to the spots of a slice: those of `rods` removed, `false_spots` added."""

    rods: tuple[str, ...] = ()
    false_spots: int = 0


def plates(frame: Frame) -> list[tuple[str, ...]]:
    """Names of the rods of each plate of a Leksell indicator: they begin alike."""
    sides = sorted({name.split("_")[0] for name in frame.line_names})
    return [tuple(name for name in frame.line_names if name.split("_")[0] == side) for side in sides]


def leksell_changes(frame: Frame) -> dict[str, list[Change]]:
    """The rows of changes, by name."""
    return {
        "as found": [Change()],
        "one rod removed": [Change((name,)) for name in frame.line_names],
        "plate removed": [Change(plate) for plate in plates(frame)],
        "3 false spots": [Change((), 3)],
        "6 false spots": [Change((), 6)],
        "24 false spots": [Change((), 24)],
        "plate removed, 6 false": [Change(plate, 6) for plate in plates(frame)],
    }


def changed(found: SliceSpots, ct_slice: Slice, frame: Frame, change: Change, rng: np.random.Generator) -> SliceSpots:
    """Spots of a Leksell slice without those of the given rods, and with false ones, uniform over the image."""
    slice_from_frame = ct_slice.scanner_from_slice.inverse() @ LEKSELL_POSE
    lines = [frame.line_names.index(name) for name in change.rods]
    rods_mm = project(frame, slice_from_frame, ct_slice.scale)[1].points_mm[lines]
    away_mm = np.linalg.norm(ct_slice.scale.to_mm(found.centres_px)[:, None] - rods_mm, axis=-1)
    found = found.take(~(away_mm < _SAME_ROD_MM).any(axis=1))
    if not change.false_spots or not len(found):
        return found
    # A false spot is as well known and as long as one of those that are there.
    false = found.take(rng.integers(len(found), size=change.false_spots))
    rows, columns = ct_slice.hu.shape
    places = rng.uniform(-0.5, np.array([columns, rows]) - 0.5, (change.false_spots, 2))
    false = replace(false, centres_px=places)
    both = found, false
    return replace(
        found,
        centres_px=np.concatenate([one.centres_px for one in both]),
        covariances_px2=np.concatenate([one.covariances_px2 for one in both]),
        extents_px2=np.concatenate([one.extents_px2 for one in both]),
        cut_short=np.concatenate([one.cut_short for one in both]),
    )


def leksell_scenes(folder: Path, options: RegistrationOptions, row: str, seed: int) -> Iterator[Scene]:
    """The slices that show nine rods, with the changes of a row of `leksell_changes`."""
    frame = load_frame("leksell_ct9")
    low, high = LEKSELL_HEIGHTS
    for name, ct_slice in series_at(folder):
        if not low <= height_mm(ct_slice) <= high:
            continue
        for index, change in enumerate(leksell_changes(frame)[row]):
            # The same false spots at each threshold; of each slice others, whichever slices the folder holds.
            key = [seed, round(1000 * (height_mm(ct_slice) + 1000)), index]
            yield Scene(
                f"{name} {'-'.join(change.rods)}".strip(),
                LEKSELL_POSE,
                LEKSELL_POINT_MM,
                1.0,
                3.0,
                height_mm(ct_slice),
                partial(_register_changed, ct_slice, frame, options, change, key),
            )


def _register_changed(
    ct_slice: Slice, frame: Frame, options: RegistrationOptions, change: Change, key: Sequence[int]
) -> Registration | Refusal:
    found = changed(_spots_of(ct_slice, options), ct_slice, frame, change, np.random.default_rng(key))
    return register_slice_spots(found, frame, options)


# Frames at rest: the truth is what most of the slices say


def pose_at_rest(poses: Sequence[Pose]) -> Pose:
    """The middle of the poses, in each component of the position and of the rotation vector."""
    first = nearest_rotation(np.sum([pose.rotation for pose in poses], axis=0))
    turns = Rotation.from_matrix([pose.rotation @ first.T for pose in poses]).as_rotvec()
    return Pose(rotation_exp(np.median(turns, axis=0)) @ first, np.median([pose.translation for pose in poses], axis=0))


@lru_cache(maxsize=16)
def _at_rest(folder: Path, frame_name: str, options: RegistrationOptions, first: int, last: int) -> Pose:
    """From the slices first to last (not included) of a series, registered with the orientation known."""
    frame = load_frame(frame_name)
    known = replace(options, max_rotation_deg=PRIOR_DEG, nominal_orientation=(0.0, 0.0, 0.0, 1.0))
    results = [register_slice(one, frame, known) for _, one in series_at(folder)[first:last]]
    poses = [result.scanner_from_frame for result in results if result]
    if len(poses) < 3:
        reasons = ", ".join(sorted({result.reason for result in results if not result}))
        raise RuntimeError(f"{len(poses)} of {len(results)} slices are accepted to say where it rests ({reasons})")
    return pose_at_rest(poses)


@dataclass(frozen=True)
class CatPhanSeries:
    """A CatPhan.

    module, middle: numbers of the slices that show the module, and of those of them through which its wires surely run
    from side to side; the others are the end slices.
    """

    folder: Path
    module: range
    middle: range

    def part(self, number: int) -> str:
        """Which of `middle`, `end` and `others` a slice is."""
        return "middle" if number in self.middle else "end" if number in self.module else "others"


CATPHAN_SECOND: Final = CatPhanSeries(SHARED_DATA / "catphan_second", range(1, 12), range(3, 10))
CATPHAN_PYLINAC: Final = CatPhanSeries(ROOT / ".cache" / "catphan", range(28, 37), range(29, 36))


def catphan_rest(series: CatPhanSeries) -> Pose:
    """Where a CatPhan rests in its scan, by its middle slices."""
    options = RegistrationOptions(threshold=300.0, max_target_error_mm=10.0)
    return _at_rest(series.folder, "catphan_ctp404", options, series.middle.start, series.middle.stop)


def catphan_scenes(series: CatPhanSeries, options: RegistrationOptions, part: str) -> Iterator[Scene]:
    """Slices of a CatPhan: those in the `middle` of the module, its `end` slices, both (`module`), or all `others`."""
    frame, rest = load_frame("catphan_ctp404"), catphan_rest(series)
    for number, (_, ct_slice) in enumerate(series_at(series.folder)):
        own = series.part(number)
        if own == part or (part == "module" and own != "others"):
            register = partial(register_slice, ct_slice, frame, options)
            table_mm = height_mm(ct_slice)
            yield Scene(f"slice {number} at {table_mm:.1f} mm", rest, np.zeros(3), 1.0, 10.0, table_mm, register)


def erased(ct_slice: Slice, frame: Frame, slice_from_frame: Pose, lines: Sequence[int], thickness_mm: float) -> Slice:
    """The slice with what lies behind the given rods in their place: the median of a ring around each."""
    hu = ct_slice.hu.copy()
    rows, columns = hu.shape
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    places = ct_slice.scale.to_mm(pixels.astype(float))
    starts, ends = slice_from_frame @ frame.starts, slice_from_frame @ frame.ends
    for line in lines:
        rod = Cylinder(starts[line], ends[line], float(frame.diameters[line]))
        shadow = rod.shadow(thickness_mm)
        if shadow is None:
            continue
        along = shadow[1] - shadow[0]
        share = np.clip((places - shadow[0]) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        away = np.linalg.norm(places - shadow[0] - share[..., None] * along, axis=-1) - 0.5 * rod.diameter
        ring = (away > _ERASED_MM) & (away <= _ERASED_MM + _RING_MM)
        hu[away <= _ERASED_MM] = np.median(ct_slice.hu[ring])
    return replace(ct_slice, hu=hu)


def zframe_rest(folder: Path) -> Pose:
    """Where the Z-frame rests in its volume, by the slices that show all tubes."""
    options = RegistrationOptions(threshold=200.0, max_target_error_mm=10.0)
    return _at_rest(folder, "zframe", options, ZFRAME_FULL.start, ZFRAME_FULL.stop)


def turned_orientations() -> dict[str, tuple[float, float, float, float]]:
    """Quaternions that are wrong by a right angle or half a turn about each axis, by name."""
    turns = {}
    for axis, name in enumerate("xyz"):
        for angle in (90, 180, 270):
            x, y, z = (float(np.sin(np.radians(angle) / 2)) * np.eye(3)[axis]).tolist()
            turns[f"{name}{angle}"] = (x, y, z, float(np.cos(np.radians(angle) / 2)))
    return turns


def zframe_scenes(folder: Path, options: RegistrationOptions, row: str) -> Iterator[Scene]:
    """Slices of the Z-frame.

    row: `full` for those that show all tubes, `partly` for those beside them. Of the former: `1 erased` and `2 erased`
    for all choices of such tubes; `turned` for a nominal orientation that is wrong by a right angle or half a turn, and
    `turned onto itself` for the half turn that maps the frame onto itself, which no slice can show.
    """
    frame, rest = load_frame("zframe"), zframe_rest(folder)
    slices = series_at(folder)
    numbers = [n for n in ZFRAME_PARTLY if n not in ZFRAME_FULL] if row == "partly" else list(ZFRAME_FULL)
    for number in numbers:
        name, ct_slice = slices[number]
        cases: dict[str, Callable[[], Registration | Refusal]] = {}
        if row in ("1 erased", "2 erased"):
            for lines in combinations(range(len(frame)), int(row[0])):
                what = f"{name} {'-'.join(frame.line_names[line] for line in lines)}"
                cases[what] = partial(_register_erased, ct_slice, frame, options, rest, lines)
        elif row.startswith("turned"):
            for turn, quaternion in turned_orientations().items():
                if (turn == ZFRAME_SYMMETRY) == ("onto itself" in row):
                    turned = replace(options, nominal_orientation=quaternion)
                    cases[f"{name} {turn}"] = partial(register_slice, ct_slice, frame, turned)
        else:
            cases[name] = partial(register_slice, ct_slice, frame, options)
        for what, register in cases.items():
            yield Scene(what, rest, np.zeros(3), 2.0, 2.0, height_mm(ct_slice), register)


def _register_erased(
    ct_slice: Slice, frame: Frame, options: RegistrationOptions, rest: Pose, lines: Sequence[int]
) -> Registration | Refusal:
    slice_from_frame = ct_slice.scanner_from_slice.inverse() @ rest
    without = erased(ct_slice, frame, slice_from_frame, lines, ZFRAME_THICKNESS_MM)
    return register_slice(without, frame, options)


# BRW: rendered, as no image of one is to be had

BRW_SCALE: Final = PixelScale(0.75, 0.75)
BRW_TILT_DEG: Final = 20.0
BRW_ROD_HU: Final = 2500.0


def brw_scenes(options: RegistrationOptions, count: int, seed: int, thickness_mm: float) -> Iterator[Scene]:
    """Rendered slices of the BRW frame, tilted by up to 20 degrees, the plane anywhere along it and just beyond.

    Errors count at the middle of the frame in the plane, where a needle goes.
    """
    frame = load_frame("brw")
    settings = ScannerSettings(scale=BRW_SCALE, slice_thickness_mm=thickness_mm, rod_hu=BRW_ROD_HU, block=False)
    ends = np.concatenate([frame.starts, frame.ends])
    low, high = ends.min(axis=0), ends.max(axis=0)
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        axis = rng.normal(size=3)
        turn = rotation_exp(np.radians(rng.uniform(0, BRW_TILT_DEG)) * axis / np.linalg.norm(axis))
        middle = np.append(0.5 * (low + high)[:2], rng.uniform(low[2] - 5.0, high[2] + 5.0))
        centre = np.append(0.5 * settings.size_mm + rng.uniform(-10, 10, 2), 0.0)
        pose = Pose(turn, centre - turn @ middle)
        register = partial(_register_rendered, PlacedFrame(frame, pose), settings, options, [seed, number])
        yield Scene(f"{number} at {middle[2] - low[2]:.0f} mm", pose, middle, 2.0, 3.0, 0.0, register)


def _register_rendered(
    placed: PlacedFrame, settings: ScannerSettings, options: RegistrationOptions, key: Sequence[int]
) -> Registration | Refusal:
    ct_slice = render_slice([placed], settings, np.random.default_rng([*key, 1]))
    return register_slice(ct_slice, placed.frame, options)


def turn_deg(pose: Pose, truth: Pose) -> float:
    """Angle between the rotations of two poses, degrees."""
    return float(np.degrees(rotation_angle(pose.rotation @ truth.rotation.T)))
