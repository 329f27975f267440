"""How real frames are registered, row by row, and how often a wrong pose looks right."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import binom
from tqdm import tqdm

from stereoreg_ros import RegistrationOptions
from stereoreg_ros.options import AUTO
from stereoreg_ros.result import PoseEstimate, Refusal, Registration
from stereoreg_ros.uncertainty import error_ball_95
from support.real_scenes import (
    CATPHAN_PYLINAC,
    CATPHAN_SECOND,
    PRIOR_DEG,
    SHARED_DATA,
    ZFRAME_THICKNESS_MM,
    AbsentError,
    Row,
    Scene,
    Target,
    brw_scenes,
    catphan_scenes,
    leksell_scenes,
    turn_deg,
    zframe_scenes,
)

# A pose is wrong where it is off by more than its row allows and by more than this many times the stated 95 % radius.
BEYOND = 2.0
_INSIDE = (0.93, 0.97)
# Fewer or more errors than this within their radius are as unlikely as this if the share is in between.
_UNLIKELY = 0.025
# By how much the recovered plane may step more or less than the table, as a share: 0.05 mm of 2.4 mm.
_STEP_SHARE = 0.02
_LEAST_STEPPING = 5
_BRW_SCENES = 100


@dataclass(frozen=True)
class Attempt:
    """What came of a scene.

    reason: of the refusal, empty where accepted; message: its sentence, or the caution. Of an accepted pose: its error
    at the scene's point and the stated 95 % radius there, mm; the angle it is off by, degrees; rods with a spot;
    off: whether that is more than the scene allows; wrong: whether it is far more than what is stated, too.
    table_mm, plane_mm: where the slice was taken, and where the pose has its plane, along the scanner's z.
    """

    scene: str
    reason: str = ""
    message: str = ""
    error_mm: float = math.nan
    stated_mm: float = math.nan
    turn_deg: float = math.nan
    rods: int = 0
    off: bool = False
    wrong: bool = False
    table_mm: float = math.nan
    plane_mm: float = math.nan

    @property
    def accepted(self) -> bool:
        """Whether there is a pose."""
        return not self.reason

    def __str__(self) -> str:
        if not self.accepted:
            return f"{self.scene}: {self.reason}: {self.message}"
        return (
            f"{self.scene}:{' WRONG:' if self.wrong else ''} {self.error_mm:.2f} mm off, {self.stated_mm:.2f} stated, "
            f"{self.turn_deg:.2f} degrees, {self.rods} rods{'; ' if self.message else ''}{self.message}"
        )


@dataclass(frozen=True)
class Figures:
    """A row's attempts, and the targets that it missed, in words; absent: what is not there to make the row with."""

    row: str
    attempts: tuple[Attempt, ...]
    seconds: float
    absent: str = ""
    missed: tuple[str, ...] = field(default=(), compare=False)

    @property
    def accepted(self) -> list[Attempt]:
        """Those with a pose."""
        return [one for one in self.attempts if one.accepted]

    @property
    def wrong(self) -> list[Attempt]:
        """Those with a wrong one."""
        return [one for one in self.accepted if one.wrong]

    @property
    def inside(self) -> int:
        """How many errors are within the stated 95 % radius."""
        return sum(one.error_mm <= one.stated_mm for one in self.accepted)

    @property
    def refusals(self) -> dict[str, int]:
        """How many refusals of each reason."""
        return dict(Counter(one.reason for one in self.attempts if not one.accepted).most_common())


