"""Plays a bag of slices to its subscribers, for systems without `ros2 bag play`."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import Image

TYPES = {"/image": Image, "/slice_pose": PoseStamped}
DEADLINE_S = 30.0


def main() -> int:
    """Play to the end; exit status 1 if a topic of the bag has no subscriber."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bag", type=Path, help="folder of the bag")
    arguments = parser.parse_args()
    rclpy.init()
    node = Node("play_bag")
    with Reader(arguments.bag) as bag:
        publishers = {
            topic: node.create_publisher(kind, topic, QoSProfile(depth=10))
            for topic, kind in TYPES.items()
            if topic in bag.topics
        }
        for topic, publisher in publishers.items():
            deadline = time.monotonic() + DEADLINE_S
            while publisher.get_subscription_count() == 0:
                if time.monotonic() > deadline:
                    print(f"{topic} has no subscriber", file=sys.stderr)
                    return 1
                rclpy.spin_once(node, timeout_sec=0.1)
        first_ns, begun = bag.start_time, time.monotonic()
        for connection, at_ns, message in bag.messages([one for one in bag.connections if one.topic in TYPES]):
            time.sleep(max(0.0, begun + 1e-9 * (at_ns - first_ns) - time.monotonic()))
            publishers[connection.topic].publish(message)
            if at_ns == first_ns:
                # Before the first image arrives, the subscriber must know that slices have poses and must have the
                # first one. That may take seconds; the messages that follow keep their intervals.
                waits_since = time.monotonic()
                publishers[connection.topic].wait_for_all_acked(Duration(seconds=DEADLINE_S))
                begun += time.monotonic() - waits_since
        for publisher in publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=DEADLINE_S))
    node.destroy_node()
    rclpy.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
