"""The error that a frame lets expect: against the errors that simulated spots and rendered slices bring."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame, register_spots
from stereoreg_ros.frames.expected_error import (
    Imaging,
    expected,
    point_covariances,
    pooled_error_95,
    spot_covariances,
)
from stereoreg_ros.frames.layouts import Layouts
from stereoreg_ros.frames.slice_poses import slice_poses
from stereoreg_ros.geometry.pose import Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import cut, cut_jacobian, project
from stereoreg_ros.simulation import ScannerSettings
from stereoreg_ros.simulation.rendering import Cylinder, add_metal
from stereoreg_ros.solvers.maximum_likelihood import refine
from stereoreg_ros.uncertainty import cramer_rao_pose, error_ball_95

SCALE = PixelScale(0.5, 0.5)
UPRIGHT = Imaging(SCALE, 0.3, 0.0)


def level(count: int, tilt_deg: float = 30.0):
    return slice_poses(count, 1, np.zeros(3), np.array([-8.0, 8.0]), tilt_deg)


def test_is_the_cramer_rao_bound() -> None:
    frame, poses = load_frame("cube6"), level(16)
    found = expected(Layouts.of(frame), poses, UPRIGHT)
    for row in range(len(poses)):
        lines = np.flatnonzero(found.visible[0, row])
        bound = cramer_rao_pose(frame, lines, poses.pose(row), SCALE, 0.3)
        np.testing.assert_allclose(found.covariances[0, row], bound, rtol=1e-6, atol=1e-12)


def test_slices_are_taken_as_the_registration_assumes() -> None:
    scale = PixelScale(0.4, 0.7)
    options = RegistrationOptions(
        spot_noise_px=0.25, slice_thickness_mm=2.5, frame_tolerance_mm=0.35, scale_tolerance=0.003
    )
    assert Imaging.of(scale, options) == Imaging(scale, 0.25, 2.5, 0.35, 0.003)


def test_a_rod_left_out() -> None:
    frame, poses = load_frame("cube6"), level(4)
    less = expected(Layouts.of(frame), poses, UPRIGHT, left_out=2)
    assert not less.visible[..., 2].any()
    more = expected(Layouts.of(frame), poses, UPRIGHT)
    assert (np.linalg.eigvalsh(less.covariances - more.covariances) > -1e-12).all()


@pytest.mark.parametrize(
    ("tolerance_mm", "scale_tolerance"), [(0.4, 0.0), (0.0, 0.01), (0.3, 0.005)], ids=["rods", "scale", "both"]
)
def test_errors_of_rods_and_scale_are_those_of_simulated_frames(tolerance_mm: float, scale_tolerance: float) -> None:
    """Rods whose ends are off are cut where they are, in slices that are stretched: the covariance of the spots that
    this brings, from thousands of frames, and the bound that it makes."""
    frame, poses = load_frame("cube6"), level(4)
    imaging = Imaging(SCALE, 0.1, 0.0, tolerance_mm, scale_tolerance)
    found = expected(Layouts.of(frame), poses, imaging)
    rng, drawn = np.random.default_rng(8), 6000
    off = tolerance_mm * rng.standard_normal((2, drawn, len(frame), 3))
    built = Layouts(frame.starts + off[0], frame.ends + off[1], frame.diameters)
    for row in range(len(poses)):
        lines = np.flatnonzero(found.visible[0, row])
        shifted = cut(built, poses.rotations[row], poses.translations[row]).points_mm[:, 0][:, lines]
        stretch = 1 + scale_tolerance * rng.standard_normal((drawn, 1, 2))
        noise = 0.1 * 0.5 * rng.standard_normal(shifted.shape)
        spots = (shifted * stretch + noise).reshape(drawn, -1)
        jacobian = cut_jacobian(found.cuts, poses.translations)[0, row, lines].reshape(-1, 6)
        wanted = np.linalg.inv(jacobian.T @ np.linalg.solve(np.cov(spots.T), jacobian))
        # In units in which the expected covariance is the identity, all directions count alike.
        root = np.linalg.cholesky(np.linalg.inv(found.covariances[0, row]))
        np.testing.assert_allclose(root.T @ wanted @ root, np.eye(6), atol=0.1)


def test_the_tolerance_of_the_frame_goes_before_that_of_the_options() -> None:
    frame, poses = load_frame("cube6"), level(4)
    own = replace(frame, tolerances_mm=np.array([0.3, 0.3, 0.3, np.nan, np.nan, 0.3]))
    by_frame = expected(Layouts.of(own), poses, Imaging(SCALE, 0.3, 0.0, 0.3)).covariances
    by_option = expected(Layouts.of(frame), poses, Imaging(SCALE, 0.3, 0.0, 0.3)).covariances
    np.testing.assert_array_equal(by_frame, by_option)
    larger = expected(Layouts.of(own), poses, Imaging(SCALE, 0.3, 0.0, 0.5)).covariances
    assert (np.linalg.eigvalsh(larger - by_frame) > -1e-12).all()
    assert (np.linalg.eigvalsh(larger - by_frame)[..., -1] > 1e-4).all()


@pytest.mark.parametrize(("scale_tolerance", "most"), [(0.0, 1.1), (0.002, 1.5)])
def test_is_what_the_registration_states(scale_tolerance: float, most: float) -> None:
    """Nearly so where the scale may be off: what the spots say of it does not move the frame as a whole."""
    frame, poses = load_frame("cube6"), level(6, 10.0)
    options = RegistrationOptions(scale_tolerance=scale_tolerance, max_target_error_mm=100.0)
    bound = expected(Layouts.of(frame), poses, Imaging.of(SCALE, options)).covariances[0]
    for row in range(len(poses)):
        spots, cuts = project(frame, poses.pose(row), SCALE)
        result = register_spots(spots[cuts.inside], frame, SCALE, options)
        assert result, result.message
        ratios = np.linalg.eigvals(np.linalg.solve(bound[row], result.covariance)).real
        assert ratios.min() > 0.9
        assert ratios.max() < most


def test_pooled_error_of_one_pose_is_its_ball() -> None:
    rng = np.random.default_rng(0)
    factors = rng.standard_normal((20, 3, 3))
    covariances = factors @ np.swapaxes(factors, 1, 2)
    pooled = pooled_error_95(covariances[:, None])
    np.testing.assert_allclose(pooled, [error_ball_95(one) for one in covariances], rtol=0.01)


def test_pooled_error_holds_95_percent_over_all_poses() -> None:
    """The error at a target, drawn for each pose from simulated spots and the true solver."""
    frame, poses = load_frame("cube6"), level(40)
    target = np.array([0.0, 100.0, 0.0])
    found = expected(Layouts.of(frame), poses, UPRIGHT)
    radius = pooled_error_95(point_covariances(found.covariances, poses.rotations, target))[0]
    rng = np.random.default_rng(3)
    trials, errors = 500, []
    whitening = np.broadcast_to(np.eye(2), (trials, len(frame), 2, 2))
    for row in range(len(poses)):
        pose = poses.pose(row)
        spots, cuts = project(frame, pose, SCALE)
        noisy = SCALE.to_mm(spots + 0.3 * rng.standard_normal((trials, *spots.shape)))
        used = np.broadcast_to(cuts.inside, noisy.shape[:2])
        start = np.broadcast_to(pose.rotation, (trials, 3, 3)), np.broadcast_to(pose.translation, (trials, 3))
        fitted = refine(frame, *start, noisy, used, whitening)
        errors.append(np.linalg.norm(fitted.rotations @ target + fitted.translations - pose @ target, axis=1))
    share = float(np.mean(np.concatenate(errors) < radius))
    assert share == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / (trials * len(poses))) + 0.003)


@pytest.mark.parametrize(("lean_deg", "thickness_mm"), [(0, 1), (30, 1), (45, 1), (45, 3), (60, 3), (67, 5)])
def test_leaning_rods_against_rendered_ones(lean_deg: float, thickness_mm: float) -> None:
    """The Fisher information of the rendered spot's own place, by finite differences of its image."""
    lean = math.radians(lean_deg)
    direction = np.array([math.cos(0.7) * math.sin(lean), math.sin(0.7) * math.sin(lean), math.cos(lean)])

    def image(shift, tilt, thick):
        picture = np.zeros((120, 120))
        centre = np.array([30.0 + shift[0], 30.0 + shift[1], 0.0])
        rod = Cylinder(centre - 60 * tilt, centre + 60 * tilt, 1.0)
        add_metal(picture, rod, SCALE, thick, ScannerSettings().psf_sigma_mm)
        return picture

    def information(tilt, thick):
        step = 0.02
        slopes = [
            (image(step * axis, tilt, thick) - image(-step * axis, tilt, thick)).ravel() / (2 * step)
            for axis in np.eye(2)
        ]
        return np.array([[a @ b for a in slopes] for b in slopes])

    upright = information(np.array([0.0, 0.0, 1.0]), thickness_mm)
    rendered = np.linalg.inv(information(direction, thickness_mm)) * upright[0, 0]
    rotation = rotation_between(direction)
    frame = Layouts(np.array([[[0.0, 0, -50]]]), np.array([[[0.0, 0, 50]]]), np.ones(1))
    cuts = cut(frame, rotation[None], np.zeros((1, 3)))
    modelled = spot_covariances(cuts, np.ones(1), Imaging(SCALE, 1 / 0.5, thickness_mm))[0, 0, 0]
    values, vectors = np.linalg.eigh(rendered)
    wanted = (vectors * np.maximum(values, 1.0)) @ vectors.T  # no spot counts as better than an upright one
    np.testing.assert_allclose(modelled, wanted, rtol=0.25, atol=0.1)


