"""`python -m benchmarks.recalibration`: the scale from rendered slices, right from the start and up to 10 % wrong."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter

import cv2
import numpy as np
from tqdm import tqdm

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame, register_slice
from stereoreg_ros.calibration import Calibration, Sighting, calibrate, sighting_of
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice

TRUE = PixelScale(0.5, 0.5)
CENTRE_NOISE_PX = 0.25
_CHI_SQUARE_2_AT_1E5 = 23.0


def sightings(rng: np.random.Generator, slices: int, most_false: int) -> list[Sighting]:
    """Spots found in rendered slices of cube6, their centres shifted by CENTRE_NOISE_PX."""
    frame, taken = load_frame("cube6"), []
    for _ in range(slices):
        scanner = ScannerSettings(shape=(320, 320), scale=TRUE, false_spots=int(rng.integers(0, most_false + 1)))
        ct_slice: Slice = render_slice([PlacedFrame(frame, random_pose(rng, frame, scanner))], scanner, rng)
        seen = sighting_of(register_slice(ct_slice, frame), ct_slice.hu.size)
        shifted = seen.spots_px + CENTRE_NOISE_PX * rng.standard_normal(seen.spots_px.shape)
        taken.append(Sighting(shifted, seen.covariances_px2, seen.pixels))
    return taken


def main() -> int:
    """Print what came of the trials; 1 where a scale was made worse, or where errors are not as stated."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recalibration", description=__doc__)
    parser.add_argument("--trials", type=int, default=200, help="trials from a wrong start (default 200)")
    parser.add_argument("--sequences", type=int, default=20, help="sequences of 43 slices (default 20)")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    frame, options = load_frame("cube6"), RegistrationOptions(spot_noise_px=CENTRE_NOISE_PX)
    failed = False
    print("slices  false  wrong by  trials  right  refused  worse  RMS/%   stated/%  NEES (2)  median/s  longest/s")
    for slices, most_false, wrong, trials in (
        (43, 0, 0.0, arguments.sequences),
        (1, 0, 0.0, arguments.trials),
        (10, 8, 0.0, arguments.trials // 4),
        (1, 8, 0.1, arguments.trials),
        (5, 8, 0.1, arguments.trials),
    ):
        rng = np.random.default_rng(slices + most_false)
        errors, stated, nees, times = [], [], [], []
        worse, reasons = 0, Counter[str]()
        for trial in tqdm(range(trials), disable=None, leave=False):
            by = 1 + (rng.choice([-wrong, wrong], 2) if trial % 2 else rng.uniform(-wrong, wrong, 2))
            told = PixelScale(by[0] * TRUE.sx, by[1] * TRUE.sy)
            taken = sightings(rng, slices, most_false)
            start = time.perf_counter()
            found = calibrate(taken, frame, told, options)
            times.append(time.perf_counter() - start)
            if not isinstance(found, Calibration):
                reasons[found.message[:60]] += 1
                continue
            error = np.array([found.scale.sx - TRUE.sx, found.scale.sy - TRUE.sy])
            nees.append(float(error @ np.linalg.solve(found.covariance, error)))
            errors.append(error / TRUE.sx)
            stated.append(np.array(found.standard_errors) / TRUE.sx)
            worse += bool(wrong > 0 and np.abs(error).max() / TRUE.sx > np.abs(by - 1).max() + 1e-9)
            worse += nees[-1] > _CHI_SQUARE_2_AT_1E5
        failed |= worse > 0
        rms, claimed = (100 * math.sqrt(float(np.mean(np.square(part)))) for part in (errors, stated))
        print(
            f"{slices:6d}  {most_false:5d}  {100 * wrong:6.0f} %  {trials:6d}  {len(errors):5d}  "
            f"{sum(reasons.values()):7d}  {worse:5d}  {rms:5.3f}   {claimed:8.3f}  {np.mean(nees):8.2f}  "
            f"{np.median(times):8.2f}  {max(times):9.2f}   {dict(reasons) or ''}",
            flush=True,
        )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
