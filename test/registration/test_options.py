"""Options check themselves and say what is wrong."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, fields
from typing import Any

import numpy as np
import pytest

from stereoreg_ros.options import MATCHERS, RegistrationOptions

NUMBERS = [entry for entry in fields(RegistrationOptions) if entry.metadata["low"] is not None]


def test_defaults_of_the_contract() -> None:
    options = RegistrationOptions()
    assert options.threshold == "auto"
    assert options.max_log10_false_alarms == -6
    assert options.max_rotation_deg == 180.0
    assert options.nominal_orientation == (0.0, 0.0, 0.0, 1.0)
    assert options.matcher == "three_line"


@pytest.mark.parametrize("name", [entry.name for entry in fields(RegistrationOptions)])
def test_every_option_is_described(name: str) -> None:
    (entry,) = (entry for entry in fields(RegistrationOptions) if entry.name == name)
    assert len(entry.metadata["description"]) > 10


@pytest.mark.parametrize("name", [entry.name for entry in NUMBERS])
def test_range(name: str) -> None:
    (entry,) = (entry for entry in NUMBERS if entry.name == name)
    low, high = entry.metadata["low"], entry.metadata["high"]
    assert entry.default == entry.metadata["word"] or low <= entry.default <= high
    # The other end of the pair of areas moves along, so that it does not stand in the way.
    wide = {"min_spot_area_mm2": 0.0, "max_spot_area_mm2": 10000.0}
    for value in (low, high):
        assert getattr(RegistrationOptions(**{**wide, name: value}), name) == value
    bad: tuple[Any, ...] = (low - 1e-3, high + 1e-3, np.nan, np.inf, -np.inf, "4", None, True, [5])
    for value in bad:
        with pytest.raises(ValueError, match=f"^{name} is .*, expected a number from {low:g} to {high:g}"):
            RegistrationOptions(**{name: value})


def test_numbers_of_numpy_are_numbers() -> None:
    assert RegistrationOptions(threshold=np.float32(300), min_inliers=np.int64(5)).min_inliers == 5  # type: ignore[arg-type]


def test_threshold_may_be_automatic() -> None:
    assert RegistrationOptions(threshold="auto").threshold == "auto"
    with pytest.raises(ValueError, match="threshold is 'Auto', expected a number from -32768 to 65535, or 'auto'"):
        RegistrationOptions(threshold="Auto")
    with pytest.raises(ValueError, match=r"spot_noise_px is 'auto', expected a number from 0\.001 to 10$"):
        RegistrationOptions(spot_noise_px="auto")  # type: ignore[arg-type]


def test_min_inliers_is_whole() -> None:
    with pytest.raises(ValueError, match=r"min_inliers is 4\.5, expected a whole number"):
        RegistrationOptions(min_inliers=4.5)  # type: ignore[arg-type]
    whole = RegistrationOptions(min_inliers=5.0).min_inliers  # type: ignore[arg-type]
    assert whole == 5
    assert isinstance(whole, int)


def test_matcher_is_a_known_one() -> None:
    for matcher in MATCHERS:
        assert RegistrationOptions(matcher=matcher).matcher == matcher
    with pytest.raises(ValueError, match="matcher is 'guess', expected one of three_line"):
        RegistrationOptions(matcher="guess")


@pytest.mark.parametrize(("low", "high"), [(10.0, 10.0), (20.0, 10.0)])
def test_areas_are_in_order(low: float, high: float) -> None:
    with pytest.raises(ValueError, match=f"min_spot_area_mm2 is {low:g}, expected less than max_spot_area_mm2"):
        RegistrationOptions(min_spot_area_mm2=low, max_spot_area_mm2=high)


@pytest.mark.parametrize(
    ("orientation", "told"),
    [
        ((0, 0, 0), r"shape \(3,\), expected \(4,\)"),
        ((0, 0, 0, 0), "no length"),
        ((0, 0, 0, np.nan), "not finite"),
        ("up", "could not convert"),
        (None, r"shape \(\)"),
    ],
)
def test_orientation_is_a_quaternion(orientation: Any, told: str) -> None:
    with pytest.raises(ValueError, match=f"nominal_orientation: .*{told}"):
        RegistrationOptions(nominal_orientation=orientation)


def test_orientation_becomes_a_tuple_that_can_be_compared_and_hashed() -> None:
    options = RegistrationOptions(nominal_orientation=np.array([0, 0, 1, 1]))  # type: ignore[arg-type]
    assert options.nominal_orientation == (0.0, 0.0, 1.0, 1.0)
    assert options == RegistrationOptions(nominal_orientation=(0, 0, 1, 1))
    assert hash(options) == hash(RegistrationOptions(nominal_orientation=(0, 0, 1, 1)))


@pytest.mark.parametrize(
    "target",
    [(0.0, 0.0), (0.0, 0.0, np.nan), (0.0, np.inf, 0.0), (0.0, 0.0, 10001.0), (-10001.0, 0.0, 0.0), "tip", None, 5.0],
    ids=str,
)
def test_target_is_a_point(target: Any) -> None:
    with pytest.raises(
        ValueError, match=r"^target_in_frame_mm is .*, expected three numbers of mm from -10000 to 10000"
    ):
        RegistrationOptions(target_in_frame_mm=target)


def test_target_becomes_a_tuple_of_plain_numbers() -> None:
    assert RegistrationOptions().target_in_frame_mm == (0.0, 0.0, 0.0)
    options = RegistrationOptions(target_in_frame_mm=np.array([1, -2, 3.5]))  # type: ignore[arg-type]
    assert options.target_in_frame_mm == (1.0, -2.0, 3.5)
    assert hash(options) == hash(RegistrationOptions(target_in_frame_mm=(1, -2, 3.5)))


def test_what_is_taken_to_be_off_by_default() -> None:
    """And how weak a pose may be: a controller that reads nothing but poses must not get weak ones."""
    options = RegistrationOptions()
    assert options.frame_tolerance_mm == 0.2
    assert options.scale_tolerance == 0.002
    assert options.max_target_error_mm == 3.0


def test_a_frame_and_a_scale_may_be_perfect() -> None:
    options = RegistrationOptions(frame_tolerance_mm=0.0, scale_tolerance=0.0)
    assert options.frame_tolerance_mm == options.scale_tolerance == 0.0


def test_cannot_be_changed() -> None:
    with pytest.raises(FrozenInstanceError):
        RegistrationOptions().threshold = 0.0  # type: ignore[misc]
