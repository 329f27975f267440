"""`python -m benchmarks.soak`, `make soak`: slices at a steady rate for a given time; what is lost, what grows?

Scanner, node and listener are processes. Six rods and 24 false spots move through 512 x 512 pixels, now and then a
slice shows no frame. Memory is what register_node holds that no file holds too, be it swapped out. Latency is from an
image's stamp, taken just before it is published, to the arrival of its status here.

The run is cut into windows of a minute, or of a twelfth of it where that is less. The first sixth, but no more than
five minutes, is for warming up. Growth of the memory: from the first window after that to the highest later one, of
the windows' medians, as one sample says little. The p99 is flat where, in units of the yardstick timed in the same
window, that of the last sixth is at most 1.5 times that of the first; a sixth's is the median of its windows', so that
a minute of other work on the machine is not what is judged.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from tqdm import tqdm

from benchmarks.answers import Listener, nanoseconds
from benchmarks.register_process import DEADLINE_S, RegisterProcess
from benchmarks.slice_source import TRUTH_QOS, WARM_UP
from benchmarks.yardstick import Yardstick
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.nodes.common.conversions import pose_from_message
from stereoreg_ros.nodes.demo.demo_report import WRONG_DEG, WRONG_MM
from support.pose_statistics import pose_error
from support.process_memory import memory_kib
from support.soak_verdict import JUDGED_FROM_S, Sample, Verdict, Window, verdict_of, windows_of

_PASSAGES: Final = 5
_SAMPLE_S: Final = 2.0
_SILENCE_S: Final = 10.0


@dataclass
class Counts:
    """What became of the slices; lost: never answered; poses_lost: said to be accepted, but no pose came.

    skipped: answered, but not registered, for a newer one; wrong: poses off by more than what `make demo` allows, or
    of a slice without a frame.
    """

    sent: int = 0
    lost: int = 0
    accepted: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    skipped: int = 0
    poses_lost: int = 0
    wrong: int = 0
    largest_error_mm: float = 0.0
    largest_error_deg: float = 0.0


class _SoakListener(Listener):
    """Collects the truth too."""

    def __init__(self) -> None:
        super().__init__("soak_listener")
        self.truths: dict[int, Pose] = {}
        self.stated: dict[int, Pose] = {}
        self.create_subscription(PoseStamped, "true_pose", self._on_truth, TRUTH_QOS)

    def _on_truth(self, message: PoseStamped) -> None:
        self.truths[nanoseconds(message)] = pose_from_message(message)

    def on_pose(self, message: PoseStamped) -> None:
        super().on_pose(message)
        self.stated[nanoseconds(message)] = pose_from_message(message)

    def counts(self, stamps: list[int]) -> Counts:
        """Of the slices with these stamps."""
        heard = self.heard
        counts = Counts(sent=len(stamps))
        reasons: Counter[str] = Counter()
        for stamp in stamps:
            if stamp not in heard.statuses:
                counts.lost += 1
            elif stamp in heard.refused:
                reasons[heard.refused[stamp]] += 1
            else:
                counts.accepted += 1
                counts.poses_lost += stamp not in heard.poses
        counts.skipped = reasons.pop("skipped", 0)
        counts.refused = dict(reasons)
        for stamp, stated in self.stated.items():
            truth = self.truths.get(stamp)
            if truth is None:
                counts.wrong += 1
                continue
            error = pose_error(stated, truth)
            off_mm, off_deg = float(np.linalg.norm(error[:3])), float(np.degrees(np.linalg.norm(error[3:])))
            counts.wrong += off_mm > WRONG_MM or off_deg > WRONG_DEG
            counts.largest_error_mm = max(counts.largest_error_mm, off_mm)
            counts.largest_error_deg = max(counts.largest_error_deg, off_deg)
        return counts


def _soak(listener: _SoakListener, node: RegisterProcess, rate: float, slices: int) -> tuple[list[int], list[Sample]]:
    """The stamps of the slices sent, and samples of the node; RuntimeError where either ends before its time."""
    command = [sys.executable, "-m", "benchmarks.slice_source", "--rate", str(rate), "--slices", str(slices)]
    command += ["--passages", str(_PASSAGES)]
    yardstick, samples, heard = Yardstick(), list[Sample](), listener.heard
    # To a file: a pipe that is not read would block the source's last lines.
    with tempfile.TemporaryFile("w+") as said, subprocess.Popen(command, stdout=said) as source:
        try:
            # Until the slices begin, the source is drawing them.
            listener.spin(lambda: bool(heard.statuses) or source.poll() is not None, DEADLINE_S)
            due_s, last_ns = time.monotonic(), time.time_ns()
            with tqdm(total=WARM_UP + slices, desc=f"{rate:g} Hz", unit="slice", disable=None, leave=False) as bar:
                while source.poll() is None:
                    rclpy.spin_once(listener, timeout_sec=0.1)
                    if len(heard.statuses) > bar.n:
                        bar.update(len(heard.statuses) - bar.n)
                        last_ns = time.time_ns()
                    if not node.running or time.time_ns() - last_ns > DEADLINE_S * 1e9:
                        raise RuntimeError(f"register_node has ended, or answers no more:\n{node.output}")
                    if time.monotonic() >= due_s:
                        due_s += _SAMPLE_S
                        own, resident = memory_kib(node.process.pid)
                        samples.append(Sample(time.time_ns(), own / 1024, resident / 1024, yardstick.once()))
        finally:
            source.kill()
        said.seek(0)
        stamps = [int(line) for line in said.read().split()]
        if source.returncode or not stamps:
            raise RuntimeError(f"the slice source ended with exit code {source.returncode}")
    listener.spin(lambda: heard.statuses.keys() >= set(stamps[-10:]), _SILENCE_S)
    # The pose of the last slice may come after its status.
    listener.spin(lambda: False, 1.0)
    return stamps, samples


def _print_counts(counts: Counts) -> None:
    refused = ", ".join(f"{number} {reason}" for reason, number in counts.refused.items()) or "none"
    print(
        f"{counts.sent} slices sent, {counts.lost} lost, {counts.skipped} skipped; {counts.accepted} accepted, "
        f"{counts.poses_lost} of their poses lost; refused: {refused}"
    )
    print(
        f"{counts.wrong} wrong poses; largest error {counts.largest_error_mm:.2f} mm, "
        f"{counts.largest_error_deg:.2f} degrees",
        flush=True,
    )


def _print_verdict(windows: list[Window], verdict: Verdict) -> None:
    print(
        f"memory {windows[0].memory_mib:.2f} MiB in the first window, {verdict.warm_mib:.2f} MiB when warm, at most "
        f"{verdict.highest_mib:.2f} MiB after that: growth {verdict.growth_mb:+.3f} MB"
    )
    for name, values in (("p50", verdict.p50_y), ("p99", verdict.p99_y)):
        sixths = " ".join(f"{value:6.2f}" for value in values)
        print(f"latency, {name} by sixths of the run: {sixths} Y; last to first {values[-1] / values[0]:.2f}")
    print(
        f"over the whole run p50 {verdict.p50_ms:.1f} ms, p99 {verdict.p99_ms:.1f} ms, "
        f"longest {verdict.longest_ms:.1f} ms; Y = {verdict.yardstick_ms:.2f} ms",
        flush=True,
    )


def main() -> int:
    """Print the figures, write them as JSON and as a picture; 1 where one misses its target."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.soak", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="length of the run (default 60)")
    parser.add_argument("--rate", type=float, default=20.0, help="slices per second (default 20)")
    parser.add_argument("--output", type=Path, default=Path("build/soak"), help="folder to write (default build/soak)")
    arguments = parser.parse_args()
    slices = round(60 * arguments.minutes * arguments.rate)
    if arguments.rate <= 0 or slices < 15 * arguments.rate:
        parser.error(f"--minutes is {arguments.minutes:g}, --rate {arguments.rate:g}, expected 0.25 or more, above 0")
    # Other nodes on the network neither disturb nor are disturbed.
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    rclpy.init()
    listener = _SoakListener()
    with tempfile.TemporaryFile() as log:
        node = RegisterProcess(log)
        try:
            if not listener.spin(listener.hears_the_node, DEADLINE_S):
                raise RuntimeError(f"register_node was not discovered within {DEADLINE_S:g} s")
            stamps, samples = _soak(listener, node, arguments.rate, slices)
        finally:
            node.end()
            listener.destroy_node()
            rclpy.shutdown()
    counts, answered = listener.counts(stamps), listener.heard.statuses
    _print_counts(counts)
    stamps = [stamp for stamp in stamps if stamp in answered]
    latencies_s = np.array([1e-9 * (answered[stamp] - stamp) for stamp in stamps])
    try:
        windows = windows_of(np.array(stamps), latencies_s, samples)
    except ValueError as error:
        print(f"FAILED: {counts.lost} slices lost; {error}")
        return 1
    verdict = verdict_of(windows, latencies_s)
    _print_verdict(windows, verdict)
    arguments.output.mkdir(parents=True, exist_ok=True)
    record = {
        "minutes": arguments.minutes,
        "rate_hz": arguments.rate,
        "counts": asdict(counts),
        "verdict": asdict(verdict),
        "windows": [asdict(window) for window in windows],
        "samples": [asdict(sample) for sample in samples],
    }
    (arguments.output / "soak.json").write_text(json.dumps(record, indent=1) + "\n")
    # Imported only here: the figures do not need matplotlib.
    from benchmarks.soak_plot import draw_soak

    draw_soak(samples, windows, verdict, arguments.output / "soak.png")
    print(f"as JSON: {arguments.output / 'soak.json'}, as a picture: {arguments.output / 'soak.png'}")
    missed = []
    if counts.lost:
        missed.append(f"{counts.lost} slices lost")
    if counts.poses_lost:
        missed.append(f"{counts.poses_lost} poses lost")
    if counts.wrong:
        missed.append(f"{counts.wrong} wrong poses")
    if slices / arguments.rate >= JUDGED_FROM_S:
        missed += [f"{counts.skipped} slices skipped"] if counts.skipped else []
        missed += verdict.missed
    else:
        print(f"skipping, growth and p99 are not judged: the run is shorter than {JUDGED_FROM_S / 60:g} minutes")
    print(f"FAILED: {'; '.join(missed)}" if missed else "all as it has to be")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
