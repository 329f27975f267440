"""Does memory grow, does latency? From the samples of a long run; what the words mean: `benchmarks.soak`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array

GROWTH_MB: Final = 1.0
FLAT: Final = 1.5
JUDGED_FROM_S: Final = 300.0
_WINDOW_S: Final = 60.0
_FEWEST: Final = 12
_PARTS: Final = 6
_WARM_S: Final = 300.0
_MB_PER_MIB: Final = 1.048576


@dataclass(frozen=True)
class Sample:
    """At one time (ns since the epoch): the node's memory without what files hold, and with it; and the yardstick."""

    at_ns: int
    memory_mib: float
    resident_mib: float
    yardstick_s: float


@dataclass(frozen=True)
class Window:
    """From start_s to end_s since the first slice: median memory, median yardstick, latencies of its slices."""

    start_s: float
    end_s: float
    memory_mib: float
    yardstick_s: float
    p50_s: float
    p99_s: float


@dataclass(frozen=True)
class Verdict:
    """What the windows say; p50_y, p99_y: of each sixth of the run, as multiples of the yardstick."""

    warm_s: float
    warm_mib: float
    highest_mib: float
    growth_mb: float
    p50_y: list[float]
    p99_y: list[float]
    yardstick_ms: float
    p50_ms: float
    p99_ms: float
    longest_ms: float

    @property
    def missed(self) -> list[str]:
        """What is not as it has to be."""
        missed = []
        if not self.growth_mb < GROWTH_MB:
            missed.append(f"memory grew by {self.growth_mb:.2f} MB, expected less than {GROWTH_MB:g}")
        ratio = self.p99_y[-1] / self.p99_y[0]
        if not ratio <= FLAT:
            missed.append(f"p99 of the last sixth is {ratio:.2f} times that of the first, expected at most {FLAT:g}")
        return missed


def windows_of(stamps: NDArray[np.int64], latencies_s: Array, samples: Sequence[Sample]) -> list[Window]:
    """Cut a run into windows; stamps (n,) ns and latencies_s (n,) of the slices answered, in order.

    Raises ValueError where no slice was answered, or a window has no slice or no sample.
    """
    if not stamps.size:
        raise ValueError("no slice was answered")
    begun = stamps[0]
    slices_s = 1e-9 * (stamps - begun)
    samples_s = 1e-9 * np.array([sample.at_ns - begun for sample in samples])
    memory = np.array([sample.memory_mib for sample in samples])
    yardstick = np.array([sample.yardstick_s for sample in samples])
    count = max(_FEWEST, round(slices_s[-1] / _WINDOW_S))
    edges = np.linspace(0.0, np.nextafter(slices_s[-1], np.inf), count + 1)
    windows = []
    for start, end in pairwise(edges):
        of_slices, of_samples = ((start <= at) & (at < end) for at in (slices_s, samples_s))
        if not of_slices.any() or not of_samples.any():
            raise ValueError(f"no slice was answered or no sample taken between {start:.0f} and {end:.0f} s")
        p50, p99 = np.percentile(latencies_s[of_slices], [50, 99])
        middle = float(np.median(memory[of_samples])), float(np.median(yardstick[of_samples]))
        windows.append(Window(float(start), float(end), *middle, float(p50), float(p99)))
    return windows


def verdict_of(windows: Sequence[Window], latencies_s: Array) -> Verdict:
    """Judge a run by its windows, of which there are twelve or more."""
    warm_s = min(_WARM_S, windows[-1].end_s / _PARTS)
    warm = [window for window in windows if window.start_s >= warm_s - 1e-6]
    highest = max(window.memory_mib for window in warm)
    sixths = [[windows[row] for row in rows] for rows in np.array_split(np.arange(len(windows)), _PARTS)]
    p50, p99, longest = (1e3 * float(value) for value in np.percentile(latencies_s, [50, 99, 100]))
    return Verdict(
        warm_s=warm_s,
        warm_mib=warm[0].memory_mib,
        highest_mib=highest,
        growth_mb=_MB_PER_MIB * (highest - warm[0].memory_mib),
        p50_y=[float(np.median([window.p50_s / window.yardstick_s for window in sixth])) for sixth in sixths],
        p99_y=[float(np.median([window.p99_s / window.yardstick_s for window in sixth])) for sixth in sixths],
        yardstick_ms=1e3 * float(np.median([window.yardstick_s for window in windows])),
        p50_ms=p50,
        p99_ms=p99,
        longest_ms=longest,
    )
