"""The table of parameters: complete, described, bounded, checked as a whole, and equal to the shipped file."""

from __future__ import annotations

import math
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from rclpy.parameter import Parameter

from stereoreg_ros.nodes.common.parameters import ParameterError
from stereoreg_ros.nodes.register.parameters import ENTRIES, NodeSettings, changed_settings, declare_settings
from stereoreg_ros.nodes.scanner import reception_parameters
from stereoreg_ros.nodes.scanner.reception_parameters import ReceptionSettings
from stereoreg_ros.options import MATCHERS, CalibrationOptions, RegistrationOptions
from stereoreg_ros.reception.bounded_socket import Limits

CONFIG = Path(__file__).resolve().parents[2] / "config"
DEFAULTS = {entry.name: entry.default for entry in ENTRIES}

CONTRACT = {
    "frame_file",
    "pixel_spacing",
    "pixel_shear",
    "rescale_slope",
    "rescale_intercept",
    "threshold",
    "spot_noise_px",
    "frame_tolerance_mm",
    "scale_tolerance",
    "min_inliers",
    "matcher",
    "max_log10_false_alarms",
    "nominal_orientation",
    "max_rotation_deg",
    "scanner_frame_id",
    "fiducial_frame_id",
    "max_position_std_mm",
    "max_target_error_mm",
}


def test_table_holds_the_contract_and_every_option():
    assert set(DEFAULTS) >= CONTRACT
    for options in (RegistrationOptions, CalibrationOptions):
        assert set(DEFAULTS) >= {field.name for field in fields(options)}
    assert len(DEFAULTS) == len(ENTRIES)


@pytest.mark.parametrize("entry", [*ENTRIES, *reception_parameters.ENTRIES], ids=lambda entry: entry.name)
def test_descriptor(entry):
    descriptor = entry.descriptor
    assert descriptor.description == entry.description != ""
    if isinstance(entry.default, float):
        (bounds,) = descriptor.floating_point_range
        assert (bounds.from_value, bounds.to_value, bounds.step) == (entry.low, entry.high, 0.0)
    elif isinstance(entry.default, int) and not isinstance(entry.default, bool):
        (bounds,) = descriptor.integer_range
        assert (bounds.from_value, bounds.to_value, bounds.step) == (entry.low, entry.high, 0)
    elif entry.default == ():
        assert (descriptor.dynamic_typing, descriptor.additional_constraints) == (True, "a list of names")
    elif isinstance(entry.default, tuple):
        assert descriptor.additional_constraints == f"{len(entry.default)} numbers"


@pytest.mark.parametrize(
    ("node", "entries"), [("register_node", ENTRIES), ("receive_dicom_node", reception_parameters.ENTRIES)]
)
def test_shipped_file_equals_the_defaults_and_explains_them(node, entries):
    text = (CONFIG / f"{node}.yaml").read_text(encoding="utf-8")
    values = yaml.safe_load(text)[f"/**/{node}"]["ros__parameters"]
    assert values == {entry.name: entry.value for entry in entries}
    assert list(values) == [entry.name for entry in entries]
    assert {name: type(value) for name, value in values.items()} == {e.name: type(e.value) for e in entries}
    lines = [line.strip() for line in text.splitlines()]
    for entry in entries:
        (number,) = (n for n, line in enumerate(lines) if line.startswith(f"{entry.name}:"))
        bounds = f"; from {entry.low:g} to {entry.high:g}" if entry.low is not None else ""
        assert lines[number - 1] == f"# {entry.description}{bounds}"


def test_defaults_are_valid_and_know_no_spacing():
    settings = NodeSettings.from_parameters(DEFAULTS)
    assert settings.options == RegistrationOptions()
    assert settings.scale is None


