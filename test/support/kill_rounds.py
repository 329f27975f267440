"""Processes that are killed at random while slices flow, and a controller that judges all that is published.

At full length: `python -m benchmarks.kill_rounds`.
"""

from __future__ import annotations

import json
import random
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from stereoreg_ros.calibration.file import CalibrationRecord, load_calibration, save_calibration
from stereoreg_ros.nodes.common.conversions import pose_from_message
from support.known_slices import CALIBRATED, EXACT, FRAME, KnownSlice, draw, number_of
from support.ros_process import NodeProcess, RosClient
from support.slice_sender import Sent, SliceSender

Victim: TypeAlias = Literal["register_node", "receive_dicom_node", "play_dicom_node"]

# Ten times the RMS error of these slices, and half of what the scale of the other scanner does.
WRONG_MM: Final = 0.5
WRONG_DEG: Final = 1.0
_SAME_SCALE: Final = 5e-3
_FLOW_S: Final = 60.0
_LATE_S: Final = 20.0
_NS: Final = 10**9
_LATCHED: Final = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@dataclass
class Tally:
    """What was seen in all rounds; faults: every promise that was broken, in a sentence."""

    rounds: dict[str, int] = field(default_factory=dict)
    sent: int = 0
    acknowledged: int = 0
    poses: int = 0
    refused: int = 0
    sent_again: int = 0
    largest_mm: float = 0.0
    largest_deg: float = 0.0
    longest_gap_s: float = 0.0
    faults: list[str] = field(default_factory=list)


