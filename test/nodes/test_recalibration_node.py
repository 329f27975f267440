"""`~/recalibrate` over DDS: from a wrong spacing, while slices stream in, and over a restart."""

from __future__ import annotations

import re
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from std_srvs.srv import Trigger

from stereoreg_ros import PixelScale, Pose, register_slice
from stereoreg_ros.calibration.file import CalibrationRecord, load_calibration, save_calibration
from stereoreg_ros.geometry.pose import rotation_exp
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.nodes.common.conversions import covariance_to_message, pose_to_message
from stereoreg_ros.simulation import PlacedFrame, centred_pose, random_pose, render_slice
from support.register_bench import (
    CUBE,
    OTHER,
    SCALE,
    SCANNER,
    Bench,
    SpacedBench,
    assert_near,
    image_of,
    of_stamp,
    rendered,
    values_of,
)
from support.ros_process import RosClient, node_process

SLICES = [rendered(seed, noise_hu=5.0) for seed in range(40, 46)]
LARGER = 1.03
# Of a measured scale, (mm/pixel)^2; no two alike.
MEASURED_COVARIANCE = ((9e-7, -4e-7, 1e-7), (-4e-7, 25e-7, 2e-7), (1e-7, 2e-7, 4e-7))
MEASURED_ON = "2026-01-01T00:00:00+00:00"


def arguments(namespace: str, spacing: tuple[float, float], *more: str) -> list[str]:
    told = ["-p", f"pixel_spacing:=[{spacing[0]},{spacing[1]}]"]
    return ["--ros-args", "-r", f"__ns:={namespace}", *told, *[part for one in more for part in ("-p", one)]]


def clutter_of(rng: np.random.Generator) -> np.ndarray:
    """A slice of false spots."""
    hu = np.zeros_like(SLICES[0][0])
    for u, v in rng.integers(5, 250, (14, 2)):
        hu[v - 1 : v + 2, u - 1 : u + 2] = 3000
    return hu


def of_a_larger_frame(seed: int) -> np.ndarray:
    """A slice of a frame that is built 3 % larger than its file says."""
    rng = np.random.default_rng(seed)
    frame = replace(CUBE, starts=LARGER * CUBE.starts, ends=LARGER * CUBE.ends)
    pose = random_pose(rng, frame, SCANNER, max_offset_mm=15.0)
    return render_slice([PlacedFrame(frame, pose)], replace(SCANNER, noise_hu=5.0), rng).hu


def wait_until_spacing_is_heard(bench: SpacedBench) -> None:
    """Until the node is known to pair images with the spacing that comes with them."""

    def heard() -> bool:
        values = values_of(bench.status(bench.send_spaced(SLICES[0][0], OTHER)))
        return float(values["pixel_spacing_x_mm"]) == pytest.approx(OTHER.sx)

    bench.client.announce(f"{bench.namespace}/slice_spacing", Vector3Stamped)
    bench.client.wait_for(heard, "a slice to be registered with its own spacing")


def forget_slices(bench: Bench) -> None:
    """Have the node forget the slices that it was warmed up with."""
    assert bench.set(pixel_spacing=[1.1 * SCALE.sx, SCALE.sy]) == ""
    assert bench.set(pixel_spacing=[SCALE.sx, SCALE.sy]) == ""


def recalibrate(bench: Bench) -> Trigger.Response:
    return bench.client.call(Trigger, f"{bench.node}/recalibrate", deadline_s=90.0, again_after_s=None)


def published_covariance(bench: Bench, hu: np.ndarray) -> np.ndarray:
    """The covariance (6, 6) in m and rad that is published for a slice, which must be accepted."""
    stamp = bench.send(image_of(hu))
    bench.pose(stamp)
    message = bench.client.wait_for(lambda: of_stamp(bench.with_covariance, stamp), "the pose with its covariance")
    return np.reshape(message.pose.covariance, (6, 6))


def covariance_of(hu: np.ndarray, scale: PixelScale, scale_covariance: np.ndarray | None) -> np.ndarray:
    """What it has to be where the scale was measured with such errors, or is known."""
    result = register_slice(Slice(hu, scale), CUBE, scale_covariance=scale_covariance)
    assert result, result.message
    return np.reshape(covariance_to_message(result.covariance), (6, 6))


