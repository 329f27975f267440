"""`make bench`: times as multiples of the yardstick Y, accuracy of the spots, and how often the pose is right."""

from __future__ import annotations

import argparse
import json
import platform
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import scipy

from benchmarks.matching import BASELINE_FALSE_SPOTS, PROBLEMS, measure, measure_baseline
from benchmarks.yardstick import Yardstick, seconds_of
from stereoreg_ros import PixelScale, RegistrationOptions, load_frame
from stereoreg_ros.options import AUTO
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice
from stereoreg_ros.spots import find_spots
from support import artefacts, spot_accuracy


def main() -> int:
    """Print the table, write it as JSON; 1 where any accepted pose is wrong."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--trials", type=int, default=200, help="problems of each class (default 200)")
    parser.add_argument(
        "--baseline-samples", type=int, default=20_000, help="samples of the paper's search to time (default 20000)"
    )
    parser.add_argument("--output", type=Path, default=Path("build/bench.json"), help="JSON file to write")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    unit = Yardstick().unit()
    print(f"Y = {1e3 * unit:.2f} ms: threshold and connected components of a 512 x 512 slice\n")
    finding = [_finding(side, threshold) for side in (512, 1024) for threshold in (2000.0, AUTO)]
    for one in finding:
        print(f"finding the spots of a {one.side} x {one.side} slice, threshold {one.threshold}: {one.ratio:.1f} Y")
    centres = [_centres(case, arguments.trials) for case in spot_accuracy.CASES]
    scanned = artefacts.measure(max(arguments.trials // 40, 2), 6, 1.0, AUTO)
    print(
        f"in a scan with metal streaks: {scanned[0]} of {scanned[1]} rods found, RMS {scanned[2]:.3f} pixel, "
        f"largest error {scanned[3]:.3f}\n"
    )
    print(
        "frame       rods  false  noise/px  allowed  prior/deg  guess   right  weak  wrong  refused  median/Y   p99/Y  "
        "median/ms"
    )
    rows = []
    for problem in PROBLEMS:
        row = measure(problem, arguments.trials)
        rows.append(row)
        guess = "near" if problem.guess else "any" if problem.any_rotation else ""
        print(
            f"{problem.frame:10s} {problem.visible:5d}  {problem.false_spots:5d}  {problem.noise_px:8.2f}  "
            f"{problem.max_log10:7.0f}  {problem.max_rotation_deg:9.0f}  {guess:5s}  "
            f"{row.right:6d} {row.weak:5d} {row.wrong:6d}  "
            f"{sum(row.refused.values()):7d}  {row.median_s / row.unit_s:8.1f} {row.p99_s / row.unit_s:7.1f}  "
            f"{1e3 * row.median_s:9.1f}   {row.refused or ''}",
            flush=True,
        )
    print("\nguess: near = the pose before, 2 mm and 1 degree off; any = the frame turned in any way")
    print("weak: accepted, off by more than 2 mm or 3 degrees, but no more than the stated covariance says")
    baselines = []
    for false_spots in BASELINE_FALSE_SPOTS:
        baseline = measure_baseline(false_spots, arguments.baseline_samples)
        baselines.append(baseline)
        print(
            f"maurin2009, six rods and {false_spots} false spots: {baseline.paper_s:.0f} s "
            f"({baseline.samples} of {baseline.planned} samples run), ours {1e3 * baseline.ours_s:.1f} ms: "
            f"{baseline.paper_s / baseline.ours_s:.0f} times faster",
            flush=True,
        )
    record = {
        "yardstick_s": unit,
        "spot_finding": [asdict(one) for one in finding],
        "spot_centres": [asdict(row) for row in centres],
        "spots_in_scan": {"found": scanned[0], "there": scanned[1], "rms_px": scanned[2], "largest_px": scanned[3]},
        "versions": {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "opencv": cv2.__version__,
        },
        "rows": [asdict(row) for row in rows],
        "baselines": [asdict(baseline) for baseline in baselines],
    }
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(record, indent=1) + "\n")
    print(f"\nas JSON: {arguments.output}")
    return 1 if any(row.wrong for row in rows) else 0


@dataclass(frozen=True)
class Finding:
    """How long it takes to find the spots of a slice, s and as a multiple of the yardstick."""

    side: int
    threshold: float | str
    median_s: float
    ratio: float


def _finding(side: int, threshold: float | str) -> Finding:
    frame = load_frame("cube6")
    rng = np.random.default_rng(0)
    spacing = 256.0 / side
    settings = ScannerSettings(false_spots=8, shape=(side, side), scale=PixelScale(spacing, spacing))
    ct_slice = render_slice([PlacedFrame(frame, random_pose(rng, frame, settings))], settings, rng)
    options, yardstick = RegistrationOptions(threshold=threshold), Yardstick()
    times, units = [], []
    for _ in range(150):
        times.append(seconds_of(lambda: find_spots(ct_slice, options)))
        units.append(yardstick.once())
    return Finding(side, threshold, median(times), median(times) / median(units))


def _centres(case: spot_accuracy.Case, trials: int) -> spot_accuracy.Row:
    row = spot_accuracy.measure(case, trials)
    if case is spot_accuracy.CASES[0]:
        print(
            "\ncentres of spots       found  wrong   RMS/px  bias/px  along/px  across/px  x bound  NEES (2 is right)"
        )
    print(
        f"{case.name:24s} {row.found:4d}  {row.wrong:5d}  {row.rms_px:7.4f}  {row.bias_px:7.4f}  {row.along_px:8.4f}  "
        f"{row.across_px:9.4f}  {row.ratio:7.2f}  {row.nees:4.2f}",
        flush=True,
    )
    return row


if __name__ == "__main__":
    sys.exit(main())
