"""`python -m benchmarks.recalibration`: the scale from rendered slices, right from the start and up to 10 % wrong, of
frames that are exact, built to a tolerance, or of another size than their file says.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from tqdm import tqdm

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame
from stereoreg_ros.calibration.calibrate import Calibration, calibrate
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice
from stereoreg_ros.spots import find_spots

TRUE = PixelScale(0.5, 0.5)
CENTRE_NOISE_PX = 0.25
_CHI_SQUARE_2_AT_1E5 = 23.0


class Kind(NamedTuple):
    """What is tried: how many slices, with how many false spots at most, the spacing wrong by which share at most, of a
    frame whose rods' ends are off by tolerance_mm, as is stated, and that is larger than its file says by a factor.

    stated: whether the spacing comes with the slices, so that it is to be kept.
    """

    slices: int
    most_false: int
    wrong: float
    tolerance_mm: float = 0.0
    larger: float = 1.0
    stated: bool = False


def sightings(rng: np.random.Generator, frame: Frame, kind: Kind, stated: PixelScale) -> list[SliceSpots]:
    """Spots found in rendered slices of a frame, their centres shifted by CENTRE_NOISE_PX."""
    taken = []
    for _ in range(kind.slices):
        scanner = ScannerSettings(shape=(320, 320), scale=TRUE, false_spots=int(rng.integers(0, kind.most_false + 1)))
        ct_slice: Slice = render_slice([PlacedFrame(frame, random_pose(rng, frame, scanner))], scanner, rng)
        found = find_spots(ct_slice, RegistrationOptions())
        shifted = found.centres_px + CENTRE_NOISE_PX * rng.standard_normal(found.centres_px.shape)
        taken.append(replace(found, centres_px=shifted, stated_scale=stated if kind.stated else None))
    return taken


def as_built(rng: np.random.Generator, frame: Frame, kind: Kind) -> Frame:
    """The frame as it truly is."""
    starts, ends = (
        kind.larger * points + kind.tolerance_mm * rng.standard_normal(points.shape)
        for points in (frame.starts, frame.ends)
    )
    return replace(frame, starts=starts, ends=ends)


def main() -> int:
    """Print what came of the trials; 1 where a scale was made worse, or where errors are not as stated."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recalibration", description=__doc__)
    parser.add_argument("--trials", type=int, default=200, help="trials from a wrong start (default 200)")
    parser.add_argument("--sequences", type=int, default=20, help="sequences of 43 slices (default 20)")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    frame = load_frame("cube6")
    failed = False
    print(
        "slices  false  wrong by  rods/mm  larger  spacing  trials  right  refused  worse  RMS/%   stated/%  NEES (2)  "
        "median/s  longest/s"
    )
    for kind, trials in (
        (Kind(43, 0, 0.0), arguments.sequences),
        (Kind(1, 0, 0.0), arguments.trials),
        (Kind(10, 8, 0.0), max(arguments.trials // 4, 1)),
        (Kind(1, 8, 0.1), arguments.trials),
        (Kind(5, 8, 0.1), arguments.trials),
        (Kind(43, 0, 0.0, tolerance_mm=0.2), arguments.sequences),
        (Kind(1, 0, 0.0, tolerance_mm=0.2), arguments.trials),
        (Kind(10, 8, 0.0, tolerance_mm=0.2), max(arguments.trials // 4, 1)),
        (Kind(5, 8, 0.1, tolerance_mm=0.2), max(arguments.trials // 4, 1)),
        (Kind(10, 8, 0.0, tolerance_mm=0.2, stated=True), max(arguments.trials // 4, 1)),
        (Kind(5, 8, 0.0, tolerance_mm=0.2, larger=1.03, stated=True), max(arguments.trials // 4, 1)),
    ):
        options = RegistrationOptions(spot_noise_px=CENTRE_NOISE_PX, frame_tolerance_mm=kind.tolerance_mm)
        rng = np.random.default_rng(kind.slices + kind.most_false)
        errors, stated, nees, times = [], [], [], []
        worse, reasons = 0, Counter[str]()
        for trial in tqdm(range(trials), disable=None, leave=False):
            by = 1 + (
                rng.choice([-kind.wrong, kind.wrong], 2) if trial % 2 else rng.uniform(-kind.wrong, kind.wrong, 2)
            )
            assumed = PixelScale(by[0] * TRUE.sx, by[1] * TRUE.sy)
            taken = sightings(rng, as_built(rng, frame, kind), kind, assumed)
            start = time.perf_counter()
            found = calibrate(taken, frame, assumed, options)
            times.append(time.perf_counter() - start)
            if not isinstance(found, Calibration):
                reasons[found.message[:60]] += 1
                continue
            error = np.array([found.scale.sx - TRUE.sx, found.scale.sy - TRUE.sy])
            nees.append(float(error @ np.linalg.solve(found.covariance, error)))
            errors.append(error / TRUE.sx)
            stated.append(np.array(found.standard_errors) / TRUE.sx)
            worse += bool(kind.wrong > 0 and np.abs(error).max() / TRUE.sx > np.abs(by - 1).max() + 1e-9)
            worse += nees[-1] > _CHI_SQUARE_2_AT_1E5
        failed |= worse > 0
        rms, claimed = (
            100 * math.sqrt(float(np.mean(np.square(part)))) if part else math.nan for part in (errors, stated)
        )
        print(
            f"{kind.slices:6d}  {kind.most_false:5d}  {100 * kind.wrong:6.0f} %  {kind.tolerance_mm:7.1f}  "
            f"{kind.larger:6.2f}  {'stated' if kind.stated else 'typed':7s}  {trials:6d}  {len(errors):5d}  "
            f"{sum(reasons.values()):7d}  {worse:5d}  {rms:5.3f}   {claimed:8.3f}  {np.mean(nees or [math.nan]):8.2f}  "
            f"{np.median(times):8.2f}  {max(times):9.2f}   {dict(reasons) or ''}",
            flush=True,
        )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
