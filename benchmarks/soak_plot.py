"""Memory and latency over a long run as a picture; needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from support.soak_verdict import Sample, Verdict, Window


def draw_soak(samples: Sequence[Sample], windows: Sequence[Window], verdict: Verdict, path: Path) -> None:
    """Write a PNG: the memory of register_node, and the latency of each window, against minutes."""
    figure = Figure(figsize=(9, 7), layout="constrained")
    memory, latency = figure.subplots(2, 1, sharex=True)
    begun = samples[0].at_ns
    minutes = [(sample.at_ns - begun) / 60e9 for sample in samples]
    middles = [(window.start_s + window.end_s) / 120 for window in windows]
    memory.plot(minutes, [sample.memory_mib for sample in samples], ".", markersize=3, label="not held by files")
    memory.plot(middles, [window.memory_mib for window in windows], color="tab:red", label="median of each window")
    memory.axvline(verdict.warm_s / 60, color="black", linestyle=":", label="warm")
    memory.set_ylabel("memory of register_node / MiB")
    memory.set_title(f"growth {verdict.growth_mb:+.3f} MB after warm-up", fontsize="medium")
    latency.plot(middles, [1e3 * window.p50_s for window in windows], label="p50")
    latency.plot(middles, [1e3 * window.p99_s for window in windows], label="p99")
    latency.plot(middles, [1e3 * window.yardstick_s for window in windows], color="grey", label="the yardstick Y")
    latency.set_ylim(bottom=0.0)
    latency.set_ylabel("image to answer / ms")
    latency.set_xlabel("minutes")
    sixths = ", ".join(f"{value:.1f}" for value in verdict.p99_y)
    latency.set_title(f"p99 by sixths of the run: {sixths} Y", fontsize="medium")
    for axes in (memory, latency):
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    figure.savefig(path, dpi=100)