def assert_alike(found: np.ndarray, expected: np.ndarray) -> None:
    """Covariances that are the same, to a thousandth of the variances."""
    stds = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(stds, stds), expected / np.outer(stds, stds), atol=1e-3)


def wait_until_running(bench: Bench) -> None:
    """Until the node has taken up a call of `recalibrate`: requests of several clients come in any order."""

    def running() -> bool:
        return "running" in bench.client.call(Trigger, f"{bench.node}/reset_calibration").message

    bench.client.wait_for(running, "the recalibration to run")


@pytest.fixture
def client():
    with RosClient("console") as console:
        yield console


@pytest.mark.parametrize("factors", [(1.08, 0.94), (0.9, 1.1)])
def test_from_a_wrong_spacing(client, factors):
    """No slice is accepted before, all are after; the last refused ones are what it is measured from."""
    wrong = (factors[0] * SCALE.sx, factors[1] * SCALE.sy)
    namespace = f"/wrong{int(100 * factors[0])}"
    with node_process("register_node", *arguments(namespace, wrong)):
        bench = Bench(client, namespace, f"{namespace}/image")
        bench.warm_up(bench.diagnostics)
        for hu, _ in SLICES:
            bench.status(bench.send(image_of(hu)))
        response = recalibrate(bench)
        assert response.success, response.message
        (measured,) = client.get_parameters(bench.node, "pixel_spacing")
        np.testing.assert_allclose(measured, [SCALE.sx, SCALE.sy], rtol=3e-3)
        for hu, slice_from_frame in SLICES:
            pose, values = bench.accept(image_of(hu))
            assert_near(pose, slice_from_frame)
            assert values["calibration"] == "measured"


def test_spacing_that_came_with_the_slices_is_not_made_to_fit_the_frame(client):
    """A frame 3 % larger than its file: either the scanner is off, or the file; the scanner hardly ever is."""
    with node_process("register_node", *arguments("/stated", (SCALE.sx, SCALE.sy), "calibration_timeout:=0.0")):
        bench = SpacedBench(client, "/stated", "/stated/image")
        bench.warm_up(bench.diagnostics)
        wait_until_spacing_is_heard(bench)
        forget_slices(bench)
        for seed in range(4):
            bench.status(bench.send_spaced(of_a_larger_frame(seed), SCALE))
        response = recalibrate(bench)
        assert not response.success
        assert "scanner, or frame file?" in response.message
        assert "came with the slices is (0.5000, 0.6000) mm/pixel, the one measured is (0.48" in response.message
        assert re.search(r"would have to be (2\.[5-9]|3\.[0-5]) % larger than its file says", response.message)
        assert "cannot distinguish the scale from the size of the frame" in response.message
        assert list(client.get_parameters(bench.node, "pixel_spacing")[0]) == [SCALE.sx, SCALE.sy]

        # On purpose it may be changed; the slices are still there.
        assert bench.set(calibration_max_change=0.15) == ""
        response = recalibrate(bench)
        assert response.success, response.message
        assert "cannot distinguish the scale from the size of the frame" in response.message
        (measured,) = client.get_parameters(bench.node, "pixel_spacing")
        np.testing.assert_allclose(measured, [SCALE.sx / LARGER, SCALE.sy / LARGER], rtol=5e-3)


def test_spacing_that_was_typed_in_is(client):
    """The same slices without their spacing."""
    with node_process("register_node", *arguments("/typed", (SCALE.sx, SCALE.sy))):
        bench = Bench(client, "/typed", "/typed/image")
        bench.warm_up(bench.diagnostics)
        forget_slices(bench)
        for seed in range(4):
            bench.status(bench.send(image_of(of_a_larger_frame(seed))))
        response = recalibrate(bench)
        assert response.success, response.message
        assert "cannot distinguish the scale from the size of the frame" in response.message
        assert re.search(r"would have to be (2\.[5-9]|3\.[0-5]) % larger than its file says", response.message)


