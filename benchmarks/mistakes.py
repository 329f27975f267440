"""`python -m benchmarks.mistakes`: scenes with the mistakes that operators make, and how often a pose is wrong.

One kind and one frame: `python -m benchmarks.mistakes --kinds spacing --frames cube8 --scenes 100`; one scene again,
with all that is known of it: add `--scene 17`. All kinds and frames at 2,000 scenes each take hours.

right: accepted, within 2 mm and 3 degrees. weak: farther off, but no more than the covariance says. wrong: farther off
than that (a squared Mahalanobis distance that chance exceeds once in 1e5), or accepted where the frame is absent. Of
the wrong ones, `fits` are those that explain every spot that a rod made, with residuals as large as the stated noise
and tolerance bring once in a hundred times or more often, while the true matches do not: nothing in the slice speaks
against such a pose. They are counted apart and do not fail.

What no single slice can show, whatever the software:
- A mirrored image or a left-handed frame file: the mirror image of a scene is a scene. Not drawn here.
- Helical motion: the slice is a plane still, tilted by 1.15 degrees.
- A leaning rod mirrored in the file, near the height at which it crosses the true one: there both have the same spot,
  and farther off another tilt brings it nearly to its place. With plates of an N that reaches farthest: two of an N's
  three spots say where the plate is, and only the third at what height it is cut; read the wrong way round, it is
  another height, which some other plane satisfies but for the foreshortening of the plates. `leksell_ct9` with the
  front diagonal mirrored is exactly what the true one is upside down: without a prior every slice fits that.
- Errors of spacing and of rods' ends leave 2 n - 6 figures that show them. Five rods leave four: some errors are then
  nearly those of another pose.
The first two are kinds. Of the others it depends on the scene, which is what `fits` says.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from support.mistake_scenes import CASES, FRAMES, KINDS, register, scene_of
from support.mistake_verdicts import Outcome, Row, judge, measure, measure_cases, row_of

_BATCH = 50


def measured_rows(kinds: list[str], frames: list[str], scenes: int, seed: int, workers: int) -> Iterator[Row]:
    """A row for each kind and frame; except for times, independent of the number of workers."""
    cells = [(kind, frame) for frame in frames for kind in kinds]
    starts = range(0, scenes, _BATCH)
    with (
        ProcessPoolExecutor(workers) as pool,
        tqdm(total=len(cells) * scenes, unit="scene", disable=None, leave=False) as bar,
    ):
        jobs = [
            [pool.submit(measure, *cell, start, min(_BATCH, scenes - start), seed) for start in starts]
            for cell in cells
        ]
        for (kind, frame), parts in zip(cells, jobs, strict=True):
            bar.set_description(f"{kind}, {frame}")
            outcomes: list[Outcome] = []
            for part in parts:
                outcomes += part.result()
                bar.update(len(part.result()))
            yield row_of(kind, frame, outcomes)


_HEAD = (
    "kind                frame        scenes   right  weak  wrong  fits  cautioned  refused   NEES  median/ms  "
    "reasons of refusals"
)


def _line(row: Row) -> str:
    nees = "" if row.nees is None else f"{row.nees:.4g}"
    reasons = ", ".join(f"{reason} {number}" for reason, number in sorted(row.refused.items()))
    indices = ", ".join(str(outcome.index) for outcome in row.wrong_scenes if not outcome.fits)
    wrong = f"  {row.shortcoming}: scenes {indices:.40}" if row.shortcoming == "WRONG" else f"  {row.shortcoming}"
    return (
        f"{row.kind:19s} {row.frame:12s} {row.scenes:6d}  {row.right:6d} {row.weak:5d}  {row.wrong:5d} {row.fits:5d}  "
        f"{row.cautioned:9d}  {sum(row.refused.values()):7d}  {nees:>5s}  {1e3 * row.median_s:9.0f}  {reasons}{wrong}"
    )


def _describe(kind: str, frame: str, index: int, seed: int) -> None:
    """One scene: the truth and the result."""
    scene = scene_of(kind, frame, index, seed)
    result = register(scene)
    print(f"{len(scene.spots_px)} spots, rods {scene.rods.tolist()}, options {scene.options}, scale {scene.scale}")
    print(f"truth {scene.truth}\nprevious {scene.previous}\n{judge(scene, result)}")
    estimates = (result.estimate,) if result else result.estimates
    print(f"accepted; caution: {result.caution or 'none'}" if result else f"{result.reason}: {result.message}")
    for estimate in estimates:
        matches = {match.line_index: int(scene.rods[match.spot]) for match in estimate.matches}
        print(
            f"{estimate.inliers} rods, log10 false alarms {estimate.log10_false_alarms:.1f}, chi-square "
            f"{estimate.chi_square:.1f} of {estimate.degrees_of_freedom}, {estimate.position_std_mm:.2f} mm, "
            f"{estimate.rotation_std_deg:.2f} degrees; rod: whose spot it has {matches}\n{estimate.scanner_from_frame}"
        )


def main() -> int:
    """Print the table and write it as JSON; 1 where more than 1 in 1,000 is wrong that a slice can show."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.mistakes", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=2000, help="scenes of each kind and frame (default 2000)")
    parser.add_argument(
        "--kinds", nargs="+", default=[*KINDS, "cases"], choices=[*KINDS, "cases"], metavar="KIND",
        help=f"of {', '.join(KINDS)}, and cases, the scenes of {CASES.name} (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--frames", nargs="+", default=list(FRAMES), metavar="FRAME", help=f"(default: {', '.join(FRAMES)})"
    )
    parser.add_argument("--scene", type=int, help="describe this one scene of the first kind and frame, and no more")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: all cores)")
    parser.add_argument("--output", type=Path, default=Path("build/mistakes.json"), help="JSON file to write")
    arguments = parser.parse_args()
    kinds = [kind for kind in arguments.kinds if kind != "cases"]
    if arguments.scene is not None:
        _describe(kinds[0], arguments.frames[0], arguments.scene, arguments.seed)
        return 0
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []

    def add(row: Row) -> None:
        rows.append(row)
        tqdm.write(_line(row), file=sys.stdout)
        sys.stdout.flush()
        # After each row, as all of them take hours.
        arguments.output.write_text(json.dumps([asdict(one) for one in rows], indent=1) + "\n")

    print(_HEAD, flush=True)
    if "cases" in arguments.kinds and CASES.exists():
        add(row_of("cases", "", measure_cases()))
    elif "cases" in arguments.kinds:
        print(f"cases: {CASES} is absent, skipped")
    for row in measured_rows(kinds, arguments.frames, arguments.scenes, arguments.seed, arguments.workers):
        add(row)
    print(f"\nas JSON: {arguments.output}")
    short = [row for row in rows if row.shortcoming]
    for row in short:
        print(f"{row.shortcoming}: {row.kind} {row.frame}")
    return 1 if any(row.shortcoming == "WRONG" for row in short) else 0


if __name__ == "__main__":
    sys.exit(main())