def judged(scene: Scene, result: Registration | Refusal) -> Attempt:
    """A result beside the truth."""
    if not result:
        return Attempt(scene.name, result.reason, result.message)
    estimate: PoseEstimate = result.estimate
    truth, pose = scene.scanner_from_frame, estimate.scanner_from_frame
    error = float(np.linalg.norm(pose @ scene.point_mm - truth @ scene.point_mm))
    turn = turn_deg(pose, truth)
    stated = estimate.target_error_95_mm(scene.point_mm)
    stated_deg = math.degrees(error_ball_95(estimate.covariance[3:, 3:]))
    off_place, off_turn = error > scene.largest_mm, turn > scene.largest_deg
    wrong = (off_place and error > BEYOND * stated) or (off_turn and turn > BEYOND * stated_deg)
    # Where the plane would lie if the frame were where it truly is.
    plane = scene.table_mm + float((truth @ scene.point_mm - pose @ scene.point_mm)[2])
    return Attempt(
        scene.name,
        "",
        result.caution,
        error,
        stated,
        turn,
        estimate.inliers,
        off_place or off_turn,
        wrong,
        scene.table_mm,
        plane,
    )


def step_share(attempts: Sequence[Attempt]) -> float:
    """By how much the recovered plane moves for each mm that the table does; NaN of less than two accepted slices."""
    seen = [(one.table_mm, one.plane_mm) for one in attempts if one.accepted]
    if len({table for table, _ in seen}) < 2:
        return math.nan
    table, plane = np.transpose(seen)
    return float(np.polyfit(table, plane, 1)[0])


def missed_targets(attempts: Sequence[Attempt], target: Target) -> tuple[str, ...]:
    """What a row does not reach, in words.

    A share inside is missed where a true one between 93 and 97 % would hardly bring it in this many independent errors.
    Errors that slices have in common, such as of a rod that is off its place, make the share vary more than that.
    """
    accepted = [one for one in attempts if one.accepted]
    missed = []
    if not attempts:
        missed.append("no scene")
    wrong = sum(one.wrong for one in accepted)
    if wrong and not target.may_be_wrong:
        missed.append(f"{wrong} wrong")
    if len(accepted) < target.accepted * len(attempts):
        missed.append(f"accepted {100 * len(accepted) / len(attempts):.0f} %, wanted {100 * target.accepted:.0f} %")
    if len(accepted) > target.most_accepted * len(attempts):
        missed.append(
            f"accepted {100 * len(accepted) / len(attempts):.0f} %, wanted {100 * target.most_accepted:.0f} %"
        )
    inside, n = sum(one.error_mm <= one.stated_mm for one in accepted), len(accepted)
    if target.inside and n:
        few, many = binom.cdf(inside, n, _INSIDE[0]), binom.sf(inside - 1, n, _INSIDE[1])
        if few < _UNLIKELY or many < _UNLIKELY:
            missed.append(f"{100 * inside / n:.0f} % inside the stated radius, wanted 93 to 97 %")
    if target.all_inside and inside < n:
        missed.append(f"{n - inside} beyond the stated radius")
    # Of fewer slices the slope is not known well enough.
    if target.steps and n >= _LEAST_STEPPING and not abs(step_share(attempts) - 1) <= _STEP_SHARE:
        missed.append(f"the plane steps by {step_share(attempts):.3f} of what the table does")
    return tuple(missed)


def run(row: Row, most: int | None = None) -> Figures:
    """Register the scenes of a row; most: of more scenes only this many, always the same ones."""
    start = time.perf_counter()
    try:
        scenes = list(row.scenes())
    except AbsentError as absent:
        return Figures(row.name, (), 0.0, str(absent))
    except RuntimeError as nothing:
        return Figures(row.name, (), time.perf_counter() - start, missed=(str(nothing),))
    if most is not None and len(scenes) > most:
        # Drawn at random, as every n-th may always be the same rod.
        chosen = np.random.default_rng(0).choice(len(scenes), most, replace=False)
        scenes = [scenes[k] for k in sorted(chosen)]
    attempts = tuple(
        judged(scene, scene.register())
        for scene in tqdm(scenes, desc=row.name, unit="scene", disable=None, leave=False)
    )
    return Figures(row.name, attempts, time.perf_counter() - start, missed=missed_targets(attempts, row.target))


