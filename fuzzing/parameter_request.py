"""Requests to set parameters of register_node, as they come over the wire: CDR bytes."""

from __future__ import annotations

import functools
import os
import random
import tempfile
from pathlib import Path
from typing import Any, Final

import rclpy
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

from fuzzing.kind import Kind
from fuzzing.mutation import mutate_bytes
from stereoreg_ros.geometry.frame_file import FrameFileError, load_frame
from stereoreg_ros.nodes.register.parameters import ENTRIES, changed_settings, declare_settings
from stereoreg_ros.nodes.scanner import reception_parameters
from stereoreg_ros.nodes.scanner.reception_parameters import ReceptionSettings

_NAMES: Final = tuple(entry.name for entry in ENTRIES)
_RECEPTION: Final = {entry.name: entry for entry in reception_parameters.ENTRIES}
_ALL_NAMES: Final = (*_NAMES, *_RECEPTION, "use_sim_time", "none of them", "", "threshold.x", "a" * 3000)
_DOUBLES: Final = (
    *(0.0, -0.0, 0.5, 1.0, -1.0, 2.0, 100.0, 1e-300, 1e300, -1e300, float("nan"), float("inf"), -float("inf")),
    *(5e-324, 0.1, 4.5, 180.0, 180.0000001, 1e6, 2000.0),
)
_INTEGERS: Final = (0, 1, -1, 3, 4, 5, 10, 200, 1000, 1001, 2**31, 2**63 - 1, -(2**63))
_TEXTS: Final = (
    *("", "auto", "Auto", "three_line", "maurin2009", "cube6", "cube5", "zframe", "no such frame", "../../etc/passwd"),
    *(
        "/dev/zero",
        "/dev/stdin",
        "/dev/tty",
        "/",
        ".",
        "..",
        "a" * 300,
        "a/" * 1500,
        "x.yaml",
        "~",
        "%s%n",
        "\n",
        "\x01",
    ),
    *("\ufffd", "\U0001f600", "cube6\\", " CT1", "CT1", "A" * 17, "{}", "nan", "1.0", "frame.yaml"),
)


class _RequestError(ValueError):
    """A request that rclpy does not hand on."""


class _ReasonError(ValueError):
    """The reason with which a request was refused."""


@functools.cache
def _pipe() -> str:
    """Opening it to read would wait for a writer."""
    path = Path(tempfile.mkdtemp(prefix="fuzzing-")) / "pipe.yaml"
    os.mkfifo(path)
    return str(path)


class _Target(Node):
    """As register_node checks what is set, but by names of errors, and without the tables that it fills."""

    def __init__(self) -> None:
        # Of its own, as the process may have others.
        context = Context()
        rclpy.init(context=context)
        super().__init__("fuzzing", context=context, enable_rosout=False, start_parameter_services=False)
        declare_settings(self)
        self.add_on_set_parameters_callback(self._check)

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            settings = changed_settings(self, parameters)
            if any(parameter.name in ("frame_file", "frame_files") for parameter in parameters):
                for source in settings.frame_sources:
                    load_frame(source)
        except FrameFileError as error:
            return SetParametersResult(successful=False, reason=f"frame_file: {error}")
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


@functools.cache
def _target() -> _Target:
    return _Target()


def _attempt(data: bytes) -> None:
    node = _target()
    try:
        request = deserialize_message(data, SetParametersAtomically.Request)
        parameters = [Parameter.from_parameter_msg(message) for message in request.parameters]
    except (rclpy_implementation.RMWError, ValueError) as error:
        raise _RequestError(f"request: {error}") from None
    _receive([parameter for parameter in parameters if parameter.name in _RECEPTION])
    declared = [parameter for parameter in parameters if node.has_parameter(parameter.name)]
    before = {parameter.name: node.get_parameter(parameter.name) for parameter in declared}
    result = node.set_parameters_atomically(declared)
    if not result.successful:
        raise _ReasonError(result.reason)
    settings = changed_settings(node, [])
    # The next input finds the node as this one did.
    restored = node.set_parameters_atomically(list(before.values()))
    assert restored.successful, restored.reason
    assert all(0.001 <= spacing <= 100 for spacing in settings.pixel_spacing) or settings.scale is None
    assert settings.rescale_slope
    assert settings.options.matcher in ("three_line", "maurin2009")
    assert 4 <= settings.options.min_inliers <= 1000