def rotation_between(direction):
    """A rotation that takes the z axis to a direction."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine = np.linalg.norm(axis)
    return np.eye(3) if sine == 0 else rotation_exp(np.arctan2(sine, direction[2]) * axis / sine)


class TestMeetings:
    def test_stay_within_their_ranges(self) -> None:
        nominal = rotation_exp(np.array([0.4, -0.2, 1.0]))
        middle = np.array([3.0, -4.0, 5.0])
        poses = slice_poses(300, 5, middle, np.array([-12.0, 7.0]), 25.0, nominal, 40.0)
        away = np.degrees(rotation_angle(poses.rotations @ nominal.T))
        assert away.max() <= 40 + 1e-9
        assert away.max() > 35
        cosines = (nominal @ np.swapaxes(poses.rotations, 1, 2))[:, 2, 2]
        tilts = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        np.testing.assert_allclose(tilts, poses.tilts_deg, atol=1e-4)
        assert 20 < tilts.max() <= 25 + 1e-6
        for row in (0, 17, 299):
            assert (poses.pose(row) @ middle)[2] == pytest.approx(-poses.heights_mm[row])
        assert -12 <= poses.heights_mm.min() < -11
        assert 6 < poses.heights_mm.max() <= 7

    def test_no_direction_of_the_normal_is_met_more_often_than_another(self) -> None:
        """Of the cap of a sphere, the heights above its rim are all as frequent."""
        poses = slice_poses(256, 5, np.zeros(3), np.array([0.0, 0.0]), 60.0)
        np.testing.assert_allclose(np.sort(poses.rotations[:, 2, 2]), 0.5 + (np.arange(256) + 0.5) / 512, atol=0.004)

    def test_any_turn_where_nothing_is_known(self) -> None:
        poses = slice_poses(400, 5, np.zeros(3), np.array([0.0, 0.0]), 30.0)
        turns = np.arctan2(poses.rotations[:, 1, 0], poses.rotations[:, 0, 0])
        assert np.histogram(turns, 4, (-np.pi, np.pi))[0].min() > 60

    def test_seeded(self) -> None:
        again = [slice_poses(8, seed, np.zeros(3), np.array([-1.0, 1.0]), 30.0).rotations for seed in (1, 1, 2)]
        np.testing.assert_array_equal(again[0], again[1])
        assert not np.allclose(again[0], again[2])

    def test_takes_rows(self) -> None:
        poses = level(10)
        assert isinstance(poses.take(np.array([2])).pose(0), Pose)
        np.testing.assert_array_equal(poses.take(np.array([2])).pose(0).rotation, poses.rotations[2])
