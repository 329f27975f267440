"""From rendered slice to pose: all but none of the slices accepted, and no wrong pose among them."""

from __future__ import annotations

import numpy as np

from stereoreg_ros import load_frame, register_slice
from stereoreg_ros.geometry.pose import rotation_angle
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice

SLICES = 100


def test_cube_with_false_spots_and_a_missing_rod():
    frame = load_frame("cube6")
    rng = np.random.default_rng(2009)
    accepted, errors = 0, []
    for _ in range(SLICES):
        settings = ScannerSettings(false_spots=int(rng.integers(0, 9)), needle=bool(rng.integers(2)))
        truth = random_pose(rng, frame, settings)
        hidden = tuple(rng.choice(frame.line_names, rng.integers(0, 2), replace=False))
        ct_slice = render_slice([PlacedFrame(frame, truth, hidden)], settings, rng)
        result = register_slice(ct_slice, frame)
        if result:
            accepted += 1
            found = result.scanner_from_frame
            turn = np.degrees(rotation_angle(found.rotation @ truth.rotation.T))
            errors.append((np.linalg.norm(found.translation - truth.translation), turn))
    position, rotation = np.array(errors).T
    print(
        f"{accepted} of {SLICES} accepted; error median {np.median(position):.3f} mm, {np.median(rotation):.3f} deg, "
        f"largest {position.max():.3f} mm, {rotation.max():.3f} deg"
    )
    assert position.max() <= 1.5
    assert rotation.max() <= 2.0
    assert accepted >= 0.99 * SLICES
