"""Which scale the node's keeper uses for which slices, without DDS: a node and its settings stand in by hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from rcl_interfaces.msg import SetParametersResult

from stereoreg_ros import PixelScale, load_frame
from stereoreg_ros.calibration.calibrate import Calibration
from stereoreg_ros.calibration.file import CalibrationRecord, load_calibration, save_calibration
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.nodes.register.scale_keeper import ScaleKeeper
from stereoreg_ros.options import CalibrationOptions

CONFIGURED = PixelScale(0.4, 0.6, 0.01)
MEASURED = PixelScale(0.402, 0.598, 0.011)
COVARIANCE = ((1e-7, 2e-8, 0.0), (2e-8, 4e-7, 1e-8), (0.0, 1e-8, 9e-8))
OTHER = PixelScale(0.6, 0.4, 0.01)  # the same numbers, but another scale
FRAME = load_frame("cube6")


class Stand:
    """What the keeper asks of the node, and the parameters that it sets."""

    def __init__(self, scale: PixelScale | None, calibration_file: str = "") -> None:
        self.settings = SimpleNamespace(
            scale=scale, calibration=CalibrationOptions(), calibration_file=calibration_file
        )
        self.warnings: list[str] = []
        self.refuses = ""
        self.changes = 0
        self.keeper = ScaleKeeper(cast("Any", self), cast("Any", self))

    def get_logger(self) -> Any:
        return SimpleNamespace(info=lambda _text: None, warning=self.warnings.append)

    def set_parameters_atomically(self, parameters: list[Any]) -> SetParametersResult:
        if self.refuses:
            return SetParametersResult(successful=False, reason=self.refuses)
        values = {parameter.name: parameter.value for parameter in parameters}
        sx, sy = values["pixel_spacing"]
        self.settings.scale = PixelScale(sx, sy, values["pixel_shear"])
        assert self.keeper.sets_it_itself, "the keeper's own change is no configuration"
        return SetParametersResult(successful=True)

    def scale_changed(self) -> None:
        self.changes += 1

    def configure(self, scale: PixelScale) -> None:
        """As somebody sets the parameters."""
        assert not self.keeper.sets_it_itself
        self.settings.scale = scale
        self.keeper.configure()

    def in_use(self, stated: PixelScale | None = None) -> tuple[PixelScale, str] | None:
        used = self.keeper.scale_for(stated)
        assert used is None or (used.covariance is not None) == (used.source == "measured")
        return None if used is None else (used.scale, used.source)


def saved(path: Path) -> str:
    """A file with what was measured in place of the configured scale."""
    save_calibration(path, CalibrationRecord(MEASURED, CONFIGURED, COVARIANCE, "cube6", 10, 60, "2026-01-01", "test"))
    return str(path)


def sighting(number: float = 0.0, stated: PixelScale | None = None) -> SliceSpots:
    return SliceSpots(np.full((4, 2), number), CONFIGURED, stated_scale=stated)


def calibration(scale: PixelScale = MEASURED) -> Calibration:
    return Calibration(
        scale, CONFIGURED, (1e-4, 1e-4, 1e-4), np.array(COVARIANCE), (0.0, 0.0), 3, 18, 0.2, 0.1, (), "measured"
    )


def test_a_slice_is_registered_with_the_scale_that_it_states_and_an_image_without_with_the_configured_one() -> None:
    stand = Stand(CONFIGURED)
    assert stand.in_use() == (CONFIGURED, "configured")
    assert stand.in_use(OTHER) == (OTHER, "configured")
    assert Stand(None).in_use() is None
    assert Stand(None).in_use(OTHER) == (OTHER, "configured")


@pytest.mark.parametrize("number", range(3), ids=["sx", "sy", "shear"])
def test_a_measured_scale_replaces_the_one_that_it_was_measured_for_and_no_other(tmp_path: Path, number: int) -> None:
    stand = Stand(None, saved(tmp_path / "scale.yaml"))
    stand.keeper.load()
    # The parameters serve images without a spacing, and nobody has set them.
    assert stand.settings.scale is None
    assert stand.in_use() is None
    assert stand.in_use(CONFIGURED) == (MEASURED, "measured")
    assert stand.in_use(MEASURED) == (MEASURED, "configured")
    for off in (1e-5, -1e-5):
        numbers = [CONFIGURED.sx, CONFIGURED.sy, CONFIGURED.shear]
        numbers[number] += off
        assert stand.in_use(PixelScale(*numbers)) == (PixelScale(*numbers), "configured")


def test_configured_and_measured_and_gone_back_on(tmp_path: Path) -> None:
    path = tmp_path / "scale.yaml"
    stand = Stand(CONFIGURED, saved(path))
    keeper = stand.keeper
    keeper.load()
    # Whoever watches the parameter sees the measured scale.
    assert stand.settings.scale == MEASURED
    assert keeper.configured == CONFIGURED
    assert stand.in_use() == (MEASURED, "measured")
    np.testing.assert_array_equal(cast("Any", keeper.scale_for(None)).covariance, COVARIANCE)

    stand.configure(OTHER)
    assert (stand.settings.scale, keeper.configured) == (OTHER, OTHER)
    assert stand.in_use() == (OTHER, "configured")
    assert "measured in place of the pixel_spacing [0.4, 0.6], which is [0.6, 0.4]" in stand.warnings[-1]
    # Slices that state what it was measured for are registered with it all the same.
    assert stand.in_use(CONFIGURED) == (MEASURED, "measured")
    stand.configure(CONFIGURED)
    assert stand.settings.scale == MEASURED
    assert stand.in_use() == (MEASURED, "measured")

    assert keeper.reset() == (True, "pixel_spacing is the configured one, [0.4, 0.6] mm/pixel")
    assert stand.settings.scale == CONFIGURED
    assert stand.in_use() == stand.in_use(CONFIGURED) == (CONFIGURED, "configured")
    assert not path.exists()


def test_measured_from_slices_that_state_their_scale(tmp_path: Path) -> None:
    path = tmp_path / "scale.yaml"
    stand = Stand(OTHER, str(path))
    keeper = stand.keeper
    keeper.add(sighting(stated=CONFIGURED))
    assert cast("Any", keeper.to_measure).scale == CONFIGURED
    assert keeper.take(calibration(), FRAME) == (True, "measured")
    assert stand.in_use(CONFIGURED) == (MEASURED, "measured")
    assert stand.in_use(OTHER) == (OTHER, "configured")
    # An image without a spacing is taken to be of the scanner that was measured.
    assert (stand.settings.scale, stand.in_use()) == (MEASURED, (MEASURED, "measured"))
    record = load_calibration(path)
    assert record is not None
    assert (record.scale, record.configured) == (MEASURED, CONFIGURED)
    assert keeper.reset()[0]
    assert (stand.settings.scale, stand.in_use()) == (CONFIGURED, (CONFIGURED, "configured"))


def test_measured_from_images_without_a_spacing_and_measured_again() -> None:
    stand = Stand(CONFIGURED)
    keeper = stand.keeper
    keeper.add(sighting())
    assert keeper.take(calibration(), FRAME) == (True, "measured")
    assert (stand.settings.scale, stand.in_use()) == (MEASURED, (MEASURED, "measured"))
    again = PixelScale(0.403, 0.597, 0.012)
    assert cast("Any", keeper.to_measure).scale == MEASURED
    assert keeper.take(calibration(again), FRAME) == (True, "measured")
    # It stands for the configured one still, not for the first that was measured.
    assert stand.in_use(CONFIGURED) == (again, "measured")
    assert keeper.configured == CONFIGURED


def test_set_anew_by_hand_what_was_measured_and_not_kept_in_a_file_is_forgotten() -> None:
    stand = Stand(CONFIGURED)
    stand.keeper.add(sighting())
    assert stand.keeper.take(calibration(), FRAME)[0]
    stand.configure(CONFIGURED)
    assert stand.in_use() == (CONFIGURED, "configured")


def test_a_measured_scale_that_cannot_be_set_is_not_used(tmp_path: Path) -> None:
    stand = Stand(CONFIGURED, saved(tmp_path / "scale.yaml"))
    stand.refuses = "no"
    stand.keeper.load()
    assert stand.in_use() == (CONFIGURED, "configured")
    assert stand.warnings[-1].endswith("scale.yaml: no")
    stand.keeper.add(sighting())
    assert stand.keeper.take(calibration(), FRAME) == (False, "the measured scale cannot be set: no")
    assert stand.in_use() == (CONFIGURED, "configured")


def test_going_back_where_nothing_was_configured_is_a_change_that_no_parameter_shows(tmp_path: Path) -> None:
    stand = Stand(None, saved(tmp_path / "scale.yaml"))
    stand.keeper.load()
    assert (stand.in_use(CONFIGURED), stand.changes) == ((MEASURED, "measured"), 0)
    assert stand.keeper.reset() == (True, "slices are registered with the pixel spacing that they state")
    assert (stand.in_use(CONFIGURED), stand.changes) == ((CONFIGURED, "configured"), 1)
    assert stand.settings.scale is None


def test_nothing_to_go_back_to() -> None:
    assert Stand(None).keeper.reset() == (False, "pixel_spacing has not been configured, nothing to go back to")


def test_the_last_slices_are_kept_however_many_they_may_be() -> None:
    keeper = Stand(CONFIGURED).keeper
    slices = [sighting(float(k)) for k in range(13)]
    for one in slices[:12]:
        keeper.add(one)
    assert list(keeper.sightings) == slices[2:12]  # ten by default
    keeper.keep_slices(3)
    assert list(keeper.sightings) == slices[9:12]
    keeper.add(slices[12])
    assert list(keeper.sightings) == slices[10:]


def test_slices_of_another_scale_are_not_measured_with_those_before() -> None:
    keeper = Stand(CONFIGURED).keeper
    two, three = (sighting(float(k), OTHER) for k in (2, 3))
    keeper.add(sighting())
    keeper.add(two)
    assert list(keeper.sightings) == [two]
    assert cast("Any", keeper.to_measure).scale == OTHER
    keeper.add(three)
    assert list(keeper.sightings) == [two, three]
