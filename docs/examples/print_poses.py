"""Prints what register_node answers to each slice: the pose, or why the slice was refused."""

from __future__ import annotations

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node


class PrintPoses(Node):
    """Subscribes to poses and diagnostics."""

    def __init__(self) -> None:
        super().__init__("print_poses")
        self.create_subscription(PoseStamped, "pose", self._on_pose, 10)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def _on_pose(self, message: PoseStamped) -> None:
        at = message.pose.position
        print(f"frame at x {1e3 * at.x:.1f}, y {1e3 * at.y:.1f}, z {1e3 * at.z:.1f} mm in {message.header.frame_id}")

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            print(f"{status.name}: {status.message}")


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    try:
        rclpy.spin(PrintPoses())
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
