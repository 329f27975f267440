"""Receiver, register_node and controller on hosts of their own, and what becomes of them when a cable is pulled."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest

from support.dicom_clients import association
from support.dicom_files import write_slice
from support.network_hosts import INTERFACE, Hosts, hosts

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.nodes.common.conversions import pose_from_message
from support import ros_process
from support.contract import STATUS_NAME
from support.process_memory import memory_kib
from support.register_bench import SCALE, assert_near, rendered
from support.ros_process import REPOSITORY, NodeProcess, RosClient, node_process
from support.scanner_nodes import SUCCESS, port_of, seconds

RECEPTION, REGISTERING, CONTROL = HOSTS = ("reception", "registering", "control")
SLICES = [rendered(seed, noise_hu=5.0) for seed in range(40, 48)]
QUEUE = 8
QUEUE_FULL = 0xA700
CUT_S, PERIOD_S = 10.0, 0.25
# DDS repeats what was not acknowledged every three seconds; discovery, where it was lost, takes as long.
# And a slice whose answer was lost is sent once more after fifteen.
AGAIN_S = 45.0
MULTICAST = "239.255.0.1"
PROFILE = REPOSITORY / "config" / "fastdds_hosts.xml"
assert f"<interface>{INTERFACE}</interface>" in PROFILE.read_text()


@dataclass(frozen=True)
class Sent:
    """A slice that the scanner sent, and what it was told."""

    from_s: float
    to_s: float
    scanner_from_frame: Pose
    status: int


class Scanner:
    """Sends slices over an association that is open; knows where the frame is in each."""

    def __init__(self, opened: Any, paths: list[Path], truths: list[Pose]) -> None:
        self._association = opened
        self._slices = [(pydicom.dcmread(path), truth) for path, truth in zip(paths, truths, strict=True)]
        self.sent: list[Sent] = []

    def send(self) -> Sent:
        dataset, truth = self._slices[len(self.sent) % len(self._slices)]
        begun = time.time()
        status = self._association.send_c_store(dataset).Status
        self.sent.append(Sent(begun, time.time(), truth, status))
        return self.sent[-1]


class Site:
    """The three hosts at work, as the controller sees them."""

    def __init__(self, network: Hosts, receiver: NodeProcess, register: NodeProcess, controller: RosClient) -> None:
        self.network, self.receiver, self.register, self.controller = network, receiver, register, controller
        self.poses: list[PoseStamped] = []
        # Transient-local: however long the cable was out, the newest pose comes by itself.
        newest = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        controller.node.create_subscription(PoseStamped, "pose", self.poses.append, newest)
        self.diagnostics = controller.collect(DiagnosticArray, "/diagnostics")

    def pose_of(self, sent: Sent) -> PoseStamped | None:
        """The receiver stamps a slice when it comes."""
        return next((pose for pose in self.poses if sent.from_s <= seconds(pose.header) <= sent.to_s), None)

    def wait_for_poses(self, slices: list[Sent]) -> None:
        """Until there is the true pose of each."""
        self.controller.wait_for(lambda: all(map(self.pose_of, slices)), f"{len(slices)} poses", AGAIN_S)
        for sent in slices:
            assert_near(pose_from_message(self.pose_of(sent)), sent.scanner_from_frame)

    def wait_for_statuses(self, slices: list[Sent]) -> None:
        """Until each is told as registered."""

        def all_registered() -> bool:
            stamps = [stamp for stamp, status in self.statuses() if status.message.startswith("registered ")]
            return all(any(sent.from_s <= stamp <= sent.to_s for stamp in stamps) for sent in slices)

        self.controller.wait_for(all_registered, f"the statuses of {len(slices)} registered slices", AGAIN_S)

    def statuses(self) -> list[tuple[float, DiagnosticStatus]]:
        """Of slices, that the controller has heard, each with its stamp."""
        return [(seconds(one.header), one.status[0]) for one in self.diagnostics if one.status[0].name == STATUS_NAME]

    def wait_until_prepared(self) -> None:
        """Until register_node has filled its tables: while it does, its memory grows for no other reason."""
        samples = [memory_kib(self.register.pid)[0]]
        sampled_s = time.monotonic()

        def at_rest() -> bool:
            nonlocal sampled_s
            if time.monotonic() >= sampled_s + 2.0:
                samples.append(memory_kib(self.register.pid)[0])
                sampled_s = time.monotonic()
            # Six seconds in which a busy machine would have let it fill some.
            return len(samples) >= 4 and max(samples[-4:]) - min(samples[-4:]) < 128

        self.controller.wait_for(at_rest, "the tables of register_node", 250.0)

    @property
    def pose_age_s(self) -> float:
        """What a controller has to look at before it moves."""
        return time.time() - max(seconds(pose.header) for pose in self.poses)

    def listen(self, for_s: float) -> None:
        with suppress(AssertionError):
            self.controller.wait_for(lambda: False, "", for_s)


def by_multicast(network: Hosts, host: str) -> dict[str, str]:
    """How the processes of a host are told to find the others."""
    return {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}


def by_name(network: Hosts, host: str) -> dict[str, str]:
    others = [address for name, address in network.addresses.items() if name != host]
    return {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": ";".join(others)}


@contextmanager
def running(folder: Path, discovery: Callable[[Hosts, str], dict[str, str]]) -> Iterator[tuple[Site, Scanner]]:
    """Receiver, register_node and controller on the hosts, and a scanner beside the receiver."""
    files, truths = [], []
    for number, (hu, slice_from_frame) in enumerate(SLICES):
        spacing = [SCALE.sy, SCALE.sx]
        stored = np.clip(hu + 1024, 0, 4095).astype(np.uint16)
        files.append(write_slice(folder / f"{number}.dcm", stored, 5.0 * number, PixelSpacing=spacing))
        scanner_from_slice = Pose(np.eye(3), np.array([-10.0, -20.0, 5.0 * number]))
        truths.append(scanner_from_slice @ slice_from_frame)
    profile = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(PROFILE)}
    with hosts(*HOSTS) as network, pytest.MonkeyPatch.context() as patch:
        # A second network, of the hospital, that ROS has nothing to do with.
        network.add_network("hospital0", RECEPTION, REGISTERING)
        for name, value in discovery(network, CONTROL).items():
            patch.setitem(ros_process.ROS_ENVIRONMENT, name, value)
            patch.setenv(name, value)
        with (
            node_process(
                "register_node",
                env=discovery(network, REGISTERING) | profile,
                within=network.command(REGISTERING),
            ) as register,
            node_process(
                "receive_dicom_node",
                "--ros-args",
                # However long a console is served meanwhile, the scanner's association stays.
                *["-p", "port:=0", "-p", f"max_queue:={QUEUE}", "-p", "network_timeout:=600.0"],
                env=discovery(network, RECEPTION) | profile,
                within=network.command(RECEPTION),
            ) as receiver,
            network.on(CONTROL),
            RosClient("controller") as controller,
        ):
            site = Site(network, receiver, register, controller)
            port = port_of(receiver, controller)
            with (
                network.on(RECEPTION),
                association(port, [(CTImageStorage, ExplicitVRLittleEndian)]) as opened,
                network.on(CONTROL),
            ):
                assert opened.is_established
                yield site, Scanner(opened, files, truths)


@pytest.fixture(scope="module")
def system(tmp_path_factory) -> Iterator[tuple[Site, Scanner]]:
    with running(tmp_path_factory.mktemp("slices"), by_multicast) as both:
        yield both


def send(site: Site, scanner: Scanner, count: int) -> list[Sent]:
    """At the scanner's pace."""
    slices = []
    for _ in range(count):
        slices.append(scanner.send())
        site.listen(PERIOD_S)
    return slices


