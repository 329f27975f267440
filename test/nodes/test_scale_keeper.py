"""Which scale the node's keeper uses for which slices, without DDS: a node and its settings stand in by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from rcl_interfaces.msg import SetParametersResult
from std_srvs.srv import Trigger

from stereoreg_ros import PixelScale, RegistrationOptions
from stereoreg_ros.calibration.file import CalibrationRecord, save_calibration
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.nodes.register.scale_keeper import ScaleKeeper
from stereoreg_ros.options import CalibrationOptions

TOLD = PixelScale(0.4, 0.6, 0.01)
MEASURED = PixelScale(0.402, 0.598, 0.011)
COVARIANCE = ((1e-7, 2e-8, 0.0), (2e-8, 4e-7, 1e-8), (0.0, 1e-8, 9e-8))


class Stand:
    """What the keeper asks of the node, and the parameters that it sets."""

    frame = None

    def __init__(self, scale: PixelScale | None, calibration_file: str = "") -> None:
        self.settings = SimpleNamespace(
            scale=scale,
            options=RegistrationOptions(),
            calibration=CalibrationOptions(),
            calibration_file=calibration_file,
            calibration_timeout=0.0,
        )
        self.services: dict[str, Callable[..., Any]] = {}
        self.warnings: list[str] = []
        self.keeper = ScaleKeeper(cast("Any", self), cast("Any", self))

    def images_come(self) -> bool:
        return False

    def create_service(self, _type: type, name: str, callback: Callable[..., Any], **_: object) -> None:
        self.services[name] = callback

    def get_logger(self) -> Any:
        return SimpleNamespace(info=lambda _text: None, warning=self.warnings.append)

    def set_parameters_atomically(self, parameters: list[Any]) -> SetParametersResult:
        values = {parameter.name: parameter.value for parameter in parameters}
        before = self.settings.scale
        sx, sy = values["pixel_spacing"]
        self.settings.scale = PixelScale(sx, sy, values["pixel_shear"])
        assert not self.keeper.scale_was_set(before), "the keeper's own change is none"
        return SetParametersResult(successful=True)

    def tell(self, scale: PixelScale) -> bool:
        """As somebody sets the parameters; returns whether the scale in use is another now."""
        before, self.settings.scale = self.settings.scale, scale
        return self.keeper.scale_was_set(before)


@pytest.mark.parametrize("number", range(3), ids=["sx", "sy", "shear"])
def test_a_slice_must_bear_each_number_of_what_was_told(number: int) -> None:
    keeper = Stand(TOLD).keeper
    for off, stands in ((1e-6, True), (-1e-6, True), (4e-4, False), (-4e-4, False)):
        numbers = [TOLD.sx, TOLD.sy, TOLD.shear]
        numbers[number] += off
        assert keeper.stands_for(PixelScale(*numbers)) == stands


def test_nothing_told_stands_for_no_slice() -> None:
    assert not Stand(None).keeper.stands_for(TOLD)


def test_told_and_measured_and_gone_back_on(tmp_path: Path) -> None:
    path = tmp_path / "scale.yaml"
    save_calibration(path, CalibrationRecord(MEASURED, TOLD, COVARIANCE, "cube6", 10, 60, "2026-01-01", "test"))
    stand = Stand(TOLD, str(path))
    keeper = stand.keeper
    keeper.load()
    assert stand.settings.scale == MEASURED
    assert (keeper.source, keeper.configured) == ("measured", TOLD)
    np.testing.assert_array_equal(cast("Any", keeper.covariance), COVARIANCE)
    # The slices still bear what was told.
    assert keeper.stands_for(TOLD)
    assert not keeper.stands_for(MEASURED)

    other = PixelScale(0.6, 0.4, 0.01)  # the same numbers, but another scale
    assert stand.tell(other)
    assert (stand.settings.scale, keeper.source, keeper.covariance) == (other, "configured", None)
    assert "measured in place of the pixel_spacing [0.4, 0.6], which is [0.6, 0.4]" in stand.warnings[-1]
    assert stand.tell(TOLD)
    assert (stand.settings.scale, keeper.source) == (MEASURED, "measured")

    response = stand.services["~/reset_calibration"](Trigger.Request(), Trigger.Response())
    assert response.success, response.message
    assert response.message == "pixel_spacing is the configured one, [0.4, 0.6] mm/pixel"
    assert (stand.settings.scale, keeper.source, keeper.covariance) == (TOLD, "configured", None)
    assert not path.exists()


def test_the_last_slices_are_kept_however_many_they_may_be() -> None:
    keeper = Stand(TOLD).keeper
    slices = [SliceSpots(np.full((4, 2), float(k)), TOLD) for k in range(13)]
    keeper.sightings.extend(slices[:12])
    assert list(keeper.sightings) == slices[2:12]  # ten by default
    keeper.keep_slices(3)
    assert list(keeper.sightings) == slices[9:12]
    keeper.sightings.append(slices[12])
    assert list(keeper.sightings) == slices[10:]


def test_the_same_scale_told_again_is_no_change() -> None:
    stand = Stand(TOLD)
    assert not stand.tell(PixelScale(0.4, 0.6, 0.01))
    for changed in (PixelScale(0.41, 0.6, 0.01), PixelScale(0.41, 0.61, 0.01), PixelScale(0.41, 0.61, 0.0)):
        assert stand.tell(changed)
        assert stand.keeper.configured == changed
