"""Tables filled beforehand: a stream's first slice without the frame waits for none."""

from __future__ import annotations

import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, load_frame, register_frames, register_slice, registration
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.registration import Registrar, prepare
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice
from stereoreg_ros.solvers import distance_table

FRAME, SCANNER = load_frame("cube6"), ScannerSettings(false_spots=24)


@pytest.fixture
def no_tables():
    registration._kept.cache_clear()
    yield
    registration._kept.cache_clear()


def assert_no_slice_waits_for_a_table(monkeypatch, frame: Frame | Registrar, options: RegistrationOptions) -> None:
    rng = np.random.default_rng(0)
    there = PlacedFrame(FRAME, random_pose(rng, FRAME, SCANNER))
    with_frame, without_frame = (render_slice(placed, SCANNER, rng) for placed in ([there], []))

    def missed(*_: object) -> None:
        raise AssertionError("a table was not prepared")

    monkeypatch.setattr(distance_table.DistanceTable, "of", missed)
    (seen,) = register_frames(with_frame, [frame], options)
    assert seen
    (gone,) = register_frames(without_frame, [frame], options, previous=[seen.scanner_from_frame])
    assert not gone
    assert gone.reason == "no_consensus"


# Of less noise than that, it is the image that says how well a spot is known.
@pytest.mark.parametrize("noise_px", [0.3, 0.45])
def test_once_prepared_no_slice_waits_for_a_table(no_tables, monkeypatch, noise_px):
    options = RegistrationOptions(spot_noise_px=noise_px)
    prepare(FRAME, SCANNER.scale, options)
    # Nor where the frame is loaded anew.
    assert_no_slice_waits_for_a_table(monkeypatch, load_frame("cube6"), options)


def test_a_registrar_has_tables_of_its_own(no_tables, monkeypatch):
    registrar = Registrar(FRAME)
    for _ in registrar.preparation(SCANNER.scale):
        pass
    assert_no_slice_waits_for_a_table(monkeypatch, registrar, RegistrationOptions())
    assert registration._kept.cache_info().currsize == 0
    rng = np.random.default_rng(0)
    ct_slice = render_slice([PlacedFrame(FRAME, random_pose(rng, FRAME, SCANNER))], SCANNER, rng)
    with pytest.raises(AssertionError, match="a table was not prepared"):
        register_slice(ct_slice, FRAME)


def test_the_tables_of_a_few_frames_are_kept(no_tables):
    others = [Frame(str(k), FRAME.line_names, FRAME.starts, FRAME.ends, FRAME.diameters) for k in range(10)]
    for frame in others:
        registration._kept(frame)
    kept = registration._kept.cache_info()
    assert kept.maxsize is not None
    assert kept.currsize == kept.maxsize < 10
    assert registration._kept(others[-1]) is registration._kept(others[-1])


def test_the_node_goes_on_preparing_while_no_slice_comes(no_tables, monkeypatch):
    rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not there")

    from stereoreg_ros.nodes.register import register_node
    from support.ros_process import node_here

    monkeypatch.setattr(register_node, "_PREPARE_AT_START_S", 0.0)
    monkeypatch.setattr(register_node, "_SPARE_TIME_S", 0.001)
    with node_here(register_node.RegisterNode) as node:
        (output,) = node._outputs
        tables = output.registrar._matchers.by_levels.tables
        few = len(tables)
        for _ in range(10000):
            if node._preparation is None:
                break
            rclpy.spin_once(node, timeout_sec=0.1)
    assert few < len(tables)
    assert_no_slice_waits_for_a_table(monkeypatch, output.registrar, RegistrationOptions())
