"""The DICOM receiver and the DICOM player as processes of their own, and what they publish."""

from __future__ import annotations

import json
import re
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image

from support.ros_process import NodeProcess, RosClient, node_process

LISTENS = re.compile(r"listens at \S+ port (\d+)")
SUCCESS, OUT_OF_RESOURCES, CANNOT_UNDERSTAND = 0x0000, 0xA700, 0xC000


class Received:
    """A running receiver, and what it has published."""

    def __init__(self, process: NodeProcess, client: RosClient) -> None:
        self.process, self._client = process, client
        self.poses = client.collect(PoseStamped, "slice_pose")
        self.images = client.collect(Image, "image")
        self.port = port_of(process, client)

    def wait(self, count: int) -> list[Image]:
        self._client.wait_for(lambda: min(len(self.images), len(self.poses)) >= count, f"{count} slices")
        return self.images

    def wait_for_log(self, sentence: str) -> None:
        self._client.wait_for(lambda: sentence in self.process.output, f"'{sentence}' in the log")


@contextmanager
def receiver(client: RosClient, **parameters: Any):
    """The receiver at a free port, not waiting for a register_node, unless `parameters` say otherwise."""
    with receiving_process(**parameters) as process:
        yield Received(process, client)


def receiving_process(namespace: str = "/", **parameters: Any):
    values = {"port": 0, "register_node": "", **parameters}
    arguments = [f"{name}:={json.dumps(value)}" for name, value in values.items()]
    flags = [part for one in arguments for part in ("-p", one)]
    return node_process("receive_dicom_node", "--ros-args", "-r", f"__ns:={namespace}", *flags)


def port_of(process: NodeProcess, client: RosClient) -> int:
    """Where the receiver listens, once it does."""
    client.wait_for(lambda: LISTENS.search(process.output), "the receiver's port")
    return int(LISTENS.findall(process.output)[0])


def seconds(header) -> float:
    return float(header.stamp.sec + 1e-9 * header.stamp.nanosec)


def hung_up(connection) -> bool:
    """Waits for the end of a connection, up to its timeout."""
    try:
        while connection.recv(4096):
            pass
    except ConnectionError:
        pass
    return True


def play(path: Path, *remaps: str, **parameters: Any):
    """The player for `path` with 50 slices per second and no register_node, unless `parameters` say otherwise."""
    values = {"path": str(path), "rate": 50.0, "register_node": "", **parameters}
    # JSON is YAML, which is what values on the command line are.
    arguments = [f"{name}:={json.dumps(value)}" for name, value in values.items()]
    flags = [part for argument in arguments for part in ("-p", argument)]
    return node_process("play_dicom_node", "--ros-args", *flags, *remaps)


def pixels(image: Image) -> np.ndarray:
    dtype = np.dtype({"16SC1": "i2", "32FC1": "f4"}[image.encoding])
    assert image.is_bigendian == (sys.byteorder == "big")
    assert image.step == image.width * dtype.itemsize
    return np.frombuffer(image.data, dtype).reshape(image.height, image.width)
