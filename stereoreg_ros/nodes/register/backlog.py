"""The slices that wait to be registered: in order while that is timely, the newest alone where it is not."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any, Final

from rclpy.subscription import Subscription
from sensor_msgs.msg import Image

# Slices that come faster than they are registered are skipped once one has waited for so long.
MOST_WAIT_S: Final = 0.5
_NS_PER_S: Final = 1e9


class Backlog:
    """Images that were received and not registered yet."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Image, float]] = deque()
        self.received = 0
        self.skipped = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, image: Image, received_s: float) -> None:
        """Take an image; received_s: when it came, in seconds of the system's clock."""
        self.received += 1
        self._waiting.append((image, received_s))

    def take_late(self, now_s: float) -> list[Image]:
        """The images that are skipped, in order: all but the newest where the oldest has waited too long."""
        # A clock that was set back makes no slice old.
        if not self._waiting or now_s - self._waiting[0][1] <= MOST_WAIT_S:
            return []
        late = [self._waiting.popleft()[0] for _ in range(len(self._waiting) - 1)]
        self.skipped += len(late)
        return late

    def take(self) -> Image | None:
        """The image whose turn it is, None where none waits."""
        return self._waiting.popleft()[0] if self._waiting else None


def waiting_in(subscription: Subscription) -> Iterator[tuple[Image, float]]:
    """Messages that the middleware holds for a subscription, with the seconds at which each came.

    The executor hands out one for each of its turns, so that by itself the node would not know how many wait.
    """
    while True:
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, False)
        if taken is None:
            return
        yield taken[0], received_s(taken[1])


def received_s(message_info: Any) -> float:
    """When a message came, seconds of the system's clock."""
    return float(message_info["received_timestamp"]) / _NS_PER_S