def _receive(parameters: list[Parameter]) -> None:
    """What receive_dicom_node would make of them at its start."""
    values: dict[str, Any] = {name: entry.default for name, entry in _RECEPTION.items()}
    for parameter in parameters:
        default = values[parameter.name]
        value = tuple(parameter.value) if isinstance(parameter.value, list) else parameter.value
        # rclpy lets no other type through, and nothing beyond the range.
        entry = _RECEPTION[parameter.name]
        in_range = (
            entry.low is None
            or entry.high is None
            or (isinstance(value, (int, float)) and entry.low <= value <= entry.high)
        )
        if type(value) is type(default) and in_range:
            values[parameter.name] = value
    settings = ReceptionSettings(**values)
    assert settings.limits.max_object_bytes >= 2**20


def _seeds() -> list[bytes]:
    every = [_message(entry.name, entry.value) for entry in ENTRIES]
    requests = [[one] for one in every] + [every]
    requests.append([_message("pixel_spacing", [0.5, 0.5]), _message("threshold", "auto")])
    requests.append([_message("frame_files", ["cube6", "cube5"]), _message("calibration_file", "scale.yaml")])
    requests.append([_message("address", "0.0.0.0"), _message("allowed_callers", ["CT1", "CT2"])])
    return [_written(parameters) for parameters in requests]


def _message(name: str, value: Any) -> ParameterMessage:
    return Parameter(name, value=value).to_parameter_msg()


def _written(parameters: list[ParameterMessage]) -> bytes:
    return bytes(serialize_message(SetParametersAtomically.Request(parameters=parameters)))


def _mutate(data: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.1:
        return mutate_bytes(data, rng)
    try:
        parameters = list(deserialize_message(data, SetParametersAtomically.Request).parameters)
    except rclpy_implementation.RMWError:
        return mutate_bytes(data, rng)
    for _ in range(rng.randint(1, 3)):
        place = rng.randrange(len(parameters) + 1)
        match rng.randrange(6):
            case 0:
                del parameters[place : place + rng.randint(1, 4)]
            case 1 | 2:
                parameters.insert(place, ParameterMessage(name=rng.choice(_ALL_NAMES), value=_value(rng)))
            case 3 | 4 if place < len(parameters):
                parameters[place].value = _value(rng)
            case 5 if place < len(parameters):
                parameters[place].name = rng.choice(_ALL_NAMES)
    return _written(parameters[:60])


def _value(rng: random.Random) -> ParameterValue:
    value = ParameterValue(type=rng.choice((*range(10), *range(1, 5), 10, 42, 255)))
    many = rng.choice((0, 1, 2, 2, 3, 4, 4, 5, 100))
    value.bool_value = rng.random() < 0.5
    value.integer_value = rng.choice(_INTEGERS)
    value.double_value = rng.choice((*_DOUBLES, rng.uniform(-10, 200)))
    value.string_value = rng.choice((*_TEXTS, _pipe()))
    value.byte_array_value = [rng.randbytes(1) for _ in range(many)]
    value.bool_array_value = [rng.random() < 0.5 for _ in range(many)]
    value.integer_array_value = [rng.choice(_INTEGERS) for _ in range(many)]
    value.double_array_value = [rng.choice((*_DOUBLES, rng.uniform(-1, 2))) for _ in range(many)]
    value.string_array_value = [rng.choice((*_TEXTS, _pipe())) for _ in range(min(many, 5))]
    return value


# What rclpy answers before it asks the node.
_OF_RCLPY: Final = ("Wrong parameter type, expected ", "Static parameter cannot be undeclared")


def _names(text: str) -> bool:
    return text.startswith(_OF_RCLPY) or any(name in text for name in (*_NAMES, *_RECEPTION, "request"))


PARAMETERS = Kind(
    name="parameters",
    ending=".cdr",
    attempt=_attempt,
    refusals=(_RequestError, _ReasonError, ValueError),
    names=_names,
    seeds=_seeds,
    mutate=_mutate,
)
