"""Images and what comes with them on other topics, put together by their stamp, whichever comes first."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image

from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.common.conversions import MessageError
from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice, SlicePlane

SPACING: Final = "slice_spacing"
PLANE: Final = "slice_pose"
FRAME_OF_REFERENCE: Final = "slice_frame_of_reference"
_TOPICS: Final = (SPACING, PLANE, FRAME_OF_REFERENCE)
# A message that is lost on its way is sent again after three seconds, the heartbeat of a reliable writer.
WAIT_S: Final = 4.0
CAPACITY: Final = 32
Part: TypeAlias = PixelScale | SlicePlane | str
_Stamp: TypeAlias = tuple[int, int]


@dataclass(eq=False)
class _Waiting:
    """An image, the topics that have still to say something of it, and what the others have said."""

    image: Image
    received_s: float
    missing: set[str]
    parts: dict[str, Part | MessageError] = field(default_factory=dict)

    def whole(self) -> IncomingSlice:
        spacing, plane, reference = parts = [self.parts.get(topic) for topic in _TOPICS]
        faults = [str(part) for part in parts if isinstance(part, MessageError)]
        faults += [f"no {topic} with the image's stamp came within {WAIT_S:g} s" for topic in sorted(self.missing)]
        return IncomingSlice(
            self.image,
            self.received_s,
            spacing if isinstance(spacing, PixelScale) else None,
            plane if isinstance(plane, SlicePlane) else None,
            reference if isinstance(reference, str) else None,
            "; ".join(faults),
        )


class SliceAssembly:
    """Images that wait for their parts, and parts that wait for their image, the newest few of each.

    A part serves one image: a stamp that returns, as when a recording starts again, asks for its parts again. In place
    of a part may stand the MessageError that says why it cannot be used. Times are seconds of the steady clock.
    """

    def __init__(self) -> None:
        self._parts: dict[str, OrderedDict[_Stamp, Part | MessageError]] = {topic: OrderedDict() for topic in _TOPICS}
        self._waiting: list[_Waiting] = []

    def add_image(self, image: Image, received_s: float, expected: Iterable[str]) -> None:
        """Take an image; expected: the topics on which something comes with it."""
        topics = set(expected)
        one = _Waiting(image, received_s, topics)
        if topics and image.header.stamp == Time():
            names = " and ".join(sorted(topics))
            fault = MessageError(f"its stamp is 0, expected one by which to know its {names}")
            one.parts, one.missing = dict.fromkeys(sorted(topics)[:1], fault), set()
        for topic in list(one.missing):
            if (part := self._parts[topic].pop(_key(image.header.stamp), None)) is not None:
                one.parts[topic] = part
                one.missing.remove(topic)
        self._waiting.append(one)

    def add_part(self, topic: str, stamp: Time, part: Part | MessageError) -> None:
        """Take what a topic says of the image with this stamp, which may have come or not."""
        key = _key(stamp)
        takers = [one for one in self._waiting if topic in one.missing and _key(one.image.header.stamp) == key]
        if takers:
            if len(takers) > 1:
                part = MessageError(
                    f"two images have the same stamp, expected one: nothing shows whose {topic} this is"
                )
            takers[0].parts[topic] = part
            takers[0].missing.remove(topic)
            return
        kept = self._parts[topic]
        known = kept.get(key)
        if isinstance(known, MessageError):
            # Nothing that comes later says which of two was right, or what could not be read.
            part = known
        elif known is not None and not isinstance(part, MessageError) and not _are_same(known, part):
            part = MessageError(f"two different {topic} messages have the image's stamp, expected one")
        kept[key] = part
        while len(kept) > CAPACITY:
            kept.popitem(last=False)

    def take(self, now_s: float) -> list[IncomingSlice]:
        """The slices that are whole, or have waited in vain, or are too many to keep waiting; in order of arrival."""
        too_many = max(sum(bool(one.missing) for one in self._waiting) - CAPACITY, 0)
        taken, left = [], []
        for one in self._waiting:
            if one.missing and too_many:
                too_many -= 1
                taken.append(one)
            elif not one.missing or now_s >= one.received_s + WAIT_S:
                taken.append(one)
            else:
                left.append(one)
        self._waiting = left
        return [one.whole() for one in taken]

    def __len__(self) -> int:
        """How many images wait for their parts."""
        return len(self._waiting)


def _are_same(one: Part, other: Part) -> bool:
    if isinstance(one, SlicePlane) and isinstance(other, SlicePlane):
        a, b = one.scanner_from_slice, other.scanner_from_slice
        return (
            one.frame_id == other.frame_id
            and np.array_equal(a.rotation, b.rotation)
            and np.array_equal(a.translation, b.translation)
        )
    return one == other


def _key(stamp: Time) -> _Stamp:
    return stamp.sec, stamp.nanosec
