"""`make bench`: times as multiples of the yardstick Y, and how often the answer is right."""

from __future__ import annotations

import argparse
import json
import platform
import sys
from dataclasses import asdict
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import scipy

from benchmarks.matching import BASELINE_FALSE_SPOTS, PROBLEMS, measure, measure_baseline
from benchmarks.yardstick import Yardstick, seconds_of
from stereoreg_ros import RegistrationOptions, load_frame
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice
from stereoreg_ros.spots import find_spots


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
    finding = _spot_finding()
    print(f"Y = {1e3 * unit:.2f} ms: threshold and connected components of a 512 x 512 slice")
    print(f"finding the spots of such a slice: {finding / unit:.1f} Y\n")
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
    print(
        "weak: accepted with a caution, off by more than 2 mm or 3 degrees, but no more than the stated covariance says"
    )
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
        "spot_finding_s": finding,
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


def _spot_finding() -> float:
    frame = load_frame("cube6")
    rng = np.random.default_rng(0)
    settings = ScannerSettings(false_spots=8)
    ct_slice = render_slice([PlacedFrame(frame, random_pose(rng, frame, settings))], settings, rng)
    return median(seconds_of(lambda: find_spots(ct_slice, RegistrationOptions())) for _ in range(100))


if __name__ == "__main__":
    sys.exit(main())
