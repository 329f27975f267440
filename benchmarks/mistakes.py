"""`python -m benchmarks.mistakes`: scenes with the mistakes that operators make, and how often a pose is wrong.

One kind and one frame: `python -m benchmarks.mistakes --kinds spacing --frames cube8 --scenes 100`; one scene again,
with all that is known of it: add `--scene 17`. All kinds and frames at 2,000 scenes each take hours.

right: accepted, within 2 mm and 3 degrees. weak: farther off, but no more than the covariance says. wrong: farther off
than that (a squared Mahalanobis distance that chance exceeds once in 1e5), or accepted where the frame is absent. Of
the wrong ones, `fits` are those that explain every spot that a rod made, with residuals as large as the stated noise
and tolerance bring once in a hundred times or more often, while the true matches do not: nothing in the slice speaks
against such a pose. They are counted apart and do not fail.

What no single slice can show, whatever the software:
- A mirrored image or a left-handed frame file: the mirror image of a scene is a scene. Not drawn here.
- Helical motion: the slice is a plane still, tilted by 1.15 degrees.
- A leaning rod mirrored in the file, near the height at which it crosses the true one: there both have the same spot,
  and farther off another tilt brings it nearly to its place. With plates of an N that reaches farthest: two of an N's
  three spots say where the plate is, and only the third at what height it is cut; read the wrong way round, it is
  another height, which some other plane satisfies but for the foreshortening of the plates. `leksell_ct9` with the
  front diagonal mirrored is exactly what the true one is upside down: without a prior every slice fits that.
- Errors of spacing and of rods' ends leave 2 n - 6 figures to tell them by. Five rods leave four: some errors are then
  nearly those of another pose.
The first two are kinds. Of the others it depends on the scene, which is what `fits` says.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from tqdm import tqdm

from benchmarks.matching import is_wrong, random_rods
from stereoreg_ros import PixelScale, Pose, Refusal, Registration, RegistrationOptions, load_frame, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, rotation_angle
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.simulation import ScannerSettings
from stereoreg_ros.simulation.mistakes import (
    NO_ROD,
    NOISE_PX,
    Scene,
    SceneGenerator,
    Surroundings,
    collinear,
    contradicted_prior,
    fragments,
    helical,
    mirrored_rod,
    scale_within_tolerance,
    sister,
    template,
    true_scene,
    wrong_spacing,
)

CASES = Path(__file__).parents[2] / "shared" / "cases" / "mistakes.json"
# Squared Mahalanobis distance of six degrees of freedom that chance exceeds once in 1e5.
STATED = 34.0
ALLOWED_SHARE = 1e-3
_PRIOR_DEG = 30.0
_BATCH = 50
# Probability of residuals as large by noise and tolerance alone, below which the slice speaks against a pose.
_FITS = 0.01


@dataclass(frozen=True)
class Kind:
    """A kind of scene.

    prior: whether a prior of 30 degrees is configured; None: where the frame needs it. nees: limits of the mean squared
    error in terms of the covariance, 6 where it is right. can_show: whether a single slice can show the mistake.
    """

    name: str
    draw: SceneGenerator
    prior: bool | None = None
    nees: tuple[float, float] | None = None
    can_show: bool = True


LAYOUTS = tuple(f"random{number}" for number in range(10))
FRAMES = ("cube5", "cube6", "cube8", "zframe", "leksell_ct9", *LAYOUTS)
_bare = partial(true_scene, most_false=0)
_mismeasured = partial(_bare, rod_ends_mm=1.0)

KINDS = {
    kind.name: kind
    for kind in (
        Kind("true", true_scene),
        Kind("true_missing", partial(true_scene, missing=1)),
        Kind("as_built", partial(true_scene, rod_ends_mm=0.2)),
        Kind("as_built_missing", partial(true_scene, rod_ends_mm=0.2, missing=1)),
        Kind("half_turn", partial(contradicted_prior, turn_deg=180.0), prior=True),
        Kind("quarter_turn", partial(contradicted_prior, turn_deg=90.0), prior=True),
        Kind("spacing", wrong_spacing, prior=False),
        Kind("spacing_prior", wrong_spacing, prior=True),
        Kind("rod_ends", _mismeasured, prior=False),
        Kind("rod_ends_prior", _mismeasured, prior=True),
        Kind("mirrored_rod", mirrored_rod, prior=False),
        Kind("mirrored_rod_prior", mirrored_rod, prior=True),
        Kind("perfect", partial(_bare, stated_mm=0.0, stated_scale=0.0), nees=(5.0, 7.0)),
        Kind("small_rod_ends", partial(_bare, rod_ends_mm=0.25, stated_mm=0.25, stated_scale=0.0), nees=(5.0, 8.0)),
        Kind("small_scale", scale_within_tolerance, nees=(5.0, 8.0)),
        Kind("small_both", partial(scale_within_tolerance, rod_ends_mm=0.25), nees=(5.0, 8.0)),
        Kind("helical", helical, can_show=False),
        Kind("double_noise", partial(_bare, noise_px=2 * NOISE_PX)),
        Kind("template", template, prior=False),
        Kind("template_prior", template, prior=True),
        Kind("sister", sister),
        Kind("sister_missing", partial(sister, missing=1)),
        Kind("fragments", fragments),
        Kind("fragments_alone", partial(fragments, pieces=(2, 4), radius_mm=(0.5, 2.0), with_previous=False)),
        Kind("collinear", collinear),
        Kind("collinear_missing", partial(collinear, missing=1)),
    )
}


@cache
def frame_named(name: str) -> Frame:
    """A shipped frame or a layout of 5 to 9 rods: random0 to random4 of rods at random, the others with N plates."""
    if name not in LAYOUTS:
        return load_frame(name)
    number = LAYOUTS.index(name)
    rng, rods = np.random.default_rng([17, number]), 5 + number % 5
    frame = random_rods(rng, rods) if number < 5 else _with_plates(rng, rods)
    return replace(frame, name=name)


def needs_prior(name: str) -> bool:
    """Whether slices of a frame are ambiguous without a prior; N plates are, read upside down."""
    return name in {"zframe", "leksell_ct", "leksell_ct9", *LAYOUTS[5:]}


def _with_plates(rng: np.random.Generator, rods: int) -> Frame:
    """As many plates of an N as there are threes of rods, on sides of a cube of 60 mm, and random rods between them."""
    starts: list[Array] = []
    ends: list[Array] = []
    for quarter in rng.permutation(4)[: rods // 3]:
        half, out, leans = rng.uniform(18, 28), rng.uniform(28, 34), rng.choice([-1.0, 1.0])
        turned = Rotation.from_euler("z", 90 * quarter + rng.uniform(-10, 10), degrees=True).as_matrix()
        for low, high in ((-half, -half), (-half * leans, half * leans), (half, half)):
            starts.append(turned @ np.array([low, out, -30.0]))
            ends.append(turned @ np.array([high, out, 30.0]))
    while len(starts) < rods:
        start, end = np.append(rng.uniform(-20, 20, 2), -30.0), np.append(rng.uniform(-20, 20, 2), 30.0)
        if min(np.linalg.norm(starts - start, axis=1).min(), np.linalg.norm(ends - end, axis=1).min()) > 8:
            starts.append(start)
            ends.append(end)
    names = tuple(f"r{number}" for number in range(rods))
    return Frame("plates", names, np.array(starts), np.array(ends), np.ones(rods))


@dataclass(frozen=True)
class Outcome:
    """What came of one scene.

    verdict: right, weak, wrong (see above) or the reason of the refusal. error_mm (at the frame's origin), error_deg,
    nees (error' covariance^-1 error): None where refused, or where the frame is absent. plausibility: see there.
    """

    index: int
    verdict: str
    seconds: float
    caution: bool = False
    error_mm: float | None = None
    error_deg: float | None = None
    nees: float | None = None
    plausibility: float | None = None

    @property
    def fits(self) -> bool:
        """Whether it is wrong, but nothing in the slice speaks against it."""
        return self.verdict == "wrong" and self.plausibility is not None and self.plausibility > _FITS


def scene_of(kind: str, frame: str, index: int, seed: int = 0) -> Scene:
    """Scene number `index` of a kind with a frame: the same for the same arguments."""
    rng = np.random.default_rng([seed, index, zlib.crc32(kind.encode()), zlib.crc32(frame.encode())])
    prior = KINDS[kind].prior
    side = 640 if frame.startswith("leksell") else 512
    limit = _PRIOR_DEG if prior or (prior is None and needs_prior(frame)) else 180.0
    return KINDS[kind].draw(rng, frame_named(frame), Surroundings(ScannerSettings(shape=(side, side)), limit))


def read_cases(path: Path = CASES) -> list[Scene]:
    """The scenes that were seen to go wrong; see ../shared/cases/README.md. Which rod made which spot is not known."""
    return [_case(record) for record in json.loads(path.read_text())]


def _case(record: dict[str, Any]) -> Scene:
    frame = frame_named(record["frame"])
    truth, previous = (
        record[key] and Pose.from_quaternion(record[key]["quaternion_xyzw"], record[key]["position_mm"])
        for key in ("truth", "previous")
    )
    spots = np.array(record["spots_px"])
    return Scene(
        spots_px=spots,
        rods=np.full(len(spots), NO_ROD),
        frame=frame,
        scale=PixelScale(*record["pixel_spacing"]),
        options=record["options"],
        slice_area_mm2=record["slice_area_mm2"],
        previous=previous,
        truth=truth,
        true_frame=None if truth is None else frame,
    )


def register(scene: Scene) -> Registration | Refusal:
    """Register a scene as it is configured."""
    return register_spots(
        scene.spots_px,
        scene.frame,
        scene.scale,
        options_of(scene),
        slice_area_mm2=scene.slice_area_mm2,
        previous=scene.previous,
    )


def options_of(scene: Scene) -> RegistrationOptions:
    """The options of a scene; the defaults for those that it does not name."""
    return replace(RegistrationOptions(), **scene.options)  # type: ignore[arg-type]


def judge(scene: Scene, result: Registration | Refusal, *, near_too: bool = False) -> Outcome:
    """The outcome, without index and time. near_too: wrong is what exceeds its stated error, however near it is."""
    if not result:
        return Outcome(0, result.reason, 0.0)
    caution = bool(result.caution)
    if scene.truth is None:
        return Outcome(0, "wrong", 0.0, caution=caution)
    found, truth = result.scanner_from_frame, scene.truth
    shift, turn = found.translation - truth.translation, found.rotation @ truth.rotation.T
    error = np.append(shift, Rotation.from_matrix(turn).as_rotvec())
    nees = float(error @ np.linalg.solve(result.covariance, error))
    is_far = is_wrong(found, truth)
    is_beyond = nees > STATED and (is_far or near_too)
    verdict = "wrong" if is_beyond else "weak" if is_far else "right"
    return Outcome(
        index=0,
        verdict=verdict,
        seconds=0.0,
        caution=caution,
        error_mm=float(np.linalg.norm(shift)),
        error_deg=float(np.degrees(rotation_angle(turn))),
        nees=nees,
        plausibility=plausibility(scene, result),
    )


def plausibility(scene: Scene, result: Registration) -> float | None:
    """Probability of residuals as large by noise and tolerance alone; None where the slice speaks against the pose.

    It does so unless every spot that a rod made is matched, and no other; a rod of several spots leaves some over.
    Where the matches are not the true ones, those must not fit as well, or the slice is ambiguous. Worked out here, not
    taken from the result, as it excuses a wrong pose. The scale's tolerance is left out: that excuses less.
    """
    made = np.flatnonzero(scene.rods != NO_ROD)
    spots = np.array([match.spot for match in result.matches])
    rods = np.array([match.line_index for match in result.matches])
    if not made.size or len(set(scene.rods[made])) < len(made) or not np.array_equal(np.sort(spots), made):
        return None
    if scene.truth is not None and not np.array_equal(scene.rods[spots], rods):
        truth = scene.truth

        def residuals(step: Array) -> Array:
            return _whitened(scene, truth.perturbed(step[:3], step[3:]), scene.rods[made], made)

        best = least_squares(residuals, np.zeros(6), x_scale=[1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
        if _probability(best.fun) > _FITS:
            return None
    return _probability(_whitened(scene, result.estimate.slice_from_frame, rods, spots))


def _whitened(scene: Scene, pose: Pose, rods: NDArray[np.intp], spots: NDArray[np.intp]) -> Array:
    """Residuals (2k,) of spots (k,) at rods (k,), in standard deviations, at a pose slice_from_frame."""
    options, frame = options_of(scene), scene.frame
    predicted, cuts = project(frame, pose, scene.scale)
    residuals = scene.scale.to_mm(scene.spots_px[spots] - predicted[rods])
    along = ((cuts.lambdas - frame.lambda_min) / (frame.lambda_max - frame.lambda_min))[rods]
    # Both ends are off, independently; what they are off by along the normal moves the cut along the rod's slope.
    slope = cuts.directions[rods, :2] / cuts.directions[rods, 2:]
    variance = frame.tolerances_or(options.frame_tolerance_mm)[rods] ** 2 * (along**2 + (1 - along) ** 2)
    of_rods = variance[:, None, None] * (np.eye(2) + slope[:, :, None] * slope[:, None, :])
    of_spots = options.spot_noise_px**2 * scene.scale.matrix @ scene.scale.matrix.T
    whitening = np.linalg.inv(np.linalg.cholesky(of_rods + of_spots))
    whitened: Array = (whitening @ residuals[..., None]).ravel()
    return whitened


def _probability(whitened: Array) -> float:
    """Of residuals (2k,) as large, of which a pose has taken six."""
    return float(chi2.sf(float(whitened @ whitened), len(whitened) - 6))


def measure(kind: str, frame: str, start: int, count: int, seed: int = 0) -> list[Outcome]:
    """The outcomes of scenes `start` to `start + count - 1` of a kind with a frame."""
    cv2.setNumThreads(1)
    return [_timed(index, scene_of(kind, frame, index, seed)) for index in range(start, start + count)]


def measure_cases(path: Path = CASES) -> list[Outcome]:
    """The outcomes of the scenes that were seen to go wrong: right is what is within its stated error, or refused."""
    return [_timed(index, scene, near_too=True) for index, scene in enumerate(read_cases(path))]


def _timed(index: int, scene: Scene, *, near_too: bool = False) -> Outcome:
    start = time.perf_counter()
    result = register(scene)
    seconds = time.perf_counter() - start
    return replace(judge(scene, result, near_too=near_too), index=index, seconds=seconds)


@dataclass(frozen=True)
class Row:
    """A kind with a frame. cautioned: how many of the wrong poses had a caution; nees: mean over accepted poses."""

    kind: str
    frame: str
    scenes: int
    right: int
    weak: int
    wrong: int
    fits: int
    cautioned: int
    refused: dict[str, int]
    nees: float | None
    median_s: float
    wrong_scenes: tuple[Outcome, ...]

    @property
    def shortcoming(self) -> str:
        """What is worse than it may be; empty where nothing is."""
        kind = KINDS.get(self.kind)
        if kind is None:
            return "WRONG" if self.wrong else ""
        if kind.can_show and self.wrong - self.fits > ALLOWED_SHARE * self.scenes:
            return "WRONG"
        if kind.nees is not None and self.nees is not None and not kind.nees[0] <= self.nees <= kind.nees[1]:
            return "NEES"
        return ""


def row_of(kind: str, frame: str, outcomes: list[Outcome]) -> Row:
    """The row of the table."""
    counts = Counter(outcome.verdict for outcome in outcomes)
    nees = [outcome.nees for outcome in outcomes if outcome.nees is not None]
    wrong = tuple(outcome for outcome in outcomes if outcome.verdict == "wrong")
    return Row(
        kind=kind,
        frame=frame,
        scenes=len(outcomes),
        right=counts.pop("right", 0),
        weak=counts.pop("weak", 0),
        wrong=counts.pop("wrong", 0),
        fits=sum(outcome.fits for outcome in wrong),
        cautioned=sum(outcome.caution for outcome in wrong),
        refused=dict(counts),
        nees=float(np.mean(nees)) if nees else None,
        median_s=float(np.median([outcome.seconds for outcome in outcomes])),
        wrong_scenes=wrong,
    )


def measured_rows(kinds: list[str], frames: list[str], scenes: int, seed: int, workers: int) -> Iterator[Row]:
    """A row for each kind and frame; the same, times apart, whatever the number of workers."""
    cells = [(kind, frame) for frame in frames for kind in kinds]
    starts = range(0, scenes, _BATCH)
    with (
        ProcessPoolExecutor(workers) as pool,
        tqdm(total=len(cells) * scenes, unit="scene", disable=None, leave=False) as bar,
    ):
        jobs = [
            [pool.submit(measure, *cell, start, min(_BATCH, scenes - start), seed) for start in starts]
            for cell in cells
        ]
        for (kind, frame), parts in zip(cells, jobs, strict=True):
            bar.set_description(f"{kind}, {frame}")
            outcomes: list[Outcome] = []
            for part in parts:
                outcomes += part.result()
                bar.update(len(part.result()))
            yield row_of(kind, frame, outcomes)


_HEAD = (
    "kind                frame        scenes   right  weak  wrong  fits  cautioned  refused   NEES  median/ms  "
    "reasons of refusals"
)


def _line(row: Row) -> str:
    nees = "" if row.nees is None else f"{row.nees:.4g}"
    reasons = ", ".join(f"{reason} {number}" for reason, number in sorted(row.refused.items()))
    indices = ", ".join(str(outcome.index) for outcome in row.wrong_scenes if not outcome.fits)
    wrong = f"  {row.shortcoming}: scenes {indices:.40}" if row.shortcoming == "WRONG" else f"  {row.shortcoming}"
    return (
        f"{row.kind:19s} {row.frame:12s} {row.scenes:6d}  {row.right:6d} {row.weak:5d}  {row.wrong:5d} {row.fits:5d}  "
        f"{row.cautioned:9d}  {sum(row.refused.values()):7d}  {nees:>5s}  {1e3 * row.median_s:9.0f}  {reasons}{wrong}"
    )


def _describe(kind: str, frame: str, index: int, seed: int) -> None:
    """One scene: what is true, and what came of it."""
    scene = scene_of(kind, frame, index, seed)
    result = register(scene)
    print(f"{len(scene.spots_px)} spots, rods {scene.rods.tolist()}, options {scene.options}, scale {scene.scale}")
    print(f"truth {scene.truth}\nprevious {scene.previous}\n{judge(scene, result)}")
    estimates = (result.estimate,) if result else result.estimates
    print(f"accepted; caution: {result.caution or 'none'}" if result else f"{result.reason}: {result.message}")
    for estimate in estimates:
        matches = {match.line_index: int(scene.rods[match.spot]) for match in estimate.matches}
        print(
            f"{estimate.inliers} rods, log10 false alarms {estimate.log10_false_alarms:.1f}, chi-square "
            f"{estimate.chi_square:.1f} of {estimate.degrees_of_freedom}, {estimate.position_std_mm:.2f} mm, "
            f"{estimate.rotation_std_deg:.2f} degrees; rod: whose spot it has {matches}\n{estimate.scanner_from_frame}"
        )


def main() -> int:
    """Print the table and write it as JSON; 1 where more than 1 in 1,000 is wrong that a slice can show."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.mistakes", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=2000, help="scenes of each kind and frame (default 2000)")
    parser.add_argument(
        "--kinds", nargs="+", default=[*KINDS, "cases"], choices=[*KINDS, "cases"], metavar="KIND",
        help=f"of {', '.join(KINDS)}, and cases, the scenes of {CASES.name} (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--frames", nargs="+", default=list(FRAMES), metavar="FRAME", help=f"(default: {', '.join(FRAMES)})"
    )
    parser.add_argument("--scene", type=int, help="describe this one scene of the first kind and frame, and no more")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: all cores)")
    parser.add_argument("--output", type=Path, default=Path("build/mistakes.json"), help="JSON file to write")
    arguments = parser.parse_args()
    kinds = [kind for kind in arguments.kinds if kind != "cases"]
    if arguments.scene is not None:
        _describe(kinds[0], arguments.frames[0], arguments.scene, arguments.seed)
        return 0
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []

    def add(row: Row) -> None:
        rows.append(row)
        tqdm.write(_line(row), file=sys.stdout)
        sys.stdout.flush()
        # After each row, as all of them take hours.
        arguments.output.write_text(json.dumps([asdict(one) for one in rows], indent=1) + "\n")

    print(_HEAD, flush=True)
    if "cases" in arguments.kinds and CASES.exists():
        add(row_of("cases", "", measure_cases()))
    elif "cases" in arguments.kinds:
        print(f"cases: {CASES} is absent, skipped")
    for row in measured_rows(kinds, arguments.frames, arguments.scenes, arguments.seed, arguments.workers):
        add(row)
    print(f"\nas JSON: {arguments.output}")
    short = [row for row in rows if row.shortcoming]
    for row in short:
        print(f"{row.shortcoming}: {row.kind} {row.frame}")
    return 1 if any(row.shortcoming == "WRONG" for row in short) else 0


if __name__ == "__main__":
    sys.exit(main())
