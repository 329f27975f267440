"""register_node in a ROS system: several frames, targets, quality of service, streams, TF, two nodes at once."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped, TransformStamped
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from visualization_msgs.msg import Marker, MarkerArray

from stereoreg_ros import load_frame
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import frame_text
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.nodes.common import conversions
from stereoreg_ros.simulation import PlacedFrame, render_slice
from stereoreg_ros.uncertainty import error_ball_95, point_covariance
from support.register_bench import (
    CUBE,
    SCALE,
    SCANNER,
    START,
    Bench,
    assert_near,
    image_of,
    of_stamp,
    rendered,
    target_of,
    values_of,
)
from support.ros_process import RosClient, node_process

SPACING = f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]"


@pytest.fixture
def client():
    with RosClient("controller") as controller:
        yield controller


def arguments(namespace: str, *parameters: str) -> list[str]:
    told = [part for one in (SPACING, *parameters) for part in ("-p", one)]
    return ["--ros-args", "-r", f"__ns:={namespace}", *told]


def statuses(diagnostics: list[DiagnosticArray], name: str) -> list[DiagnosticStatus]:
    return [status for array in diagnostics for status in array.status if status.name == name]


def two_frames() -> tuple[np.ndarray, dict[str, Pose]]:
    """One slice with cube6 on the left and cube8 on the right."""
    left = Pose(np.eye(3), np.array([34.0, 70.0, 3.0]))
    right = Pose(np.eye(3), np.array([95.0, 80.0, -4.0]))
    placed = [PlacedFrame(CUBE, left), PlacedFrame(load_frame("cube8"), right)]
    return render_slice(placed, SCANNER, np.random.default_rng(1)).hu, {"cube6": left, "cube8": right}


def test_two_frames_have_topics_and_statuses_of_their_own(client):
    with node_process("register_node", *arguments("/both", "frame_files:=[cube6,cube8]")):
        diagnostics = client.collect(DiagnosticArray, "/diagnostics")
        poses = {name: client.collect(PoseStamped, f"/both/{name}/pose") for name in ("cube6", "cube8")}
        covariances = client.collect(PoseWithCovarianceStamped, "/both/cube8/pose_with_covariance")
        targets = client.collect(PointStamped, "/both/cube8/target_in_frame")
        hu, true = two_frames()
        image = image_of(hu)
        image.header.frame_id = "ct"
        sent = 0.0

        def all_came() -> bool:
            nonlocal sent
            if time.monotonic() > sent + 1.0:
                sent = time.monotonic()
                image.header.stamp.sec += 1
                client.publish("/both/target", target_of([10.0, 20.0, 30.0]))
                client.publish("/both/image", image)
            return bool(all(poses.values()) and covariances and targets and statuses(diagnostics, NAMES[1]))

        client.wait_for(all_came, "poses of both frames")
        for name, slice_from_frame in true.items():
            assert_near(conversions.pose_from_message(poses[name][-1]), slice_from_frame)
        in_frame = conversions.pose_from_message(poses["cube8"][-1]).inverse() @ np.array([10.0, 20.0, 30.0])
        assert targets[-1].header.frame_id == "cube8"
        np.testing.assert_allclose(conversions.point_from_message(targets[-1]), in_frame, atol=0.2)
        # Of a slice that was answered: the last that was sent may not be yet.
        both = next(array for array in reversed(diagnostics) if array.status[0].name == NAMES[0])
        assert [status.name for status in both.status] == list(NAMES)
        values = [values_of(status) for status in both.status]
        assert [(one["frame"], one["outcome"], one["inliers"]) for one in values] == [
            ("cube6", "accepted", "6"),
            ("cube8", "accepted", "8"),
        ]
        # One pass over the image; where no spot is claimed twice, each frame is offered all of them.
        (spots,) = {int(one["spots"]) for one in values}
        assert spots >= 14


NAMES = tuple(f"both/register_node: registration of {name}" for name in ("cube6", "cube8"))


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        (["cube6", "cube6"], "two frames are called 'cube6', expected distinct names"),
        (["cube6", "no_frame"], "frame 'no_frame' is neither a file nor a shipped frame"),
        (["cube6", ""], "expected a list of names or paths"),
        ("cube6", "expected a list of names or paths"),
    ],
)
def test_frame_files_that_cannot_be(streams, value, sentence):
    assert sentence in streams.set(frame_files=value)


def test_one_frame_to_two_and_back(streams):
    hu, slice_from_frame = rendered(21)
    assert streams.set(frame_files=["cube6", "leksell_ct"]) == ""
    several = streams.client.collect(PoseStamped, f"{streams.namespace}/cube6/pose")

    def came() -> bool:
        # Until both sides have discovered the new topic, its poses go astray.
        stamp = streams.send(image_of(hu))
        streams.client.wait_for(lambda: of_stamp(streams.diagnostics, stamp), "the diagnostics of an image")
        return bool(several)

    streams.client.wait_for(came, "the pose of a frame among two")
    assert_near(conversions.pose_from_message(several[-1]), slice_from_frame)
    assert streams.set(frame_files=[]) == ""
    pose, _ = streams.accept(image_of(hu))
    assert_near(pose, slice_from_frame)


@pytest.fixture(scope="module")
def running():
    with RosClient("streams") as client, node_process("register_node", *arguments("/streams")):
        bench = Bench(client, "/streams", "/streams/image")
        bench.warm_up()
        yield bench


@pytest.fixture
def streams(running: Bench) -> Bench:
    """The running node as at its start, whatever other tests have made of it."""
    running.start_anew()
    return running


def test_target_error_and_age(streams):
    """The target's 95 % error is that of the pose it rests on, at the target."""
    hu, _ = rendered(22)
    stamp = streams.send(image_of(hu))
    pose = streams.pose(stamp)
    message = streams.client.wait_for(lambda: of_stamp(streams.with_covariance, stamp), "the covariance")
    target = np.array([40.0, 60.0, 25.0])
    in_frame = pose.inverse() @ target
    streams.client.publish(f"{streams.namespace}/target", target_of(target))

    def of_this_target() -> list[DiagnosticStatus]:
        told = statuses(streams.diagnostics, streams.name_of("target"))
        return [one for one in told if abs(float(values_of(one)["target_x_mm"]) - in_frame[0]) < 1e-6]

    status = streams.client.wait_for(of_this_target, "the target's status")[-1]
    assert status.level == DiagnosticStatus.OK
    values = values_of(status)
    to_mm = np.array([1e3] * 3 + [1.0] * 3)
    covariance = np.reshape(message.pose.covariance, (6, 6)) * np.outer(to_mm, to_mm)
    expected = error_ball_95(point_covariance(covariance, pose, in_frame))
    assert float(values["target_error_95_mm"]) == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose([float(values[f"target_{axis}_mm"]) for axis in "xyz"], in_frame, atol=1e-6)
    assert 0 <= float(values["pose_age_s"]) < 20


