"""Processes killed at random while slices flow: a few seeded rounds of `python -m benchmarks.kill_rounds`."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from support.kill_rounds import KillRounds
from support.ros_process import RosClient

# pynetdicom leaves the socket open where nobody listens, as while the receiver is dead.
pytestmark = pytest.mark.filterwarnings("ignore:Exception ignored in. <socket:pytest.PytestUnraisableExceptionWarning")


@pytest.fixture
def rounds(tmp_path):
    with RosClient("controller") as client:
        yield KillRounds(client, tmp_path, seed=5)


def test_nothing_acknowledged_is_lost_and_nothing_wrong_published(rounds):
    with rounds.receiving():
        rounds.run("register_node", recalibrate=True)
        rounds.run("register_node", both_scanners=True)
        rounds.run("receive_dicom_node", both_scanners=True)
    rounds.judge()
    assert not rounds.tally.faults
    assert rounds.tally.poses >= 4
    assert rounds.tally.acknowledged >= 10


def test_player_and_register_node_killed(rounds):
    with rounds.playing():
        rounds.run("register_node")
        rounds.run("play_dicom_node")
    rounds.judge()
    assert not rounds.tally.faults
    assert rounds.tally.poses >= 3
