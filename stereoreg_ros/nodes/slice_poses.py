"""Which slice pose belongs to which image: the one with the same stamp, whichever of the two comes first."""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image

from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.nodes.conversions import MessageError

# A message that is lost on its way is sent again after three seconds, the heartbeat of a reliable writer.
WAIT_S: Final = 4.0
_CAPACITY: Final = 32
_Stamp: TypeAlias = tuple[int, int]


@dataclass(frozen=True, eq=False)
class _Waiting:
    image: Image
    deadline_s: float


class SlicePoses:
    """Poses `scanner_from_slice` and images that have not met yet, the newest few of each.

    A pose serves one image: a stamp that returns, as when a recording starts again, asks for its pose again.
    In place of a pose stands the MessageError that says why there is none.
    """

    def __init__(self) -> None:
        self._poses: OrderedDict[_Stamp, Pose | MessageError] = OrderedDict()
        self._waiting: deque[_Waiting] = deque()

    def add_pose(self, stamp: Time, pose: Pose | MessageError) -> Image | None:
        """Take a pose; returns the image that waited for it, or keeps the pose for the image to come."""
        for waiting in self._waiting:
            if _key(waiting.image.header.stamp) == _key(stamp):
                self._waiting.remove(waiting)
                return waiting.image
        known = self._poses.get(_key(stamp))
        if isinstance(known, Pose) and isinstance(pose, Pose) and not _same(known, pose):
            pose = MessageError("two different slice_pose messages bear the image's stamp, expected one")
        self._poses[_key(stamp)] = pose
        while len(self._poses) > _CAPACITY:
            self._poses.popitem(last=False)
        return None

    def take_pose(self, stamp: Time) -> Pose | MessageError | None:
        """The pose of an image with this stamp; None where none has come yet."""
        return self._poses.pop(_key(stamp), None)

    def add_image(self, image: Image, now_s: float) -> None:
        """Let an image wait for its pose, from `now_s` in seconds of a steady clock."""
        self._waiting.append(_Waiting(image, now_s + WAIT_S))

    def take_overdue(self, now_s: float) -> Image | None:
        """An image that has waited in vain, or is one too many to keep; None where there is none."""
        if self._waiting and (len(self._waiting) > _CAPACITY or now_s >= self._waiting[0].deadline_s):
            return self._waiting.popleft().image
        return None


def _key(stamp: Time) -> _Stamp:
    return stamp.sec, stamp.nanosec


def _same(one: Pose, other: Pose) -> bool:
    return np.array_equal(one.rotation, other.rotation) and np.array_equal(one.translation, other.translation)