@pytest.mark.parametrize(
    ("settings", "reason"), [({"max_pose_age": 0.1}, "pose_too_old"), ({"max_target_error_mm": 0.001}, "inaccurate")]
)
def test_target_on_a_pose_that_will_not_do(streams, settings, reason):
    hu, _ = rendered(23)
    streams.accept(image_of(hu))
    restored = {name: START[name] for name in settings}
    if reason == "pose_too_old":
        end = time.monotonic() + 0.2
        streams.client.wait_for(lambda: time.monotonic() > end, "the pose to age")
    assert streams.set(**settings) == ""
    streams.client.publish(f"{streams.namespace}/target", target_of([1.0, 2.0, 3.0]))
    (status,) = streams.client.wait_for(
        lambda: statuses(streams.diagnostics, streams.name_of("target"))[:1], "the target's status"
    )
    assert status.level == DiagnosticStatus.ERROR
    assert values_of(status)["reason"] == reason
    # The first that is published is that of the next pose, with which it will do.
    assert streams.set(**restored) == ""
    stamp = streams.send(image_of(hu))
    streams.client.wait_for(lambda: streams.targets, "target_in_frame")
    assert [target.header.stamp for target in streams.targets] == [stamp]


def test_latest_pose_waits_for_who_comes_late(streams):
    hu, _ = rendered(24)
    for _ in range(3):
        stamp = streams.send(image_of(hu))
        streams.pose(stamp)
    late: list[PoseStamped] = []
    profile = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = streams.client.node.create_subscription(
        PoseStamped, f"{streams.namespace}/pose", late.append, profile
    )
    streams.client.wait_for(lambda: late, "the latest pose")
    assert [message.header.stamp for message in late] == [stamp]
    streams.client.node.destroy_subscription(subscription)


