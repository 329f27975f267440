"""Matching: right, wrong, refused, and how long it takes, over classes of problems."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from stereoreg_ros import Pose, RegistrationOptions, load_frame, register_spots
from stereoreg_ros.geometry.pose import rotation_angle
from stereoreg_ros.simulation import ScannerSettings, SpotSetSettings, random_spot_set

WRONG_MM, WRONG_DEG = 2.0, 3.0


@dataclass(frozen=True)
class Problem:
    """A class of problems. noise_px: uniform; max_rotation_deg: the prior that the matcher is given."""

    frame: str
    visible: int
    false_spots: int
    noise_px: float
    max_rotation_deg: float = 180.0


PROBLEMS = (
    Problem("cube6", 6, 0, 0.5),
    Problem("cube6", 6, 8, 0.5),
    Problem("cube6", 6, 24, 0.5),
    Problem("cube6", 5, 8, 0.1),
    Problem("cube6", 5, 24, 0.1),
    Problem("cube6", 4, 8, 0.5),
    Problem("zframe", 7, 20, 0.5, 40.0),
)


@dataclass(frozen=True)
class Row:
    """What a class of problems gave; times in seconds."""

    problem: Problem
    right: int
    wrong: int
    refused: dict[str, int]
    median_s: float
    p99_s: float


def is_wrong(found: Pose, truth: Pose) -> bool:
    """Whether a pose is off by more than WRONG_MM or WRONG_DEG."""
    turn = np.degrees(rotation_angle(found.rotation @ truth.rotation.T))
    return bool(np.linalg.norm(found.translation - truth.translation) > WRONG_MM or turn > WRONG_DEG)


def measure(problem: Problem, trials: int) -> Row:
    """Run one class of problems, seeded."""
    frame = load_frame(problem.frame)
    settings = SpotSetSettings(ScannerSettings(), problem.visible, problem.false_spots, problem.noise_px)
    options = RegistrationOptions(
        spot_noise_px=max(settings.noise_std_px, 0.01), max_rotation_deg=problem.max_rotation_deg
    )
    rng = np.random.default_rng(1)
    times, right, wrong = [], 0, 0
    refused: Counter[str] = Counter()
    name = f"{problem.frame} {problem.visible}+{problem.false_spots}"
    for _ in tqdm(range(trials), desc=name, disable=None, leave=False):
        spots = random_spot_set(rng, frame, settings)
        start = time.perf_counter()
        result = register_spots(spots.spots_px, frame, settings.scanner.scale, options)
        times.append(time.perf_counter() - start)
        if not result:
            refused[result.reason] += 1
        elif is_wrong(result.scanner_from_frame, spots.slice_from_frame):
            wrong += 1
        else:
            right += 1
    # The first call fills the frame's tables, once for the life of a process.
    warm = np.array(times[1:])
    return Row(problem, right, wrong, dict(refused), float(np.median(warm)), float(np.percentile(warm, 99)))