def test_values_reach_their_places():
    options = RegistrationOptions(
        threshold=1500.0, frame_tolerance_mm=0.4, scale_tolerance=0.01, max_target_error_mm=5.0
    )
    changed = {**DEFAULTS, **asdict(options), "pixel_spacing": (0.5, 0.7), "pixel_shear": 0.01}
    calibration = CalibrationOptions(calibration_slices=7, calibrate_shear=True, calibration_max_change=0.1)
    settings = NodeSettings.from_parameters(changed | asdict(calibration))
    assert (settings.options, settings.calibration) == (options, calibration)
    assert settings.scale is not None
    assert (settings.scale.sx, settings.scale.sy, settings.scale.shear) == (0.5, 0.7, 0.01)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("pixel_spacing", (0.5,), "pixel_spacing has 1 numbers, expected two"),
        ("pixel_spacing", (0.5, -0.5), "pixel_spacing is .*, expected two positive numbers of mm/pixel"),
        ("pixel_spacing", (0.0, 0.5), "pixel_spacing is .*, expected two positive numbers"),
        ("pixel_spacing", (math.nan, 0.5), "pixel_spacing is .*, expected two positive numbers"),
        ("pixel_spacing", (math.inf, 0.5), "pixel_spacing is .*, expected two positive numbers"),
        ("pixel_shear", math.nan, "pixel_shear is nan, expected a number from -10 to 10"),
        ("rescale_slope", 0.0, "rescale_slope is 0.0, expected a number that is not 0"),
        ("rescale_intercept", math.inf, "rescale_intercept is inf, expected a number from"),
        ("frame_file", "", "frame_file is empty, expected a name"),
        ("fiducial_frame_id", "", "fiducial_frame_id is empty, expected a name"),
        ("matcher", "guess", "matcher is 'guess', expected one of"),
        ("nominal_orientation", (0.0, 0.0, 1.0), "nominal_orientation: .*expected \\(4,\\)"),
        ("nominal_orientation", (0.0, 0.0, 0.0, 0.0), "nominal_orientation: .*no length"),
        ("frame_tolerance_mm", -0.1, "frame_tolerance_mm is -0.1, expected a number from 0 to 10"),
        ("frame_tolerance_mm", math.nan, "frame_tolerance_mm is nan, expected a number from 0 to 10"),
        ("scale_tolerance", 0.2, "scale_tolerance is 0.2, expected a number from 0 to 0.1"),
        ("scale_tolerance", math.inf, "scale_tolerance is inf, expected a number from 0 to 0.1"),
        ("min_spot_area_mm2", 90.0, "min_spot_area_mm2 is 90, expected less than max_spot_area_mm2"),
    ],
)
def test_faulty_value_is_named(name, value, sentence):
    with pytest.raises(ValueError, match=sentence):
        NodeSettings.from_parameters({**DEFAULTS, name: value})


def test_of_several_frames_every_one_is_a_source_and_frame_file_is_none():
    several = NodeSettings.from_parameters({**DEFAULTS, "frame_file": "cube5", "frame_files": ("cube6", "cube8")})
    assert several.frame_sources == ("cube6", "cube8")
    # An empty list in a parameter file comes as nothing at all.
    for none in ((), None):
        one = NodeSettings.from_parameters({**DEFAULTS, "frame_file": "cube5", "frame_files": none})
        assert (one.frame_sources, one.frame_files) == (("cube5",), ())


@pytest.mark.parametrize("names", [("cube6", ""), ("cube6", 7), "cube6"])
def test_frames_that_have_no_names_are_named(names):
    with pytest.raises(ValueError, match=r"frame_files is .*, expected a list of names or paths"):
        NodeSettings.from_parameters({**DEFAULTS, "frame_files": names})


class Told:
    """Stands in for a node that was started with these parameters, beside the defaults."""

    def __init__(self, **given):
        self.given, self.held = given, {}

    def declare_parameter(self, name, default, _descriptor):
        self.held[name] = Parameter(name, value=self.given.get(name, default))
        return self.held[name]

    def get_parameter(self, name):
        return self.held[name]


def started_with(**parameters: Any) -> Any:
    """A node for whoever asks for one."""
    return Told(**parameters)


