"""Scenes with the mistakes that operators make, by kind, frame and number: the same for the same arguments."""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stereoreg_ros import PixelScale, Pose, Refusal, Registration, RegistrationOptions, load_frame, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
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
from support.dicom_files import ROOT
from support.rod_layouts import random_rods

CASES = ROOT.parent / "shared" / "cases" / "mistakes.json"
_PRIOR_DEG = 30.0


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
