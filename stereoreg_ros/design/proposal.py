"""A frame that can be built: searched for, rounded, and tried for ambiguous poses with each rod missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereoreg_ros.design.ambiguity import trials
from stereoreg_ros.design.layouts import Layouts
from stereoreg_ros.design.meeting import meetings
from stereoreg_ros.design.search import Wish, search
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.options import RegistrationOptions

_ATTEMPTS = 4
_POSES = 64


@dataclass(frozen=True, eq=False)
class Proposal:
    """A frame; target_error_95_mm: over the wished poses; ambiguous, tried: of so many spot sets, how many another pose
    explained as well, with all rods and with each one missing (tried is 0 where that was interrupted); interrupted.
    """

    frame: Frame
    target_error_95_mm: float
    ambiguous: int
    tried: int
    interrupted: bool


def propose(
    wish: Wish,
    name: str,
    options: RegistrationOptions,
    seed: int,
    chains: int,
    progress: Callable[[str, float, float], bool] | None = None,
) -> Proposal:
    """The first of a few searches, each with a seed of its own, whose frame is never ambiguous; else the least so.

    progress: told what is done, the share of it done and the least error so far, says whether to go on.
    Raises ValueError where no layout that can be built was found.
    """
    best: Proposal | None = None
    for attempt in range(_ATTEMPTS):
        what = "searching" if attempt == 0 else f"searching, attempt {attempt + 1}"

        def tell(share: float, least: float, what: str = what) -> bool:
            return progress is None or progress(what, share, least)

        found = search(wish, seed + attempt, chains, tell)
        layouts = wish.envelope.layouts(found.corners[None], wish.diameters_mm)
        rounded = Layouts(np.round(layouts.starts, 1), np.round(layouts.ends, 1), layouts.diameters)
        frame, error = rounded.frame(0, name), float(wish.target_errors(rounded)[0])
        ambiguous, tried, interrupted = 0, 0, found.interrupted
        if not interrupted:
            try:
                ambiguous, tried, interrupted = _ambiguous(wish, frame, error, options, seed, progress)
            except KeyboardInterrupt:
                interrupted = True
        proposal = Proposal(frame, error, ambiguous, tried, interrupted)
        if best is None or (tried > 0 and ambiguous < best.ambiguous):
            best = proposal
        if interrupted or ambiguous == 0:
            break
    assert best is not None
    return best


def _ambiguous(
    wish: Wish,
    frame: Frame,
    error: float,
    options: RegistrationOptions,
    seed: int,
    progress: Callable[[str, float, float], bool] | None,
) -> tuple[int, int, bool]:
    """How many spot sets were explained by more than one pose or by a wrong one, of how many; whether cut short."""
    heights = np.array([-wish.largest_height_mm, wish.largest_height_mm])
    poses = meetings(_POSES, seed + 1, np.zeros(3), heights, wish.largest_tilt_deg)
    left_out: list[int | None] = [None, *range(len(frame))]
    total, ambiguous, tried = len(poses) * len(left_out), 0, 0
    for trial in trials(frame, poses, wish.imaging.scale, options, left_out, np.random.default_rng(seed)):
        tried += 1
        ambiguous += trial.reason == "ambiguous" or (not trial.reason and not trial.right)
        if progress is not None and not progress("trying poses", tried / total, error):
            return ambiguous, tried, True
    return ambiguous, tried, False
