"""Matching: right, wrong, refused, and how long it takes, over classes of problems."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from benchmarks.yardstick import Yardstick
from stereoreg_ros import RegistrationOptions, load_frame, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import rotation_angle
from stereoreg_ros.matching import maurin2009
from stereoreg_ros.registration import prepare
from stereoreg_ros.simulation import ScannerSettings, SpotSet, SpotSetSettings, centred_pose, random_spot_set
from support.pose_verdict import is_covered, is_wrong
from support.rod_layouts import random_rods

# False spots of the comparison with the paper's search: 60 and 80 % of all.
BASELINE_FALSE_SPOTS = (9, 24)


@dataclass(frozen=True)
class Problem:
    """A class of problems.

    noise_px: uniform, as in the paper; max_log10: false alarms allowed; max_rotation_deg: the prior that the matcher is
    given, and within which the poses lie; guess: how far off the guess of the pose is, mm and degrees, if one is given;
    any_rotation: poses all around, not within 20 degrees about each axis.
    """

    frame: str
    visible: int
    false_spots: int
    noise_px: float
    max_log10: float = -6.0
    max_rotation_deg: float = 180.0
    guess: tuple[float, float] | None = None
    any_rotation: bool = False
    trials: float = 1.0  # share of the requested trials


PROBLEMS = (
    Problem("cube6", 6, 0, 0.5),
    Problem("cube6", 6, 4, 0.5),
    Problem("cube6", 6, 8, 0.5),
    Problem("cube6", 6, 24, 0.5),
    Problem("cube6", 6, 100, 0.1, trials=0.2),
    Problem("cube6", 6, 200, 0.1, trials=0.1),
    Problem("cube6", 5, 25, 0.5),
    Problem("cube6", 5, 25, 0.5, max_log10=-3.0),
    Problem("cube6", 5, 25, 0.1),
    Problem("cube6", 5, 25, 0.5, max_rotation_deg=25.0),
    Problem("cube6", 5, 25, 0.5, guess=(2.0, 1.0)),
    Problem("cube6", 6, 24, 0.5, guess=(2.0, 1.0)),
    Problem("cube6", 6, 100, 0.1, guess=(2.0, 1.0), trials=0.2),
    Problem("cube6", 4, 8, 0.5),
    Problem("cube6", 6, 12, 0.5, any_rotation=True),
    Problem("zframe", 7, 20, 0.5, max_rotation_deg=40.0),
    Problem("zframe", 7, 20, 0.5),
    Problem("leksell_ct", 6, 20, 0.5, max_rotation_deg=40.0),
    *(Problem(f"random{lines}", lines, 12, 0.3, any_rotation=True, trials=0.5) for lines in (3, 4, 5, 7, 9, 12)),
)


@dataclass(frozen=True)
class Row:
    """The results of a class of problems; times in seconds.

    unit_s: the yardstick meanwhile, once after each problem.
    weak: accepted, and off by more than WRONG_MM or WRONG_DEG, but as the stated covariance says.
    """

    problem: Problem
    right: int
    weak: int
    wrong: int
    refused: dict[str, int]
    median_s: float
    p99_s: float
    unit_s: float


def frame_named(name: str) -> Frame:
    """A shipped frame, manufactured exactly to its drawing; or, for `random12`, twelve random rods through a cube."""
    if not name.startswith("random"):
        frame = load_frame(name)
        return replace(frame, tolerances_mm=np.zeros(len(frame)))
    return random_rods(np.random.default_rng(len(name)), int(name.removeprefix("random")))


def measure(problem: Problem, trials: int) -> Row:
    """Run one class of problems, seeded."""
    frame = frame_named(problem.frame)
    # The Leksell box is wider than the others.
    scanner = ScannerSettings(shape=(640, 640)) if problem.frame == "leksell_ct" else ScannerSettings()
    settings = SpotSetSettings(scanner, problem.visible, problem.false_spots, problem.noise_px)
    # The simulated frames match their files exactly, and weak poses are counted as such.
    options = RegistrationOptions(
        spot_noise_px=max(settings.noise_std_px, 0.01),
        frame_tolerance_mm=0.0,
        scale_tolerance=0.0,
        max_target_error_mm=1000.0,
        max_rotation_deg=problem.max_rotation_deg,
        max_log10_false_alarms=problem.max_log10,
    )
    rng = np.random.default_rng(1)
    prepare(frame, scanner.scale, options)
    yardstick, units = Yardstick(), []
    times, right, weak, wrong = [], 0, 0, 0
    refused: Counter[str] = Counter()
    count = max(int(trials * problem.trials), 2)
    for spots in tqdm(_drawn(rng, frame, settings, problem, count), total=count, disable=None, leave=False):
        guess = None
        if problem.guess is not None:
            step, axis = rng.normal(size=(2, 3))
            mm, degrees = problem.guess
            guess = spots.slice_from_frame.perturbed(
                mm * step / np.linalg.norm(step), np.radians(degrees) * axis / np.linalg.norm(axis)
            )
        start = time.perf_counter()
        result = register_spots(spots.spots_px, frame, scanner.scale, options, previous=guess)
        times.append(time.perf_counter() - start)
        units.append(yardstick.once())
        if not result:
            refused[result.reason] += 1
        elif not is_wrong(result.scanner_from_frame, spots.slice_from_frame):
            right += 1
        elif is_covered(result, spots.slice_from_frame):
            weak += 1
        else:
            wrong += 1
    p99_s = float(np.percentile(times, 99))
    return Row(problem, right, weak, wrong, dict(refused), float(np.median(times)), p99_s, float(np.median(units)))


def _drawn(
    rng: np.random.Generator, frame: Frame, settings: SpotSetSettings, problem: Problem, count: int
) -> Iterator[SpotSet]:
    """`count` problems, their poses within the prior."""
    while count:
        nominal = None
        if problem.any_rotation:
            rotation = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
            nominal = centred_pose(frame, settings.scanner, rotation=rotation)
        try:
            spots = random_spot_set(rng, frame, settings, nominal)
        except ValueError:
            continue  # this rotation has not enough rods through any slice
        if np.degrees(rotation_angle(spots.slice_from_frame.rotation)) <= problem.max_rotation_deg:
            count -= 1
            yield spots


@dataclass(frozen=True)
class Baseline:
    """The paper's search and ours, seconds; the paper's is extrapolated from the samples that were run."""

    false_spots: int
    paper_s: float
    ours_s: float
    samples: int
    planned: int


def measure_baseline(false_spots: int, budget_samples: int) -> Baseline:
    """The median of five sets of spots each; the paper's search with s_c = sin 20 degrees, its fastest."""
    frame, scanner = load_frame("cube6"), ScannerSettings()
    settings = SpotSetSettings(scanner, 6, false_spots, 0.5)
    options = RegistrationOptions(spot_noise_px=settings.noise_std_px, frame_tolerance_mm=0.0, scale_tolerance=0.0)
    rng = np.random.default_rng(2)
    paper, ours, samples, planned = [], [], 0, 0
    for number in range(5):
        spots = random_spot_set(rng, frame, settings).spots_px
        register_spots(spots, frame, scanner.scale, options)
        start = time.perf_counter()
        register_spots(spots, frame, scanner.scale, options)
        ours.append(time.perf_counter() - start)
        mm = scanner.scale.to_mm(spots)
        noise_mm = maurin2009.PREDICTION_SPREAD * settings.noise_std_px * scanner.scale.sx
        part = maurin2009.search(mm, frame, noise_mm, max_samples=budget_samples, seed=number)
        paper.append(part.seconds * part.planned / part.samples)
        samples, planned = samples + part.samples, planned + part.planned
    return Baseline(false_spots, float(np.median(paper)), float(np.median(ours)), samples, planned)
