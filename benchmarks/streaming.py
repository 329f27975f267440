"""`python -m benchmarks.streaming`: slices over DDS at a steady rate; scanner, node and listener are processes.

512 x 512 pixels, six rods and 24 false spots. Latency is from an image's stamp, taken just before it is published, to
the arrival of its pose here. CPU is of the node alone, 100 % being one core. The unit Y is timed without pauses. A
computer that rests between two slices is slower when the next comes; what Y itself takes then, and an image alone on
its way, is told beside.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
import rclpy
from tqdm import tqdm

from benchmarks.answers import Answers, Listener
from benchmarks.bare_transport import bare_transport_s
from benchmarks.register_process import DEADLINE_S, Load, LoadMeter, RegisterProcess
from benchmarks.slice_source import WARM_UP
from benchmarks.yardstick import Yardstick

P50_Y, P99_Y = 8.0, 30.0
RATE_HZ, FAST_HZ = 10.0, 30.0
_SILENCE_S: Final = 10.0
# Slices that are sent to a bare subscriber.
_ALONE: Final = 100


@dataclass
class Stream:
    """What became of the slices sent at one rate; times in s, by slice in the order sent.

    quarters_s: median latency of each quarter of the stream. paced_yardstick_s: median of one yardstick after each
    pose; transport_s: median of an image's way to a subscriber that does nothing else.
    """

    rate_hz: float
    sent: int
    answered: int
    accepted: int
    p50_s: float
    p99_s: float
    longest_s: float
    inside_p50_s: float
    quarters_s: list[float]
    load: Load
    paced_yardstick_s: float
    transport_s: float


def _stream(
    listener: Listener, node: RegisterProcess, yardstick: Yardstick, rate: float, slices: int, transport_s: float
) -> Stream:
    command = [sys.executable, "-m", "benchmarks.slice_source", "--rate", str(rate), "--slices", str(slices)]
    heard = listener.heard = Answers()
    source = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert source.stdout is not None
    # Until the slices begin, the source is drawing them.
    listener.spin(lambda: bool(heard.statuses) or source.poll() is not None, DEADLINE_S)
    meter = LoadMeter(node.process)
    answered, last_s, load = 0, time.monotonic(), meter.load()
    stamps: list[int] = []
    paced: list[float] = []
    with tqdm(total=WARM_UP + slices, desc=f"{rate:g} Hz", unit="slice", disable=None, leave=False) as bar:
        while not stamps or not heard.statuses.keys() >= set(stamps):
            rclpy.spin_once(listener, timeout_sec=0.1)
            if len(heard.statuses) > answered:
                answered, last_s, load = len(heard.statuses), time.monotonic(), meter.load()
                bar.update(answered - bar.n)
            elif stamps and time.monotonic() > last_s + _SILENCE_S:
                break
            # Not before the pose has come, which would wait for it.
            if min(len(heard.poses), answered) > len(paced):
                paced.append(yardstick.once())
            if not stamps and source.poll() is not None:
                stamps = [int(line) for line in source.stdout.read().split()]
                if source.returncode or not stamps:
                    raise RuntimeError(f"the slice source ended with exit code {source.returncode}")
    # The pose of the last slice may come after its status.
    listener.spin(lambda: stamps[-1] in heard.poses, 1.0)
    latencies = np.array([1e-9 * (heard.poses[stamp] - stamp) for stamp in stamps if stamp in heard.poses])
    if latencies.size < 8:
        raise RuntimeError(f"only {latencies.size} of {len(stamps)} slices gave a pose:\n{node.output}")
    return Stream(
        rate_hz=rate,
        sent=len(stamps),
        answered=sum(stamp in heard.statuses for stamp in stamps),
        accepted=latencies.size,
        p50_s=float(np.median(latencies)),
        p99_s=float(np.percentile(latencies, 99)),
        longest_s=float(latencies.max()),
        inside_p50_s=float(np.median([heard.inside_s[stamp] for stamp in stamps if stamp in heard.inside_s])),
        quarters_s=[float(np.median(part)) for part in np.array_split(latencies, 4)],
        load=load,
        paced_yardstick_s=float(np.median(paced)),
        transport_s=transport_s,
    )


def _grows(stream: Stream) -> bool:
    """Whether slices queue: the last quarter waits longer than the first by more than half of it and a period."""
    first, last = stream.quarters_s[0], stream.quarters_s[-1]
    return last > 1.5 * first + 1.0 / stream.rate_hz


def _print(stream: Stream, unit: float) -> None:
    quarters = " ".join(f"{1e3 * value:.1f}" for value in stream.quarters_s)
    print(f"{stream.rate_hz:g} Hz: {stream.sent} sent, {stream.answered} answered, {stream.accepted} accepted")
    for name, value in (("p50", stream.p50_s), ("p99", stream.p99_s), ("longest", stream.longest_s)):
        print(f"  image to pose, {name:8s} {1e3 * value:7.1f} ms = {value / unit:6.1f} Y")
    print(f"  median by quarters of the stream: {quarters} ms; within the node: {1e3 * stream.inside_p50_s:.1f} ms")
    pauses = f"Y between two slices {1e3 * stream.paced_yardstick_s:.1f} ms, so p50 is"
    print(f"  {pauses} {stream.p50_s / stream.paced_yardstick_s:.1f} of those")
    print(f"  of it, an image alone to a bare subscriber: {1e3 * stream.transport_s:.1f} ms")
    print(f"  CPU {stream.load.cpu_percent:.0f} %, memory {stream.load.memory_mib:.0f} MiB", flush=True)


def main() -> int:
    """Print the figures, write them as JSON; 1 where one misses its target."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.streaming", description=__doc__)
    parser.add_argument("--slices", type=int, default=1000, help="slices at each rate (default 1000)")
    parser.add_argument(
        "--idle", type=float, default=20.0, help="seconds for which the idle node is watched (default 20)"
    )
    parser.add_argument("--output", type=Path, default=Path("build/streaming.json"), help="JSON file to write")
    arguments = parser.parse_args()
    if arguments.slices < 8:
        parser.error(f"--slices is {arguments.slices}, expected 8 or more")
    # Other nodes on the network neither disturb nor are disturbed.
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    yardstick = Yardstick()
    unit = yardstick.unit()
    print(f"Y = {1e3 * unit:.2f} ms: threshold and connected components of a 512 x 512 slice")
    rclpy.init()
    transport_s = {rate: bare_transport_s(rate, min(_ALONE, arguments.slices)) for rate in (RATE_HZ, FAST_HZ)}
    listener = Listener("streaming_listener")
    with tempfile.TemporaryFile() as log:
        node = RegisterProcess(log)
        try:
            if not listener.spin(listener.hears_the_node, DEADLINE_S):
                raise RuntimeError(f"register_node was not discovered within {DEADLINE_S:g} s")
            meter = LoadMeter(node.process)
            listener.spin(lambda: False, arguments.idle)
            idle = meter.load()
            print(
                f"from start to ready {node.ready_s:.1f} s; idle: CPU {idle.cpu_percent:.1f} %, "
                f"memory {idle.memory_mib:.0f} MiB",
                flush=True,
            )
            streams = []
            for rate in (RATE_HZ, FAST_HZ):
                streams.append(_stream(listener, node, yardstick, rate, arguments.slices, transport_s[rate]))
                _print(streams[-1], unit)
        finally:
            node.end()
            listener.destroy_node()
            rclpy.shutdown()
    record = {
        "yardstick_s": unit,
        "ready_s": node.ready_s,
        "idle": asdict(idle),
        "streams": [asdict(stream) for stream in streams],
    }
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(record, indent=1) + "\n")
    print(f"as JSON: {arguments.output}")
    slow, fast = streams
    missed = []
    if slow.answered < slow.sent:
        missed.append(f"{slow.sent - slow.answered} slices lost at {slow.rate_hz:g} Hz")
    if slow.p50_s > P50_Y * unit:
        missed.append(f"p50 above {P50_Y:g} Y")
    if slow.p99_s > P99_Y * unit:
        missed.append(f"p99 above {P99_Y:g} Y")
    if _grows(fast):
        missed.append(f"the delay grows at {fast.rate_hz:g} Hz")
    print(f"FAILED: {'; '.join(missed)}" if missed else "all as it has to be")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
