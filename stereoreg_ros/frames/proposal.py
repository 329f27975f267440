"""A frame that can be built: searched for, rounded, and tried for ambiguous poses with each rod missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereoreg_ros.frames.ambiguity import trials
from stereoreg_ros.frames.design_search import Candidate, Requirements, search
from stereoreg_ros.frames.layouts import Layouts
from stereoreg_ros.frames.slice_poses import slice_poses
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import rotation_from_quaternion
from stereoreg_ros.options import RegistrationOptions

_ATTEMPTS = 3
_POSES = 500


@dataclass(frozen=True, eq=False)
class Proposal:
    """A frame; target_error_95_mm: over the required poses; ambiguous, tried: how many of how many spot sets, with all
    rods and with each one missing, how many another pose explained as well: at the first one, trying ends (tried is 0
    where it was interrupted); interrupted.
    """

    frame: Frame
    target_error_95_mm: float
    ambiguous: int
    tried: int
    interrupted: bool


def propose(
    requirements: Requirements,
    name: str,
    options: RegistrationOptions,
    seed: int,
    chains: int,
    progress: Callable[[str, float, float], bool] | None = None,
) -> Proposal:
    """The best layout of a search that is never ambiguous; where none is, of another search, and at last the one that
    was ambiguous latest.

    options: those of the later registration, such as how the frame stands. progress: called with what is done, the
    share of it done and the least error so far, says whether to go on. Raises ValueError where no layout that can be
    built was found.
    """
    best: Proposal | None = None
    for attempt in range(_ATTEMPTS):
        what = "searching" if attempt == 0 else f"searching, attempt {attempt + 1}"

        def tell(share: float, least: float, what: str = what) -> bool:
            return progress is None or progress(what, share, least)

        for candidate in search(requirements, seed + attempt, chains, tell):
            frame, error = _rounded(requirements, candidate, name)
            if candidate.interrupted:
                return best or Proposal(frame, error, 0, 0, True)
            try:
                proposal = _tried(requirements, frame, error, options, seed, progress)
            except KeyboardInterrupt:
                proposal = Proposal(frame, error, 0, 0, True)
            if proposal.interrupted or proposal.ambiguous == 0:
                return proposal
            if best is None or proposal.tried > best.tried:
                best = proposal
    assert best is not None
    return best


def _rounded(requirements: Requirements, candidate: Candidate, name: str) -> tuple[Frame, float]:
    """Ends to a tenth of a millimetre, as they can be drilled; and the target error of that."""
    layouts = requirements.envelope.layouts(candidate.corners[None], requirements.diameters_mm)
    rounded = Layouts(np.round(layouts.starts, 1), np.round(layouts.ends, 1), layouts.diameters)
    return rounded.frame(0, name), float(requirements.target_errors(rounded)[0])


def _tried(
    requirements: Requirements,
    frame: Frame,
    error: float,
    options: RegistrationOptions,
    seed: int,
    progress: Callable[[str, float, float], bool] | None,
) -> Proposal:
    """The frame with how many spot sets were explained by more than one pose or by a wrong one."""
    heights = np.array([-requirements.largest_height_mm, requirements.largest_height_mm])
    nominal = rotation_from_quaternion(options.nominal_orientation)
    poses = slice_poses(
        _POSES, seed + 1, np.zeros(3), heights, requirements.largest_tilt_deg, nominal, options.max_rotation_deg
    )
    left_out: list[int | None] = [None, *range(len(frame))]
    total, ambiguous, tried = len(poses) * len(left_out), 0, 0
    for trial in trials(frame, poses, requirements.imaging.scale, options, left_out, np.random.default_rng(seed)):
        tried += 1
        ambiguous += trial.reason == "ambiguous" or (not trial.reason and not trial.right)
        if ambiguous:
            break
        if progress is not None and not progress("trying poses", tried / total, error):
            return Proposal(frame, error, ambiguous, tried, True)
    return Proposal(frame, error, ambiguous, tried, False)
