"""What `/diagnostics` says of the stream of slices: how many, how late, whether it has stopped."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from diagnostic_msgs.msg import DiagnosticStatus

from stereoreg_ros.nodes.common.diagnostic_status import status_with

NAME: Final = "stream"


@dataclass(frozen=True)
class StreamCounts:
    """Slices received and skipped since the start, and those that wait now, the one under way among them."""

    received: int
    skipped: int
    waiting: int


class StreamStatus:
    """Counts of the slices and the times they took; times are seconds of a steady clock but for the latency."""

    def __init__(self, now_s: float) -> None:
        self._last_slice_s: float | None = None
        self._reported_s = now_s
        self._registered = 0
        self._latencies_ms: list[float] = []
        self._reported = StreamCounts(0, 0, 0)

    def registered(self, now_s: float, latency_ms: float) -> None:
        """A slice was accepted or refused; latency_ms: from its stamp to what was published, NaN without a stamp."""
        self._last_slice_s = now_s
        self._registered += 1
        self._latencies_ms.append(latency_ms)

    def report(
        self,
        now_s: float,
        counts: StreamCounts,
        stale_after_s: float,
        hardware_id: str,
        missing: str,
    ) -> DiagnosticStatus:
        """The status since the last report; missing: what has to be set before any slice can be registered, or ""."""
        age_s = now_s - self._last_slice_s if self._last_slice_s is not None else math.nan
        known = [latency for latency in self._latencies_ms if not math.isnan(latency)]
        skipped_now = counts.skipped - self._reported.skipped
        if missing:
            level, message = DiagnosticStatus.ERROR, missing
        elif self._last_slice_s is None:
            level, message = DiagnosticStatus.OK, "waiting for the first slice"
        elif age_s > stale_after_s:
            level, message = DiagnosticStatus.WARN, f"stale: no slice for {age_s:.1f} s"
        elif skipped_now:
            level, message = DiagnosticStatus.WARN, f"{skipped_now} slices skipped: they come faster than registered"
        else:
            level, message = DiagnosticStatus.OK, f"{counts.received - self._reported.received} slices received"
        period_s = max(now_s - self._reported_s, 1e-9)
        values: dict[str, str | int | float] = {
            "slices_received": counts.received,
            "slices_registered": self._registered,
            "slices_skipped": counts.skipped,
            "slices_waiting": counts.waiting,
            "slices_per_second": len(self._latencies_ms) / period_s,
            "last_slice_age_s": age_s,
            "latency_ms": known[-1] if known else math.nan,
            "latency_max_ms": max(known, default=math.nan),
        }
        self._reported_s, self._reported, self._latencies_ms = now_s, counts, []
        return status_with(level, NAME, message, values, hardware_id)