def test_slices_that_have_waited_too_long_are_skipped_for_the_newest_and_counted(client, tmp_path: Path):
    """While the node is busy with the tables of a frame of many rods, slices go on coming."""
    rng = np.random.default_rng(4)
    starts, ends = rng.uniform(-50, 50, (2, 20, 3))
    starts[:, 2], ends[:, 2] = -50, 50
    many = Frame("many", tuple(f"r{number}" for number in range(20)), starts, ends, np.ones(20))
    path = tmp_path / "many.yaml"
    path.write_text(frame_text(many, "Twenty rods."))
    with node_process("register_node", *arguments("/late")) as process:
        bench = Bench(client, "/late", "/late/image")
        bench.warm_up()
        bench.accept(image_of(rendered(25)[0]))
        change = [Parameter("frame_file", value=str(path)).to_parameter_msg()]
        # By a client that was answered before: the first request of another may come seconds late, after the slices.
        assert bench.set(stale_after=2.0) == ""
        service = client.client_of(SetParametersAtomically, f"{bench.node}/set_parameters_atomically")
        done = service.call_async(SetParametersAtomically.Request(parameters=change))
        late = [bench.next_stamp() for _ in range(8)]
        for stamp in late:
            plane = PoseStamped(pose=conversions.pose_to_message(Pose.identity()))
            plane.header.stamp = stamp
            client.publish("/late/slice_pose", plane)
            bench.send(image_of(rendered(25)[0]), stamp=stamp)
        client.wait_for(done.done, "the change of the frame")
        # A search for twenty rods: ten seconds of a core that may have other things to do.
        bench.status(late[-1], 90.0)

        def skipped() -> int:
            told = [values_of(one) for one in statuses(bench.diagnostics, bench.name_of("stream"))]
            return int(told[-1]["slices_skipped"]) if told else 0

        client.wait_for(skipped, "skipped slices in the stream's status")
        answers = [of_stamp(bench.diagnostics, one) for one in late]
        assert all(answers), "an image without an answer"
        reasons = [values_of(answer.status[0])["reason"] for answer in answers]

        def heard_skipped() -> int:
            heard = statuses(bench.diagnostics, bench.name_of("registration"))
            return [values_of(one)["reason"] for one in heard].count("skipped")

        # On a busy computer, some of those before were skipped too; the stream's status comes once a second.
        client.wait_for(lambda: skipped() == heard_skipped(), "every skipped slice in the stream's status")
        assert "skipped" in reasons
        assert reasons[-1] != "skipped"

        def all_told() -> bool:
            last = values_of(statuses(bench.diagnostics, bench.name_of("stream"))[-1])
            told = int(last["slices_registered"]) + int(last["slices_skipped"])
            return int(last["slices_received"]) == told >= len(late)

        client.wait_for(all_told, "every slice in the stream's counts")
        # The pose of a skipped slice is not there for the next image with its stamp.
        again = late[reasons.index("skipped")]
        bench.diagnostics.clear()
        bench.send(image_of(rendered(25)[0]), stamp=again)
        assert "no slice_pose with the image's stamp came" in bench.status(again).message
        assert process.running


def test_stream_that_stops_is_told_as_stale(streams):
    hu, _ = rendered(26)
    assert streams.set(stale_after=0.5) == ""
    stamp = streams.client.node.get_clock().now().to_msg()
    streams.accept(image_of(hu), stamp=stamp)
    streams.diagnostics.clear()

    def warned() -> list[DiagnosticStatus]:
        told = statuses(streams.diagnostics, streams.name_of("stream"))
        return [status for status in told if status.level == DiagnosticStatus.WARN]

    status = streams.client.wait_for(warned, "a warning that the stream is stale")[0]
    assert status.message.startswith("stale: no slice for ")
    with_latency = [values_of(one) for one in statuses(streams.diagnostics, streams.name_of("stream"))]
    known = [float(one["latency_ms"]) for one in with_latency if one["latency_ms"] != "nan"]
    assert all(0 < latency < 20_000 for latency in known)


def test_required_slice_pose(client):
    """An image that comes before anybody publishes slice poses must not be registered in the wrong axes."""
    with node_process("register_node", *arguments("/required", "slice_pose_required:=true")):
        bench = Bench(client, "/required", "/required/image")
        hu, slice_from_frame = rendered(27)
        stamp = bench.send(image_of(hu))
        status = bench.status(stamp)
        assert "no slice_pose with the image's stamp came" in status.message
        assert not bench.poses
        plane = PoseStamped(pose=conversions.pose_to_message(Pose(np.eye(3), np.array([0.0, 0.0, 500.0]))))
        plane.header.stamp = bench.next_stamp()
        client.publish("/required/slice_pose", plane)
        bench.send(image_of(hu), stamp=plane.header.stamp)
        assert bench.pose(plane.header.stamp).translation[2] == pytest.approx(
            slice_from_frame.translation[2] + 500, abs=1
        )