class KillRounds:
    """The processes, kept from round to round, a scanner, and the controller; one after the other with `run`."""

    def __init__(self, client: RosClient, folder: Path, seed: int) -> None:
        self.tally = Tally()
        self._client = client
        self._folder = folder
        self._random = random.Random(seed)
        rng = np.random.default_rng(seed)
        self._kept, self._played = folder / "kept", folder / "played"
        for path in (self._kept, self._played):
            path.mkdir()
        self._slices = draw(self._played, CALIBRATED, range(1, 13), rng)
        self._slices |= draw(folder, EXACT, range(13, 21), rng)
        self._calibration = folder / "scale.yaml"
        self._save_calibration()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = int(free.getsockname()[1])
        self._processes: dict[Victim, NodeProcess] = {}
        self._sender: SliceSender | None = None
        self._sent: list[Sent] = []
        self._played_ns: list[tuple[int, int]] = []
        self._both_scanners = False
        self._listens = False
        self._poses: list[PoseStamped] = []
        self._statuses: list[DiagnosticArray] = []
        self._judged_poses = self._judged_statuses = self._judged_sent = 0
        self._stamps: set[int] = set()

    def _save_calibration(self) -> None:
        variance = (1e-4 * CALIBRATED.true.sx) ** 2
        save_calibration(
            self._calibration,
            CalibrationRecord(
                CALIBRATED.true,
                CALIBRATED.told,
                ((variance, 0.0), (0.0, variance)),
                FRAME.name,
                10,
                60,
                "2026-01-01T00:00:00+00:00",
                "test",
            ),
        )

    # The processes.

    @contextmanager
    def receiving(self) -> Iterator[None]:
        """While a scanner sends and the receiver receives."""
        self._start("register_node")
        self._start("receive_dicom_node")
        self._listen()
        self._sender = SliceSender(self._port, self._choose)
        try:
            self._wait_for_flow(time.time_ns())
            yield
        finally:
            self._sender.stop()
            self._sent += self._sender.sent
            self._sender = None
            self._end_all()

    @contextmanager
    def playing(self) -> Iterator[None]:
        """While the player plays."""
        self._start("register_node")
        self._played_ns.append((time.time_ns(), 2**63))
        self._start("play_dicom_node")
        self._listen()
        try:
            self._wait_for_flow(time.time_ns())
            yield
        finally:
            self._end_all()
            self._played_ns[-1] = (self._played_ns[-1][0], time.time_ns())

    def _start(self, victim: Victim) -> None:
        told: dict[Victim, dict[str, Any]] = {
            "register_node": {
                "frame_file": FRAME.name,
                "pixel_spacing": [CALIBRATED.told.sx, CALIBRATED.told.sy],
                "calibration_file": str(self._calibration),
            },
            "receive_dicom_node": {"port": self._port, "keep_folder": str(self._kept)},
            "play_dicom_node": {"path": str(self._played), "rate": 5.0, "loop": True},
        }
        flags = [part for name, value in told[victim].items() for part in ("-p", f"{name}:={json.dumps(value)}")]
        self._processes[victim] = NodeProcess(victim, "--ros-args", *flags)

    def _end_all(self) -> None:
        for process in self._processes.values():
            code, _ = process.stop(deadline_s=20.0)
            if code != 0:
                self.tally.faults.append(f"{process.name} ended with exit code {code}:\n{process.output}")
            process.close()
        self._processes.clear()

    def _listen(self) -> None:
        if not self._listens:
            self._listens = True
            self._poses = self._client.collect(PoseStamped, "pose")
            self._statuses = self._client.collect(DiagnosticArray, "/diagnostics")

    def _choose(self) -> KnownSlice:
        numbers = [number for number, one in self._slices.items() if self._both_scanners or one.scanner is CALIBRATED]
        return self._slices[self._random.choice(numbers)]

    # A round.

    def run(self, victim: Victim, *, both_scanners: bool = False, recalibrate: bool = False) -> None:
        """Kill one process at a random moment, start it again, wait for poses of slices of later, and judge.

        both_scanners: slices of both are sent, in any order. recalibrate: the scale is being measured meanwhile.
        """
        self.tally.rounds[victim] = self.tally.rounds.get(victim, 0) + 1
        self._both_scanners = both_scanners
        self._spin(self._random.uniform(0.0, 1.0))
        if recalibrate:
            service = self._client.node.create_client(Trigger, "register_node/recalibrate")
            self._client.wait_for(service.service_is_ready, "the service")
            service.call_async(Trigger.Request())
            self._spin(self._random.uniform(0.0, 0.3))
            self._client.node.destroy_client(service)
        process = self._processes[victim]
        process.kill()
        killed_ns = time.time_ns()
        process.close()
        if victim == "play_dicom_node":
            self._played_ns[-1] = (self._played_ns[-1][0], killed_ns)
        self._spin(self._random.uniform(0.0, 0.5))
        if victim == "play_dicom_node":
            self._played_ns.append((time.time_ns(), 2**63))
        self._start(victim)
        self._wait_for_flow(time.time_ns())
        self.tally.longest_gap_s = max(self.tally.longest_gap_s, (time.time_ns() - killed_ns) / _NS)
        self._judge_late_joiner()
        self.judge()

    def _spin(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        self._client.wait_for(lambda: time.monotonic() >= end_s, "the time")

    def _wait_for_flow(self, since_ns: int) -> None:
        def flows() -> bool:
            return bool(self._poses) and _stamp_ns(self._poses[-1]) > since_ns

        try:
            self._client.wait_for(flows, "a pose", _FLOW_S)
        except AssertionError:
            outputs = "\n".join(f"--- {one.name}\n{one.output[-2000:]}" for one in self._processes.values())
            self.tally.faults.append(f"no pose came within {_FLOW_S:g} s\n{outputs}")

    # The controller.

    def judge(self) -> None:
        """Judge what has come since the last time."""
        sent = [*self._sent, *(self._sender.sent if self._sender else ())]
        for one in sent[self._judged_sent :]:
            self.tally.sent += 1
            self.tally.acknowledged += one.acknowledged
            if one.acknowledged and not one.is_kept_in(self._kept):
                self.tally.faults.append(f"{one.uid} was acknowledged and is not kept, whole and readable")
        self._judged_sent = len(sent)
        for message in self._poses[self._judged_poses :]:
            self._judge_pose(message)
        self._judged_poses = len(self._poses)
        for message in self._statuses[self._judged_statuses :]:
            self._judge_status(message)
        self._judged_statuses = len(self._statuses)
        try:
            record = load_calibration(self._calibration)
        except ValueError as error:
            self.tally.faults.append(f"the calibration file is broken: {error}")
            return
        if record is None:
            self.tally.faults.append("the calibration file is gone")
        elif not _near((record.scale.sx, record.scale.sy), (CALIBRATED.true.sx, CALIBRATED.true.sy)):
            self.tally.faults.append(f"the calibration file says {record.scale}, expected {CALIBRATED.true}")

    def _judge_pose(self, message: PoseStamped) -> None:
        self.tally.poses += 1
        pose, stamp = pose_from_message(message), _stamp_ns(message)
        self.tally.sent_again += stamp in self._stamps
        self._stamps.add(stamp)
        known = self._slices.get(number_of(pose))
        if known is None:
            self.tally.faults.append(f"a pose of no slice at {pose.translation}")
            return
        off_mm, off_deg = known.off(pose)
        self.tally.largest_mm = max(self.tally.largest_mm, off_mm)
        self.tally.largest_deg = max(self.tally.largest_deg, off_deg)
        if off_mm > WRONG_MM or off_deg > WRONG_DEG:
            self.tally.faults.append(
                f"a wrong pose of {known.scanner.name} slice {known.number}: {off_mm:.2f} mm, {off_deg:.2f} degrees off"
            )
        of_stamp = self._of_stamp(stamp)
        if of_stamp is not None and of_stamp is not known:
            self.tally.faults.append(f"a pose of slice {known.number} has the stamp of slice {of_stamp.number}")
        if of_stamp is None and not self._was_played(stamp):
            self.tally.faults.append(f"a pose of slice {known.number} has a stamp at which no slice came")

    def _judge_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {one.key: one.value for one in status.values}
            if status.name != "register_node: registration":
                continue
            if values["outcome"] != "accepted":
                self.tally.refused += 1
                continue
            stamp = _stamp_ns(message)
            known = self._of_stamp(stamp)
            # Only the calibrated scanner's slices are played.
            scanner = known.scanner if known is not None else CALIBRATED
            used = (float(values["pixel_spacing_x_mm"]), float(values["pixel_spacing_y_mm"]))
            expected = "measured" if scanner is CALIBRATED else "configured"
            if not _near(used, (scanner.true.sx, scanner.true.sy)) or values["calibration"] != expected:
                self.tally.faults.append(
                    f"a slice of the {scanner.name} scanner was registered with the {values['calibration']} pixel "
                    f"spacing {used}, expected the {expected} {scanner.true}"
                )

    def _of_stamp(self, stamp_ns: int) -> KnownSlice | None:
        """The slice that was being sent at a time."""
        sent = [*self._sent, *(self._sender.sent if self._sender else ())]
        found = [one.slice for one in sent if one.begun_ns <= stamp_ns <= one.ended_ns]
        return found[0] if found else None

    def _was_played(self, stamp_ns: int) -> bool:
        return any(begun <= stamp_ns <= ended for begun, ended in self._played_ns)

    def _judge_late_joiner(self) -> None:
        """Who comes late gets the latest pose, with its own stamp, and none that was published before it."""
        heard = len(self._poses)
        late: list[PoseStamped] = []
        subscription = self._client.node.create_subscription(PoseStamped, "pose", late.append, _LATCHED)
        try:
            self._client.wait_for(lambda: late, "the latest pose", _LATE_S)
            first = late[0]
            self._client.wait_for(lambda: first in self._poses, "the same pose", _LATE_S)
            if self._poses.index(first) < heard - 1:
                self.tally.faults.append("who came late got an older pose than the latest")
        except AssertionError as error:
            self.tally.faults.append(f"who came late: {error}")
        finally:
            self._client.node.destroy_subscription(subscription)


def _near(used: tuple[float, float], expected: tuple[float, float]) -> bool:
    return bool(np.allclose(used, expected, rtol=_SAME_SCALE, atol=0.0))


def _stamp_ns(message: PoseStamped | DiagnosticArray) -> int:
    return int(message.header.stamp.sec) * _NS + int(message.header.stamp.nanosec)
