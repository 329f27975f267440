"""`python -m benchmarks.kill_rounds`: register_node, receiver and player killed at random while slices flow.

Receiver, player and register_node are processes of their own, over DICOM and DDS. The slices are drawn, and where the
frame truly stands is known. In half of the rounds the slices of two scanners come in turn, of which one has a measured
pixel scale; in a quarter the scale is being measured anew; in a quarter the player plays.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import tempfile
import time
from contextlib import AbstractContextManager
from pathlib import Path

from tqdm import tqdm

from support.kill_rounds import WRONG_DEG, WRONG_MM, KillRounds, Tally, Victim
from support.ros_process import RosClient

_SHOWN = 20


def main() -> int:
    """Print what was seen; 1 where a promise was broken."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kill_rounds", description=__doc__)
    parser.add_argument("--rounds", type=int, default=100, help="kills (default 100)")
    parser.add_argument("--seed", type=int, default=1, help="seed of slices, victims and moments (default 1)")
    arguments = parser.parse_args()
    # Each time that the receiver is killed, the scanner finds the port closed.
    logging.getLogger("pynetdicom").setLevel(logging.CRITICAL)
    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, RosClient("controller") as client:
        rounds = KillRounds(client, Path(folder), arguments.seed)
        rng = random.Random(arguments.seed)
        played = arguments.rounds // 4
        with tqdm(total=arguments.rounds, unit="round", disable=None, leave=False) as bar:

            def some(count: int, context: AbstractContextManager[None], victims: list[Victim], **how: bool) -> None:
                with context:
                    for _ in range(count):
                        rounds.run(rng.choice(victims), **how)
                        bar.update()
                        bar.set_postfix(faults=len(rounds.tally.faults))

            measured = arguments.rounds // 4
            received: list[Victim] = ["register_node", "receive_dicom_node"]
            some(measured, rounds.receiving(), received, recalibrate=True)
            some(arguments.rounds - measured - played, rounds.receiving(), received, both_scanners=True)
            some(played, rounds.playing(), ["register_node", "play_dicom_node"])
        rounds.judge()
    _print(rounds.tally, time.monotonic() - begun_s)
    return int(bool(rounds.tally.faults))


def _print(tally: Tally, seconds: float) -> None:
    for what, value in (
        *((f"rounds in which {victim} was killed", count) for victim, count in tally.rounds.items()),
        ("slices sent by DICOM", tally.sent),
        ("acknowledged, and each kept whole and readable", tally.acknowledged),
        ("poses published", tally.poses),
        ("of slices that were sent again", tally.sent_again),
        ("slices refused", tally.refused),
        (f"largest error of a pose, mm (wrong: {WRONG_MM:g})", f"{tally.largest_mm:.3f}"),
        (f"largest error of a pose, degrees (wrong: {WRONG_DEG:g})", f"{tally.largest_deg:.3f}"),
        ("from a kill to the pose of a slice of later, at most, s", f"{tally.longest_gap_s:.1f}"),
        ("seconds in all", f"{seconds:.0f}"),
        ("promises broken", len(tally.faults)),
    ):
        print(f"{what:60s} {value!s:>8s}")
    for fault in tally.faults[:_SHOWN]:
        print(f"BROKEN: {fault}")
    if len(tally.faults) > _SHOWN:
        print(f"and {len(tally.faults) - _SHOWN} more")


if __name__ == "__main__":
    sys.exit(main())