def test_quality_that_does_not_fit_is_told_and_can_be_overridden(client):
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    hu, slice_from_frame = rendered(28)
    with node_process("register_node", *arguments("/strict")) as process:
        publisher = client.node.create_publisher(Image, "/strict/image", best_effort)
        cure = "-p qos_overrides./strict/image.subscription.reliability:=best_effort"
        client.wait_for(lambda: cure in process.output, "the cure in the log")
        client.node.destroy_publisher(publisher)
    overridden = arguments("/mild", "qos_overrides./mild/image.subscription.reliability:=best_effort")
    with node_process("register_node", *overridden) as process:
        poses = client.collect(PoseStamped, "/mild/pose")
        publisher = client.node.create_publisher(Image, "/mild/image", best_effort)
        client.wait_for(publisher.get_subscription_count, "the node")
        image = image_of(hu)

        def came() -> bool:
            image.header.stamp.sec += 1
            publisher.publish(image)
            end = time.monotonic() + 1.0
            client.wait_for(lambda: poses or time.monotonic() > end, "a pose")
            return bool(poses)

        client.wait_for(came, "a pose from a publisher of best effort")
        assert_near(conversions.pose_from_message(poses[-1]), slice_from_frame)
        client.node.destroy_publisher(publisher)


def test_override_that_is_none_ends_the_node_with_a_sentence():
    wrong = arguments("/wrong", "qos_overrides./wrong/image.subscription.reliability:=perhaps")
    with node_process("register_node", *wrong) as process:
        assert process.wait() == 1
        assert "cannot start" in process.output
        assert "Traceback" not in process.output


TF2 = '''
from geometry_msgs.msg import TransformStamped

class TransformBroadcaster:
    """Stands for tf2_ros, which is no wheel: sends what it is given to a topic."""

    def __init__(self, node):
        self.sendTransform = node.create_publisher(TransformStamped, "sent_to_tf", 10).publish
'''


def test_tf_of_accepted_slices_only(client, tmp_path: Path):
    (tmp_path / "tf2_ros.py").write_text(TF2)
    with node_process("register_node", *arguments("/tf", "publish_tf:=true"), env={"PYTHONPATH": str(tmp_path)}):
        bench = Bench(client, "/tf", "/tf/image")
        sent = client.collect(TransformStamped, "/tf/sent_to_tf")
        bench.warm_up()
        pose, _ = bench.accept(image_of(rendered(29)[0]))
        stamp = bench.poses[-1].header.stamp
        transform = client.wait_for(lambda: of_stamp(sent, stamp), "a transform")
        assert (transform.header.frame_id, transform.child_frame_id) == ("ct", "stereotactic_frame")
        moved = transform.transform.translation
        np.testing.assert_allclose([moved.x, moved.y, moved.z], pose.translation / 1e3, atol=1e-12)
        refused = bench.send(image_of(np.zeros_like(rendered(29)[0])))
        bench.status(refused)
        bench.accept(image_of(rendered(29)[0]))
        assert of_stamp(sent, refused) is None
        assert bench.set(publish_tf=False) == ""
        stamp = bench.send(image_of(rendered(29)[0]))
        bench.pose(stamp)
        assert of_stamp(sent, stamp) is None


def test_tf_without_tf2_is_refused_by_name(streams):
    assert "publish_tf is true, but tf2_ros cannot be imported" in streams.set(publish_tf=True)


def test_markers_show_error_and_target(streams):
    hu, _ = rendered(30)
    shown = streams.client.collect(MarkerArray, f"{streams.namespace}/markers")
    streams.client.publish(f"{streams.namespace}/target", target_of([5.0, 6.0, 7.0]))

    def with_target() -> list[Marker]:
        streams.accept(image_of(hu))
        # The target may come after a slice, and there is none before it.
        return [marker for array in shown[-1:] for marker in array.markers if marker.ns == "target"]

    position = streams.client.wait_for(with_target, "a marker of the target")[0].pose.position
    np.testing.assert_allclose([position.x, position.y, position.z], [0.005, 0.006, 0.007])
    (ellipsoid,) = (m for m in shown[-1].markers if m.type == Marker.SPHERE and m.ns == "stereotactic_frame")
    assert 0 < ellipsoid.scale.x <= ellipsoid.scale.z < 0.01


def test_two_nodes_in_one_system(client):
    hu, slice_from_frame = rendered(31)
    with (
        node_process("register_node", *arguments("/one")),
        node_process("register_node", *arguments("/two", "frame_file:=cube8")),
    ):
        one, two = Bench(client, "/one", "/one/image"), Bench(client, "/two", "/two/image")
        one.warm_up()
        two.warm_up(two.diagnostics)
        assert_near(one.accept(image_of(hu))[0], slice_from_frame)
        stamp = two.send(image_of(hu))
        assert values_of(two.status(stamp))["frame"] == "cube8"
        assert of_stamp(one.poses, stamp) is None
