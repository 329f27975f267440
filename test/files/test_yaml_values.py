"""Plain values from YAML and JSON; what breaks constructors is in calibration/test_calibration_file.py."""

from __future__ import annotations

import json
from typing import Any

import pytest

from stereoreg_ros.files.bounded_yaml import UnusableYamlError
from stereoreg_ros.files.yaml_values import values_of


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("a: [1, -2.5, .inf, true, null, text]", {"a": [1, -2.5, float("inf"), True, None, "text"]}),
        ("'1'", "1"),
        (json.dumps({"a": {"b": [1, 2.5, "c", False, None]}}), {"a": {"b": [1, 2.5, "c", False, None]}}),
    ],
)
def test_plain_values(text: str, value: Any) -> None:
    assert values_of(text.encode()) == value


def test_an_octal_looking_number_is_not_guessed_at() -> None:
    with pytest.raises(UnusableYamlError, match="'010' is not of type int"):
        values_of(b"a: 010")