def test_the_largest_change_is_a_number_or_left_to_the_node(client):
    with node_process("register_node", *arguments("/limit", (SCALE.sx, SCALE.sy), "calibration_max_change:=0.03")):
        bench = Bench(client, "/limit", "/limit/image")
        assert client.get_parameters(bench.node, "calibration_max_change") == [0.03]
        assert bench.set(calibration_max_change="auto") == ""
        assert client.get_parameters(bench.node, "calibration_max_change") == ["auto"]
        assert "expected a number from 0.001 to 0.5, or 'auto'" in bench.set(calibration_max_change="any")
        assert "out of range Min: 0.001, Max: 0.5" in bench.set(calibration_max_change=0.9)
        (descriptor,) = client.describe_parameters(bench.node, "calibration_max_change")
        assert descriptor.dynamic_typing  # its type is that of what somebody last tried to set
        assert "came with the slices" in descriptor.description


def test_slices_are_registered_meanwhile_and_a_second_call_is_refused(client):
    """Clutter alone keeps it searching: that takes seconds, and is waited for by nobody else."""
    rng = np.random.default_rng(1)
    hu, slice_from_frame = SLICES[0]
    with node_process("register_node", *arguments("/busy", (SCALE.sx, SCALE.sy), "calibration_timeout:=60.0")):
        bench = Bench(client, "/busy", "/busy/image")
        bench.warm_up()
        assert bench.set(pixel_spacing=[1.001 * SCALE.sx, SCALE.sy]) == ""  # forgets the slices of before
        bench.status(bench.send(image_of(clutter_of(rng))))
        service = client.node.create_client(Trigger, f"{bench.node}/recalibrate")
        client.wait_for(service.service_is_ready, "the service")
        first = service.call_async(Trigger.Request())
        wait_until_running(bench)
        second = client.call(Trigger, f"{bench.node}/recalibrate")
        assert not second.success
        assert "running already" in second.message
        assert "running" in client.call(Trigger, f"{bench.node}/reset_calibration").message
        assert not first.done(), first.result().message
        assert_near(bench.accept(image_of(hu))[0], slice_from_frame)
        for other, _ in SLICES[1:4]:
            bench.accept(image_of(other))
        # What has come meanwhile is enough.
        client.wait_for(first.done, "the answer", deadline_s=90.0)
        assert first.result().success, first.result().message
        client.node.destroy_client(service)


def test_a_search_does_not_keep_the_node_from_ending(client):
    rng = np.random.default_rng(2)
    with node_process("register_node", *arguments("/ends", (SCALE.sx, SCALE.sy))) as process:
        bench = Bench(client, "/ends", "/ends/image")
        bench.warm_up()
        assert bench.set(pixel_spacing=[1.001 * SCALE.sx, SCALE.sy]) == ""  # forgets the slices of before
        bench.status(bench.send(image_of(clutter_of(rng))))
        service = client.node.create_client(Trigger, f"{bench.node}/recalibrate")
        client.wait_for(service.service_is_ready, "the service")
        first = service.call_async(Trigger.Request())
        wait_until_running(bench)
        assert not first.done()
        code, seconds = process.stop(signal.SIGTERM)
        assert code == 0
        assert seconds < 3.0, process.output
        client.node.destroy_client(service)


def test_the_measured_spacing_outlives_the_node(client, tmp_path: Path):
    path = tmp_path / "scale.yaml"
    configured = (1.01 * SCALE.sx, 0.99 * SCALE.sy)
    told = arguments("/kept", configured, f"calibration_file:={path}")
    with node_process("register_node", *told) as process:
        bench = Bench(client, "/kept", "/kept/image")
        bench.warm_up(bench.diagnostics)
        for hu, _ in SLICES[:3]:
            bench.status(bench.send(image_of(hu)))
        # Twice: what was measured in place of the configured one stands for that, not for the one measured before.
        for _ in range(2):
            response = recalibrate(bench)
            assert response.success, response.message
        (measured,) = client.get_parameters(bench.node, "pixel_spacing")
        process.stop(signal.SIGKILL)
    with node_process("register_node", *told) as process:
        bench = Bench(client, "/kept", "/kept/image")
        bench.warm_up(bench.diagnostics)
        assert list(client.get_parameters(bench.node, "pixel_spacing")[0]) == list(measured)
        assert bench.accept(image_of(SLICES[0][0]))[1]["calibration"] == "measured"
        assert client.call(Trigger, f"{bench.node}/reset_calibration").success
        assert list(client.get_parameters(bench.node, "pixel_spacing")[0]) == list(configured)
        assert not path.exists()


