"""A demonstration: simulated scanner and registration as two processes, watched slice by slice against the truth."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
import rclpy
from ament_index_python.packages import get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import Image

from stereoreg_ros.geometry.pose import Pose, rotation_angle
from stereoreg_ros.nodes.common.conversions import pose_from_message
from stereoreg_ros.nodes.common.diagnostic_status import NAME, name_of_status

# What the demonstration counts as a wrong pose.
WRONG_MM, WRONG_DEG = 1.5, 2.0
_START_S = 30.0
_SILENCE_S = 20.0
_QOS = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.RELIABLE)
_TRUTH_QOS = QoSProfile(
    depth=100, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)
_OUTPUTS = ("pose", "/diagnostics", "overlay")


@dataclass
class _SliceReport:
    """What was heard about one slice."""

    truth: Pose | None = None
    pose: Pose | None = None
    values: dict[str, str] = field(default_factory=dict)
    overlay: Image | None = None

    @property
    def complete(self) -> bool:
        accepted = self.values.get("outcome") == "accepted"
        return self.truth is not None and bool(self.values) and (self.pose is not None or not accepted)

    @property
    def error(self) -> tuple[float, float]:
        """Position error in mm and rotation error in degrees."""
        assert self.pose is not None
        assert self.truth is not None
        turn = np.degrees(rotation_angle(self.pose.rotation @ self.truth.rotation.T))
        return float(np.linalg.norm(self.pose.translation - self.truth.translation)), float(turn)


class _Listener(Node):
    """Collects truth, pose, diagnostics and overlay by the slices' stamps."""

    def __init__(self) -> None:
        super().__init__("demo_report")
        self.slices: dict[tuple[int, int], _SliceReport] = {}
        self._parameter_client = self.create_client(GetParameters, "register_node/get_parameters")
        self._answer: Future | None = None
        self.create_subscription(PoseStamped, "true_pose", self._on_truth, _TRUTH_QOS)
        self.create_subscription(PoseStamped, "pose", self._on_pose, _QOS)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, _QOS)
        self.create_subscription(Image, "overlay", self._on_overlay, _QOS)

    def hears_register_node(self) -> bool:
        """Whether the node's topics are connected: all are known, and it has answered a request."""
        if not all(self.count_publishers(topic) for topic in _OUTPUTS) or not self._parameter_client.service_is_ready():
            return False
        if self._answer is None:
            self._answer = self._parameter_client.call_async(GetParameters.Request(names=["frame_file"]))
        return bool(self._answer.done())

    def _slice(self, message: PoseStamped | DiagnosticArray | Image) -> _SliceReport:
        stamp = message.header.stamp
        return self.slices.setdefault((stamp.sec, stamp.nanosec), _SliceReport())

    def _on_truth(self, message: PoseStamped) -> None:
        self._slice(message).truth = pose_from_message(message)

    def _on_pose(self, message: PoseStamped) -> None:
        self._slice(message).pose = pose_from_message(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == name_of_status("register_node", NAME):
                self._slice(message).values = {entry.key: entry.value for entry in status.values}

    def _on_overlay(self, message: Image) -> None:
        self._slice(message).overlay = message


class _Process:
    """An executable of this package as a process of its own; ended on leaving."""

    def __init__(self, executable: str, parameters: dict[str, str]) -> None:
        program = Path(get_package_prefix("stereoreg_ros")) / "lib" / "stereoreg_ros" / executable
        arguments = [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]
        self._popen = subprocess.Popen([str(program), "--ros-args", "--log-level", "warn", *arguments])

    def __enter__(self) -> _Process:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._popen.poll() is None:
            self._popen.send_signal(signal.SIGINT)
        try:
            self._popen.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()

    @property
    def running(self) -> bool:
        return self._popen.poll() is None


def main() -> int:
    """Entry point of `demo_report`: 0 where every slice was answered and no accepted pose is wrong, else 1."""
    parser = argparse.ArgumentParser(prog="demo_report", description=__doc__)
    parser.add_argument("--slices", type=int, default=30, help="number of slices (default 30)")
    parser.add_argument("--output", type=Path, default=Path("demo.png"), help="picture to write (default demo.png)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the simulated scanner (default 1)")
    arguments = parser.parse_args()
    if arguments.slices < 1:
        parser.error(f"--slices is {arguments.slices}, expected 1 or more")
    # A demonstration neither hears nor disturbs other robots on this computer.
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    listener = _Listener()
    try:
        return _demonstrate(listener, arguments.slices, arguments.seed, arguments.output)
    except KeyboardInterrupt:
        return 1
    finally:
        listener.destroy_node()
        rclpy.try_shutdown()


def _demonstrate(listener: _Listener, count: int, seed: int, output: Path) -> int:
    # As on a robot: how the frame roughly stands is known, and leaves room for the simulated tilt.
    registration = {"frame_file": "cube6", "nominal_orientation": "[0.0, 0.0, 0.0, 1.0]", "max_rotation_deg": "30.0"}
    scanner = {
        "frame_file": "cube6",
        "slices": str(count),
        "seed": str(seed),
        "rate": "4.0",
        "step_mm": "1.5",
        "false_spots": "6",
        "missing_probability": "0.2",
        "wait_for_subscriber": "true",
    }
    print("A simulated CT scanner sends slices of the frame 'cube6'; register_node says where the frame is.\n")
    with _Process("register_node", registration) as register_node:
        if not _wait(listener, lambda: listener.hears_register_node() or not register_node.running, _START_S):
            print(f"register_node did not appear within {_START_S:g} s", file=sys.stderr)
            return 1
        with _Process("simulate_node", scanner):
            print("slice  outcome    rods  spots  residual/mm  error/mm  error/deg  time/ms")
            shown = _watch(listener, count)
    return _summary(shown, count, output)


def _wait(listener: _Listener, reached: Callable[[], bool], seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not reached():
        if time.monotonic() > deadline:
            return False
        rclpy.spin_once(listener, timeout_sec=0.1)
    return True


def _watch(listener: _Listener, count: int) -> list[_SliceReport]:
    """Print each slice as soon as all about it has arrived, until all are there or nothing comes any more."""
    shown: list[_SliceReport] = []
    while len(shown) < count:
        ready = _wait(listener, lambda: len(_complete(listener)) > len(shown), _SILENCE_S)
        if not ready:
            break
        report = _complete(listener)[len(shown)]
        shown.append(report)
        print(_line(len(shown), report), flush=True)
    # The last picture may still be on its way.
    _wait(listener, lambda: all(report.overlay is not None for report in shown), 2.0)
    return shown


def _complete(listener: _Listener) -> list[_SliceReport]:
    return [report for _, report in sorted(listener.slices.items()) if report.complete]


def _line(number: int, report: _SliceReport) -> str:
    values = report.values
    line = f"{number:5d}  {values['outcome']:9s} {values['inliers']:>5s}  {values['spots']:>5s}"
    line += f"  {float(values['residual_rms_mm']):11.3f}"
    if report.pose is None:
        return f"{line}         -          -  {float(values['duration_ms']):7.1f}  {values['reason']}"
    position, rotation = report.error
    wrong = "  WRONG" if _is_wrong(report) else ""
    return f"{line}  {position:8.3f}  {rotation:9.3f}  {float(values['duration_ms']):7.1f}{wrong}"


def _is_wrong(report: _SliceReport) -> bool:
    position, rotation = report.error
    return position > WRONG_MM or rotation > WRONG_DEG


def _summary(shown: list[_SliceReport], count: int, output: Path) -> int:
    accepted = [report for report in shown if report.pose is not None]
    wrong = sum(_is_wrong(report) for report in accepted)
    print(f"\n{len(shown)} of {count} slices answered: {len(accepted)} accepted, {len(shown) - len(accepted)} refused.")
    if accepted:
        errors = np.array([report.error for report in accepted])
        times = np.array([float(report.values["duration_ms"]) for report in accepted])
        print(
            f"Of the accepted ones {wrong} wrong (more than {WRONG_MM:g} mm or {WRONG_DEG:g} degrees off); error "
            f"median {np.median(errors[:, 0]):.3f} mm, {np.median(errors[:, 1]):.3f} deg, largest "
            f"{errors[:, 0].max():.3f} mm, {errors[:, 1].max():.3f} deg; time median {np.median(times):.1f} ms."
        )
    pictured = [report for report in accepted if report.overlay is not None]
    if pictured:
        # The fullest slice says most: all rods, and false spots beside them.
        best = max(pictured, key=lambda report: (int(report.values["inliers"]), int(report.values["spots"])))
        assert best.overlay is not None
        _save(best.overlay, output)
        print(f"Picture: {output}")
    if wrong:
        print(f"FAILED: {wrong} wrong poses were published", file=sys.stderr)
    if len(shown) < count:
        print(f"FAILED: {count - len(shown)} slices were not answered", file=sys.stderr)
    if not accepted:
        print("FAILED: no slice was registered", file=sys.stderr)
    return 1 if wrong or len(shown) < count or not accepted else 0


def _save(overlay: Image, output: Path) -> None:
    pixels = np.frombuffer(overlay.data, dtype=np.uint8).reshape(overlay.height, overlay.step)[:, : 3 * overlay.width]
    output.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(output), pixels.reshape(overlay.height, overlay.width, 3)):
        raise OSError(f"{output}: the picture could not be written")


if __name__ == "__main__":
    sys.exit(main())
