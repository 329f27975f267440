"""Writes a DICOM series to an MCAP bag: the topics `image` and `slice_pose`, as a scanner would have published them."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Header

from stereoreg_ros.dicom import read_series
from stereoreg_ros.nodes.common.conversions import image_from_hu, pose_to_message


def main() -> None:
    """Write the bag, and print the pixel spacing that register_node needs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("series", type=Path, help="folder with the slices of one DICOM series")
    parser.add_argument("bag", type=Path, help="folder to write; must not exist")
    parser.add_argument("--rate", type=float, default=2.0, help="slices per second (default 2)")
    arguments = parser.parse_args()
    series = read_series(arguments.series)
    types = get_typestore(Stores.ROS2_JAZZY)
    begin_ns = time.time_ns()
    with Writer(arguments.bag, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        poses = bag.add_connection("/slice_pose", "geometry_msgs/msg/PoseStamped", typestore=types)
        images = bag.add_connection("/image", "sensor_msgs/msg/Image", typestore=types)
        for number, dicom_slice in enumerate(series):
            at_ns = begin_ns + int(1e9 * number / arguments.rate)
            header = Header(stamp=Time(sec=at_ns // 10**9, nanosec=at_ns % 10**9), frame_id="scanner")
            pose = PoseStamped(header=header, pose=pose_to_message(dicom_slice.ct_slice.scanner_from_slice))
            image = image_from_hu(dicom_slice.ct_slice.hu)
            image.header = header
            bag.write(poses, at_ns, serialize_message(pose))
            bag.write(images, at_ns, serialize_message(image))
    scale = series.headers[0].scale
    print(f"{len(series)} slices; register_node needs pixel_spacing:=[{scale.sx}, {scale.sy}]")


if __name__ == "__main__":
    main()