def test_the_published_covariance_holds_that_of_the_measured_scale(client, tmp_path: Path):
    """Measured, forgotten and measured once more: as uncertain as the scale in use is, each time."""
    path = tmp_path / "scale.yaml"
    configured = PixelScale(1.01 * SCALE.sx, 0.99 * SCALE.sy)
    covariance = np.array(MEASURED_COVARIANCE)
    save_calibration(
        path, CalibrationRecord(SCALE, configured, MEASURED_COVARIANCE, "cube6", 10, 60, MEASURED_ON, "test")
    )
    hu, _ = SLICES[0]
    with node_process(
        "register_node", *arguments("/unsure", (configured.sx, configured.sy), f"calibration_file:={path}")
    ):
        bench = Bench(client, "/unsure", "/unsure/image")
        bench.warm_up(bench.diagnostics, bench.with_covariance)
        expected = covariance_of(hu, SCALE, covariance)
        assert_alike(published_covariance(bench, hu), expected)
        # Told as it truly is, it is as sure as any that is configured.
        assert bench.set(pixel_spacing=[SCALE.sx, SCALE.sy]) == ""
        plain = covariance_of(hu, SCALE, None)
        assert expected[0, 0] > 1.2 * plain[0, 0]
        assert_alike(published_covariance(bench, hu), plain)
        for other, _ in SLICES[:2]:
            bench.status(bench.send(image_of(other)))
        response = recalibrate(bench)
        assert response.success, response.message
        record = load_calibration(path)
        assert record is not None
        assert len(record.covariance) == 2
        measured = covariance_of(hu, record.scale, np.array(record.covariance))
        assert measured[0, 0] > 1.05 * plain[0, 0]
        assert_alike(published_covariance(bench, hu), measured)
        assert client.call(Trigger, f"{bench.node}/reset_calibration").success
        assert_alike(published_covariance(bench, hu), plain)


def test_slices_of_before_a_change_are_not_measured_from(client):
    with node_process("register_node", *arguments("/before", (SCALE.sx, SCALE.sy), "calibration_timeout:=0.0")):
        bench = Bench(client, "/before", "/before/image")
        bench.warm_up(bench.diagnostics)
        changes = (
            {"pixel_spacing": [1.001 * SCALE.sx, SCALE.sy]},
            {"pixel_shear": 0.0005},
            {"frame_file": "cube5"},
        )
        for change in changes:
            for hu, _ in SLICES[:2]:
                bench.status(bench.send(image_of(hu)))
            assert bench.set(**change) == ""
            response = recalibrate(bench)
            assert not response.success
            assert response.message == "no slice has been accepted yet, nothing to calibrate from"
        # And those of afterwards are.
        assert bench.set(frame_file="cube6") == ""
        for hu, _ in SLICES[:2]:
            bench.status(bench.send(image_of(hu)))
        response = recalibrate(bench)
        assert response.success, response.message
        # What was set by the node itself is no change: the slices are still there.
        response = recalibrate(bench)
        assert response.success, response.message


