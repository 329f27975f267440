"""How long an image of the stream takes to reach a subscriber that does nothing else: the share of machine and DDS."""

from __future__ import annotations

import subprocess
import sys
import time
from statistics import median

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image

from benchmarks.answers import nanoseconds
from benchmarks.slice_source import WARM_UP


def bare_transport_s(rate: float, slices: int) -> float:
    """Median time from an image's stamp to its arrival, s, of `slices` slices at a rate in Hz; rclpy is initialised."""
    node = Node("bare_subscriber")
    latencies: list[float] = []
    node.create_subscription(
        Image,
        "image",
        lambda image: latencies.append(1e-9 * (time.time_ns() - nanoseconds(image))),
        QoSProfile(depth=10),
    )
    command = [sys.executable, "-m", "benchmarks.slice_source", "--rate", str(rate), "--slices", str(slices)]
    try:
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as source:
            while source.poll() is None:
                rclpy.spin_once(node, timeout_sec=0.1)
    finally:
        node.destroy_node()
    if source.returncode or len(latencies) <= WARM_UP:
        raise RuntimeError(f"{len(latencies)} slices came, the source ended with exit code {source.returncode}")
    return median(latencies[WARM_UP:])
