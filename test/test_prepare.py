"""Tables filled beforehand: a stream's first slice without the frame waits for none."""

from __future__ import annotations

import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, load_frame, register_slice
from stereoreg_ros.matching import three_line
from stereoreg_ros.registration import prepare
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice
from stereoreg_ros.solvers import three_lines

FRAME, SCANNER = load_frame("cube6"), ScannerSettings(false_spots=24)


@pytest.fixture
def no_tables():
    three_line._solver.cache_clear()
    yield
    three_line._solver.cache_clear()


# Of less noise than that, it is the image that says how well a spot is known.
@pytest.mark.parametrize("noise_px", [0.3, 0.45])
def test_after_prepare_no_slice_waits_for_a_table(no_tables, monkeypatch, noise_px):
    options, rng = RegistrationOptions(spot_noise_px=noise_px), np.random.default_rng(0)
    there = PlacedFrame(FRAME, random_pose(rng, FRAME, SCANNER))
    with_frame, without_frame = (render_slice(placed, SCANNER, rng) for placed in ([there], []))
    prepare(FRAME, SCANNER.scale, options)

    def missed(*_: object) -> None:
        raise AssertionError("a table was not prepared")

    monkeypatch.setattr(three_lines._Table, "of", missed)
    seen = register_slice(with_frame, FRAME, options)
    assert seen
    gone = register_slice(without_frame, FRAME, options, previous=seen.scanner_from_frame)
    assert not gone
    assert gone.reason == "no_consensus"
