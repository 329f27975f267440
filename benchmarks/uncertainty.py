"""`python -m benchmarks.uncertainty`: are the errors of poses as large as stated?

Spot sets and rendered slices with known poses are registered, and the errors compared with the stated covariances: the
mean of the squared errors in terms of the covariance (NEES, 6 where it is right) and how often the 95 % ball at targets
100 mm from the origin holds the error. And the worst cases for spots that are off by no more than so much are compared
with what the solver makes of such spots. Exit code 1 where a figure is outside its limits.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from support.stated_errors import RENDERED_CASES, SPOT_CASES, WORST_CASES, is_sound, measure, within_limits
from support.worst_cases import count_worst_cases


def _worst_cases(trials: int, seed: int, records: list[dict[str, Any]]) -> bool:
    """Print and record the worst cases; whether a figure is outside its limits."""
    failed = False
    print(
        "\nworst cases         spots off by   poses  unproven   trials  beyond a bound  nearest  reached: median, least"
    )
    for case, max_error_px, linear in WORST_CASES:
        found = count_worst_cases(case.make_frame(), max_error_px, trials // len(WORST_CASES), seed)
        good = is_sound(found, linear)
        failed |= not good
        shares = found.reached if found.reached.size else np.zeros(1)
        print(
            f"{case.frame or 'generated':10s} {case.rods} rods  {max_error_px:8g} px   {found.scenes:5d}  "
            f"{found.unproven:8d}  {found.trials:7d}  {found.exceeded:14d}  {found.nearest:7.3f}  "
            f"{np.median(shares):.3f}, {shares.min():.3f}  "
            f"{'' if good else 'OUTSIDE'}",
            flush=True,
        )
        records.append(
            {
                "case": f"worst case, {case.name}",
                "max_error_px": max_error_px,
                "poses": found.scenes,
                "unproven": found.unproven,
                "trials": found.trials,
                "exceeded": found.exceeded,
                "nearest": found.nearest,
                "reached": found.reached.tolist(),
            }
        )
    return failed


def main() -> int:
    """Print the table and write it as JSON; 1 where a figure is outside its limits."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.uncertainty", description=__doc__)
    parser.add_argument("--sets", type=int, default=10_000, help="spot sets of each case (default 10000)")
    parser.add_argument("--slices", type=int, default=1000, help="rendered slices of each case (default 1000)")
    parser.add_argument(
        "--trials", type=int, default=100_000, help="errors of spots for the worst cases, in all (default 100000)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: all cores)")
    parser.add_argument("--output", type=Path, default=Path("build/uncertainty.json"), help="JSON file to write")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    records: list[dict[str, Any]] = []
    failed = False
    print(f"{'case':42s} accepted  refused  NEES (6)  limits          95 % ball holds     median radius")
    for number, case in enumerate((*SPOT_CASES, *RENDERED_CASES)):
        count = arguments.slices if case.rendered else arguments.sets
        if count < 1:
            continue
        found = measure(case, count, 100 * arguments.seed + number, arguments.workers)
        good = within_limits(case, found)
        failed |= not good
        refused, held = sum(found.refused.values()), 100 * found.coverage
        print(
            f"{case.name:42s} {found.accepted:8d} {refused:8d}  {found.nees:8.3f}  6 +- {found.nees_limit:.3f}   "
            f"{held.min():7.2f} to {held.max():5.2f} %  {np.median(found.radii_mm):10.3f} mm  "
            f"{'' if good else 'OUTSIDE'}  {dict(found.refused) or ''}",
            flush=True,
        )
        records.append(
            {
                "case": case.name,
                "accepted": found.accepted,
                "refused": dict(found.refused),
                "nees": found.nees,
                "nees_limit": found.nees_limit,
                "coverage": found.coverage.tolist(),
            }
        )
    if arguments.trials:
        failed |= _worst_cases(arguments.trials, arguments.seed, records)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(records, indent=1) + "\n")
    print(f"\nas JSON: {arguments.output}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
