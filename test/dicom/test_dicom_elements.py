"""Elements of a data set: numbers that are what and as many as is expected, or a fault that names them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest
from pydicom.dataset import Dataset

from stereoreg_ros.dicom import DicomError
from stereoreg_ros.dicom.elements import element_integer, element_numbers, element_value

FILE = Path("it")


class Held:
    """Stands in for a data set with one element, of a value that pydicom itself might not write."""

    def __init__(self, value: Any) -> None:
        self._value = value

    def get(self, _keyword: str) -> Any:
        return self._value


def held(value: Any) -> Dataset:
    return cast(Dataset, Held(value))


@pytest.mark.parametrize("value", [None, "", []])
def test_what_is_empty_is_missing(value: Any) -> None:
    assert element_value(FILE, held(value), "Rows") is None
    with pytest.raises(DicomError, match=r"^it: Rows \(0028,0010\) is missing, expected a whole number from 1 to 9$"):
        element_integer(FILE, held(value), "Rows", 1, 9)
    with pytest.raises(DicomError, match=r"Pixel Spacing \(0028,0030\) is missing, expected 2 finite numbers"):
        element_numbers(FILE, held(value), "PixelSpacing", 2)


@pytest.mark.parametrize("value", [1, 9, 9.0, "9"])
def test_a_whole_number_up_to_both_ends_of_its_range(value: Any) -> None:
    if value == "9":
        with pytest.raises(DicomError, match=r"is '9', expected"):
            element_integer(FILE, held(value), "Rows", 1, 9)
    else:
        assert element_integer(FILE, held(value), "Rows", 1, 9) == value


@pytest.mark.parametrize("value", [0, 10, 8.5, float("nan"), float("inf"), "nine", [3, 4]])
def test_what_is_no_whole_number_or_beyond_its_range(value: Any) -> None:
    with pytest.raises(DicomError, match=r"Rows \(0028,0010\) is .*, expected a whole number from 1 to 9$"):
        element_integer(FILE, held(value), "Rows", 1, 9)


def test_numbers_as_many_as_expected() -> None:
    assert element_numbers(FILE, held(0), "RescaleIntercept", 1) == [0.0]
    assert element_numbers(FILE, held([0.5, 0]), "PixelSpacing", 2) == [0.5, 0.0]


@pytest.mark.parametrize("value", [[1.0], [1.0, 2.0, 3.0], [1.0, float("nan")], [float("inf"), 1.0], ["a", 1.0]])
def test_numbers_that_are_too_few_too_many_or_none(value: Any) -> None:
    with pytest.raises(DicomError, match=r"Pixel Spacing \(0028,0030\) is \[.*\], expected 2 finite numbers$"):
        element_numbers(FILE, held(value), "PixelSpacing", 2)
