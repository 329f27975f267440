"""Tables filled beforehand: a stream's first slice without the frame waits for none."""

from __future__ import annotations

import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, load_frame, register_slice
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.matching import by_levels
from stereoreg_ros.registration import prepare
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice
from stereoreg_ros.solvers import three_rods

FRAME, SCANNER = load_frame("cube6"), ScannerSettings(false_spots=24)


@pytest.fixture
def no_tables():
    by_levels._solver.cache_clear()
    yield
    by_levels._solver.cache_clear()


def assert_no_slice_waits_for_a_table(monkeypatch, frame: Frame, options: RegistrationOptions) -> None:
    rng = np.random.default_rng(0)
    there = PlacedFrame(frame, random_pose(rng, frame, SCANNER))
    with_frame, without_frame = (render_slice(placed, SCANNER, rng) for placed in ([there], []))

    def missed(*_: object) -> None:
        raise AssertionError("a table was not prepared")

    monkeypatch.setattr(three_rods._Table, "of", missed)
    seen = register_slice(with_frame, frame, options)
    assert seen
    gone = register_slice(without_frame, frame, options, previous=seen.scanner_from_frame)
    assert not gone
    assert gone.reason == "no_consensus"


# Of less noise than that, it is the image that says how well a spot is known.
@pytest.mark.parametrize("noise_px", [0.3, 0.45])
def test_once_prepared_no_slice_waits_for_a_table(no_tables, monkeypatch, noise_px):
    options = RegistrationOptions(spot_noise_px=noise_px)
    prepare(FRAME, SCANNER.scale, options)
    assert_no_slice_waits_for_a_table(monkeypatch, FRAME, options)


def test_the_node_goes_on_preparing_while_no_slice_comes(no_tables, monkeypatch):
    rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not there")

    from stereoreg_ros.nodes.register import register_node
    from support.ros_process import node_here

    monkeypatch.setattr(register_node, "_PREPARE_AT_START_S", 0.0)
    monkeypatch.setattr(register_node, "_PREPARE_AT_ONCE_S", 0.0)
    with node_here(register_node.RegisterNode) as node:
        few = by_levels._solver.cache_info().currsize
        for _ in range(10000):
            if node._preparation is None:
                break
            rclpy.spin_once(node, timeout_sec=0.1)
        (output,) = node._outputs
    assert few < by_levels._solver.cache_info().currsize
    # Tables are of one frame, as it was loaded.
    assert_no_slice_waits_for_a_table(monkeypatch, output.frame, RegistrationOptions())
