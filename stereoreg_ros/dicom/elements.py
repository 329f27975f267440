"""Elements of a DICOM data set, or a DicomError that names the element, what was found and what was expected."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import pydicom
from pydicom.datadict import dictionary_description, tag_for_keyword

_LONGEST_TEXT: Final = 500


class DicomError(ValueError):
    """A DICOM file or folder that cannot be used; the text names it, what was found and what was expected.

    path: the file or folder.
    """

    def __init__(self, path: Path, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = path


@contextmanager
def reading(file: Path, problem: str) -> Iterator[None]:
    """Run pydicom on what may be damaged: no warnings, and nothing raised but a DicomError that says `problem`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        # It raises nearly anything then, struct.error and AttributeError among it.
        except Exception as error:
            cause = _shortened(" ".join(str(error).split())) or type(error).__name__
            raise DicomError(file, f"{problem}: {cause}") from error


def element_value(file: Path, dataset: pydicom.Dataset, keyword: str) -> Any:
    """The element's value, or None where it is missing or empty."""
    # Elements are converted when they are asked for, so this is where their faults show.
    with reading(file, f"{tag_text(keyword)} cannot be read"):
        value = dataset.get(keyword)
    return None if value is None or value == "" or value == [] else value


def element_numbers(file: Path, dataset: pydicom.Dataset, keyword: str, count: int) -> list[float]:
    """The element's finite numbers, so many; DicomError where it has others."""
    expected = "a finite number" if count == 1 else f"{count} finite numbers"
    value = element_value(file, dataset, keyword)
    if value is None:
        raise element_fault(file, keyword, None, expected)
    try:
        numbers = [float(number) for number in np.atleast_1d(np.asarray(value, dtype=np.float64))]
    except (TypeError, ValueError):
        raise element_fault(file, keyword, value, expected) from None
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise element_fault(file, keyword, numbers if count > 1 else numbers[0], expected)
    return numbers


def element_integer(file: Path, dataset: pydicom.Dataset, keyword: str, low: int, high: int) -> int:
    """The element's whole number, from low to high; DicomError where it has another."""
    expected = f"{low}" if low == high else f"a whole number from {low} to {high}"
    value = element_value(file, dataset, keyword)
    if value is None:
        raise element_fault(file, keyword, None, expected)
    try:
        number = int(value)
    except (TypeError, ValueError, OverflowError):
        raise element_fault(file, keyword, value, expected) from None
    if number != value or not low <= number <= high:
        raise element_fault(file, keyword, value, expected)
    return number


def tag_text(keyword: str) -> str:
    """The element's name and tag, as errors call it."""
    tag = tag_for_keyword(keyword) or 0
    return f"{dictionary_description(tag)} ({tag >> 16:04X},{tag & 0xFFFF:04X})"


def element_fault(file: Path, keyword: str, found: object, expected: str, *, quoted: bool = True) -> DicomError:
    """The error for an element that is missing (found: None) or not what is expected.

    quoted: as Python writes it; false for a name that stands for the value.
    """
    state = "is missing" if found is None else f"is {_shortened(repr(found) if quoted else str(found))}"
    return DicomError(file, f"{tag_text(keyword)} {state}, expected {expected}")


def _shortened(text: str) -> str:
    """Text that may repeat what an object holds, however long that is."""
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."