def test_poses_come_over_the_network_and_a_console_is_served(system):
    site, scanner = system
    slices = send(site, scanner, len(SLICES))
    assert [sent.status for sent in slices] == [SUCCESS] * len(slices)
    site.wait_for_poses(slices)
    for host in (RECEPTION, REGISTERING):
        assert MULTICAST in site.network.multicast_groups(host, INTERFACE)
        assert MULTICAST not in site.network.multicast_groups(host, "hospital0")
    with RosClient("console") as console:
        assert console.set_parameters("register_node", max_pose_age=7.5).successful
        assert console.get_parameters("register_node", "max_pose_age") == [7.5]
        response = console.call(Trigger, "register_node/recalibrate", deadline_s=90.0, again_after_s=None)
        assert response.success, response.message
        measured = console.get_parameters("register_node", "pixel_spacing")[0]
        np.testing.assert_allclose(measured, [SCALE.sx, SCALE.sy], rtol=3e-3)
        assert console.call(Trigger, "register_node/reset_calibration").success
        assert console.get_parameters("register_node", "pixel_spacing") == [[SCALE.sx, SCALE.sy]]


def test_the_host_of_register_node_is_cut_off(system):
    """What the scanner was told is stored waits for it, what would not fit is refused, and the pose grows old."""
    site, scanner = system
    site.wait_until_prepared()
    site.wait_for_poses(send(site, scanner, 4))
    site.network.pull_cable(REGISTERING)
    cut_s, poses = time.time(), len(site.poses)
    meanwhile = send(site, scanner, 2 * QUEUE)
    taken = [sent for sent in meanwhile if sent.status == SUCCESS]
    assert abs(len(taken) - QUEUE) <= 1
    before = {process: memory_kib(process.pid)[0] for process in (site.register, site.receiver)}
    while time.time() < cut_s + CUT_S:
        meanwhile += send(site, scanner, 1)
    assert [sent.status for sent in meanwhile[len(taken) :]] == [QUEUE_FULL] * (len(meanwhile) - len(taken))
    grown = {process.name: memory_kib(process.pid)[0] - kib for process, kib in before.items()}
    assert len(site.poses) == poses
    assert site.pose_age_s > CUT_S - 2 * PERIOD_S
    site.network.plug_in(REGISTERING)
    plugged_s = time.time()
    site.wait_for_statuses(taken)
    told = [stamp for stamp, _ in site.statuses() if stamp >= taken[0].from_s]
    assert len(told) == len(taken)
    assert told == sorted(told)
    # Those that were published before the controller was in reach again it has missed, but for the newest.
    site.wait_for_poses(taken[-1:])
    came = [sent for sent in taken if site.pose_of(sent)]
    site.wait_for_poses(came)
    print(
        f"cut off for {plugged_s - cut_s:.1f} s: {len(taken)} slices were registered, "
        f"{len(came)} of their poses came, {time.time() - plugged_s:.1f} s after"
    )
    print(f"memory grew by {grown} KiB with the queue full")
    # They are as old as their stamps say, however new they are to the controller.
    assert site.pose_age_s > CUT_S / 2
    stamps = [seconds(pose.header) for pose in site.poses[poses:]]
    assert len(stamps) == len(came)
    assert stamps == sorted(stamps)
    site.wait_for_poses(send(site, scanner, 3))
    assert site.pose_age_s < CUT_S / 2
    assert max(grown.values()) < 2048


