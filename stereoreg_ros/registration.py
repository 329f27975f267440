"""Slice in, pose or refusal out. The file to read first.

find the spots (`spots`) -> match them to rods (`matching`) -> estimate the pose and how far to believe it
(`estimation`) -> judge: accept it, or refuse it with a reason (`judgement`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from stereoreg_ros.estimation import estimate
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.judgement import Case, Verdict, judge, unfit
from stereoreg_ros.matching import Matchers
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.rivals import Rivals
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.result import PoseEstimate, Recognition, Refusal, Registration
from stereoreg_ros.spots import find_spots
from stereoreg_ros.uncertainty import checked_scale_covariance

# How many frames the functions of this module keep the tables of: mostly tens of MB each, with all of them prepared up
# to 300. Slices that show more frames than this are for a caller with a `Registrar` for each.
_KEPT_FRAMES: Final = 8


class Registrar:
    """Registers one frame from the spots of slice after slice, with tables of its own.

    Several threads may share it. The functions of this module keep one for each of the last few frames; who registers
    for long has its own.
    """

    def __init__(self, frame: Frame, matchers: Matchers | None = None) -> None:
        """matchers: of an equal frame, to be shared; by default its own."""
        self.frame = frame
        self._matchers = matchers or Matchers(frame)

    def register(
        self, spots: SliceSpots, options: RegistrationOptions | None = None, previous: Pose | None = None
    ) -> Registration | Refusal:
        """Match, estimate, judge; see `register_spots`."""
        options, frame = options or RegistrationOptions(), self.frame

        def refusal(verdict: Verdict, estimates: tuple[PoseEstimate, ...] = ()) -> Refusal:
            assert verdict.reason is not None
            return Refusal(frame, spots, verdict.reason, verdict.message, estimates, options)

        if fault := unfit(frame, len(spots), options):
            return refusal(fault)
        matcher = self._matchers[options.matcher]
        problem = Problem.of(spots, frame, options, previous if matcher.follows_guess else None)
        found = matcher.match(problem)
        # How weakly a pose is determined matters of the best one: the others are only listed.
        estimates = tuple(estimate(one, problem, spots, rank == 0) for rank, one in enumerate(found.hypotheses))
        verdict = judge(Case(problem, options, found, estimates, Rivals(problem, found, self._matchers.by_levels)))
        if verdict.reason is not None:
            return refusal(verdict, estimates)
        return Registration(frame, spots, options, estimates[0], verdict.message)

    def recognise(self, spots: SliceSpots, options: RegistrationOptions | None = None) -> Recognition | None:
        """What the spots look most like; see `recognise`."""
        options = options or RegistrationOptions()
        if unfit(self.frame, len(spots), options):
            return None
        problem = Problem.of(spots, self.frame, options)
        found = self._matchers.by_levels.match_most(problem)
        return Recognition(spots, options, estimate(found[0], problem, spots, False)) if found else None

    def preparation(self, scale: PixelScale, options: RegistrationOptions | None = None) -> Iterator[None]:
        """Fill the tables that slices with this scale need, in small steps; what most slices need comes first."""
        options = options or RegistrationOptions()
        return self._matchers[options.matcher].preparation(scale, options)


@lru_cache(maxsize=_KEPT_FRAMES)
def _kept(frame: Frame) -> Matchers:
    return Matchers(frame)


def _registrar_of(frame: Frame | Registrar) -> Registrar:
    return frame if isinstance(frame, Registrar) else Registrar(frame, _kept(frame))


def prepare(frame: Frame, scale: PixelScale, options: RegistrationOptions | None = None) -> None:
    """Fill the tables that slices with `frame` need; else the first slices wait for them. Takes long for many rods."""
    for _ in preparation(frame, scale, options):
        pass


def preparation(frame: Frame, scale: PixelScale, options: RegistrationOptions | None = None) -> Iterator[None]:
    """The same in small steps, for those who have other things to do; what most slices need comes first."""
    return _registrar_of(frame).preparation(scale, options)


def register_slice(
    ct_slice: Slice,
    frame: Frame,
    options: RegistrationOptions | None = None,
    previous: Pose | None = None,
    scale_covariance: ArrayLike | None = None,
) -> Registration | Refusal:
    """Register `frame` from one slice: scanner_from_frame in mm, or a refusal with its reason.

    previous, scale_covariance: see `register_spots`.
    """
    options = options or RegistrationOptions()
    known = None if scale_covariance is None else checked_scale_covariance(scale_covariance)
    spots = replace(find_spots(ct_slice, options), scale_covariance=known)
    return register_slice_spots(spots, frame, options, previous)


def register_frames(
    ct_slice: Slice,
    frames: Sequence[Frame | Registrar],
    options: RegistrationOptions | None = None,
    previous: Sequence[Pose | None] | None = None,
    scale_covariance: Array | None = None,
) -> list[Registration | Refusal]:
    """Register several frames from one slice, one result for each, in their order.

    The spots are found once, and each frame is sought among all of them. Where two accepted frames lay claim to a spot,
    the one that chance would bring less often keeps it, and the other one is sought again among the rest: the result
    does not depend on the frames' order. `Match.spot` counts in the spots of that frame's own result. frames: or a
    `Registrar` for each, which keeps the tables. previous: one a frame; that and scale_covariance: see
    `register_spots`.
    """
    options = options or RegistrationOptions()
    known = None if scale_covariance is None else checked_scale_covariance(scale_covariance)
    whole = replace(find_spots(ct_slice, options), scale_covariance=known)
    before = list(previous or [None] * len(frames))
    if len(before) != len(frames):
        raise ValueError(f"previous has {len(before)} poses, expected one for each of {len(frames)} frames")
    registrars = [_registrar_of(frame) for frame in frames]
    offered = [np.arange(len(whole)) for _ in frames]
    results = [one.register(whole, options, guess) for one, guess in zip(registrars, before, strict=True)]
    while True:
        claims = {
            row: set(offered[row][[match.spot for match in result.matches]].tolist())
            for row, result in enumerate(results)
            if result
        }
        # The surest first; each takes what is left by those before.
        surest = sorted(claims, key=lambda row: (results[row].estimate.log10_false_alarms, row))  # type: ignore[union-attr]
        kept: set[int] = set()
        loser = None
        for row in surest:
            if claims[row] & kept:
                loser = row
                break
            kept |= claims[row]
        if loser is None:
            return results
        offered[loser] = np.array([spot for spot in offered[loser] if spot not in kept], dtype=np.intp)
        results[loser] = registrars[loser].register(whole.take(offered[loser]), options, before[loser])


def register_spots(
    spots_px: ArrayLike,
    frame: Frame,
    scale: PixelScale,
    options: RegistrationOptions | None = None,
    scanner_from_slice: Pose | None = None,
    slice_area_mm2: float | None = None,
    previous: Pose | None = None,
    covariances_px2: ArrayLike | None = None,
    scale_covariance: ArrayLike | None = None,
) -> Registration | Refusal:
    """Register `frame` from the centres of bright spots (n, 2) in pixel (u, v), false ones among them.

    scanner_from_slice: where the slice lies in the scanner; by default the scanner is the slice. slice_area_mm2: the
    area over which spots could have been found; by default it is judged by the spots themselves. previous: a guess,
    scanner_from_frame of the slice before; where the frame is still near it, little else has to be searched, and chance
    brings less. Half of the false alarms that are allowed are for poses near the guess, half for all poses, so that a
    guess however wrong costs no certainty. The matcher `maurin2009` makes no use of it. covariances_px2: (n, 2, 2), of
    the centres, pixel^2, as their image shows them; where they are smaller than `spot_noise_px` has it, that counts, as
    the frame is known no better. scale_covariance: (2, 2) of (sx, sy) or (3, 3) of (sx, sy, shear), mm^2/pixel^2, where
    the scale was measured: what it makes the pose uncertain by is added to the pose's covariance.
    Raises ValueError where the spots are not of shape (n, 2) or not finite, or where a covariance is not one.
    """
    spots = SliceSpots(
        np.asarray(spots_px, dtype=np.float64),
        scale,
        scanner_from_slice=scanner_from_slice or Pose.identity(),
        area_mm2=slice_area_mm2,
        scale_covariance=None if scale_covariance is None else checked_scale_covariance(scale_covariance),
    )
    if covariances_px2 is not None:
        spots = replace(spots, covariances_px2=np.asarray(covariances_px2, dtype=np.float64))
    return register_slice_spots(spots, frame, options, previous)


def register_slice_spots(
    spots: SliceSpots, frame: Frame, options: RegistrationOptions | None = None, previous: Pose | None = None
) -> Registration | Refusal:
    """Register `frame` from the spots of a slice, whoever found them; previous: see `register_spots`."""
    return _registrar_of(frame).register(spots, options, previous)


def recognise(spots: SliceSpots, frame: Frame, options: RegistrationOptions | None = None) -> Recognition | None:
    """What the spots look most like, the most rods before the best fit, or None where they look like no part of it.

    It is not judged, and nothing is sought that speaks against it: a pose for those who test it in another way, as the
    calibration does with scales.
    """
    return _registrar_of(frame).recognise(spots, options)