def test_what_is_measured_is_not_set_where_frame_or_spacing_was_changed_meanwhile(client):
    """Called before there is a slice, it waits for slices; these come after the change."""
    with node_process("register_node", *arguments("/change", (SCALE.sx, SCALE.sy), "calibration_timeout:=60.0")):
        bench = Bench(client, "/change", "/change/image")
        bench.warm_up(bench.diagnostics)
        other = [1.004 * SCALE.sx, SCALE.sy]
        for change, told in (({"pixel_spacing": other}, other), ({"frame_file": "cube5"}, other)):
            forget_slices(bench)
            assert bench.set(pixel_spacing=other if "frame_file" in change else [SCALE.sx, SCALE.sy]) == ""
            service = client.node.create_client(Trigger, f"{bench.node}/recalibrate")
            client.wait_for(service.service_is_ready, "the service")
            answer = service.call_async(Trigger.Request())
            wait_until_running(bench)
            assert bench.set(**change) == ""
            for hu, _ in SLICES[:3]:
                bench.status(bench.send(image_of(hu)))
            client.wait_for(answer.done, "the answer", deadline_s=90.0)
            client.node.destroy_client(service)
            assert not answer.result().success
            assert "the frame or the pixel spacing was changed meanwhile" in answer.result().message
            assert list(client.get_parameters(bench.node, "pixel_spacing")[0]) == told
            assert values_of(bench.status(bench.send(image_of(SLICES[0][0]))))["calibration"] == "configured"


def test_how_the_frame_stands_in_a_tilted_gantry_is_said_of_the_scanner(client):
    """By 20 degrees, where the frame may be turned by 8: without its plane no slice could be measured from."""
    tilted = Pose(rotation_exp(np.array([np.radians(20.0), 0.0, 0.0])), np.array([0.0, 0.0, 100.0]))
    nominal = centred_pose(CUBE, SCANNER, rotation=tilted.rotation.T)
    rng = np.random.default_rng(8)
    slices = [
        render_slice(
            [PlacedFrame(CUBE, random_pose(rng, CUBE, SCANNER, max_tilt_deg=3.0, nominal=nominal))], SCANNER, rng
        )
        for _ in range(2)
    ]
    more = ("max_rotation_deg:=8.0", "slice_pose_required:=true", "calibration_timeout:=0.0")
    with node_process("register_node", *arguments("/gantry", (SCALE.sx, SCALE.sy), *more)):
        bench = Bench(client, "/gantry", "/gantry/image")
        bench.warm_up(bench.diagnostics)
        for one in slices:
            message = PoseStamped(pose=pose_to_message(tilted))
            message.header.frame_id, message.header.stamp = "ct", bench.next_stamp()
            client.publish("/gantry/slice_pose", message)
            stamp = bench.send(image_of(one.hu), stamp=message.header.stamp)
            assert values_of(bench.status(stamp))["outcome"] == "accepted"
        response = recalibrate(bench)
        assert response.success, response.message
        assert re.search(r"from 2 slices with 1[0-2] rods", response.message)


def test_a_broken_file_is_refused_and_the_configured_spacing_used(client, tmp_path: Path):
    """Whatever is wrong with it: test_calibration_file.py has the ways."""
    path, content = tmp_path / "scale.yaml", "not: [yaml"
    path.write_text(content)
    told = arguments("/broken", (SCALE.sx, SCALE.sy), f"calibration_file:={path}")
    with node_process("register_node", *told) as process:
        bench = Bench(client, "/broken", "/broken/image")
        bench.warm_up()
        hu, slice_from_frame = SLICES[0]
        pose, values = bench.accept(image_of(hu))
        assert_near(pose, slice_from_frame)
        assert values["calibration"] == "configured"
        assert f"calibration_file is not used, the configured pixel_spacing is: {path}" in process.output
    assert path.read_text() == content


def test_a_file_of_another_spacing_is_refused(client, tmp_path: Path):
    path = tmp_path / "scale.yaml"
    measured = CalibrationRecord(
        PixelScale(1.01 * SCALE.sx, SCALE.sy), SCALE, MEASURED_COVARIANCE, "cube6", 10, 60, MEASURED_ON, "test"
    )
    save_calibration(path, measured)
    other = arguments("/other", (1.3 * SCALE.sx, SCALE.sy), f"calibration_file:={path}")
    with node_process("register_node", *other) as process:
        bench = Bench(client, "/other", "/other/image")
        bench.warm_up(bench.diagnostics)
        (spacing,) = client.get_parameters(bench.node, "pixel_spacing")
        assert list(spacing) == [1.3 * SCALE.sx, SCALE.sy]
        assert "was measured in place of the pixel_spacing" in process.output
