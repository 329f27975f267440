"""register_node as a process of its own, over DDS: poses, refusals, bad input, parameters, services."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, PoseStamped, Quaternion
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterEvent, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParametersAtomically
from sensor_msgs.msg import Image
from visualization_msgs.msg import Marker, MarkerArray

from stereoreg_ros import Pose, load_frame
from stereoreg_ros.geometry.frame_file import shipped_frames
from stereoreg_ros.geometry.pose import rotation_exp
from stereoreg_ros.nodes.common import conversions
from stereoreg_ros.nodes.register import register_node, slice_registration
from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice
from stereoreg_ros.nodes.register.parameters import ENTRIES
from stereoreg_ros.simulation import PlacedFrame, random_pose, render_slice
from support.register_bench import (
    CUBE,
    NODE,
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
from support.ros_process import REPOSITORY, NodeProcess, RosClient, node_here, node_process


@pytest.fixture(scope="module")
def client() -> Iterator[RosClient]:
    with RosClient() as client:
        yield client


@pytest.fixture(scope="module")
def running(client) -> Iterator[Bench]:
    spacing = f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]"
    with node_process("register_node", "--ros-args", "-p", spacing):
        bench = Bench(client)
        bench.warm_up()
        yield bench


@pytest.fixture
def bench(running: Bench) -> Bench:
    """The running node as at its start, whatever other tests have made of it."""
    running.start_anew()
    return running


def test_pose_covariance_and_diagnostics(bench):
    assert bench.set(max_rotation_deg=40.0, threshold=2000.0) == ""
    hu, slice_from_frame = rendered(2)
    stamp = bench.send(image_of(hu))
    assert_near(bench.pose(stamp), slice_from_frame)
    pose = of_stamp(bench.poses, stamp)
    assert pose.header.frame_id == "ct"

    with_covariance = bench.client.wait_for(lambda: of_stamp(bench.with_covariance, stamp), "pose_with_covariance")
    assert with_covariance.header == pose.header
    assert with_covariance.pose.pose == pose.pose
    covariance = np.reshape(with_covariance.pose.covariance, (6, 6))
    assert np.allclose(covariance, covariance.T, rtol=1e-9)
    assert (np.linalg.eigvalsh(covariance) > 0).all()

    status = bench.status(stamp)
    assert (status.level, status.hardware_id) == (DiagnosticStatus.OK, "ct")
    assert status.message.startswith("registered 6 of 6 rods, residual 0.")
    values = values_of(status)
    assert (values["outcome"], values["reason"], values["frame"]) == ("accepted", "", "cube6")
    assert (values["spots"], values["lines"], values["inliers"], values["ambiguous_poses"]) == ("6", "6", "6", "1")
    assert (values["pixel_spacing_x_mm"], values["pixel_spacing_y_mm"]) == ("0.5", "0.6")
    assert values["calibration"] == "configured"
    assert 0 < float(values["residual_rms_mm"]) < 0.3
    assert float(values["duration_ms"]) > 0
    worst_mm = 1e3 * math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    assert float(values["position_std_mm"]) == pytest.approx(worst_mm, rel=1e-6)


def test_a_pose_without_a_configured_orientation_bears_a_caution(bench):
    hu, slice_from_frame = rendered(2)
    stamp = bench.send(image_of(hu))
    assert_near(bench.pose(stamp), slice_from_frame)
    status = bench.status(stamp)
    assert status.level == DiagnosticStatus.WARN
    assert status.message.startswith("registered 6 of 6 rods, residual 0.")
    assert "no nominal orientation is configured" in status.message


@pytest.mark.parametrize(
    ("layout", "rescale"),
    [
        ({"dtype": ">i2", "padding": 7}, (1.0, 0.0)),
        ({"dtype": "<u2", "encoding": "16UC1", "padding": 64}, (1.0, -1024.0)),
        ({"dtype": ">u2", "encoding": "mono16"}, (0.5, -1024.0)),
        ({"dtype": "<f4", "encoding": "32FC1", "padding": 4}, (1.0, 0.0)),
        ({"dtype": ">f4", "encoding": "32FC1", "padding": 1}, (2.0, 100.0)),
    ],
    ids=str,
)
def test_every_layout_gives_the_same_pose(bench, layout, rescale):
    hu, _ = rendered(3)
    expected, _ = bench.accept(image_of(hu))
    slope, intercept = rescale
    assert bench.set(rescale_slope=slope, rescale_intercept=intercept) == ""
    found, _ = bench.accept(image_of((hu - intercept) / slope, **layout))
    assert np.allclose(found.translation, expected.translation, atol=1e-6)
    assert np.allclose(found.rotation, expected.rotation, atol=1e-9)


def test_frame_ids(bench):
    assert bench.set(scanner_frame_id="scanner", fiducial_frame_id="fiducials") == ""
    bench.client.publish("/target", target_of([0, 0, 0], "scanner"))
    hu, _ = rendered(4)
    stamp = bench.send(image_of(hu), frame_id="something else")
    bench.pose(stamp)
    assert of_stamp(bench.poses, stamp).header.frame_id == "scanner"
    assert bench.status(stamp).hardware_id == "scanner"
    target = bench.client.wait_for(lambda: of_stamp(bench.targets, stamp), "target_in_frame")
    assert target.header.frame_id == "fiducials"


def test_slice_without_rods_is_refused(bench):
    bench.refuse(image_of(np.zeros((64, 64))), "too_few_spots", "0 spots")


def with_changes(image: Image, **changes: Any) -> Image:
    for name, value in changes.items():
        setattr(image, name, value)
    return image


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"encoding": "rgb8"}, "image encoding is 'rgb8', expected one of 16SC1"),
        ({"step": 511}, "image step is 511, expected at least 512 bytes"),
        ({"step": 514}, "image data has 131072 bytes, expected step * height = 514 * 256"),
        ({"data": b""}, "image data has 0 bytes, expected"),
        ({"height": 255}, "image data has 131072 bytes, expected"),
        ({"width": 0, "height": 0, "step": 0, "data": b""}, "image width is 0, expected"),
        ({"width": 2**32 - 1, "step": 2**32 - 1}, "image width is 4294967295, expected"),
    ],
    ids=str,
)
def test_faulty_image_is_refused_by_name(bench, changes, sentence):
    bench.refuse(with_changes(image_of(rendered(6)[0]), **changes), "bad_image", sentence)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_image_that_is_not_finite_is_refused(bench, value):
    broken = rendered(6)[0].copy()
    broken[3, 5] = value
    bench.refuse(image_of(broken, "<f4", "32FC1"), "bad_image", "1 pixels that are not finite")


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"pixel_spacing": [-0.5, 0.5]}, "pixel_spacing is [-0.5, 0.5], expected two positive numbers"),
        ({"pixel_spacing": [0.0, 0.0]}, "pixel_spacing is [0, 0], expected two positive numbers"),
        ({"pixel_spacing": [0.5, 0.5, 0.5]}, "pixel_spacing has 3 numbers, expected two"),
        ({"pixel_spacing": 0.5}, "Wrong parameter type"),
        ({"threshold": 1e9}, "threshold out of range"),
        ({"threshold": math.nan}, "threshold out of range"),
        ({"threshold": "loud"}, "threshold is 'loud', expected a number from -32768 to 65535, or 'auto'"),
        ({"threshold": [1.0]}, "threshold is (1.0,), expected a number"),
        ({"threshold": True}, "threshold is True, expected a number"),
        ({"frame_tolerance_mm": -0.1}, "frame_tolerance_mm out of range"),
        ({"scale_tolerance": 0.2}, "scale_tolerance out of range"),
        ({"max_target_error_mm": math.nan}, "max_target_error_mm out of range"),
        ({"rescale_slope": 0.0}, "rescale_slope is 0.0, expected a number that is not 0"),
        ({"matcher": "guess"}, "matcher is 'guess', expected one of"),
        ({"nominal_orientation": [0.0, 0.0, 0.0, 0.0]}, "nominal_orientation"),
        ({"min_spot_area_mm2": 90.0}, "min_spot_area_mm2 is 90, expected less than max_spot_area_mm2"),
        ({"frame_file": "no_such_frame"}, "frame 'no_such_frame' is neither a file nor a shipped frame"),
    ],
    ids=str,
)
def test_faulty_parameter_is_refused_with_all_set_beside_it(bench, values, sentence):
    assert sentence in bench.set(spot_noise_px=0.5, **values)
    names = ["spot_noise_px", *values]
    assert [
        list(v) if isinstance(START[n], list) else v
        for n, v in zip(names, bench.client.get_parameters(bench.node, *names), strict=True)
    ] == [START[name] for name in names]
    hu, slice_from_frame = rendered(7)
    assert_near(bench.accept(image_of(hu))[0], slice_from_frame)


def test_parameters_that_are_valid_only_together(bench):
    assert bench.set(min_spot_area_mm2=90.0, max_spot_area_mm2=100.0) == ""


def test_parameters_are_described(bench):
    names = [entry.name for entry in ENTRIES]
    descriptors = bench.client.describe_parameters(bench.node, *names)
    assert [(d.name, d.description) for d in descriptors] == [(e.name, e.description) for e in ENTRIES]


def test_malformed_frame_file_is_refused_and_the_old_frame_stays(bench, tmp_path):
    path = tmp_path / "broken.yaml"
    path.write_text("name: broken\nlines:\n  - {name: a, from: [0, 0, 0], to: [0, 0, x], diameter: 1}\n")
    reason = bench.set(frame_file=str(path))
    assert str(path) in reason
    path.write_text("name: short\nlines: []\n")
    assert "0 rods" in bench.set(frame_file=str(path))
    hu, slice_from_frame = rendered(8)
    pose, values = bench.accept(image_of(hu))
    assert_near(pose, slice_from_frame)
    assert values["frame"] == "cube6"


def test_frame_can_be_changed(bench):
    assert bench.set(frame_file="leksell_ct") == ""
    hu, slice_from_frame = rendered(8)
    stamp = bench.send(image_of(hu))
    assert values_of(bench.status(stamp))["frame"] == load_frame("leksell_ct").name
    assert bench.set(frame_file="cube6") == ""
    assert_near(bench.accept(image_of(hu))[0], slice_from_frame)


def test_pictures_while_subscribed(bench):
    hu, slice_from_frame = rendered(9, hidden=(CUBE.line_names[0],))
    with RosClient("viewer") as viewer:
        overlays, markers = viewer.collect(Image, "/overlay"), viewer.collect(MarkerArray, "/markers")

        def both_delivered() -> bool:
            if not (overlays and markers):
                bench.accept(image_of(hu))
            return bool(overlays and markers)

        viewer.wait_for(both_delivered, "overlay and markers")
    overlay = overlays[-1]
    assert overlay.encoding == "bgr8"
    assert overlay.header.frame_id == "ct"
    assert of_stamp(bench.poses, overlay.header.stamp) is not None
    assert overlay.step * overlay.height == len(overlay.data)
    rods = [marker for marker in markers[-1].markers if marker.type == Marker.CYLINDER]
    assert markers[-1].markers[0].action == Marker.DELETEALL
    assert {marker.ns for marker in rods} == {"stereotactic_frame"}
    assert len({marker.id for marker in rods}) == len(CUBE)
    colours = [(marker.color.r, marker.color.g) for marker in rods]
    assert colours.count(colours[1]) == len(CUBE) - 1
    assert colours[0] != colours[1]
    middles = slice_from_frame @ (0.5 * (CUBE.starts + CUBE.ends))
    shown = [[m.pose.position.x, m.pose.position.y, m.pose.position.z] for m in rods]
    assert np.allclose(shown, middles / 1e3, atol=1.5e-3)
    # Nobody looks any more, and slices are registered as before.
    bench.accept(image_of(hu))


def test_the_overlay_shows_every_frame(bench):
    """Each has its two lines of words above the slice, of 26 pixels each."""
    assert bench.set(frame_files=["cube6", "leksell_ct", "zframe"]) == ""
    hu, _ = rendered(9)
    with RosClient("viewer") as viewer:
        overlays = viewer.collect(Image, "/overlay")

        def delivered() -> bool:
            if not overlays:
                stamp = bench.send(image_of(hu))
                bench.client.wait_for(lambda: of_stamp(bench.diagnostics, stamp), "the diagnostics of a slice")
            return bool(overlays)

        viewer.wait_for(delivered, "the overlay")
    assert (overlays[-1].height, overlays[-1].width) == (4 * 256 + 12 + 3 * 52, 1024)


def test_target_in_frame(bench):
    hu, _ = rendered(10)
    target = np.array([30.0, -20.0, 12.0])
    bench.accept(image_of(hu))
    bench.client.publish("/target", target_of(target))
    # Answered at once from the latest pose, and again with every pose.
    bench.client.wait_for(lambda: bench.targets, "target_in_frame")
    stamp = bench.send(image_of(hu))
    answer = bench.client.wait_for(lambda: of_stamp(bench.targets, stamp), "target_in_frame")
    assert answer.header.frame_id == "stereotactic_frame"
    found = bench.pose(stamp) @ conversions.point_from_message(answer)
    assert np.allclose(found, target, atol=1e-6)


def changes_of(node: str, events: list[ParameterEvent]) -> list[list[str]]:
    """Names of the parameters of a node that were changed, of each change."""
    return [[parameter.name for parameter in one.changed_parameters] for one in events if one.node == node]


def test_recalibrate_and_reset(bench):
    wrong = [1.01 * SCALE.sx, 0.99 * SCALE.sy]
    assert bench.set(pixel_spacing=wrong, calibration_timeout=0.0) == ""
    response = bench.call("recalibrate")
    assert not response.success
    assert "no slice has been accepted yet" in response.message

    events = bench.client.collect(ParameterEvent, "/parameter_events")
    hu, slice_from_frame = rendered(12, noise_hu=5.0)
    bench.accept(image_of(hu))
    response = bench.call("recalibrate")
    assert response.success, response.message
    (measured,) = bench.client.get_parameters(bench.node, "pixel_spacing")
    assert np.allclose(measured, [SCALE.sx, SCALE.sy], rtol=3e-3)
    bench.client.wait_for(lambda: ["pixel_spacing", "pixel_shear"] in changes_of(NODE, events), "a parameter event")
    pose, values = bench.accept(image_of(hu))
    assert_near(pose, slice_from_frame)
    assert values["calibration"] == "measured"
    assert float(values["pixel_spacing_x_mm"]) == pytest.approx(measured[0], rel=1e-6)

    response = bench.call("reset_calibration")
    assert response.success, response.message
    (spacing,) = bench.client.get_parameters(bench.node, "pixel_spacing")
    assert list(spacing) == wrong
    assert bench.accept(image_of(hu))[1]["calibration"] == "configured"


def test_recalibrate_refused_changes_nothing(bench):
    # Four rods fix a pose that somebody may want to have, but no scale.
    open_limits = {"max_log10_false_alarms": 0.0, "max_position_std_mm": 1000.0, "max_target_error_mm": 1000.0}
    assert bench.set(**open_limits, max_rotation_deg=30.0, calibration_timeout=0.0) == ""
    hu, _ = rendered(13, hidden=CUBE.line_names[:2])
    status = bench.status(bench.send(image_of(hu)))
    assert values_of(status)["inliers"] == "4", status.message
    assert status.level != DiagnosticStatus.ERROR, status.message
    response = bench.call("recalibrate")
    assert not response.success
    assert response.message
    (spacing,) = bench.client.get_parameters(bench.node, "pixel_spacing")
    assert list(spacing) == [SCALE.sx, SCALE.sy]
    assert bench.accept(image_of(rendered(14)[0]))[1]["calibration"] == "configured"


def test_spacing_from_outside_becomes_the_configured_one(bench):
    hu, _ = rendered(12, noise_hu=5.0)
    bench.accept(image_of(hu))
    assert bench.call("recalibrate").success
    assert bench.set(pixel_spacing=[0.501, 0.601]) == ""
    assert bench.accept(image_of(hu))[1]["calibration"] == "configured"
    assert bench.call("reset_calibration").success
    (spacing,) = bench.client.get_parameters(bench.node, "pixel_spacing")
    assert list(spacing) == [0.501, 0.601]


def test_frame_that_asks_for_an_orientation_is_refused_until_it_has_one(client, tmp_path):
    path = tmp_path / "symmetric.yaml"
    shipped = shipped_frames()["cube6"].read_text()
    path.write_text(shipped.replace("lines:", "orientation_required: true\nlines:", 1))
    hu, slice_from_frame = rendered(15)
    spacing = f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]"
    arguments = ["-r", "__ns:=/symmetric", "-p", f"frame_file:={path}", "-p", spacing]
    with node_process("register_node", "--ros-args", *arguments):
        bench = Bench(client, "/symmetric", "/symmetric/image")
        bench.warm_up(bench.diagnostics)
        bench.refusal(image_of(hu), "ambiguous", "orientation_required")
        assert bench.set(nominal_orientation=[0.0, 0.0, 0.0, 1.0], max_rotation_deg=40.0) == ""
        stamp = bench.send(image_of(hu))
        assert_near(bench.pose(stamp), slice_from_frame)
        assert bench.status(stamp).level == DiagnosticStatus.OK
        # Now that poses are heard: there has been one only.
        assert [message.header.stamp for message in bench.poses] == [stamp]


def test_orientation_that_the_slice_contradicts_is_refused(client):
    """Within a nominal orientation that is wrong by half a turn, six of eight rods match; anywhere, all do."""
    cube8 = load_frame("cube8")
    arguments = ["-r", "__ns:=/turned", "-p", "frame_file:=cube8", "-p", f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]"]
    arguments += ["-p", "threshold:=2000.0"]
    with node_process("register_node", "--ros-args", *arguments):
        bench = Bench(client, "/turned", "/turned/image")
        bench.warm_up(bench.diagnostics)
        for seed in (16, 49, 325):
            rng = np.random.default_rng(seed)
            true = random_pose(rng, cube8, SCANNER, max_offset_mm=10.0)
            image = image_of(render_slice([PlacedFrame(cube8, true)], SCANNER, rng).hu)
            assert bench.set(nominal_orientation=[0.0, 0.0, 1.0, 0.0], max_rotation_deg=30.0) == ""
            sentence = "6 of 8 rods match within 30 degrees of nominal_orientation, but 8"
            refused = bench.refusal(image, "contradicted", sentence)
            assert bench.set(nominal_orientation=[0.0, 0.0, 0.0, 1.0], max_rotation_deg=40.0) == ""
            stamp = bench.send(image)
            assert_near(bench.pose(stamp), true)
            assert bench.status(stamp).level == DiagnosticStatus.OK
            bench.assert_no_pose_of(refused)


def test_without_frame_and_spacing_the_node_waits_for_them(client, tmp_path):
    broken = tmp_path / "broken.yaml"
    broken.write_text("name: [\n")
    hu, slice_from_frame = rendered(15)
    with node_process("register_node", "--ros-args", "-r", "__ns:=/bare", "-p", f"frame_file:={broken}") as process:
        bench = Bench(client, "/bare", "/bare/image")
        bench.warm_up(bench.diagnostics)
        without_frame = bench.refusal(image_of(hu), "bad_frame", str(broken))
        assert str(broken) in process.output
        assert bench.set(frame_file="cube6") == ""
        without_spacing = bench.refusal(
            image_of(hu),
            "bad_image",
            "pixel_spacing is not set, and the slice came without slice_spacing: set the parameter",
        )
        assert not bench.call("recalibrate").success
        assert not bench.call("reset_calibration").success
        assert bench.set(pixel_spacing=[SCALE.sx, SCALE.sy]) == ""
        assert_near(bench.accept(image_of(hu))[0], slice_from_frame)
        bench.assert_no_pose_of(without_frame, without_spacing)


@pytest.mark.parametrize("with_signal", [signal.SIGTERM, signal.SIGINT])
def test_parameter_file_namespace_remapping_and_clean_end(client, tmp_path, with_signal):
    content = yaml.safe_load((REPOSITORY / "config" / "register_node.yaml").read_text())
    told = content["/**/register_node"]["ros__parameters"]
    told["pixel_spacing"] = [SCALE.sx, SCALE.sy]
    told["scanner_frame_id"] = "from_the_file"
    path = tmp_path / "register_node.yaml"
    path.write_text(yaml.safe_dump(content))
    namespace = f"/robot_{with_signal.name.lower()}"
    arguments = ["-r", f"__ns:={namespace}", "-r", "image:=/ct/slices", "--params-file", str(path)]
    with node_process("register_node", "--ros-args", *arguments) as process:
        bench = Bench(client, namespace, "/ct/slices", "from_the_file")
        bench.warm_up()
        hu, slice_from_frame = rendered(16)
        stamp = bench.send(image_of(hu))
        assert_near(bench.pose(stamp), slice_from_frame)
        assert of_stamp(bench.poses, stamp).header.frame_id == "from_the_file"
        # Within the few seconds that it is waited for: a wait without an end would sleep through a signal.
        code, _ = process.stop(with_signal)
        assert code == 0
        assert "Traceback" not in process.output


def slice_pose_of(pose: Pose, stamp: Time) -> PoseStamped:
    message = PoseStamped(pose=conversions.pose_to_message(pose))
    message.header.stamp, message.header.frame_id = stamp, "ct"
    return message


def test_slice_pose(client):
    hu, slice_from_frame = rendered(17)
    scanner_from_slice = Pose(rotation_exp(np.array([0.3, -0.2, 0.5])), np.array([100.0, -50.0, 25.0]))
    expected = scanner_from_slice @ slice_from_frame
    arguments = ["-r", "__ns:=/posed", "-p", f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]"]
    with node_process("register_node", "--ros-args", *arguments):
        bench = Bench(client, "/posed", "/posed/image")
        bench.warm_up()
        topic = "/posed/slice_pose"

        stamp = bench.next_stamp()
        client.publish(topic, slice_pose_of(scanner_from_slice, stamp))
        assert_near(bench.accept(image_of(hu), stamp=stamp)[0], expected)

        # The image first: it waits for its pose.
        stamp = bench.send(image_of(hu))
        client.publish(topic, slice_pose_of(scanner_from_slice, stamp))
        assert_near(bench.pose(stamp), expected)

        late = bench.next_stamp()
        client.publish(topic, slice_pose_of(scanner_from_slice, late))
        refused = [bench.refusal(image_of(hu), "bad_image", "no slice_pose with the image's stamp came within 4 s")]

        stamp = bench.next_stamp()
        broken = slice_pose_of(scanner_from_slice, stamp)
        broken.pose.orientation = Quaternion(x=0.0, y=0.0, z=0.0, w=0.5)
        client.publish(topic, broken)
        refused.append(bench.refusal(image_of(hu), "bad_image", "slice_pose: pose.orientation", stamp=stamp))

        stamp = bench.next_stamp()
        broken = slice_pose_of(scanner_from_slice, stamp)
        broken.pose.position = Point(x=math.nan)
        client.publish(topic, broken)
        refused.append(bench.refusal(image_of(hu), "bad_image", "slice_pose: pose.position", stamp=stamp))

        stamp = bench.next_stamp()
        client.publish(topic, slice_pose_of(scanner_from_slice, stamp))
        client.publish(topic, slice_pose_of(Pose.identity(), stamp))
        # Topics overtake each other; when another slice has met its pose, both of these poses have come.
        last = bench.send(image_of(hu))
        client.publish(topic, slice_pose_of(scanner_from_slice, last))
        assert_near(bench.pose(last), expected)
        refused.append(bench.refusal(image_of(hu), "bad_image", "two different slice_pose", stamp=stamp))

        assert_near(bench.accept(image_of(hu), stamp=late)[0], expected)
        bench.assert_no_pose_of(*refused)

        # Without publisher the pose is still missed: the scanner's axes do not change in the middle.
        client.unpublish(topic)
        unposed = bench.refusal(image_of(hu), "bad_image", "no slice_pose with the image's stamp")

        def accepted_again() -> bool:
            stamp = bench.next_stamp()
            client.publish(topic, slice_pose_of(scanner_from_slice, stamp))
            return values_of(bench.status(bench.send(image_of(hu), stamp=stamp)))["outcome"] == "accepted"

        # The first words of a new publisher may go astray.
        client.wait_for(accepted_again, "a pose once slice poses come again")
        bench.assert_no_pose_of(unposed)


def test_start_values_that_cannot_be_end_the_node_with_a_sentence(tmp_path):
    file = tmp_path / "broken.yaml"
    file.write_text("register_node: [")
    faults = {
        ("-p", "threshold:=1e9"): "threshold out of range",
        ("-p", "threshold:=loud"): "threshold is 'loud', expected a number from -32768 to 65535, or 'auto'",
        ("-p", "spot_noise_px:=1"): "expecting type 'DOUBLE'",
        ("-p", "pixel_spacing:=[-1.0, 1.0]"): "pixel_spacing is [-1.0, 1.0], expected two positive numbers",
        ("-p", "matcher:=guess"): "matcher is 'guess', expected one of",
        ("--params-file", str(file)): "Couldn't parse params file",
    }
    processes = {fault: NodeProcess("register_node", "--ros-args", *fault) for fault in faults}
    try:
        for fault, process in processes.items():
            assert process.wait() == 1, process.output
            assert "cannot start: " in process.output
            assert faults[fault] in process.output
            assert "Traceback" not in process.output
    finally:
        for process in processes.values():
            process.close()


def test_malformed_parameter_request_leaves_the_node_alive(bench):
    unknown_type = ParameterMessage(name="threshold", value=ParameterValue(type=99))
    # By a client that was answered before: the first request of another may come after the slice.
    assert bench.set(threshold=2000.0) == ""
    requests = bench.client.client_of(SetParametersAtomically, f"{bench.node}/set_parameters_atomically")
    requests.call_async(SetParametersAtomically.Request(parameters=[unknown_type]))
    hu, slice_from_frame = rendered(18)
    assert_near(bench.accept(image_of(hu))[0], slice_from_frame)


def test_a_parameter_cannot_be_taken_away(bench):
    for name in ("frame_files", "threshold"):
        taken_away = [ParameterMessage(name=name, value=ParameterValue(type=ParameterType.PARAMETER_NOT_SET))]
        request = SetParametersAtomically.Request(parameters=taken_away)
        result = bench.client.call(SetParametersAtomically, f"{bench.node}/set_parameters_atomically", request).result
        assert not result.successful
        assert result.reason == f"{name} is not set, expected a value"
    assert bench.set(threshold=2000.0) == ""


def test_internal_error_is_refused_and_reported(monkeypatch, capfd):
    def broken(*_: object) -> None:
        raise RuntimeError("out of luck")

    monkeypatch.setattr(slice_registration, "register_frames", broken)
    published: list[DiagnosticStatus] = []
    at_once = SimpleNamespace(is_free=True, submit=lambda work, then: then(work()), close=lambda: None)
    with node_here(register_node.RegisterNode) as node:
        monkeypatch.setattr(node, "_publish_statuses", lambda statuses, _header: published.extend(statuses))
        monkeypatch.setattr(node, "_worker", at_once)
        monkeypatch.setattr(node, "_prepare_tables", lambda *_: None)
        node._begin(IncomingSlice(image_of(rendered(19)[0]), time.monotonic(), SCALE))
    (status,) = published
    assert values_of(status)["reason"] == "internal_error"
    assert status.message.startswith("internal error: RuntimeError: out of luck; please report it")
    assert "Traceback" in capfd.readouterr().err
