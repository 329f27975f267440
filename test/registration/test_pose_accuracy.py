"""Are poses as far off as they say: short, seeded versions of `python -m benchmarks.uncertainty`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, load_frame, register_spots
from stereoreg_ros.geometry.pose import Pose, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.simulation import ScannerSettings, random_pose
from support.pose_statistics import PoseStatistics, pose_error
from support.stated_errors import RENDERED_CASES, SPOT_CASES, WORST_CASES, Case, is_sound, measure, within_limits
from support.worst_cases import count_worst_cases


def assert_consistent(found: PoseStatistics, least: int) -> None:
    """Within four standard deviations of what is right, as for a test that is to fail for a reason alone."""
    print(f"{found.accepted} accepted, NEES {found.nees:.3f}, held {np.round(found.coverage, 3).tolist()}")
    assert found.accepted >= least
    assert abs(found.nees - 6) < 4 * np.sqrt(12 / found.accepted)
    assert (np.abs(found.coverage - 0.95) < 4 * np.sqrt(0.95 * 0.05 / found.accepted)).all()


@pytest.mark.parametrize("case", [SPOT_CASES[0], SPOT_CASES[-1]], ids=lambda case: case.name)
def test_spot_sets(case: Case) -> None:
    assert_consistent(measure(case, 150, 3), 120)


def test_rendered_slices() -> None:
    assert_consistent(measure(RENDERED_CASES[2], 60, 3), 58)


def test_a_wrong_covariance_is_noticed() -> None:
    """Spots of 0.15 pixel of noise that are said to have 0.1: twice the squared error, and balls that are too small."""
    rng, frame, scanner = np.random.default_rng(4), load_frame("cube6"), ScannerSettings()
    found = PoseStatistics()
    options = RegistrationOptions(spot_noise_px=0.1, frame_tolerance_mm=0.0, scale_tolerance=0.0)
    for _ in range(150):
        pose = random_pose(rng, frame, scanner)
        spots = project(frame, pose, scanner.scale)[0] + rng.normal(0, 0.15, (6, 2))
        found.add(register_spots(spots, frame, scanner.scale, options), pose)
    assert found.accepted > 100
    assert found.nees > 6 + 4 * np.sqrt(12 / found.accepted)
    assert found.coverage.max() < 0.93
    assert not within_limits(Case("cube6", 6), found)


def test_error_is_the_perturbation() -> None:
    rng = np.random.default_rng(5)
    stated = Pose(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    step = np.array([1.0, -2.0, 3.0, 0.01, 0.02, -0.03])
    np.testing.assert_allclose(pose_error(stated, stated.perturbed(step[:3], step[3:])), step, atol=1e-12)


@pytest.mark.parametrize(("case", "max_error_px", "linear"), WORST_CASES[1:4:2], ids=str)
def test_worst_cases(case: Case, max_error_px: float, linear: bool) -> None:
    found = count_worst_cases(case.make_frame(), max_error_px, 3000, 3)
    assert found.trials >= 3000
    assert is_sound(found, linear)
    # Beyond the bounds of a smaller error there is much, or the trials would show nothing.
    assert found.nearest > 0.85
    assert not is_sound(replace(found, exceeded=1), linear)
