"""The unit of all times here: threshold and connected components of a 512 x 512 slice, on this machine, in this run."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import cv2
import numpy as np

from stereoreg_ros import load_frame
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice


def seconds_of(call: Callable[[], object]) -> float:
    """Wall time of one call, s."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


class Yardstick:
    """One threshold and one labelling of a rendered slice with six rods and eight false spots."""

    def __init__(self) -> None:
        frame = load_frame("cube6")
        rng = np.random.default_rng(0)
        settings = ScannerSettings(false_spots=8)
        self._hu = render_slice([PlacedFrame(frame, random_pose(rng, frame, settings))], settings, rng).hu

    def once(self) -> float:
        """Seconds that it takes at present; other work on the machine makes it vary."""
        return seconds_of(lambda: cv2.connectedComponentsWithStats((self._hu > 2000).view(np.uint8), connectivity=8))

    def unit(self, repeats: int = 200) -> float:
        """The median of several, s."""
        return median(self.once() for _ in range(repeats))
