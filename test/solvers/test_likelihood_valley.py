"""The covariance of weakly determined poses against the errors of simulated ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame, register_spots
from stereoreg_ros.frames.slice_poses import slice_poses
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.solvers import likelihood_valley
from stereoreg_ros.solvers.likelihood_valley import covariance_along_valley
from stereoreg_ros.solvers.maximum_likelihood import Evaluated, refine

SCALE = PixelScale(0.5, 0.5)
ALL_SIX = np.arange(6)


def four_rods(seed: int) -> Frame:
    rng = np.random.default_rng(seed)
    starts, ends = rng.uniform(-30, 30, (2, 4, 3))
    starts[:, 2], ends[:, 2] = -30, 30
    return Frame("four", tuple("abcd"), starts, ends, np.ones(4))


def solved(frame: Frame, true: Pose, spots_px: Array, noise_px: float) -> tuple[Pose, Array, Array]:
    """The maximum-likelihood pose that is reached from the truth, its information, and the whitening."""
    whitening = np.tile(SCALE.inverse_matrix / noise_px, (len(frame), 1, 1))
    spots, used = SCALE.to_mm(spots_px)[None], np.ones((1, len(frame)), dtype=bool)
    found = refine(frame, true.rotation[None], true.translation[None], spots, used, whitening[None], 1000)
    assert found.converged[0]
    return Pose(found.rotations[0], found.translations[0]), found.information[0], whitening


def squared_error(found: Pose, true: Pose, covariance: Array) -> float:
    turned = Rotation.from_matrix(found.rotation @ true.rotation.T).as_rotvec()
    error = np.concatenate([found.translation - true.translation, turned])
    return float(error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize("noise_px", [1e-3, 0.03])
def test_of_a_straight_valley_it_is_the_inverse_of_the_information(noise_px):
    frame, pose = load_frame("cube6"), Pose(np.eye(3), np.array([40.0, 50.0, 4.0]))
    spots_px, _ = project(frame, pose, SCALE)
    _, information, whitening = solved(frame, pose, spots_px, noise_px)
    covariance = covariance_along_valley(frame, pose, ALL_SIX, SCALE.to_mm(spots_px), whitening)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9, atol=1e-15)
    # The sum over the steps of the walk is the integral to within two percent.
    shares = np.linalg.eigvals(covariance @ information).real
    np.testing.assert_allclose(shares, 1.0, atol=0.02)


def test_errors_that_spots_share_widen_it():
    """As they do the information, of which it is the inverse where the valley is straight."""
    frame, pose, noise_px = load_frame("cube6"), Pose(np.eye(3), np.array([40.0, 50.0, 4.0])), 0.01
    spots_px, _ = project(frame, pose, SCALE)
    spots_mm = SCALE.to_mm(spots_px)
    whitening = np.tile(SCALE.inverse_matrix / noise_px, (6, 1, 1))
    off = spots_mm - spots_mm.mean(axis=0)
    common = 0.01 * np.stack([off * [1, 0], off * [0, 1]], axis=-1)
    rotations, translations, used = pose.rotation[None], pose.translation[None], np.ones((1, 6), dtype=bool)
    found = refine(frame, rotations, translations, spots_mm[None], used, whitening[None], 100, common[None])
    covariance = covariance_along_valley(frame, pose, ALL_SIX, spots_mm, whitening, common)
    np.testing.assert_allclose(np.linalg.eigvals(covariance @ found.information[0]).real, 1.0, atol=0.02)
    without = covariance_along_valley(frame, pose, ALL_SIX, spots_mm, whitening)
    assert np.linalg.eigvalsh(covariance - without)[-1] > 0.2 * np.linalg.eigvalsh(without)[-1]


def test_each_rod_has_its_own_spot_weight_and_errors():
    """Five of six rods, in an order of their own, and no two known alike."""
    frame, pose = load_frame("cube6"), Pose(np.eye(3), np.array([40.0, 50.0, 4.0]))
    rng = np.random.default_rng(5)
    lines = np.array([4, 0, 3, 2, 5])
    spots_mm = SCALE.to_mm(project(frame, pose, SCALE)[0])
    whitening = np.tril(rng.uniform(50.0, 400.0, (6, 2, 2)))
    common = rng.normal(0.0, 0.005, (6, 2, 3))
    used = np.isin(np.arange(6), lines)[None]
    rotations, translations = pose.rotation[None], pose.translation[None]
    found = refine(frame, rotations, translations, spots_mm[None], used, whitening[None], 100, common[None])
    covariance = covariance_along_valley(frame, pose, lines, spots_mm[lines], whitening[lines], common[lines])
    np.testing.assert_allclose(np.linalg.eigvals(covariance @ found.information[0]).real, 1.0, atol=0.02)


def test_of_four_rods_it_is_the_mean_squared_error():
    """Over even poses, as it supposes. The inverse of the information holds no more than the bottom of the valley."""
    along, at_bottom = [], []
    for seed in (100, 104, 105, 106):
        frame, rng = four_rods(seed), np.random.default_rng(seed)
        poses = slice_poses(150, seed, np.zeros(3), np.array([-10.0, 10.0]), 30.0)
        for row in range(len(poses)):
            true = poses.pose(row)
            spots_px, cuts = project(frame, true, SCALE)
            if not cuts.inside.all():
                continue
            noisy = spots_px + 0.3 * rng.standard_normal(spots_px.shape)
            found, information, whitening = solved(frame, true, noisy, 0.3)
            at_solution = np.asarray(np.linalg.inv(information), dtype=np.float64)
            if not 0.75 < np.degrees(np.sqrt(np.linalg.eigvalsh(at_solution[3:, 3:])[-1])) < 10:
                continue
            covariance = covariance_along_valley(frame, found, np.arange(4), SCALE.to_mm(noisy), whitening)
            at_bottom.append(squared_error(found, true, at_solution))
            along.append(squared_error(found, true, covariance))
    count = len(along)
    assert count > 400
    # Of a chi-square of six degrees of freedom, three standard errors.
    assert np.mean(along) == pytest.approx(6.0, abs=3 * np.sqrt(12 / count))
    # Beyond the 99.995 % point: hardly any, while at the bottom of the valley alone it is one in a hundred.
    assert np.mean(np.array(along) > 30) <= 1 / 200
    assert np.mean(np.array(at_bottom) > 30) > 1 / 100


def test_the_registration_states_it():
    """A pose of a four-rod frame at which the bottom of the valley tells too little."""
    frame, rng = four_rods(100), np.random.default_rng(3)
    poses = slice_poses(60, 3, np.zeros(3), np.array([-10.0, 10.0]), 30.0)
    options = RegistrationOptions(
        frame_tolerance_mm=0.0,
        scale_tolerance=0.0,
        # No rod ends within so thin a slice.
        slice_thickness_mm=0.01,
        max_rotation_deg=60.0,
        max_log10_false_alarms=-4.0,
        max_target_error_mm=1000.0,
    )
    ratios = []
    for row in range(len(poses)):
        spots_px, cuts = project(frame, poses.pose(row), SCALE)
        if not cuts.inside.all():
            continue
        noisy = spots_px + 0.3 * rng.standard_normal(spots_px.shape)
        # In no rod's own row.
        result = register_spots(noisy[[2, 0, 3, 1]], frame, SCALE, options, slice_area_mm2=65536.0)
        if not result or not result.caution:
            continue
        assert "weakly determined" in result.caution or "is large for" in result.caution
        estimate = result.estimate
        lines = np.array([match.line_index for match in estimate.matches])
        spots_mm = SCALE.to_mm(np.array([match.spot_px for match in estimate.matches]))
        whitening = np.tile(SCALE.inverse_matrix / 0.3, (len(lines), 1, 1))
        stated = covariance_along_valley(frame, estimate.slice_from_frame, lines, spots_mm, whitening)
        np.testing.assert_allclose(estimate.covariance, stated, rtol=1e-6, atol=1e-12)
        _, information, _ = solved(frame, estimate.slice_from_frame, noisy[np.argsort(lines)], 0.3)
        ratios.append(np.trace(stated[3:, 3:]) / np.trace(np.linalg.inv(information)[3:, 3:]))
    assert max(ratios) > 1.5


@pytest.mark.parametrize("narrowing", [0.0, 0.05, -0.05])
def test_a_valley_whose_width_changes_counts_by_its_width(monkeypatch: pytest.MonkeyPatch, narrowing: float) -> None:
    """By hand: along x 10 mm to either side; across it 0.5 mm of y, and narrower by exp(-k x).

    What is left of the likelihood when y is integrated out is a Gaussian about x = -k a^2, and y^2 is exp(4 k^2 a^2)
    times as large as in the middle.
    """
    a, b = 10.0, 0.5
    known = np.array([np.nan, np.nan, 0.2, 1e-3, 2e-3, 3e-3])

    def evaluate(
        _frame: Frame, rotations: Array, translations: Array, _target: Array, _used: Array, *_: Array | None
    ) -> Evaluated:
        at = np.concatenate([translations, Rotation.from_matrix(rotations).as_rotvec()], axis=1)
        precision = np.tile(known**-2, (len(at), 1))
        precision[:, 0], precision[:, 1] = a**-2, b**-2 * np.exp(2 * narrowing * at[:, 0])
        information = precision[:, :, None] * np.eye(6)
        return Evaluated(rotations, translations, (precision * at**2).sum(axis=1), information, -precision * at)

    monkeypatch.setattr(likelihood_valley, "evaluate", evaluate)
    found = covariance_along_valley(four_rods(1), Pose.identity(), np.arange(4), np.zeros((4, 2)), np.zeros((4, 2, 2)))
    tilt = (narrowing * a) ** 2
    expected = [a**2 * (1 + tilt), b**2 * np.exp(4 * tilt), *known[2:] ** 2]
    # The steps of the walk are short enough for two percent.
    np.testing.assert_allclose(np.diag(found), expected, rtol=0.02)
    np.testing.assert_allclose(found - np.diag(np.diag(found)), 0.0, atol=1e-6)


def test_a_valley_without_an_end_gives_what_is_seen_of_it():
    """Rods at right angles to the slice fix no height."""
    starts = np.array([[0.0, 0, -30], [40, 0, -30], [0, 40, -30], [40, 45, -30]])
    frame = Frame("pins", tuple("abcd"), starts, starts + np.array([0, 0, 60]), np.ones(4))
    pose = Pose(np.eye(3), np.array([50.0, 50.0, 0.0]))
    spots_px, _ = project(frame, pose, SCALE)
    whitening = np.tile(SCALE.inverse_matrix / 0.3, (4, 1, 1))
    covariance = covariance_along_valley(frame, pose, np.arange(4), SCALE.to_mm(spots_px), whitening)
    assert np.isfinite(covariance).all()
    assert covariance[2, 2] > 100.0**2
