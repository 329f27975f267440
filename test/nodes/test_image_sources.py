"""Two sources of slices at once: no pose, for nobody could tell in whose axes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image

from stereoreg_ros.nodes.register.image_sources import LEASE_S, ImageSources
from support.register_bench import SCALE, Bench, assert_near, image_of, of_stamp, rendered, values_of
from support.ros_process import RosClient, node_process


class Graph:
    """Stands in for a node that sees these publishers of `image`: pairs of a name and an id."""

    def __init__(self, *publishers: tuple[str, int]) -> None:
        self.publishers = publishers

    def get_publishers_info_by_topic(self, _topic: str) -> list[Any]:
        return [
            SimpleNamespace(node_namespace="/", node_name=name, endpoint_gid=[gid] * 16)
            for name, gid in self.publishers
        ]


def sources_in(graph: Graph) -> ImageSources:
    node: Any = graph
    image: Any = SimpleNamespace(topic_name="/image")
    return ImageSources(node, (image,))


def test_one_source_and_a_killed_one_before_it_are_no_fault():
    graph = Graph(("receiver", 1))
    sources = sources_in(graph)
    assert sources.fault(0.0) == sources.fault(1000.0) == ""
    graph.publishers = (("receiver", 1), ("receiver", 2))
    assert sources.fault(1001.0) == sources.fault(1001.0 + 0.9 * LEASE_S) == ""
    graph.publishers = (("receiver", 2),)
    assert sources.fault(1001.0 + 1.1 * LEASE_S) == ""


def test_two_names_are_a_fault_at_once():
    sources = sources_in(Graph(("receiver", 1), ("player", 2)))
    assert sources.fault(0.0) == "/image is published by /player and /receiver at once, expected one source of slices"


def test_a_second_one_whose_name_is_not_known_yet_is_a_fault():
    sources = sources_in(Graph(("receiver", 1), ("_NODE_NAME_UNKNOWN_", 2)))
    assert sources.fault(0.0).startswith("/image is published by /receiver and a node whose name is not known at once")


def test_publishers_of_one_process_are_one_source():
    """As of one that offers slices reliably and best-effort."""

    class Endpoints(Graph):
        def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
            first, second = super().get_publishers_info_by_topic(topic)
            second.endpoint_gid = [*first.endpoint_gid[:12], 0, 0, 7, 3]
            return [first, second]

    sources = sources_in(Endpoints(("scanner", 1), ("scanner", 2)))
    assert sources.fault(0.0) == sources.fault(10 * LEASE_S) == ""


def test_two_of_one_name_that_both_stay_are_a_fault():
    sources = sources_in(Graph(("receiver", 1), ("receiver", 2)))
    assert sources.fault(0.0) == ""
    assert "2 nodes called /receiver at once" in sources.fault(1.1 * LEASE_S)


def test_three_of_one_name_are_a_fault_once_two_of_them_have_stayed():
    graph = Graph(("receiver", 1), ("receiver", 2))
    sources = sources_in(graph)
    assert sources.fault(0.0) == ""
    graph.publishers += (("receiver", 3),)
    assert sources.fault(0.9 * LEASE_S) == ""
    assert "3 nodes called /receiver at once" in sources.fault(1.1 * LEASE_S)


def test_nodes_of_one_name_in_two_namespaces_are_two_names():
    class Namespaces(Graph):
        def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
            first, second = super().get_publishers_info_by_topic(topic)
            second.node_namespace = "/other"
            return [first, second]

    fault = sources_in(Namespaces(("scanner", 1), ("scanner", 2))).fault(0.0)
    assert fault == "/image is published by /other/scanner and /scanner at once, expected one source of slices"


def test_every_topic_of_a_slice_is_looked_at():
    class Topics(Graph):
        def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
            return super().get_publishers_info_by_topic(topic)[: 2 if topic == "/slice_pose" else 1]

    node: Any = Topics(("scanner", 1), ("player", 2))
    inputs: Any = [SimpleNamespace(topic_name=name) for name in ("/image", "/slice_pose", "/slice_spacing")]
    assert ImageSources(node, inputs).fault(0.0).startswith("/slice_pose is published by /player and /scanner at once")


@pytest.mark.parametrize(("topic", "message_type"), [("image", Image), ("slice_pose", PoseStamped)])
def test_while_two_nodes_publish_nothing_is_registered(topic, message_type):
    hu, slice_from_frame = rendered(8)
    namespace = f"/two_{topic}"
    told = ["--ros-args", "-r", f"__ns:={namespace}", "-p", f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]"]
    with (
        RosClient("one_scanner") as client,
        RosClient("other_scanner") as other,
        node_process("register_node", *told) as process,
    ):
        bench = Bench(client, namespace, f"{namespace}/image")
        bench.warm_up()
        assert_near(bench.accept(image_of(hu))[0], slice_from_frame)
        if topic == "slice_pose":
            client.publish(f"{namespace}/slice_pose", PoseStamped())
        # It need not even have sent anything.
        publisher = other.node.create_publisher(message_type, f"{namespace}/{topic}", 10)
        client.wait_for(lambda: "/one_scanner and /other_scanner at once" in process.output, "the warning")
        if topic == "slice_pose":
            plane = PoseStamped()
            plane.header.stamp = bench.next_stamp()
            client.publish(f"{namespace}/slice_pose", plane)
            stamp = bench.send(image_of(hu), stamp=plane.header.stamp)
        else:
            stamp = bench.send(image_of(hu))
        values = values_of(bench.status(stamp))
        assert (values["outcome"], values["reason"]) == ("refused", "bad_image")
        assert f"{namespace}/{topic} is published by /one_scanner and /other_scanner" in bench.status(stamp).message
        assert of_stamp(bench.poses, stamp) is None
        if topic == "image":
            other.node.destroy_publisher(publisher)
            client.wait_for(lambda: bench.is_accepted(image_of(hu)), "poses after the other has gone")
