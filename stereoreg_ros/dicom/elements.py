"""Elements of a DICOM data set; a DicomError names the element, what was found and what was expected."""

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
    """Run pydicom on possibly damaged data: no warnings, and no exception but a DicomError that says `problem`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        # On damaged data it raises almost anything, including struct.error and AttributeError.
        except Exception as error:
            cause = _shortened(" ".join(str(error).split())) or type(error).__name__
            raise DicomError(file, f"{problem}: {cause}") from error


def element_value(file: Path, dataset: pydicom.Dataset, keyword: str) -> Any:
    """The element's value, or None where it is missing or empty."""
    # pydicom converts elements on access, so this is where faults show.
    with reading(file, f"{tag_text(keyword)} cannot be read"):
        value = dataset.get(keyword)
    return None if value is None or value == "" or value == [] else value


def element_numbers(file: Path, dataset: pydicom.Dataset, keyword: str, count: int) -> list[float]:
    """The element's `count` finite numbers; DicomError where it has anything else."""
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
    """The element's whole number, from low to high; DicomError where it has anything else."""
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
    """Text with at most _LONGEST_TEXT characters of what an object holds."""
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."
