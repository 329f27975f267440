"""What the layouts for RViz and Foxglove name is what the running node has: topics with their types, service, keys."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from rclpy.qos import QoSDurabilityPolicy, QoSReliabilityPolicy

from stereoreg_ros.nodes.common.parameters import Entry, entries_of
from stereoreg_ros.nodes.scanner.simulate_node import SimulationSettings
from support.contract import DIAGNOSTIC_KEYS, PUBLISHED, SERVICES, STATUS_NAME, SUBSCRIBED
from support.node_interface import NodeInterface, interface_of
from support.ros_process import REPOSITORY, RosClient, node_process

RVIZ = yaml.safe_load((REPOSITORY / "config" / "stereoreg.rviz").read_text())["Visualization Manager"]
FOXGLOVE = json.loads((REPOSITORY / "config" / "stereoreg.foxglove.json").read_text())

RVIZ_TYPES = {
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "PointStamped": "geometry_msgs/msg/PointStamped",
    "Image": "sensor_msgs/msg/Image",
    "PublishPoint": "geometry_msgs/msg/PointStamped",
}
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
PLOTTED = re.compile(r'(?P<topic>/\w+)\.status\[:\]{name=="(?P<name>[^"]+)"}\.values\[:\]{key=="(?P<key>\w+)"}\.value')


@pytest.fixture(scope="module")
def client() -> Iterator[RosClient]:
    with node_process("register_node"), RosClient() as client:
        yield client


@pytest.fixture(scope="module")
def node(client) -> NodeInterface:
    return interface_of(client, "register_node", [*PUBLISHED, *SUBSCRIBED, *SERVICES])


def panels(kind: str) -> list[dict[str, Any]]:
    return [config for name, config in FOXGLOVE["configById"].items() if name.split("!")[0] == kind]


def rviz_parts() -> list[dict[str, Any]]:
    return [part for part in [*RVIZ["Displays"], *RVIZ["Tools"]] if "Topic" in part]


def test_rviz_shows_what_the_node_publishes(node):
    shown = {}
    for part in rviz_parts():
        kind = part["Class"].removeprefix("rviz_default_plugins/")
        topic = part["Topic"]["Value"]
        # The target is told to the node, all else comes from it.
        known = node.subscribed if topic == "/target" else node.published
        assert known[topic] == RVIZ_TYPES[kind]
        shown[kind] = topic
    assert shown == {
        "MarkerArray": "/markers",
        "PoseWithCovariance": "/pose_with_covariance",
        "PointStamped": "/target",
        "Image": "/overlay",
        "PublishPoint": "/target",
    }
    assert "rviz_default_plugins/TF" in [display["Class"] for display in RVIZ["Displays"]]


def test_rviz_asks_for_no_more_than_is_offered(node, client):
    for part in rviz_parts():
        topic = part["Topic"]
        for offered in client.node.get_publishers_info_by_topic(topic["Value"]):
            best_effort = offered.qos_profile.reliability == QoSReliabilityPolicy.BEST_EFFORT
            assert topic["Reliability Policy"] == "Best Effort" or not best_effort
            volatile = offered.qos_profile.durability == QoSDurabilityPolicy.VOLATILE
            assert topic["Durability Policy"] == "Volatile" or not volatile


def test_fixed_frame_is_that_of_the_simulated_scanner():
    entries: dict[str, Entry] = {entry.name: entry for entry in entries_of(SimulationSettings)}
    assert RVIZ["Global Options"]["Fixed Frame"] == entries["frame_id"].default
    (scene,) = panels("3D")
    assert scene["followTf"] == entries["frame_id"].default
    (status,) = panels("DiagnosticStatusPanel")
    assert status["selectedHardwareId"] == entries["frame_id"].default


def test_foxglove_shows_what_the_node_publishes(node):
    (scene,), (image,) = panels("3D"), panels("Image")
    assert {"/markers", "/pose_with_covariance"} <= set(scene["topics"])
    assert set(scene["topics"]) <= set(node.published) | set(node.subscribed)
    assert node.subscribed[scene["publish"]["pointTopic"]] == "geometry_msgs/msg/PointStamped"
    assert node.published[image["imageMode"]["imageTopic"]] == "sensor_msgs/msg/Image"
    for panel in [*panels("DiagnosticStatusPanel"), *panels("DiagnosticSummary")]:
        assert node.published[panel["topicToRender"]] == DIAGNOSTICS
    (status,) = panels("DiagnosticStatusPanel")
    assert status["selectedName"] == STATUS_NAME


def test_foxglove_plots_keys_of_the_diagnostics(node):
    plotted = set()
    for plot in panels("Plot"):
        for path in plot["paths"]:
            found = PLOTTED.fullmatch(path["value"])
            assert found, path["value"]
            assert node.published[found["topic"]] == DIAGNOSTICS
            assert found["name"] == STATUS_NAME
            assert found["key"] in DIAGNOSTIC_KEYS
            plotted.add(found["key"])
    assert {"residual_rms_mm", "inliers"} <= plotted


def test_foxglove_button_calls_a_service_of_the_node(node):
    (button,) = panels("CallService")
    assert button["serviceName"] == "/register_node/recalibrate"
    assert node.services[button["serviceName"]] == "std_srvs/srv/Trigger"
    assert json.loads(button["requestPayload"]) == {}


def test_foxglove_places_every_panel_once():
    def places(layout: Any) -> list[str]:
        if isinstance(layout, str):
            return [layout]
        return places(layout["first"]) + places(layout["second"])

    assert sorted(places(FOXGLOVE["layout"])) == sorted(FOXGLOVE["configById"])
