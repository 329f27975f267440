"""Slices with known poses, registered: whether the poses are as far off as they say."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import cv2
import numpy as np
from tqdm import tqdm

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame, register_slice, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice
from support.pose_statistics import PoseStatistics
from support.rod_layouts import best_subset, well_conditioned_frame
from support.worst_cases import WorstCaseCount

_BATCH = 250
# The ball holds 95 % of the errors, within this share, for spot sets and for rendered slices.
_SPOTS_SLACK, _RENDERED_SLACK = 0.01, 0.02
# Standard errors of the measured scale, mm/pixel, and their correlation, where a case has them.
_PERFECT = RegistrationOptions(frame_tolerance_mm=0.0, scale_tolerance=0.0, max_target_error_mm=1000.0)
_SCALE_COVARIANCE = 0.0004**2 * np.array([[1.0, 0.4], [0.4, 1.0]])


@dataclass(frozen=True)
class Case:
    """A class of slices with known poses.

    frame: name of a shipped frame, or empty for one of `rods` generated rods; of a shipped one the best subset of
    that many. noise_px: of each coordinate, normal; mixed: each spot has a covariance of its own instead, of 0.05 to
    0.3 pixel in two directions; with_scale: the stated pixel scale is off, as its covariance says; rendered: the
    spots are found in slices drawn by the simulated scanner; max_rotation_deg: how far from upright the frame is known
    to stand. Of four rods the matcher finds nearly all poses, but not all, and the twin of one that it has missed may
    be taken for it where nothing is known. image_noise_hu: of the rendered slices, as thin slices have it.
    """

    frame: str
    rods: int
    noise_px: float = 0.1
    mixed: bool = False
    with_scale: bool = False
    rendered: bool = False
    max_rotation_deg: float = 180.0
    image_noise_hu: float = 20.0

    @property
    def name(self) -> str:
        """What the table calls it."""
        spots = (
            f"rendered, {self.image_noise_hu:g} HU"
            if self.rendered
            else "unequal, correlated"
            if self.mixed
            else f"{self.noise_px:g} px"
        )
        return f"{self.frame or 'generated':10s} {self.rods} rods  {spots}{', scale' if self.with_scale else ''}"

    def make_frame(self) -> Frame:
        """The frame of this case."""
        if not self.frame:
            return well_conditioned_frame(self.rods)
        shipped = load_frame(self.frame)
        return best_subset(shipped, list(combinations(range(len(shipped)), min(self.rods, len(shipped)))))


SPOT_CASES = (
    Case("", 4, max_rotation_deg=40.0),
    Case("", 5),
    Case("cube6", 5),
    Case("cube6", 6),
    Case("", 8),
    Case("cube6", 6, mixed=True, with_scale=True),
)
RENDERED_CASES = (
    Case("", 4, rendered=True, max_rotation_deg=40.0),
    Case("", 5, rendered=True),
    Case("cube6", 6, rendered=True),
    Case("", 8, rendered=True),
)
# Frame, rods, and the largest error of a spot, pixel; whether that is in the range in which all is linear.
WORST_CASES = (
    (Case("", 4), 0.005, True),
    (Case("cube6", 6), 0.02, True),
    (Case("", 8), 0.02, True),
    (Case("cube6", 6), 0.1, False),
    (Case("cube6", 6), 0.3, False),
)
# Share of a bound that the corner named for it has to reach, in the median pose, where all is linear.
_TIGHT = 0.9


def measure_spot_sets(case: Case, sets: int, seed: int) -> PoseStatistics:
    """Register `sets` spot sets at random poses."""
    rng = np.random.default_rng(seed)
    frame, scanner = case.make_frame(), ScannerSettings()
    true_scale, area_mm2 = scanner.scale, float(np.prod(scanner.size_mm))
    # With covariances of the spots' own, the floor is below them all.
    options = replace(
        _PERFECT, spot_noise_px=0.04 if case.mixed else case.noise_px, max_rotation_deg=case.max_rotation_deg
    )
    statistics = PoseStatistics()
    for _ in range(sets):
        pose = random_pose(rng, frame, scanner)
        stated, scale_covariance = true_scale, None
        if case.with_scale:
            off = rng.multivariate_normal(np.zeros(2), _SCALE_COVARIANCE)
            stated, scale_covariance = PixelScale(true_scale.sx + off[0], true_scale.sy + off[1]), _SCALE_COVARIANCE
        covariances = (
            _mixed(rng, len(frame)) if case.mixed else np.tile(case.noise_px**2 * np.eye(2), (len(frame), 1, 1))
        )
        noise = (np.linalg.cholesky(covariances) @ rng.standard_normal((len(frame), 2, 1)))[..., 0]
        spots_px = project(frame, pose, true_scale)[0] + noise
        result = register_spots(
            spots_px,
            frame,
            stated,
            options,
            slice_area_mm2=area_mm2,
            covariances_px2=covariances,
            scale_covariance=scale_covariance,
        )
        statistics.add(result, pose)
    return statistics


def measure_rendered(case: Case, slices: int, seed: int) -> PoseStatistics:
    """Find and register `slices` rendered slices at random poses."""
    rng = np.random.default_rng(seed)
    frame, scanner = case.make_frame(), ScannerSettings(shape=(384, 384), noise_hu=case.image_noise_hu)
    # Far below what the spots' own covariances are, which is what is measured here.
    options = replace(_PERFECT, spot_noise_px=0.001, max_rotation_deg=case.max_rotation_deg)
    statistics = PoseStatistics()
    for _ in range(slices):
        pose = random_pose(rng, frame, scanner)
        statistics.add(register_slice(render_slice([PlacedFrame(frame, pose)], scanner, rng), frame, options), pose)
    return statistics


def _mixed(rng: np.random.Generator, count: int) -> Array:
    """Covariances (count, 2, 2), pixel^2: standard deviations of 0.05 to 0.3 pixel along axes turned at random."""
    turn = rng.uniform(0, np.pi, count)
    axes = np.moveaxis(np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]), 2, 0)
    variances = rng.uniform(0.05, 0.3, (count, 2)) ** 2
    covariances: Array = (axes * variances[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return covariances


def measure(case: Case, count: int, seed: int, workers: int = 1) -> PoseStatistics:
    """The statistics of `count` slices, in batches over several processes; independent of the number of processes."""
    run = partial(measure_rendered if case.rendered else measure_spot_sets, case)
    sizes = [min(_BATCH, count - start) for start in range(0, count, _BATCH)]
    seeds = [1_000_003 * seed + number for number in range(len(sizes))]
    total = PoseStatistics()
    if workers == 1:
        parts: Iterable[PoseStatistics] = map(run, sizes, seeds)
        for part in tqdm(parts, desc=case.name, total=len(sizes), unit="batch", disable=None, leave=False):
            total.join(part)
        return total
    with ProcessPoolExecutor(workers, initializer=_one_thread) as pool:
        for part in tqdm(pool.map(run, sizes, seeds), desc=case.name, total=len(sizes), disable=None, leave=False):
            total.join(part)
    return total


def _one_thread() -> None:
    cv2.setNumThreads(1)


def within_limits(case: Case, statistics: PoseStatistics) -> bool:
    """Whether the mean and the coverage of every target are what the covariance says."""
    slack = _RENDERED_SLACK if case.rendered else _SPOTS_SLACK
    right = abs(statistics.nees - 6) <= statistics.nees_limit
    return right and bool((np.abs(statistics.coverage - 0.95) <= slack).all())


def is_sound(found: WorstCaseCount, linear: bool) -> bool:
    """Whether no error was beyond its bound, and, where all is linear, the bounds are nearly reached."""
    return found.exceeded == 0 and (not linear or float(np.median(found.reached)) >= _TIGHT)
