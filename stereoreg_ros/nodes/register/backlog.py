"""The slices that wait to be registered: in order while that is timely, the newest alone where it is not."""

from __future__ import annotations

from collections import deque
from typing import Final

from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice

# Slices that come faster than they are registered are skipped once one has waited for so long.
MOST_WAIT_S: Final = 0.5


class Backlog:
    """Slices that are whole and not registered yet; times are seconds of the steady clock."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[IncomingSlice, float]] = deque()
        self.skipped = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, incoming: IncomingSlice, now_s: float) -> None:
        """Take a slice, which waits from now on: what it waited for before, it could not do without."""
        self._waiting.append((incoming, now_s))

    def take_late(self, now_s: float) -> list[IncomingSlice]:
        """The slices that are skipped, in order: all but the newest where the oldest has waited too long."""
        if not self._waiting or now_s - self._waiting[0][1] <= MOST_WAIT_S:
            return []
        late = [self._waiting.popleft()[0] for _ in range(len(self._waiting) - 1)]
        self.skipped += len(late)
        return late

    def take(self) -> IncomingSlice | None:
        """The slice whose turn it is, None where none waits."""
        return self._waiting.popleft()[0] if self._waiting else None
