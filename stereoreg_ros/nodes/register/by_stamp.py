"""What belongs to an image and comes on another topic: what bears the same stamp, whichever of the two comes first."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Generic, TypeAlias, TypeVar

from builtin_interfaces.msg import Time

from stereoreg_ros.nodes.common.conversions import MessageError

# A message that is lost on its way is sent again after three seconds, the heartbeat of a reliable writer.
WAIT_S: Final = 4.0
_CAPACITY: Final = 32
_Stamp: TypeAlias = tuple[int, int]
_Part = TypeVar("_Part")
_Whole = TypeVar("_Whole")


@dataclass(frozen=True, eq=False)
class _Waiting(Generic[_Whole]):
    whole: _Whole
    stamp: _Stamp
    deadline_s: float


class ByStamp(Generic[_Part, _Whole]):
    """Parts (slice poses, say) and wholes (images) that have not met yet, the newest few of each.

    A part serves one whole: a stamp that returns, as when a recording starts again, asks for its part again.
    In place of a part stands the MessageError that says why there is none. name: of a part, in such reasons.
    same: whether two parts say the same.
    """

    def __init__(self, name: str, same: Callable[[_Part, _Part], bool]) -> None:
        self._name = name
        self._same = same
        self._parts: OrderedDict[_Stamp, _Part | MessageError] = OrderedDict()
        self._waiting: deque[_Waiting[_Whole]] = deque()
        self._given_up: deque[_Stamp] = deque(maxlen=_CAPACITY)

    def add(self, stamp: Time, part: _Part | MessageError) -> tuple[_Whole, _Part | MessageError] | None:
        """Take a part; returns it with the whole that waited for it, or keeps it for the whole to come."""
        key = _key(stamp)
        if key in self._given_up:
            self._given_up.remove(key)
            return None
        of_stamp = [waiting for waiting in self._waiting if waiting.stamp == key]
        if of_stamp:
            self._waiting.remove(of_stamp[0])
            if len(of_stamp) > 1:
                part = MessageError(f"two images bear one stamp, expected one to tell whose {self._name} this is")
            return of_stamp[0].whole, part
        known = self._parts.get(key)
        if isinstance(known, MessageError):
            # Nothing that comes later says which of two was right, or what could not be read.
            part = known
        elif self._differ(known, part):
            part = MessageError(f"two different {self._name} messages bear the image's stamp, expected one")
        self._parts[key] = part
        while len(self._parts) > _CAPACITY:
            self._parts.popitem(last=False)
        return None

    def _differ(self, known: _Part | None, part: _Part | MessageError) -> bool:
        if known is None or isinstance(part, MessageError):
            return False
        return not self._same(known, part)

    def take(self, stamp: Time) -> _Part | MessageError | None:
        """The part with this stamp; None where none has come yet."""
        return self._parts.pop(_key(stamp), None)

    def give_up(self, stamp: Time) -> None:
        """A whole is not to meet its part, which may be here or yet to come: it must not meet a later whole instead."""
        if self._parts.pop(_key(stamp), None) is None:
            self._given_up.append(_key(stamp))

    def wait(self, stamp: Time, whole: _Whole, now_s: float) -> None:
        """Let a whole wait for its part, from `now_s` in seconds of a steady clock."""
        self._waiting.append(_Waiting(whole, _key(stamp), now_s + WAIT_S))

    def take_overdue(self, now_s: float) -> _Whole | None:
        """A whole that has waited in vain, or is one too many to keep; None where there is none."""
        if self._waiting and (len(self._waiting) > _CAPACITY or now_s >= self._waiting[0].deadline_s):
            return self._waiting.popleft().whole
        return None


def _key(stamp: Time) -> _Stamp:
    return stamp.sec, stamp.nanosec
