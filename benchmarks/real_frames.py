"""`python -m benchmarks.real_frames [ROW...]`: how real frames are registered, and how often a wrong pose looks right.

A row is chosen by any part of its name, such as `leksell/1000` or `erased`. A row whose images are not there is named,
and left out.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import asdict
from pathlib import Path
from statistics import median

import cv2

from support.real_rows import BEYOND, Figures, rows_of, run
from support.real_scenes import SHARED_DATA

# Scenes of a row for a first look.
_QUICK_SCENES = 2
# Of a row's name in the table.
_WIDTH = 56


def _line(figures: Figures) -> str:
    accepted, n = figures.accepted, len(figures.attempts)
    if figures.absent:
        return f"{figures.row:{_WIDTH}s} left out: {figures.absent}"
    share = f"{100 * len(accepted) / n:5.1f}" if n else "    -"
    errors = [one.error_mm for one in accepted]
    inside = f"{100 * figures.inside / len(accepted):5.1f}" if accepted else "    -"
    refused = ", ".join(f"{count} {reason}" for reason, count in figures.refusals.items())
    return (
        f"{figures.row:{_WIDTH}s} {n:6d}  {share}  {sum(one.off for one in accepted):4d}  {len(figures.wrong):5d}  "
        f"{sum(bool(one.message) for one in accepted):8d}  {median(errors) if errors else math.nan:7.3f}  "
        f"{max(errors, default=math.nan):7.2f}  {inside:>6s}  {figures.seconds:5.0f}  {refused}"
        + (f"   MISSED: {'; '.join(figures.missed)}" if figures.missed else "")
    )


def main() -> int:
    """Print the table, write it as JSON; 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real_frames", description=__doc__)
    parser.add_argument("rows", nargs="*", help="parts of the names of the rows wanted (default: all)")
    parser.add_argument("--quick", action="store_true", help="a few scenes of the most telling rows, in a minute")
    parser.add_argument("--scenes", type=int, help="most scenes of each row (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="of false spots and rendered poses (default 0)")
    parser.add_argument("--list", action="store_true", help="the rows' names")
    parser.add_argument("--details", action="store_true", help="every scene of the rows")
    parser.add_argument(
        "--leksell", type=Path, default=SHARED_DATA / "leksell9_ct", help="folder of the Leksell series"
    )
    parser.add_argument("--output", type=Path, default=Path("build/real_frames.json"), help="JSON file to write")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    most = arguments.scenes or (_QUICK_SCENES if arguments.quick else None)
    every_row = rows_of(arguments.leksell, arguments.seed)
    rows = [row for row in every_row if row.quick or not arguments.quick]
    if arguments.rows:
        rows = [row for row in rows if any(part in row.name for part in arguments.rows)]
    if arguments.list or not rows:
        print("\n".join(row.name for row in every_row))
        return 0 if arguments.list else 2
    print(
        f"{'row':{_WIDTH}s} scenes  acc/%   off  wrong  cautions   median      max  inside      s  refusals\n"
        f"{'':{_WIDTH}s}                                         mm       mm       %"
    )
    results = []
    for row in rows:
        figures = run(row, most)
        results.append(figures)
        print(_line(figures), flush=True)
        for one in figures.attempts if arguments.details else figures.wrong[:5]:
            print(f"    {one}")
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps([_record(one) for one in results], indent=1) + "\n")
    print(
        "\noff: by more than 1 mm (Leksell, CatPhan) or 2 mm, or 2 to 10 degrees; wrong: off, and by more than "
        f"{BEYOND:g} times the stated 95 % radius; as JSON: {arguments.output}"
    )
    return 1 if any(one.missed for one in results) else 0


def _record(figures: Figures) -> dict[str, object]:
    attempts = [
        {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in asdict(one).items()}
        for one in figures.attempts
    ]
    return {
        "row": figures.row,
        "absent": figures.absent,
        "scenes": len(figures.attempts),
        "accepted": len(figures.accepted),
        "wrong": len(figures.wrong),
        "inside": figures.inside,
        "refusals": figures.refusals,
        "missed": figures.missed,
        "seconds": figures.seconds,
        "attempts": attempts,
    }


if __name__ == "__main__":
    sys.exit(main())
