"""`python -m benchmarks.ending`: how long register_node takes to end by SIGINT or SIGTERM, idle or busy."""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
from tqdm import tqdm

_READY_S, _END_S, _WANTED_S = 30.0, 10.0, 1.0


def main() -> int:
    """Print the times; 1 where a round ended late, or with another exit code than 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ending", description=__doc__)
    parser.add_argument("--rounds", type=int, default=100, help="nodes started and ended (default 100)")
    arguments = parser.parse_args()
    rng = random.Random(0)
    seconds, bad = [], 0
    environment = os.environ | {"PYTHONUNBUFFERED": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    for _ in tqdm(range(arguments.rounds), disable=None, leave=False):
        command = [sys.executable, "-m", "stereoreg_ros.nodes.register.register_node", "--ros-args", "-p"]
        # With a spacing the node is filling tables just before it is ready.
        node = subprocess.Popen(
            [*command, "pixel_spacing:=[0.5,0.5]"], stderr=subprocess.PIPE, env=environment, text=True
        )
        assert node.stderr is not None
        begun = time.monotonic()
        for line in node.stderr:
            if "ready" in line or time.monotonic() - begun > _READY_S:
                break
        # Anywhere in the cycle of its timers.
        time.sleep(rng.uniform(0.0, 0.5))
        asked = time.monotonic()
        node.send_signal(rng.choice([signal.SIGINT, signal.SIGTERM]))
        try:
            code = node.wait(_END_S)
        except subprocess.TimeoutExpired:
            node.kill()
            code = -9
        seconds.append(time.monotonic() - asked)
        bad += code != 0 or seconds[-1] > _WANTED_S
        node.stderr.close()
    print(
        f"{arguments.rounds} rounds: median {np.median(seconds):.2f} s, longest {max(seconds):.2f} s, "
        f"{bad} later than {_WANTED_S:g} s or with another exit code than 0"
    )
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
