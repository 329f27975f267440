"""The end of a node's process, whatever its threads are at."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from support.ros_process import REPOSITORY, ROS_ENVIRONMENT

# Its thread is within OpenCV's C++ nearly all the time.
PROGRAM = """
import sys, threading
import cv2, numpy as np
from rclpy.node import Node
from stereoreg_ros.nodes.common.process import run

class Busy(Node):
    finished = is_computing = True

    def __init__(self):
        super().__init__("busy")
        threading.Thread(target=self.compute, daemon=True).start()

    def compute(self):
        picture = np.zeros((512, 512), np.float32)
        while True:
            cv2.GaussianBlur(picture, (0, 0), 5.0)

sys.exit(run(Busy))
"""


def test_a_thread_that_computes_does_not_make_the_process_abort() -> None:
    environment = {**os.environ, **ROS_ENVIRONMENT}
    for _ in range(3):
        ended = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", PROGRAM],
            cwd=REPOSITORY,
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert ended.returncode == 0, ended.stderr