def test_the_host_of_the_controller_is_cut_off(system):
    """The others go on; the newest pose is there as soon as the cable is, and not all those before."""
    site, scanner = system
    site.wait_until_prepared()
    site.wait_for_poses(send(site, scanner, 4))
    heard, poses = len(site.statuses()), len(site.poses)
    site.network.pull_cable(CONTROL)
    cut_s = time.time()
    meanwhile = send(site, scanner, QUEUE)
    before = memory_kib(site.register.pid)[0]
    while time.time() < cut_s + CUT_S:
        meanwhile += send(site, scanner, 1)
    grown = memory_kib(site.register.pid)[0] - before
    assert [sent.status for sent in meanwhile] == [SUCCESS] * len(meanwhile)
    assert len(site.poses) == poses
    assert site.pose_age_s > CUT_S - 2 * PERIOD_S
    site.network.plug_in(CONTROL)
    plugged_s = time.time()
    site.wait_for_poses(meanwhile[-1:])
    print(f"the newest pose came {time.time() - plugged_s:.1f} s after the cable; memory grew by {grown} KiB")
    site.wait_for_poses(send(site, scanner, 3))
    # Of the statuses, too, the newest few are kept for it.
    newest = site.statuses()[heard:]
    assert len(newest) < len(meanwhile)
    assert any(meanwhile[-1].from_s <= stamp <= meanwhile[-1].to_s for stamp, _ in newest)
    assert grown < 2048


def test_hosts_that_are_named_find_each_other_without_multicast(tmp_path):
    with running(tmp_path, by_name) as (site, scanner):
        site.wait_for_poses(send(site, scanner, 2))
        for host in HOSTS:
            assert MULTICAST not in site.network.multicast_groups(host, INTERFACE)
