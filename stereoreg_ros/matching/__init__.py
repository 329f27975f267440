"""Which spot is which rod. A new matcher is a file of its own and a line in the table."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, Protocol

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.matching.by_levels import ByLevels
from stereoreg_ros.matching.hypothesis import Found
from stereoreg_ros.matching.maurin2009 import Maurin2009
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.options import RegistrationOptions


class Matcher(Protocol):
    """Matches the spots of slice after slice to the rods of one frame, and keeps what it has prepared for that."""

    @property
    def follows_guess(self) -> bool:
        """Whether it makes use of `Problem.guess`, and of half of the false alarms being for poses near it."""

    def match(self, problem: Problem) -> Found:
        """The explanations of the spots that the best one does not rule out."""

    def preparation(self, scale: PixelScale, options: RegistrationOptions) -> Iterator[None]:
        """Fill the tables that slices need, some at each step, those that most slices need first."""


# By the names of the option `matcher`.
MATCHERS: Final[dict[str, Callable[[Frame], Matcher]]] = {"three_line": ByLevels, "maurin2009": Maurin2009}


class Matchers:
    """All matchers of one frame, by their names; `by_levels` is the one that also finds what speaks against a pose."""

    def __init__(self, frame: Frame) -> None:
        self.by_levels = ByLevels(frame)
        self._named = {
            name: self.by_levels if matcher is ByLevels else matcher(frame) for name, matcher in MATCHERS.items()
        }

    def __getitem__(self, name: str) -> Matcher:
        return self._named[name]
