"""What `/diagnostics` says of the stream of slices: how many, how late, whether it has stopped."""

from __future__ import annotations

import math
from typing import Final

from diagnostic_msgs.msg import DiagnosticStatus

from stereoreg_ros.nodes.diagnostic_status import status_with

NAME: Final = "register_node: stream"


class StreamStatus:
    """Counts of the slices and the times they took; times are seconds of a steady clock but for the latency."""

    def __init__(self, now_s: float) -> None:
        self._last_slice_s: float | None = None
        self._reported_s = now_s
        self._registered = 0
        self._latencies_ms: list[float] = []
        self._reported = (0, 0)

    def registered(self, now_s: float, latency_ms: float) -> None:
        """A slice was accepted or refused; latency_ms: from its stamp to what was published, NaN without a stamp."""
        self._last_slice_s = now_s
        self._registered += 1
        self._latencies_ms.append(latency_ms)

    def due(self, now_s: float, stale_after_s: float) -> bool:
        """Whether there is news: slices since the last report, or none for too long since the last slice or report."""
        if self._latencies_ms:
            return True
        return self._last_slice_s is not None and now_s - max(self._last_slice_s, self._reported_s) > stale_after_s

    def report(
        self, now_s: float, stale_after_s: float, received: int, skipped: int, waiting: int, hardware_id: str
    ) -> DiagnosticStatus:
        """The status since the last report; received, skipped, waiting: images since the start, and now."""
        age_s = now_s - self._last_slice_s if self._last_slice_s is not None else math.nan
        known = [latency for latency in self._latencies_ms if not math.isnan(latency)]
        skipped_now = skipped - self._reported[1]
        if age_s > stale_after_s:
            level, message = DiagnosticStatus.WARN, f"stale: no slice for {age_s:.1f} s"
        elif skipped_now:
            level, message = DiagnosticStatus.WARN, f"{skipped_now} slices skipped: they come faster than registered"
        else:
            level, message = DiagnosticStatus.OK, f"{received - self._reported[0]} slices received"
        period_s = max(now_s - self._reported_s, 1e-9)
        values: dict[str, str | int | float] = {
            "slices_received": received,
            "slices_registered": self._registered,
            "slices_skipped": skipped,
            "slices_waiting": waiting,
            "slices_per_second": len(self._latencies_ms) / period_s,
            "last_slice_age_s": age_s,
            "latency_ms": known[-1] if known else math.nan,
            "latency_max_ms": max(known, default=math.nan),
        }
        self._reported_s, self._reported, self._latencies_ms = now_s, (received, skipped), []
        return status_with(level, NAME, message, values, hardware_id)
