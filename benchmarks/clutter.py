"""`python -m benchmarks.clutter`: spots that are all false. How often are they taken for a frame?

The theory (docs/matching.md) says how many matches chance brings at most at each threshold. Here spots are drawn
uniformly, and what is found is counted.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from support.clutter_counts import THRESHOLDS, Clutter, Count, count

FRAMES = ("cube6", "leksell_ct", "zframe")
DEFAULT_LOG10 = -6.0
_BATCH = 250


def count_in_parallel(clutter: Clutter, sets: int, workers: int, seed: int = 0) -> Count:
    """The same over several processes; the result does not depend on their number."""
    batches = [min(_BATCH, sets - start) for start in range(0, sets, _BATCH)]
    total = Count(0, 0, dict.fromkeys(THRESHOLDS, 0), {})
    with ProcessPoolExecutor(workers) as pool:
        jobs = [pool.submit(count, clutter, size, 1_000_003 * seed + k) for k, size in enumerate(batches)]
        for job in tqdm(jobs, desc=f"{clutter.frame}, clutter only", unit="batch", disable=None, leave=False):
            part = job.result()
            total.sets += part.sets
            total.accepted += part.accepted
            for threshold, number in part.below.items():
                total.below[threshold] += number
            for reason, number in part.reasons.items():
                total.reasons[reason] = total.reasons.get(reason, 0) + number
    return total


def main() -> int:
    """Print and write the counts; 1 where a set is accepted, or where more are found than the theory allows."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.clutter", description=__doc__)
    parser.add_argument("--sets", type=int, default=2000, help="sets for each frame (default 2000)")
    parser.add_argument("--theory-sets", type=int, default=2000, help="sets to count at each threshold (default 2000)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: all cores)")
    parser.add_argument("--output", type=Path, default=Path("build/clutter.json"), help="JSON file to write")
    arguments = parser.parse_args()
    records, failed = [], False
    print(f"clutter only, 5 to 60 spots over 256 x 256 mm, at the default {DEFAULT_LOG10:g}")
    for name in FRAMES:
        clutter = Clutter(name, 5, 60, 256.0, 0.3, DEFAULT_LOG10)
        result = count_in_parallel(clutter, arguments.sets, arguments.workers)
        failed |= result.accepted > 0
        records.append({"clutter": asdict(clutter), "count": asdict(result)})
        print(f"{name:12s} {result.accepted} of {result.sets} accepted; {result.reasons}", flush=True)
    print("\nsets with an explanation below each threshold, and the most that the theory lets be expected")
    print(f"{'frame':12s} {'spots':>8s} " + "".join(f"{threshold:>14g}" for threshold in THRESHOLDS))
    for clutter in (
        Clutter("cube6", 8, 20, 256.0, 0.3, 0.0),
        Clutter("cube6", 15, 25, 120.0, 0.3, 0.0),
        Clutter("cube6", 8, 16, 256.0, 0.3, 0.0, 0.5, 0.005),
        Clutter("zframe", 8, 16, 150.0, 0.3, 0.0),
        Clutter("leksell_ct", 8, 14, 256.0, 0.3, 0.0),
    ):
        result = count_in_parallel(clutter, arguments.theory_sets, arguments.workers, seed=1)
        records.append({"clutter": asdict(clutter), "count": asdict(result)})
        row = ""
        for threshold, number in result.below.items():
            most = result.sets * 10**threshold
            # Three standard deviations of a count of that mean.
            failed |= number > most + 3 * most**0.5 + 1
            row += f"{number:>6d} /{most:6.4g}"
        tolerance = f"  tolerance {clutter.tolerance_mm:g} mm" if clutter.tolerance_mm else ""
        print(f"{clutter.frame:12s} {clutter.fewest:>3d}-{clutter.most:<3d}  {row}{tolerance}", flush=True)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(records, indent=1) + "\n")
    print(f"\nas JSON: {arguments.output}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