def rows_of(leksell: Path = SHARED_DATA / "leksell9_ct", seed: int = 0) -> list[Row]:
    """All rows. leksell: the folder of the Leksell series; seed: of false spots and rendered poses."""
    return [*_leksell(leksell, seed), *_catphan(), *_zframe(), *_brw(seed)]


def _named(threshold: float | str) -> str:
    return threshold if isinstance(threshold, str) else f"{threshold:g}"


def _leksell(folder: Path, seed: int) -> Iterable[Row]:
    for threshold in (1000.0, AUTO):
        free = RegistrationOptions(threshold=threshold)
        prior = RegistrationOptions(threshold=threshold, max_rotation_deg=PRIOR_DEG)
        for change, target, quick in (
            ("as found", Target(accepted=0.95, inside=True), True),
            ("one rod removed", Target(), False),
            ("plate removed", Target(), False),
            ("3 false spots", Target(), False),
            ("6 false spots", Target(), False),
            ("24 false spots", Target(), False),
            ("plate removed, 6 false", Target(), True),
        ):
            name = f"leksell/{_named(threshold)}/prior/{change}"
            yield Row(name, partial(leksell_scenes, folder, prior, change, seed), target, quick and threshold != AUTO)
        name = f"leksell/{_named(threshold)}/no prior/as found"
        yield Row(name, partial(leksell_scenes, folder, free, "as found", seed), quick=threshold != AUTO)


def _catphan() -> Iterable[Row]:
    for title, series in (("second", CATPHAN_SECOND), ("pylinac", CATPHAN_PYLINAC)):
        for threshold in (300.0, AUTO):
            free = RegistrationOptions(threshold=threshold)
            prior = RegistrationOptions(threshold=threshold, max_rotation_deg=PRIOR_DEG)
            for prior_or_not, part, options, target in (
                ("prior", "middle", prior, Target(accepted=0.95)),
                ("prior", "end", prior, Target(all_inside=True)),
                ("prior", "others", prior, Target(most_accepted=0.0)),
                ("no prior", "module", free, Target()),
                ("no prior", "others", free, Target(most_accepted=0.0)),
            ):
                name = f"catphan {title}/{_named(threshold)}/{prior_or_not}/{part}"
                quick = title == "second" and (part == "middle" or (part != "others" and threshold != AUTO))
                yield Row(name, partial(catphan_scenes, series, options, part), target, quick)


def _zframe() -> Iterable[Row]:
    folder = SHARED_DATA / "zframe_mr"
    for threshold in (200.0, AUTO):
        prior = RegistrationOptions(threshold=threshold, max_rotation_deg=PRIOR_DEG)
        thick = RegistrationOptions(
            threshold=threshold, max_rotation_deg=PRIOR_DEG, slice_thickness_mm=ZFRAME_THICKNESS_MM
        )
        for given, options in (("", prior), (", thickness given", thick)):
            for scenes, target in (
                ("full", Target(accepted=1.0, steps=True)),
                ("partly", Target(all_inside=True)),
                ("1 erased", Target()),
                ("2 erased", Target()),
                ("turned", Target()),
                ("turned onto itself (cannot show)", Target(may_be_wrong=True)),
            ):
                name = f"zframe/{_named(threshold)}/{scenes}{given}"
                quick = threshold != AUTO and not target.may_be_wrong and (scenes == "full" or not given)
                yield Row(name, partial(zframe_scenes, folder, options, scenes), target, quick)


def _brw(seed: int) -> Iterable[Row]:
    for thickness in (0.625, 2.5):
        for given in (0.0, thickness):
            options = RegistrationOptions(threshold=AUTO, max_rotation_deg=PRIOR_DEG, slice_thickness_mm=given)
            name = f"brw/{thickness:g} mm{', thickness given' if given else ''}"
            yield Row(name, partial(brw_scenes, options, _BRW_SCENES, seed, thickness), quick=given > 0)
