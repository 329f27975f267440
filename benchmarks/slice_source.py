"""`python -m benchmarks.slice_source`: the scanner of `benchmarks.streaming`, a process of its own.

Slices of a frame that moves through the plane, drawn beforehand, so that drawing takes no time from what is measured.
"""

from __future__ import annotations

import argparse
import sys
import time
from itertools import chain, cycle, islice
from typing import Final

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image

from stereoreg_ros import load_frame
from stereoreg_ros.nodes.conversions import image_from_hu
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, passage, random_pose, render_slice

# Discovery is not what is measured: the first slices are for finding each other.
WARM_UP: Final = 20
FRAME: Final = "cube6"
SCANNER: Final = ScannerSettings(false_spots=24)
_DRAWN: Final = 40
_STEP_MM: Final = 0.5
# Slices from the passage's turn on, where rods end within the slice: their spots are no proper ones.
_LEFT_OUT: Final = 10
_DEADLINE_S: Final = 30.0


def main() -> int:
    """Publish, then print the stamps of the slices to be counted, in nanoseconds, one a line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.slice_source", description=__doc__)
    parser.add_argument("--rate", type=float, required=True, help="slices per second")
    parser.add_argument(
        "--slices", type=int, required=True, help="slices to be counted; as many more to warm up come first"
    )
    arguments = parser.parse_args()
    images = _draw()
    rclpy.init()
    node = Node("slice_source")
    publisher = node.create_publisher(Image, "image", QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE))
    deadline = time.monotonic() + _DEADLINE_S
    while publisher.get_subscription_count() == 0:
        if time.monotonic() > deadline:
            print(f"nobody subscribed to image within {_DEADLINE_S:g} s", file=sys.stderr)
            return 1
        rclpy.spin_once(node, timeout_sec=0.05)
    stamps = []
    due = time.monotonic()
    # To and fro, so that the frame never jumps.
    order = cycle(chain(images, reversed(images[1:-1])))
    for image, _ in zip(order, range(WARM_UP + arguments.slices), strict=False):
        due += 1.0 / arguments.rate
        time.sleep(max(0.0, due - time.monotonic()))
        now = time.time_ns()
        image.header.stamp = Time(sec=now // 10**9, nanosec=now % 10**9)
        publisher.publish(image)
        stamps.append(now)
    publisher.wait_for_all_acked(Duration(seconds=10))
    print(*stamps[WARM_UP:], sep="\n")
    node.destroy_node()
    rclpy.shutdown()
    return 0


def _draw() -> list[Image]:
    frame, rng = load_frame(FRAME), np.random.default_rng(1)
    middle = random_pose(rng, frame, SCANNER, max_tilt_deg=10.0, max_depth_mm=0.0)
    poses = passage(frame, middle, _STEP_MM, min_rods=len(frame))
    images = []
    for pose in islice(poses, _LEFT_OUT, _LEFT_OUT + _DRAWN):
        ct_slice = render_slice([PlacedFrame(frame, pose)], SCANNER, rng)
        image = image_from_hu(ct_slice.hu.astype(np.int16))
        image.header.frame_id = "scanner"
        images.append(image)
    return images


if __name__ == "__main__":
    sys.exit(main())
