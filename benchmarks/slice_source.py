"""`python -m benchmarks.slice_source`: the scanner of `streaming` and `soak`, a process of its own.

Slices of a frame that moves through the plane, drawn beforehand, so that drawing takes no time from what is measured.
With several passages the frame stands anew in each, and between two comes a slice without it.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Final

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image

from stereoreg_ros import load_frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.nodes.common.conversions import image_from_hu, pose_to_message
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, passage, random_pose, render_slice

# Discovery is not part of the measurement: the first slices give it time.
WARM_UP: Final = 20
FRAME: Final = "cube6"
SCANNER: Final = ScannerSettings(false_spots=24)
# Kept for late subscribers: to judge a slice they need its truth.
TRUTH_QOS: Final = QoSProfile(
    depth=1000, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)
# Of each passage.
_DRAWN: Final = 40
_STEP_MM: Final = 0.5
# Slices from the passage's turn on, where rods end within the slice: their spots are no proper ones.
_LEFT_OUT: Final = 10
_DEADLINE_S: Final = 30.0


@dataclass(frozen=True)
class Drawn:
    """An image, and where the frame stands in it; None where no frame is shown."""

    image: Image
    scanner_from_frame: Pose | None


def main() -> int:
    """Publish, then print the stamps of the slices to be counted, in nanoseconds, one a line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.slice_source", description=__doc__)
    parser.add_argument("--rate", type=float, required=True, help="slices per second")
    parser.add_argument(
        "--slices", type=int, required=True, help="slices to be counted; as many more to warm up come first"
    )
    parser.add_argument("--passages", type=int, default=1, help="different passages of the frame (default 1)")
    arguments = parser.parse_args()
    tour = _draw(arguments.passages)
    rclpy.init()
    node = Node("slice_source")
    publisher = node.create_publisher(Image, "image", QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE))
    truth_publisher = node.create_publisher(PoseStamped, "true_pose", TRUTH_QOS)
    deadline = time.monotonic() + _DEADLINE_S
    while publisher.get_subscription_count() == 0:
        if time.monotonic() > deadline:
            print(f"no subscriber of image within {_DEADLINE_S:g} s", file=sys.stderr)
            return 1
        rclpy.spin_once(node, timeout_sec=0.05)
    stamps = []
    due = time.monotonic()
    for drawn, _ in zip(cycle(tour), range(WARM_UP + arguments.slices), strict=False):
        image = drawn.image
        due += 1.0 / arguments.rate
        time.sleep(max(0.0, due - time.monotonic()))
        now = time.time_ns()
        image.header.stamp = Time(sec=now // 10**9, nanosec=now % 10**9)
        publisher.publish(image)
        if drawn.scanner_from_frame is not None:
            pose = pose_to_message(drawn.scanner_from_frame)
            truth_publisher.publish(PoseStamped(header=image.header, pose=pose))
        stamps.append(now)
    publisher.wait_for_all_acked(Duration(seconds=10))
    print(*stamps[WARM_UP:], sep="\n")
    node.destroy_node()
    rclpy.shutdown()
    return 0


def _draw(passages: int) -> list[Drawn]:
    """A round that ends where it may begin again; in a passage to and fro, so that the frame does not jump."""
    frame, rng = load_frame(FRAME), np.random.default_rng(1)
    tour: list[Drawn] = []
    for _ in range(passages):
        middle = random_pose(rng, frame, SCANNER, max_tilt_deg=10.0, max_depth_mm=0.0)
        poses = passage(frame, middle, _STEP_MM, min_rods=len(frame))
        way = [
            Drawn(_image_of([PlacedFrame(frame, pose)], rng), pose)
            for pose in islice(poses, _LEFT_OUT, _LEFT_OUT + _DRAWN)
        ]
        tour += [*way, *way[-2:0:-1]]
        if passages > 1:
            tour.append(Drawn(_image_of([], rng), None))
    return tour


def _image_of(placed: list[PlacedFrame], rng: np.random.Generator) -> Image:
    image = image_from_hu(render_slice(placed, SCANNER, rng).hu.astype(np.int16))
    image.header.frame_id = "scanner"
    return image


if __name__ == "__main__":
    sys.exit(main())
