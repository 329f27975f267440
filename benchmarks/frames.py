"""`python -m benchmarks.frames`: the shipped cubes beside random layouts that could be built, and their ambiguity."""

from __future__ import annotations

import argparse
import sys

import numpy as np
from tqdm import tqdm

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame
from stereoreg_ros.frames.ambiguity import reasons, trials
from stereoreg_ros.frames.design_search import Requirements, random_layouts
from stereoreg_ros.frames.expected_error import Imaging
from stereoreg_ros.frames.layouts import Envelope, Layouts, gaps
from stereoreg_ros.frames.slice_poses import slice_poses

# What cube5 and cube8 were designed for; see the comments in their files.
ENVELOPE = Envelope((60.0, 60.0, 60.0), 5.0)
SCALE = PixelScale(0.5, 0.5)
IMAGING = Imaging(SCALE, noise_px=0.3, thickness_mm=1.0)
TARGET_MM = (0.0, 100.0, 0.0)
TILT_DEG, HEIGHT_MM = 30.0, 15.0
_WANTED = 0.85


def main() -> int:
    """Print the table; 1 where a frame is not 15 % better than the best random one, or a spot set ambiguous."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.frames", description=__doc__)
    parser.add_argument("--layouts", type=int, default=2000, help="random layouts for each cube (default 2000)")
    parser.add_argument("--poses", type=int, default=500, help="poses tried with each rod missing (default 500)")
    parser.add_argument("--frames", nargs="+", default=["cube5", "cube6", "cube8"], help="shipped frames")
    arguments = parser.parse_args()
    failed = False
    print("frame  rods  gap/mm  95 % target error/mm  best random  median random   sets  accepted  ambiguous  wrong")
    for name in arguments.frames:
        frame = load_frame(name)
        requirements = Requirements(ENVELOPE, tuple(frame.diameters), IMAGING, TARGET_MM, TILT_DEG, HEIGHT_MM)
        error = float(requirements.target_errors(Layouts.of(frame))[0])
        drawn = random_layouts(requirements, arguments.layouts, np.random.default_rng(0))
        random = np.concatenate(
            [
                requirements.target_errors(ENVELOPE.layouts(part, frame.diameters))
                for part in np.array_split(drawn, max(1, len(drawn) // 100))
            ]
        )
        options = RegistrationOptions(
            spot_noise_px=IMAGING.noise_px,
            frame_tolerance_mm=0.0,
            scale_tolerance=0.0,
            slice_thickness_mm=IMAGING.thickness_mm,
        )
        poses = slice_poses(arguments.poses, 7, np.zeros(3), np.array([-HEIGHT_MM, HEIGHT_MM]), TILT_DEG)
        left_out: list[int | None] = [None, *range(len(frame))]
        tried = trials(frame, poses, SCALE, options, left_out, np.random.default_rng(1))
        total = len(poses) * len(left_out)
        made = list(tqdm(tried, total=total, desc=name, disable=None, leave=False))
        counts = reasons(made)
        wrong = sum(not trial.reason and not trial.right for trial in made)
        print(
            f"{name:6} {len(frame):4}  {gaps(Layouts.of(frame)).min():6.2f}  {error:20.3f}  {random.min():11.3f}  "
            f"{np.median(random):13.3f}  {total:5}  {counts['accepted']:8}  {counts['ambiguous']:9}  {wrong:5}",
            flush=True,
        )
        failed |= error > _WANTED * float(random.min()) or counts["ambiguous"] > 0 or wrong > 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
