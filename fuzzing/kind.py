"""What one kind of input is: how it is tried, what it may be refused with, and how inputs of the kind are made."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

CORPUS = Path(__file__).resolve().parents[1] / "test" / "corpus"


@dataclass(frozen=True)
class Kind:
    """A kind of input from outside.

    attempt: does with an input what the software does with it; raises AssertionError where the result is not what it
    has to be. refusals: the exact types of exception that refuse an input. names: whether a refusal's text names the
    file, the field or the parameter. seeds: valid inputs. mutate: another input from one, the same for the same random
    numbers. ending: of files with such inputs. memory_bytes: what an input, its copies and its decoder may take; it is
    small, and so must be what it takes.
    """

    name: str
    ending: str
    attempt: Callable[[bytes], None]
    refusals: tuple[type[Exception], ...]
    names: Callable[[str], bool]
    seeds: Callable[[], list[bytes]]
    mutate: Callable[[bytes, random.Random], bytes]
    memory_bytes: int = 2**27

    @property
    def found(self) -> list[Path]:
        """Inputs that were found to do harm once, or are odd in a way of their own."""
        return sorted((CORPUS / self.name).glob(f"*{self.ending}"))