def test_settings_are_those_given_at_the_start_and_as_changed_since():
    node = started_with(
        frame_file="cube5", pixel_spacing=[0.5, 0.7], frame_files=["cube6", "cube8"], calibration_slices=7
    )
    settings = declare_settings(node)
    assert (settings.frame_file, settings.frame_files) == ("cube5", ("cube6", "cube8"))
    assert (settings.pixel_spacing, settings.calibration.calibration_slices) == ((0.5, 0.7), 7)
    changes = [Parameter("pixel_spacing", value=[0.4, 0.3]), Parameter("use_sim_time", value=True)]
    changed = changed_settings(node, changes)
    assert changed == replace(settings, pixel_spacing=(0.4, 0.3))
    with pytest.raises(ValueError, match="calibration_slices is not set, expected a value"):
        changed_settings(node, [*changes, Parameter("calibration_slices", Parameter.Type.NOT_SET)])
    with pytest.raises(ParameterError, match="pixel_spacing has 1 numbers, expected two"):
        declare_settings(started_with(pixel_spacing=[0.5]))


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"ae_title": ""}, "ae_title: found '', expected an AE title of 1 to 16 characters"),
        ({"ae_title": " CT"}, "ae_title: found ' CT', expected an AE title"),
        ({"ae_title": "Ü"}, "ae_title: found 'Ü', expected an AE title of printable ASCII"),
        ({"ae_title": "A TITLE TOO LONG."}, "ae_title: .*, expected an AE title of 1 to 16 characters"),
        ({"allowed_callers": ("CT1", "CT\\2")}, "allowed_callers: found .*, expected an AE title"),
        ({"allowed_callers": (1, 2)}, "allowed_callers: found 1, expected an AE title"),
        ({"allowed_callers": "CT1"}, "allowed_callers is 'CT1', expected a list of AE titles"),
        ({"tls_key": "key.pem"}, "one of tls_certificate and tls_key is empty, expected both or neither"),
        ({"tls_certificate": "host.pem"}, "one of tls_certificate and tls_key is empty, expected both or neither"),
        ({"tls_client_ca": "ca.pem"}, "tls_client_ca is set without tls_certificate, expected both"),
        ({"watch_folder": "/nowhere"}, "watch_folder is '/nowhere', expected a folder"),
        ({"watch_folder": "a" * 5000}, "watch_folder is 'a{199}, expected a folder"),
        ({"watch_folder": "/", "keep_folder": "/kept"}, "keep_folder /kept lies in watch_folder /"),
        ({"watch_folder": "/", "keep_folder": "/"}, "every slice would come twice"),
    ],
)
def test_faulty_value_of_the_receiver_is_named(values, sentence):
    with pytest.raises(ValueError, match=sentence):
        ReceptionSettings(**values)


def test_the_receiver_tells_clients_their_limits_in_bytes():
    assert ReceptionSettings(max_object_mb=3, allowed_callers=("CT1", "CT2")).limits.max_object_bytes == 3 * 2**20


def test_each_limit_of_the_receiver_has_its_place():
    settings = ReceptionSettings(max_object_mb=1, max_associations=2, association_timeout=3.0, network_timeout=4.0)
    assert settings.limits == Limits(2**20, max_associations=2, association_timeout_s=3.0, network_timeout_s=4.0)


def test_a_title_of_the_receiver_may_have_sixteen_characters():
    assert ReceptionSettings(ae_title="A TITLE SO LONG.").ae_title == "A TITLE SO LONG."


def test_no_object_is_kept_where_it_would_be_found_again_not_even_behind_a_link(tmp_path):
    for name in ("watched", "watched/below", "beside"):
        (tmp_path / name).mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "watched" / "below")
    watched = str(tmp_path / "watched")
    for name in ("watched", "watched/below", "link"):
        with pytest.raises(ValueError, match="every slice would come twice"):
            ReceptionSettings(watch_folder=watched, keep_folder=str(tmp_path / name))
    for name in ("beside", "."):
        assert ReceptionSettings(watch_folder=watched, keep_folder=str(tmp_path / name)).keep_folder


@pytest.mark.parametrize("matcher", MATCHERS)
def test_every_matcher_can_be_chosen(matcher):
    (entry,) = [entry for entry in ENTRIES if entry.name == "matcher"]
    assert matcher in entry.description
    assert NodeSettings.from_parameters(DEFAULTS | {"matcher": matcher}).options.matcher == matcher
